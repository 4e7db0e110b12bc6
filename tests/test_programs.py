"""Compiled programs: one for any arrays of a shape, and their release where they hold too many memory maps."""

import jax
import jax.numpy as jnp
from helpers import compiled

from nnap_em.base import programs
from nnap_em.base.parallel import each


def _scaled(common, one):
    return common * one


def test_a_program_for_every_sequence_is_compiled_once_whether_or_not_its_arrays_are_bound_to_a_device():
    free, batch = jnp.asarray(2.0), jnp.arange(3.0)
    bound = jax.device_put(free, jax.local_devices()[0])  # as the M-step hands its model back
    first = each(_scaled, free, batch)
    with compiled() as programs_of_it:
        again = each(_scaled, bound, batch)
    assert not programs_of_it
    assert jnp.array_equal(first, again)


def test_programs_are_released_beyond_the_bound(monkeypatch):
    cleared = []
    monkeypatch.setattr(jax, "clear_caches", lambda: cleared.append(True))
    monkeypatch.setattr(programs, "maps", lambda: 50)
    assert not programs.release_programs(50) and not cleared
    assert programs.release_programs(49) and cleared == [True]
