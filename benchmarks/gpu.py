"""Smoothers, particle filters and one EM epoch on a GPU beside the CPU of the same machine: docs/results/throughput.md.

    python benchmarks/gpu.py [--platforms cpu cuda] [--quick]

The work is that of throughput.py, in 32 bits; the epoch is that of `nnap-em identify` on the paper's acrobot, in 64.
"""

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from datetime import date
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
ROUNDS = 3


def rows(quick: bool) -> dict[str, Callable]:
    """Work by its name: each compiles when called, and gives the function that is timed."""
    from common_work import Size, filter_case, particle_default, paths_case, smoother_case, wide_bank

    from nnap_em.smoother.gaussian import CubatureSmoother, ExtendedKalmanSmoother
    from nnap_em.smoother.particle import Bootstrap, ExactBackward, Guided

    many, most = (40, 1000) if quick else (640, 10_000)
    cases = [
        smoother_case("extended Kalman smoother", ExtendedKalmanSmoother(wide_bank), Size()),
        smoother_case("extended Kalman smoother", ExtendedKalmanSmoother(wide_bank), Size(many)),
        smoother_case("sigma-point smoother", CubatureSmoother(wide_bank), Size()),
        smoother_case("sigma-point smoother", CubatureSmoother(wide_bank), Size(many)),
        filter_case("guided", Guided(), Size(particles=1000)),
        filter_case("guided", Guided(), Size(particles=most)),
        paths_case("bootstrap, exact backward sampling", Bootstrap(), ExactBackward(), Size(2, 500, most // 5)),
        smoother_case("particle smoother, 300", particle_default(), Size()),
    ]
    return {f"{case.what}, {case.size.sequences} x {case.size.steps}": case.prepare for case in cases}


def epoch() -> Callable:
    """One EM epoch of `nnap-em identify` on the paper's acrobot; last, because 64 bits are for good."""
    import jax
    from identify import paper_rig

    from nnap_em.em.loop import em_step
    from nnap_em.fit.identify import begin
    from nnap_em.model.simulate import paper_experiment, paper_model
    from nnap_em.smoother.gaussian import CubatureSmoother

    jax.config.update("jax_enable_x64", True)
    key = jax.random.key(0)
    data = paper_experiment(paper_model(), 20, 500, key=key).data
    first = begin(paper_rig(0.5), data, key=key)
    smoother = CubatureSmoother(first.bank)
    return lambda: em_step(first.model, data, smoother, first.m_step, key)[1:]


def child(quick: bool) -> None:
    """Times of all rows on the platform of this process: a line of JSON for each."""
    import jax

    def timed(run):
        began = time.perf_counter()
        jax.block_until_ready(run())
        return time.perf_counter() - began

    for name, prepare in [*rows(quick).items(), ("EM epoch, sigma-point, 64 bits, 20 x 500", epoch)]:
        began = time.perf_counter()
        try:
            run = prepare()
            first = time.perf_counter() - began + timed(run)
            spent = sorted(timed(run) for _ in range(ROUNDS))[ROUNDS // 2]
        except (RuntimeError, TypeError, ValueError) as error:  # the other rows are of use without it
            row = {"failed": str(error).splitlines()[0]}
        else:
            row = {"first": first, "time": spent, "where": str(jax.devices()[0])}
        for stream in (sys.stderr, sys.stdout):
            print(json.dumps({"name": name} | row), file=stream, flush=True)


def measured(name: str, quick: bool) -> list[dict]:
    """All rows of a platform, in a process of its own."""
    with tempfile.TemporaryDirectory() as cache:
        environment = os.environ | {"JAX_PLATFORMS": name, "PYTHONPATH": str(ROOT), "JAX_COMPILATION_CACHE_DIR": cache}
        done = subprocess.run(
            [sys.executable, __file__, "--child", *(["--quick"] if quick else [])],
            env=environment,
            stdout=subprocess.PIPE,
            text=True,
            check=False,
        )
        return [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]


def main() -> None:
    """Print the table."""
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--platforms", nargs="+", default=["cpu", "cuda"])
    arguments.add_argument("--quick", action="store_true", help="less work, to see that all rows run")
    arguments.add_argument("--child", action="store_true", help=argparse.SUPPRESS)
    args = arguments.parse_args()
    if args.child:
        child(args.quick)
        return
    found = {name: measured(name, args.quick) for name in args.platforms}
    print(f"{date.today()}, {platform.machine()}, {len(os.sched_getaffinity(0))} cores, `{' '.join(sys.argv)}`\n")
    print(f"| work | {' | '.join(f'{name} [s] | first [s]' for name in found)} |")
    print("| --- " * (1 + 2 * len(found)) + "|")
    for name in dict.fromkeys(row["name"] for each in found.values() for row in each):
        cells = []
        for each in found.values():
            row = next((row for row in each if row["name"] == name), {})
            cells += [f"{row['time']:.4g}", f"{row['first']:.3g}"] if "time" in row else [row.get("failed", "-"), "-"]
        print(f"| {name} | {' | '.join(cells)} |")
    print("\n" + "; ".join(f"{name}: {each[0].get('where', each[0])}" for name, each in found.items() if each))


if __name__ == "__main__":
    main()
