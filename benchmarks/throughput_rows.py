"""The measurements of benchmarks/throughput.py that need JAX, each in a process of its own; JSON on stdout.

python benchmarks/throughput_rows.py ORDER, a JSON object that benchmarks/throughput.py makes.
"""

import gc
import importlib.util
import json
import sys
import time
from pathlib import Path

import jax
import numpy as np
from common_work import (
    Case,
    Size,
    common_logs,
    common_model,
    filter_case,
    one_start,
    particle_default,
    paths_case,
    smoother_case,
    wide_bank,
)
from limits import c_case, c_smoother_case, transition_case
from peers import cuthbert_case, cuthbert_exact, dynamax_case, natural_transition, particles_case

from nnap_em.em.loop import e_step, em_step
from nnap_em.fit.identify import begin
from nnap_em.model.simulate import paper_experiment, paper_model
from nnap_em.model.state_space import Inputs
from nnap_em.numerics.parallel import use_every_device
from nnap_em.smoother.gaussian import CubatureSmoother, ExtendedKalmanSmoother
from nnap_em.smoother.particle import Bootstrap, ExactBackward, Guided, ParticleSmoother

LOST = 0.3
"""A sequence is lost where the estimate of theta2 is off by more, root mean square [rad]."""


def groups(whole: Size, quick: bool) -> dict[str, list[Case]]:
    """Rows that are timed in turn, by the name of their table; `whole.particles` is the largest number of particles."""
    most = whole.particles
    plain, half = whole._replace(particles=0), whole._replace(particles=most // 2)
    pair = half._replace(sequences=2)
    sizes = (whole,) if quick else (whole._replace(particles=most // 10), half, whole)
    limit = whole._replace(steps=whole.steps // 5, particles=64 * -(-most // 64))
    transition = lambda x, u: common_model().transition(x, Inputs.held(u))  # noqa: E731
    return {
        "extended": [
            smoother_case("one start, one pass", ExtendedKalmanSmoother(one_start, iterations=0), plain),
            smoother_case("as the library sets it", ExtendedKalmanSmoother(one_start), plain),
            smoother_case("13 starts", ExtendedKalmanSmoother(wide_bank), plain),
            dynamax_case("extended", False, plain),
            dynamax_case("extended", True, plain),
            c_smoother_case(plain),
        ],
        "sigma-point": [
            smoother_case("one start, one pass", CubatureSmoother(one_start, iterations=0), plain),
            smoother_case("as the library sets it", CubatureSmoother(one_start), plain),
            smoother_case("13 starts", CubatureSmoother(wide_bank), plain),
            dynamax_case("unscented", False, plain),
            dynamax_case("unscented", True, plain),
        ],
        "filter": [
            transition_case("our transition alone", transition, 1, limit),
            transition_case("natural transition alone", natural_transition(common_model()), 0, limit),
            c_case("C transition", (), limit),
            c_case("C transition, 512-bit vectors", ("-mprefer-vector-width=512",), limit),
            *(filter_case("bootstrap", Bootstrap(), size) for size in sizes),
            *(filter_case("guided", Guided(), size) for size in sizes),
            *(cuthbert_case(f"bootstrap filter, {size.particles}", False, size) for size in sizes),
            cuthbert_case(f"bootstrap filter, {most}", True, whole),
            *(particles_case(size._replace(sequences=2)) for size in sizes),
        ],
        "exact": [
            paths_case("bootstrap, exact backward", Bootstrap(), ExactBackward(), pair),
            cuthbert_case("bootstrap, exact backward", False, pair, cuthbert_exact),
        ],
    }


def installed(case: Case) -> bool:
    """Whether the package of a row is there."""
    return case.who in ("nnap_em", "limit") or importlib.util.find_spec(case.who) is not None


def say(*words) -> None:
    """Progress."""
    print(*words, file=sys.stderr, flush=True)


def seconds(run) -> tuple[float, object]:
    """Time of one run [s], and its result."""
    began = time.perf_counter()
    result = jax.block_until_ready(run())
    return time.perf_counter() - began, result


def quality(case: Case, result) -> dict:
    """Root mean square errors of the four states, and the number of lost sequences."""
    if case.states is None:
        return {}
    error = np.asarray(case.states(result)) - np.asarray(common_logs(case.size).x)
    lost = np.sqrt(np.mean(error[..., 1] ** 2, axis=1)) > LOST
    return {"rmse": np.sqrt(np.mean(error**2, axis=(0, 1))).tolist(), "lost": int(lost.sum())}


def speed(group: str, size: list[int], quick: bool, repeats: int, budget: float) -> list[dict]:
    """Times of all rows of a group in turn: 3 rounds, then until `repeats` or `budget` [s] of each row."""
    rows, runs, times = [], [], []
    for case in filter(installed, groups(Size(*size), quick)[group]):
        common_logs(case.size)
        began = time.perf_counter()
        runs.append(case.prepare())
        compile_s = time.perf_counter() - began
        first, result = seconds(runs[-1])
        say(f"  {case.who}: {case.what}: {compile_s:.1f} s to compile, {1e3 * first:.0f} ms")
        times.append([first])
        rows.append({"who": case.who, "what": case.what, "size": case.size, "compile": compile_s})
        rows[-1] |= quality(case, result)
        del result
    for turn in range(1, repeats):
        for run, spent in zip(runs, times, strict=True):
            if turn < 3 or sum(spent) < budget:
                spent.append(seconds(run)[0])
    return [row | {"times": spent} for row, spent in zip(rows, times, strict=True)]


def resident(field: str) -> int:
    """Memory of this process [B]: VmRSS now, VmHWM at most since `forget_peak`."""
    line = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith(field))
    return 1024 * int(line.split()[1])


def forget_peak() -> int:
    """Start a new VmHWM; the memory now [B]."""
    gc.collect()
    Path("/proc/self/clear_refs").write_text("5")
    return resident("VmRSS")


def memory(group: str, size: list[int], quick: bool) -> list[dict]:
    """Peak memory of one run of every row of a group, beyond what the compiled program and the logs take."""
    rows = []
    for case in filter(installed, groups(Size(*size), quick)[group]):
        run = case.prepare()
        before = forget_peak()
        seconds(run)
        rows.append({"who": case.who, "what": case.what, "memory": resident("VmHWM") - before})
        say(f"  {case.who}: {case.what}: {rows[-1]['memory'] / 1e6:.0f} MB")
    return rows


def growth(smoother: str, axis: str, points: list[int], base: list[int]) -> list[dict]:
    """Time and peak memory of `e_step` along one axis of `Size`."""
    rows = []
    for point in points:
        size = Size(*base)._replace(**{axis: point})
        rule = particle_default(size.particles, 25) if smoother == "particle" else ExtendedKalmanSmoother(wide_bank)
        run = smoother_case(smoother, rule, size).prepare()
        before = forget_peak()
        times = [seconds(run)[0]]
        peak = resident("VmHWM") - before
        while len(times) < 3 and sum(times) < 2:
            times.append(seconds(run)[0])
        rows.append({"point": point, "time": float(np.median(times)), "memory": peak})
        say(f"  {smoother} smoother, {point} {axis}: {rows[-1]['time']:.2f} s, {peak / 1e6:.0f} MB")
    return rows


def cores(size: list[int], repeats: int) -> dict[str, float]:
    """Time of `e_step` on the cores that this process was given [s]."""
    use_every_device()
    logs = common_logs(Size(*size)).data
    rules = {"extended": ExtendedKalmanSmoother(wide_bank), "particle": particle_default()}
    out = {}
    for name, rule in rules.items():
        run = lambda rule=rule: e_step(common_model(), logs, rule, key=jax.random.key(2))  # noqa: E731
        seconds(run)
        out[name] = float(np.median([seconds(run)[0] for _ in range(repeats)]))
        say(f"  {name}: {out[name]:.2f} s")
    return out


def large(size: list[int]) -> dict[str, float]:
    """Time [s] and peak memory [B] of the particle smoother on more than fits into memory at once."""
    use_every_device()
    whole = Size(*size)
    logs = common_logs(whole).data
    before = forget_peak()
    rule = particle_default(whole.particles, 25)
    spent, _ = seconds(lambda: e_step(common_model(), logs, rule, key=jax.random.key(2)))
    return {"time": spent, "memory": resident("VmHWM") - before}


def epoch(size: list[int], repeats: int) -> dict[str, dict]:
    """Time of one EM epoch, as `nnap-em identify` runs it on the paper's acrobot, in 64 bits [s]."""
    from identify import paper_rig

    jax.config.update("jax_enable_x64", True)
    use_every_device()
    key = jax.random.key(0)
    data = paper_experiment(paper_model(), size[0], size[1], key=key).data
    first = begin(paper_rig(0.5), data, key=key)
    guide = CubatureSmoother(first.bank)
    out = {}
    for name, smoother in {"cubature RTS": guide, "particle 300": ParticleSmoother(guide)}.items():
        run = lambda smoother=smoother: em_step(first.model, data, smoother, first.m_step, key)[1:]  # noqa: E731
        once, _ = seconds(run)
        typical = float(np.median([seconds(run)[0] for _ in range(repeats)]))
        out[name] = {"time": typical, "compile": once - typical}
        say(f"  {name}: {typical:.2f} s, {once - typical:.1f} s to compile")
    return out


tasks = {"speed": speed, "memory": memory, "growth": growth, "cores": cores, "large": large, "epoch": epoch}

if __name__ == "__main__":
    order = json.loads(sys.argv[1])
    print(json.dumps(tasks[order.pop("task")](**order)))
