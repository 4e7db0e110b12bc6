"""The cost of a test run: programs compiled in the test processes, and the order in which files are run.

A plugin of pytest (`conftest.py` registers it).  Processes that tests start are not counted.
"""

import jax
import pytest

LONGEST_FIRST = (
    "test_design.py",
    "test_particle.py",
    "test_loop.py",
    "test_docs.py",
    "test_faults.py",
    "test_parallel.py",
    "test_machines.py",
    "test_predict.py",
    "test_kalman.py",
    "test_calibration.py",
    "test_cli.py",
    "test_measured.py",
    "test_em.py",
    "test_rough.py",
    "test_mutants.py",
)
"""Files of more than half a minute: a worker takes a whole file, and a long one at the end would be waited for."""

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

    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        """Sort files by `LONGEST_FIRST`; the tests of a file keep their order."""
        rank = {name: i for i, name in enumerate(LONGEST_FIRST)}
        items.sort(key=lambda item: rank.get(item.path.name, len(rank)))

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
        compiled, found = self.total["programs"] - self.total["found"], self.total["found"]
        line = f"{compiled} programs compiled in {self.total['seconds']:.0f} s, {found} more taken from the cache"
        terminalreporter.write_line(line)
