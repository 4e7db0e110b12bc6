"""Time of a run by stage, and by program: those that were traced, lowered and compiled or loaded."""

import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

import jax

STAGES = {
    "/jax/core/compile/jaxpr_trace_duration": "trace",
    "/jax/core/compile/jaxpr_to_mlir_module_duration": "lower",
    "/jax/core/compile/backend_compile_duration": "compile",
    "/nnap_em/stage": "run",
}
"""Events of JAX about a program, of which loading a cached one counts as compiling it, and of `stage`."""
_inside: ContextVar[bool] = ContextVar("nnap_em_stage", default=False)


@contextmanager
def stage(name: str) -> Iterator[None]:
    """Count the time inside as that of a stage of the run; a stage within another is part of that."""
    token, began = _inside.set(True), time.perf_counter()
    try:
        yield
    finally:
        _inside.reset(token)
        if not _inside.get():
            jax.monitoring.record_event_duration_secs("/nnap_em/stage", time.perf_counter() - began, fun_name=name)


class Profile:
    """The seconds of every stage of every program so far."""

    def __init__(self) -> None:
        self.spent: dict[str, dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
        self._began = time.perf_counter()

    def __call__(self, event: str, duration_secs: float, **labels: str | int) -> None:
        """One event, as `jax.monitoring` reports it."""
        if event in STAGES:
            name = str(labels.get("fun_name", "?")).removeprefix("jit(").removesuffix(")").removeprefix("jit_")
            self.spent[name][STAGES[event]].append(duration_secs)

    def __str__(self) -> str:
        named = [(name, [stages[stage] for stage in STAGES.values()]) for name, stages in self.spent.items()]
        named.sort(key=lambda row: -sum(map(sum, row[1])))
        every = [[seconds for _, cells in named for seconds in cells[i]] for i in range(len(STAGES))]
        rows = [(name, cells) for name, cells in named if cells[2] or cells[3]]
        rows.append((f"all of {len(rows)} names", every))
        head = "".join(f"{stage + ' s':>10}" for stage in STAGES.values())
        lines = [f"{'stage or program':32} {'count':>8}{head}"]
        for name, cells in rows:
            count = len(cells[2] or cells[3])
            lines.append(f"{name:32.32} {count:8}" + "".join(f"{sum(cell):10.2f}" for cell in cells))
        elapsed = time.perf_counter() - self._began
        lines.append(f"{elapsed:.1f} s in all; a program within another is traced with it, and counts in both")
        return "\n".join(lines)


@contextmanager
def profiling(show: bool = False) -> Iterator[Profile]:
    """The programs that this process makes inside; `show`: their table is printed at the end, also after a stop."""
    profile = Profile()
    jax.monitoring.register_event_duration_secs_listener(profile)
    try:
        yield profile
    finally:
        jax.monitoring.unregister_event_duration_listener(profile)
        if show:
            print(profile)
