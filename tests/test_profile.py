"""The table of compiled programs."""

import time

import jax
import jax.numpy as jnp

from nnap_em.numerics.parallel import each
from nnap_em.numerics.profile import profiling, stage


def test_programs_are_counted_once_for_every_shape_and_by_name():
    @jax.jit
    def cube(x):
        return x**3

    with profiling() as profile:
        for size in (3, 4, 3):
            cube(jnp.ones(size))
    assert len(profile.spent["cube"]["compile"]) == 2
    assert any(line.split()[:2] == ["cube", "2"] for line in str(profile).splitlines())
    assert all(seconds >= 0 for stages in profile.spent.values() for spent in stages.values() for seconds in spent)


def test_what_is_compiled_afterwards_is_not_counted():
    with profiling() as profile:
        pass
    jax.jit(lambda x: x + 1)(jnp.arange(7))
    assert not profile.spent


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


def test_time_counts_for_the_outermost_stage_alone():
    @stage("refit")
    def inner():
        time.sleep(0.02)

    with profiling() as profile:
        with stage("fit"):
            inner()
        inner()
    (fit,), (refit,) = profile.spent["fit"]["run"], profile.spent["refit"]["run"]
    assert fit >= 0.02 <= refit
    rows = {line.split()[0]: line.split() for line in str(profile).splitlines()}
    assert [rows[name][-1] for name in ("fit", "refit")] == [f"{fit:.2f}", f"{refit:.2f}"]
