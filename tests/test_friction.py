"""The friction map: its short cut for derivatives, and the form in scalars, against the map written joint by joint."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from nnap_em.model.friction import FrictionNetwork

SPEED, SCALE = jnp.asarray([8.0, 15.0]), jnp.asarray([0.3, 0.1])
FRICTION = FrictionNetwork(SPEED, SCALE, key=jax.random.key(0))
SPEEDS = jnp.asarray([[0.0, 0.0], [0.01, -0.2], [-3.0, 14.0], [30.0, -50.0]])


def _plain(friction, v):
    torques = []
    for joint in range(2):
        mlp = jax.tree.map(lambda a: a[joint] if eqx.is_array(a) else a, friction.mlp)  # noqa: B023
        speed, knee = friction.speed[joint], friction.knee[joint]
        features = jnp.stack([v[joint] / speed, jnp.arcsinh(v[joint] / knee) / jnp.arcsinh(speed / knee)])
        torques.append(friction.scale[joint] * mlp(features))
    return jnp.stack(torques)


def test_values_and_derivatives_by_weights_and_velocity():
    w = FRICTION.weights()

    def all_of(f):
        value = lambda w, v: f(FRICTION.with_weights(w), v)  # noqa: E731
        slopes = jax.jacfwd(value, argnums=(0, 1))
        return jax.vmap(lambda v: (value(w, v), slopes(w, v), jax.vjp(value, w, v)[1](jnp.ones(2))))(SPEEDS)

    forms = (lambda f, v: f(v)), (lambda f, v: f.by_entry()(v)), _plain
    *both, reference = jax.jit(lambda: [all_of(form) for form in forms])()
    for mine in both:
        for a, b in zip(jax.tree.leaves(mine), jax.tree.leaves(reference), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-11, atol=1e-14)
