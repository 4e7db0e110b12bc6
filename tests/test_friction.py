"""The friction map: its short cut for derivatives against jax's own."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from nnap_em.model.friction import FrictionNetwork

SPEED, SCALE = jnp.asarray([8.0, 15.0]), jnp.asarray([0.3, 0.1])
FRICTION = FrictionNetwork(SPEED, SCALE, key=jax.random.key(0))


def _plain(friction, v):
    """The map written joint by joint."""
    torques = []
    for joint in range(2):
        mlp = jax.tree.map(lambda a: a[joint] if eqx.is_array(a) else a, friction.mlp)  # noqa: B023
        speed, knee = friction.speed[joint], friction.knee[joint]
        features = jnp.stack([v[joint] / speed, jnp.arcsinh(v[joint] / knee) / jnp.arcsinh(speed / knee)])
        torques.append(friction.scale[joint] * mlp(features))
    return jnp.stack(torques)


def test_value_and_slope():
    for v in jnp.asarray([[0.0, 0.0], [0.01, -0.2], [-3.0, 14.0], [30.0, -50.0]]):
        np.testing.assert_allclose(FRICTION(v), _plain(FRICTION, v), rtol=1e-12, atol=1e-15)
        mine, reference = (jax.jacfwd(lambda v, f=f: f(v))(v) for f in (FRICTION, lambda v: _plain(FRICTION, v)))
        np.testing.assert_allclose(mine, reference, rtol=1e-11, atol=1e-14)


def test_in_scalars_it_is_the_same_map():
    for v in jnp.asarray([[0.0, 0.0], [0.01, -0.2], [-3.0, 14.0], [30.0, -50.0]]):
        np.testing.assert_allclose(FRICTION.by_entry()(v), FRICTION(v), rtol=1e-12, atol=1e-15)
        slope, reference = jax.jacfwd(FRICTION.by_entry())(v), jax.jacfwd(FRICTION)(v)
        np.testing.assert_allclose(slope, reference, rtol=1e-11, atol=1e-14)


def test_weights_and_velocity_together():
    v, w = jnp.asarray([0.4, -2.0]), FRICTION.weights()
    derive = lambda f: jax.jacfwd(lambda w, v: f(FRICTION.with_weights(w), v), argnums=(0, 1))(w, v)  # noqa: E731
    for mine, reference in zip(derive(lambda f, v: f(v)), derive(_plain), strict=True):
        np.testing.assert_allclose(mine, reference, rtol=1e-11, atol=1e-14)
    mine, reference = (
        jax.grad(lambda w, f=f: jnp.sum(f(FRICTION.with_weights(w), v) ** 2))(w) for f in (lambda f, v: f(v), _plain)
    )
    np.testing.assert_allclose(mine, reference, rtol=1e-11, atol=1e-14)
