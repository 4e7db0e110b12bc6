"""Compiled programs are let go only where they hold too many memory maps."""

import jax

from nnap_em.numerics import programs


def test_programs_are_released_beyond_the_bound(monkeypatch):
    cleared = []
    monkeypatch.setattr(jax, "clear_caches", lambda: cleared.append(True))
    monkeypatch.setattr(programs, "maps", lambda: 50)
    assert not programs.release_programs(50) and not cleared
    assert programs.release_programs(49) and cleared == [True]
