"""Compiled programs: their table, the flags of the compiler, and their release where they hold too many memory maps."""

import jax
import jax.numpy as jnp

from nnap_em.numerics import programs
from nnap_em.numerics.parallel import each
from nnap_em.numerics.profile import profiling


def test_programs_are_counted_once_for_every_shape_and_by_name(capsys):
    @jax.jit
    def cube(x):
        return x**3

    with profiling(show=True) as profile:
        for size in (3, 4, 3):
            cube(jnp.ones(size))
    seconds = profile.spent["cube"]["compile"]
    assert len(seconds) == 2
    rows = {line.split()[0]: line.split() for line in capsys.readouterr().out.splitlines()}
    assert rows["cube"][1] == "2" and rows["cube"][4] == f"{sum(seconds):.2f}"
    count = len(profile.spent)
    jax.jit(lambda x: x + 1)(jnp.arange(7))  # after it
    assert len(profile.spent) == count


def _scaled(common, one):
    return common * one


def test_a_program_for_every_sequence_is_compiled_once_whether_or_not_its_arrays_are_bound_to_a_device():
    free, batch = jnp.asarray(2.0), jnp.arange(3.0)
    bound = jax.device_put(free, jax.local_devices()[0])  # as the M-step hands its model back
    first = each(_scaled, free, batch)
    with profiling() as profile:
        again = each(_scaled, bound, batch)
    assert not profile.spent
    assert jnp.array_equal(first, again)


def test_programs_are_released_beyond_the_bound(monkeypatch):
    cleared = []
    monkeypatch.setattr(jax, "clear_caches", lambda: cleared.append(True))
    monkeypatch.setattr(programs, "maps", lambda: 50)
    assert not programs.release_programs(50) and not cleared
    assert programs.release_programs(49) and cleared == [True]
