"""A model along a path: its affine form in every row, and how next state and reading move with what is estimated."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..data.dataset import Dataset
from ..model.base import AbstractModel, Prepared, prepare
from ..model.state_space import Inputs, StateSpaceModel
from ..numerics.gaussian import Gaussian
from ..numerics.parallel import each
from ..numerics.rows import rows
from ..smoother.kalman import TANGENT, Cubature, Tangent, linear_reading
from ..smoother.posterior import Posterior
from .prior import ParameterPrior
from .quadratic import Local


def local(
    model: StateSpaceModel, prior: ParameterPrior, path: Gaussian, seq: Dataset, linearise: Tangent | Cubature = TANGENT
) -> Local:
    """The model of one sequence, linearised about the Gaussians of `path`, and its sensitivities at their means."""
    prepared = prepare(model, seq)
    affine = rows(lambda state, u: linearise(model, state, u), path, prepared.inputs)
    reading = jax.vmap(lambda x, u: linear_reading(model, x, u))(path.mean, prepared.inputs)
    return Local(prepared, affine, reading, *_sensitivities(model, prior, path, seq, prepared.inputs))


def _sensitivities(
    model: StateSpaceModel, prior: ParameterPrior, path: Gaussian, seq: Dataset, inputs: Inputs
) -> tuple[
    Float[Array, "time state"],
    Float[Array, "time state port"],
    Float[Array, "time state param"],
    Float[Array, "time obs param"],
    Float[Array, "time obs port"] | None,
]:
    """The next state; sensitivities of it and the reading to a force held over the step and to the parameters."""
    value, held = prior.read(model), prior.held(model)
    free = np.flatnonzero(~held)
    ports = len(model.system.ports)
    still = jnp.zeros(ports, path.mean.dtype)
    z = jnp.concatenate([still, value[free]])  # a force, and the parameters that do not act as forces held over a step
    by_z = jax.jacfwd(lambda z: prior.write(model, value.at[free].set(z[ports:])).inputs(seq))(z)

    def row(state, u, by_z):
        x = state.mean

        def both(z, u, x):
            changed = prior.write(model, value.at[free].set(z[ports:]))
            return changed.transition(x, u, z[:ports]), changed.emission(x, u, z[:ports])

        def along(one):  # in a loop: six joints are compiled in 16 s in place of 20 to 25 side by side, and run as fast
            dz, du = one
            dx = (x - x) * dz[0]  # nothing, but batched as what follows: loops are traced once
            (ahead, _), tangents = jax.jvp(both, (z, u, x), (dz, du, dx))
            return ahead, tangents

        def pushed(p):
            changed = prior.write(model, value.at[held].set(p))
            scene = changed.scene(middle, u.at(0.5))
            nothing = jnp.zeros(0, x.dtype)
            return sum((e.force(scene, nothing) for e in changed.effects if e.held), still)

        unit = jnp.eye(z.shape[0], dtype=z.dtype)
        turned = jax.tree.map(lambda a: jnp.moveaxis(a, -1, 0), by_z)
        ahead, (moved, read) = jax.lax.map(along, (unit, turned))
        ahead, moved, read = ahead[0], moved.T, read.T
        by_force, feels = moved[:, :ports], read[:, :ports] if model.system.senses_push else None
        by_parameter = jnp.zeros((x.shape[0], value.shape[0]), x.dtype).at[:, free].set(moved[:, ports:])
        of_reading = jnp.zeros((read.shape[0], value.shape[0]), x.dtype).at[:, free].set(read[:, ports:])
        if held.any():
            middle = x + 0.5 * model.dt * model.rate(x, u, still)
            push = jax.jacfwd(pushed)(value[held])
            by_parameter = by_parameter.at[:, held].set(by_force @ push)
            of_reading = of_reading if feels is None else of_reading.at[:, held].set(feels @ push)
        return ahead, by_force, by_parameter, of_reading, feels

    return rows(row, path, inputs, by_z)


def locals_along(
    model: StateSpaceModel, prior: ParameterPrior, path: Gaussian, data: Dataset, linearise: Tangent | Cubature
) -> Local:
    """`local` of every sequence: all of an M-step that is compiled anew for a model of another structure."""
    return each(_local, (model, prior, linearise), (path, data))


def _local(common, one) -> Local:
    (model, prior, linearise), (path, seq) = common, one
    return local(model, prior, path, seq, linearise)


def readings_at(model: AbstractModel, posterior: Posterior, seq: Prepared) -> Float[Array, "time node obs"]:
    """The emission at the nodes of a posterior."""
    nodes = jnp.concatenate([posterior.prev, posterior.next[-1:]])
    return jax.vmap(jax.vmap(model.emission, in_axes=(0, None)))(nodes, seq.inputs)


def readings_along(model: AbstractModel, posterior: Posterior, seq: Prepared) -> Float[Array, "seq time node obs"]:
    """`readings_at` of every sequence."""
    return each(_readings, model, (posterior, seq))


def _readings(model, one) -> Float[Array, "time node obs"]:
    return readings_at(model, *one)
