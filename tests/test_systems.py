"""Shipped machines against mechanics: Lagrange's equations of an independently written Lagrangian, energy, power."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nnap_em.base.gaussian import Gaussian
from nnap_em.machines.systems import specs, systems
from nnap_em.machines.systems.acrobot import table_i
from nnap_em.model.state_space import Inputs, StateSpaceModel

PARAMETERS = {
    "acrobot": {**table_i, "Ir": 6e-5, "gr": 6.0, "lc1": 0.12, "I2": 2e-3},  # not the uniform rods: every term counts
    "pendubot": {**table_i, "Ir": 6e-5, "gr": 6.0},
    "pendulum": {"m": 0.3, "lc": 0.2, "I": 4e-3, "g": 9.81},
    "slide": {"m": 1.7},
}
INPUTS = {"acrobot": (2,), "pendubot": (1,), "pendulum": (1,), "slide": (1,)}
names = pytest.mark.parametrize("name", sorted(PARAMETERS))


def _system(name: str):
    return systems[name](**{k: jnp.asarray(v) for k, v in PARAMETERS[name].items()}, joints=INPUTS[name])


def _arm(p, q):
    """Heights and positions of the bodies [m], and angles of all that turns, with the inertias [kg m^2]."""
    first, second = q[0], q[0] + q[1]
    down = lambda angle: jnp.stack([jnp.sin(angle), -jnp.cos(angle)])  # noqa: E731
    centres = [p["lc1"] * down(first), p["l1"] * down(first) + p["lc2"] * down(second)]
    # INTERFACE.md: the rotor of joint 1 sits in the ground and turns gr times as fast as link 1; that of joint 2 rides
    # on link 1 and turns the other way
    turning = [(p["I1"], first), (p["I2"], second), (p["Ir"], p["gr"] * q[0]), (p["Ir"], q[0] - p["gr"] * q[1])]
    return list(zip((p["m1"], p["m2"]), centres, strict=True)), turning


BODIES = {
    "acrobot": _arm,
    "pendubot": _arm,
    "pendulum": lambda p, q: ([(p["m"], p["lc"] * jnp.stack([jnp.sin(q[0]), -jnp.cos(q[0])]))], [(p["I"], q[0])]),
    "slide": lambda p, q: ([(p["m"], jnp.stack([q[0], jnp.zeros(())]))], []),
}


def _energies(name: str, q, v):
    """Kinetic and potential energy [J] from the positions of the bodies."""
    p = PARAMETERS[name]
    bodies = lambda q: [position for _, position in BODIES[name](p, q)[0]]  # noqa: E731
    angles = lambda q: [angle for _, angle in BODIES[name](p, q)[1]]  # noqa: E731
    masses, turning = BODIES[name](p, q)
    _, velocities = jax.jvp(bodies, (q,), (v,))
    _, rates = jax.jvp(angles, (q,), (v,))
    kinetic = sum(0.5 * m * jnp.sum(w**2) for (m, _), w in zip(masses, velocities, strict=True))
    kinetic = kinetic + sum(0.5 * i * w**2 for (i, _), w in zip(turning, rates, strict=True))
    return kinetic, sum(m * p.get("g", 0.0) * position[1] for m, position in masses)


def _states(name: str, count: int = 20):
    dof = len(systems[name].coordinates)
    rng = np.random.default_rng(0)
    return jnp.asarray(rng.normal(size=(count, dof)) * 2), jnp.asarray(rng.normal(size=(count, dof)) * 5)


def _model(name: str, unknown=jnp.zeros_like, dt: float = 0.01, substeps: int = 2):
    n = len(specs[name].states)
    start = Gaussian(jnp.zeros(n), jnp.eye(n))
    return StateSpaceModel(_system(name), unknown, start, jnp.zeros(n), jnp.zeros(1), (0,), dt, substeps)


@names
def test_mass_and_bias_are_lagranges_equations(name):
    """d/dt dL/dv - dL/dq = M a + c, for any a; M is symmetric and positive definite."""
    system = _system(name)
    lagrangian = lambda q, v: _energies(name, q, v)[0] - _energies(name, q, v)[1]  # noqa: E731

    def both(q, v, a):
        momentum = lambda q, v: jax.jacfwd(lagrangian, argnums=1)(q, v)  # noqa: E731
        _, change = jax.jvp(momentum, (q, v), (v, a))
        mass = system.mass(q)
        return change - jax.jacfwd(lagrangian)(q, v), mass @ a + system.bias(q, v), mass

    q, v = _states(name)
    expected, torque, mass = map(np.asarray, jax.jit(jax.vmap(both))(q, v, 3 * q - v))
    assert np.all(mass == np.swapaxes(mass, 1, 2)) and np.all(np.linalg.eigvalsh(mass) > 0)
    np.testing.assert_allclose(torque, expected, rtol=0, atol=1e-13 * np.abs(expected).max())


@names
def test_energy_changes_by_the_work_of_the_input(name):
    """Power balance dE/dt = v . B u, and friction only takes."""
    u = Inputs.held(jnp.asarray([0.3]))
    models = [_model(name), _model(name, lambda v: -0.05 * v)]

    def powers(x):
        rates = [model.rate(x, u, jnp.zeros(x.shape[0] // 2)) for model in models]
        return [jax.jvp(lambda x: sum(_energies(name, *jnp.split(x, 2))), (x,), (rate,))[1] for rate in rates]

    q, v = _states(name, 4)
    driven = v[:, INPUTS[name][0] - 1] * u.u[0]
    for power, friction in zip(jax.jit(jax.vmap(powers))(jnp.concatenate([q, v], axis=1)), (0.0, 0.05), strict=True):
        expected = driven - friction * jnp.sum(v**2, axis=1)
        np.testing.assert_allclose(power, expected, rtol=0, atol=1e-11)  # cancellation of terms of some 10 W


def test_inputs_drive_their_joints_in_units_of_turning_or_sliding():
    assert set(PARAMETERS) == {name for name, spec in specs.items() if not spec.declare}  # the others: test_machines.py
    arm = systems["acrobot"](**{k: jnp.asarray(v) for k, v in PARAMETERS["acrobot"].items()}, joints=(2, 1))
    np.testing.assert_array_equal(arm.drive(jnp.asarray([3.0, 5.0])), [5.0, 3.0])
    np.testing.assert_array_equal(_system("pendubot").drive(jnp.asarray([3.0])), [3.0, 0.0])
    slide = _system("slide")
    assert [arm.unit("theta2"), arm.unit("dtheta1"), slide.unit("x"), slide.unit("dx")] == ["rad", "rad/s", "m", "m/s"]
    assert (arm.force_unit(2), slide.force_unit(1)) == ("N m", "N")
