"""Flags of the compiler are set where it knows them; programs are released where they hold too many memory maps."""

import os

import jax
import pytest

from nnap_em.numerics import programs


def test_programs_are_released_beyond_the_bound(monkeypatch):
    cleared = []
    monkeypatch.setattr(jax, "clear_caches", lambda: cleared.append(True))
    monkeypatch.setattr(programs, "maps", lambda: 50)
    assert not programs.release_programs(50) and not cleared
    assert programs.release_programs(49) and cleared == [True]


@pytest.mark.parametrize(
    "version, before, after",
    [
        ("0.10.2", "", "--xla_cpu_use_fusion_emitters=false"),
        ("0.10.2", "--xla_a=1", "--xla_a=1 --xla_cpu_use_fusion_emitters=false"),
        ("0.10.2", "--xla_cpu_use_fusion_emitters=true", "--xla_cpu_use_fusion_emitters=true"),
        ("0.11.0", "--xla_a=1", "--xla_a=1"),
    ],
)
def test_the_older_emitters_are_asked_for_where_they_are_known(version, before, after, monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", before)
    monkeypatch.setattr(programs.version, "__version__", version)
    programs.use_older_emitters()
    assert os.environ["XLA_FLAGS"] == after
