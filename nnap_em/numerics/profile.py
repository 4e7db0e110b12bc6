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
    """The count and the seconds of every stage of every program so far."""

    def __init__(self) -> None:
        self.spent: dict[str, dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
        self._began = time.perf_counter()

    def __call__(self, event: str, duration_secs: float, **labels: str | int) -> None:
        """One event, as `jax.monitoring` reports it."""
        if event in STAGES:
            name = str(labels.get("fun_name", "?")).removeprefix("jit(").removesuffix(")").removeprefix("jit_")
            self.spent[name][STAGES[event]].append(duration_secs)

    def __str__(self) -> str:
        elapsed = time.perf_counter() - self._began
        row = lambda *cells: "{:32.32} {:>8} {:>9} {:>9} {:>9} {:>9}".format(*cells)  # noqa: E731
        seconds = lambda stages: [f"{sum(stages[stage]):.2f}" for stage in STAGES.values()]  # noqa: E731
        order = sorted(self.spent.items(), key=lambda one: -sum(map(sum, one[1].values())))
        programs = [(name, stages) for name, stages in order if stages["compile"] or stages["run"]]
        every = {stage: [s for _, stages in order for s in stages[stage]] for stage in STAGES.values()}
        return "\n".join(
            [
                row("stage or program", "count", "trace s", "lower s", "compile s", "run s"),
                *(row(name, len(stages["compile"] or stages["run"]), *seconds(stages)) for name, stages in programs),
                row(f"all of {len(programs)} names", len(every["compile"]), *seconds(every)),
                f"{elapsed:.1f} s in all; a program within another is traced with it, and counts in both",
            ]
        )


@contextmanager
def profiling() -> Iterator[Profile]:
    """The programs that this process makes inside."""
    profile = Profile()
    jax.monitoring.register_event_duration_secs_listener(profile)
    try:
        yield profile
    finally:
        jax.monitoring.unregister_event_duration_listener(profile)
