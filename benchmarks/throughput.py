"""Speed of the smoothers beside their peers, one core, rows of a table in turn: docs/results/throughput.md.

    JAX_NUM_CPU_DEVICES=1 XLA_FLAGS=--xla_cpu_multi_thread_eigen=false \\
        taskset -c 0 python benchmarks/throughput.py [--quick] [--only filter ...]

Peers come with `pip install .[bench]`; a peer that is not installed has no row.
"""

import argparse
import importlib.util
import time
from collections.abc import Callable

import jax
import numpy as np
from common_work import Case, Size, common_logs, filter_case, one_start, paths_case, smoother_case, wide_bank
from peers import cuthbert_case, cuthbert_exact, dynamax_case
from runner import made

from nnap_em.estimate.smoother.gaussian import CubatureSmoother, ExtendedKalmanSmoother
from nnap_em.estimate.smoother.particle import Bootstrap, ExactBackward, Guided

BUDGET = 5.0
"""Time of a row after its third run [s]."""


def gaussian(kind: type, rule: str, size: Size) -> list[Case]:
    """Rows of a Gaussian smoother and of dynamax's."""
    plain = size._replace(particles=0)
    return [
        smoother_case("one start, one pass", kind(one_start, iterations=0), plain),
        smoother_case("as the library sets it", kind(one_start), plain),
        smoother_case("13 starts", kind(wide_bank), plain),
        dynamax_case(rule, False, plain),
        dynamax_case(rule, True, plain),
    ]


def particle_filters(size: Size) -> list[Case]:
    """Rows of the particle filters."""
    name = f"bootstrap filter, {size.particles}"
    return [
        filter_case("bootstrap", Bootstrap(), size),
        filter_case("guided", Guided(), size),
        cuthbert_case(name, False, size),
        cuthbert_case(name, True, size),
    ]


def backward(size: Size) -> list[Case]:
    """Rows of exact backward sampling, as many trajectories as particles."""
    pair = size._replace(sequences=2, particles=size.particles // 2)
    return [
        paths_case("bootstrap, exact backward", Bootstrap(), ExactBackward(), pair),
        cuthbert_case("bootstrap, exact backward", False, pair, cuthbert_exact),
    ]


TABLES: dict[str, tuple[str, Callable[[Size], list[Case]]]] = {
    "extended": ("Extended Kalman filter + RTS", lambda size: gaussian(ExtendedKalmanSmoother, "extended", size)),
    "sigma-point": ("Sigma-point filter + RTS", lambda size: gaussian(CubatureSmoother, "unscented", size)),
    "filter": ("Particle filter", particle_filters),
    "exact": ("Particle filter + exact backward sampling, as many trajectories as particles", backward),
}


def timed(run: Callable) -> tuple[float, object]:
    """Time of one run [s], and its result."""
    began = time.perf_counter()
    result = jax.block_until_ready(run())
    return time.perf_counter() - began, result


def measured(cases: list[Case], repeats: int) -> list[tuple[Case, float, float]]:
    """Median time of a run [s] and RMSE of theta2 [rad]: 3 rounds in turn, then until `repeats` or `BUDGET`."""
    cases = [case for case in cases if case.who == "nnap_em" or importlib.util.find_spec(case.who)]
    runs = [case.prepare() for case in cases]
    times, errors = [], []
    for case, run in zip(cases, runs, strict=True):
        seconds, result = timed(run)
        error = np.asarray(case.states(result)) - np.asarray(common_logs(case.size).x)
        times.append([seconds])
        errors.append(float(np.sqrt(np.mean(error[..., 1] ** 2))))
        del result
    for turn in range(1, repeats):
        for run, spent in zip(runs, times, strict=True):
            if turn < 3 or sum(spent) < BUDGET:
                spent.append(timed(run)[0])
    return list(zip(cases, map(np.median, times), errors, strict=True))


def lines(rows: list[tuple[Case, float, float]]) -> list[str]:
    """Table of sequence-steps a second, the ratio to the best peer, and errors."""
    paces = [case.size.sequences * case.size.steps / seconds for case, seconds, _ in rows]
    peers = [pace for (case, *_), pace in zip(rows, paces, strict=True) if case.who != "nnap_em"]
    out = ["| program | row | sequence-steps/s | x best peer | theta2 [rad] |", "| --- " * 5 + "|"]
    for (case, _, error), pace in zip(rows, paces, strict=True):
        ratio = f"{pace / max(peers):.2f}" if peers and case.who == "nnap_em" else ""
        out.append(f"| {case.who} | {case.what} | {pace:.3g} | {ratio} | {error:.3g} |")
    return out


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a small size of everything, to see that it runs")
    parser.add_argument("--only", nargs="+", choices=TABLES, default=list(TABLES))
    args = parser.parse_args()
    size = Size(3, 60, 200) if args.quick else Size(20, 500, 1000)
    names = [name for name in ("dynamax", "cuthbert") if importlib.util.find_spec(name)]
    print(made(*names))
    for name in args.only:
        title, cases = TABLES[name]
        print(f"\n## {title}\n", *lines(measured(cases(size), 3 if args.quick else 7)), sep="\n", flush=True)


if __name__ == "__main__":
    main()
