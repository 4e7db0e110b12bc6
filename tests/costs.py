"""The cost of a test run: programs compiled in the test processes, and the order in which files are run.

A plugin of pytest (`conftest.py` registers it).  Processes that tests start are not counted.
"""

import jax
import pytest

SECONDS = {
    "test_loop.py": 41,
    "test_design.py": 35,
    "test_equation_laws.py": 29,
    "test_online.py": 29,
    "test_mstep.py": 24,
    "test_cli.py": 23,
    "test_observer.py": 20,
    "test_multistep.py": 19,
    "test_public.py": 19,
    "test_particle.py": 19,
    "test_changed.py": 16,
    "test_predict.py": 16,
    "test_written_back.py": 15,
    "test_mixture.py": 14,
    "test_kalman.py": 14,
    "test_em.py": 14,
    "test_sensors.py": 13,
    "test_equations.py": 12,
    "test_effects.py": 11,
    "test_machines.py": 10,
    "test_unroll.py": 10,
    "test_inputs.py": 10,
    "test_compare.py": 10,
    "test_check.py": 10,
}
"""Processor time of the files that take more than ten seconds where nothing is compiled yet [s].

A worker takes a whole file, and a long one at the end would be waited for: files are run in this order, and those that
are not named come last.  `make check` leaves these out (marker `large`).
"""

_COMPILE = "/jax/core/compile/backend_compile_duration"
_RETRIEVE = "/jax/compilation_cache/cache_retrieval_time_sec"
_HIT = "/jax/compilation_cache/cache_hits"


class Costs:
    """Programs and seconds of compilation of this process and, after a run by xdist, of its workers."""

    def __init__(self):
        self.total = {"programs": 0, "found": 0, "seconds": 0.0}
        jax.monitoring.register_event_duration_secs_listener(self._duration)
        jax.monitoring.register_event_listener(self._event)

    def _duration(self, name: str, seconds: float, **_) -> None:
        if name == _COMPILE:  # a program that the cache holds counts here, too
            self.total["programs"] += 1
            self.total["seconds"] += seconds
        elif name == _RETRIEVE:
            self.total["seconds"] -= seconds

    def _event(self, name: str, **_) -> None:
        if name == _HIT:
            self.total["found"] += 1

    @pytest.hookimpl(tryfirst=True)  # before tests are chosen by their markers
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        """Sort files by `SECONDS`; the tests of a file keep their order."""
        items.sort(key=lambda item: -SECONDS.get(item.path.name, 0))
        for item in items:
            if item.path.name in SECONDS:
                item.add_marker("large")

    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        """Hand the costs of a worker to the process that started it."""
        if hasattr(session.config, "workeroutput"):
            session.config.workeroutput["costs"] = self.total

    @pytest.hookimpl(optionalhook=True)
    def pytest_testnodedown(self, node) -> None:
        """Add the costs of a worker."""
        for name, value in getattr(node, "workeroutput", {}).get("costs", {}).items():
            self.total[name] += value

    def pytest_terminal_summary(self, terminalreporter) -> None:
        """Print one line."""
        compiled, cached = self.total["programs"] - self.total["found"], self.total["found"]
        line = f"{compiled} programs compiled in {self.total['seconds']:.0f} s, {cached} more taken from the cache"
        terminalreporter.write_line(line)
