"""A model along a path: its affine form, how next state and reading move with what is estimated, and by them the
log-likelihood to second order, with the score by Fisher's identity and the information of the linearised model.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ...base.gaussian import Gaussian, spd_solve
from ...base.parallel import each
from ...base.rows import rows
from ...logs.dataset import Dataset
from ...model.base import AbstractModel, Prepared, prepare
from ...model.state_space import Inputs, StateSpaceModel
from ..smoother.kalman import TANGENT, Affine, Cubature, Filtered, Reading, Tangent, kalman_filter, linearised
from ..smoother.posterior import Posterior
from .prior import ParameterPrior


class Local(NamedTuple):
    """A model along a path: all that depends on its structure."""

    seq: Prepared
    affine: Affine
    reading: Reading
    ahead: Float[Array, "*time state"]
    """The next state."""
    by_force: Float[Array, "*time state port"]
    """Sensitivity of the next state to a force held over the step."""
    by_parameter: Float[Array, "*time state param"]
    reading_by_parameter: Float[Array, "*time obs param"]
    reading_by_force: Float[Array, "*time obs port"] | None = None
    """Sensitivity of the reading to a force at its moment; None without a sensor of forces."""

    @property
    def filtered_from(self) -> tuple[Affine, Reading, Prepared]:
        """Affine maps, readings and inputs of a filter: the same for any number of parameters."""
        return self.affine, self.reading, self.seq


class Quadratic(NamedTuple):
    """Log-likelihood about the present parameters: score and information of phi = (node torques, parameters)."""

    score: Float[Array, "*seq phi"]
    information: Float[Array, "*seq phi phi"]
    noise_score: Float[Array, "*seq noise"]
    """Score with respect to (log_q, log_r)."""
    noise_information: Float[Array, "*seq noise noise"]


def spread(
    nodes: Float[Array, "dof count"], speed: Float[Array, "node dof"], amount: Float[Array, "node dof"]
) -> Float[Array, "dof count"]:
    """Sums of `amount`, each shared by the two nodes beside its speed as linear interpolation weighs them; beyond the
    ends the last node takes all.
    """
    count = nodes.shape[1]

    def one(nodes, v, amount):
        left = jnp.clip(jnp.searchsorted(nodes, v, side="right") - 1, 0, count - 2)
        share = jnp.clip((v - nodes[left]) / (nodes[left + 1] - nodes[left]), 0.0, 1.0) * amount
        return jnp.zeros(count, v.dtype).at[left].add(amount - share).at[left + 1].add(share)

    return jax.vmap(one, in_axes=(0, 1, 1))(nodes, speed, amount)


def whitened_sensitivities(
    filtered: Filtered,
    columns: Float[Array, "time state column"],
    readings: Float[Array, "time obs column"],
    observed: Bool[Array, "time obs"],
) -> Float[Array, "time obs column"]:
    """Sensitivity of whitened readings to numbers that move the next state by `columns`, the reading by `readings`."""

    def step(s, slices):
        matrix, rows, columns, readings, gain, log_variance, observed = slices
        out = []
        for i in range(rows.shape[0]):
            j = rows[i] @ s + readings[i]
            out.append(jnp.where(observed[i], j * jnp.exp(-0.5 * log_variance[i]), 0.0))
            s = s - gain[i][:, None] * j[None, :]
        return matrix @ s + columns, jnp.stack(out)

    f = filtered
    slices = (f.affine.matrix, f.reading.rows, columns, readings, f.gain, f.log_variance, observed)
    return jax.lax.scan(step, jnp.zeros_like(columns[0]), slices)[1]


def friction_columns(
    nodes: Float[Array, "dof count"], speed: Float[Array, "node dof"], by_force: Float[Array, "state port"]
) -> Float[Array, "state phi"]:
    """Sensitivity of the next state to the torques at the nodes, mean over some speeds; equations have none."""
    by_force = by_force[:, : len(nodes)]
    weights = spread(nodes, speed, jnp.full_like(speed, 1 / speed.shape[0]))
    return (by_force[:, :, None] * weights[None]).reshape(by_force.shape[0], -1)


def reading_columns(
    nodes: Float[Array, "dof count"], speed: Float[Array, "time node dof"], linear: Local
) -> Float[Array, "time obs phi"]:
    """Sensitivity of the readings of a sequence to phi, the torques mean over some speeds in every row."""
    torque = jnp.zeros((*linear.seq.y.shape, nodes.size), speed.dtype)
    if linear.reading_by_force is not None:
        torque = jax.vmap(lambda v, b: friction_columns(nodes, v, b))(speed, linear.reading_by_force)
    return jnp.concatenate([torque, linear.reading_by_parameter], axis=-1)


def quadratic(
    log_q, log_r, start: Gaussian, linear: Local, nodes: Float[Array, "dof count"], posterior: Posterior, read
) -> Quadratic:
    """The log-likelihood of one sequence to second order, from the local model alone, with the emission at the nodes of
    the posterior, `read` (time, node, obs): the same program for every structure of the same size.
    """
    y, observed, dof = linear.seq.y, linear.seq.observed, nodes.shape[0]
    q, r = jnp.exp(log_q), jnp.exp(log_r)

    def columns(prev, following, kick, excess, by_force, by_parameter):
        """Mean sensitivity of x_{k+1} to phi, and expected score, over the nodes of one step."""
        speed = 0.5 * (prev + following - kick)[:, dof : 2 * dof]  # half the kick would count as signal
        sensitivity = friction_columns(nodes, speed, by_force)
        push = spd_solve(jnp.diag(q) + excess, kick.T).T
        pull = push @ by_force[:, :dof]  # node dof
        score = spread(nodes, speed, pull / speed.shape[0]).ravel()
        score = jnp.concatenate([score, jnp.mean(push, axis=0) @ by_parameter])
        expected = jnp.diag(spd_solve(jnp.diag(q) + excess, jnp.eye(q.shape[0], dtype=q.dtype)))
        square = 0.5 * q * (jnp.mean(push**2, axis=0) - expected)
        return jnp.concatenate([sensitivity, by_parameter], axis=1), score, square

    sensitivity, score, square = jax.vmap(columns)(
        posterior.prev, posterior.next, posterior.kick, posterior.excess, linear.by_force[:-1], linear.by_parameter[:-1]
    )
    inside = linear.seq.active[:-1]
    score = jnp.sum(jnp.where(inside[:, None], score, 0.0), axis=0)
    score_q = jnp.sum(jnp.where(inside[:, None], square, 0.0), axis=0)
    miss = y[:, None] - read
    misfit = jnp.mean(miss**2, axis=1)
    score_r = 0.5 * jnp.sum(jnp.where(observed, misfit / r[None] - 1.0, 0.0), axis=0)
    weighed = jnp.where(observed, jnp.mean(miss, axis=1) / r[None], 0.0)
    rates = jnp.concatenate([posterior.prev, posterior.next[-1:]])[..., dof : 2 * dof]
    of_torque = jnp.zeros(nodes.size, score.dtype)
    if linear.reading_by_force is not None:
        unit = jnp.where(observed[:, None], miss / r[None, None], 0.0)
        pull = unit @ linear.reading_by_force[..., :dof] / miss.shape[1]
        of_torque = jnp.sum(jax.vmap(lambda v, pull: spread(nodes, v, pull))(rates, pull), axis=0).ravel()
    of_readings = jnp.einsum("to,top->p", weighed, linear.reading_by_parameter)
    score = score + jnp.concatenate([of_torque, of_readings])

    def noise_filter(log_q, log_r):
        filtered = kalman_filter(log_q, log_r, start, linear.affine, linear.reading, linear.seq)
        return (filtered.innovation, filtered.log_variance), filtered

    (jac_e, jac_s), filtered = jax.jacfwd(noise_filter, argnums=(0, 1), has_aux=True)(log_q, log_r)
    jac_e, jac_s = (jnp.concatenate(j, axis=-1).reshape(-1, q.shape[0] + r.shape[0]) for j in (jac_e, jac_s))
    jac_e = jac_e + 0.5 * filtered.innovation.reshape(-1, 1) * jac_s
    noise_information = jac_e.T @ jac_e + 0.5 * jac_s.T @ jac_s

    padded = jnp.concatenate([jnp.where(inside[:, None, None], sensitivity, 0.0), jnp.zeros_like(sensitivity[:1])])
    jac = whitened_sensitivities(filtered, padded, reading_columns(nodes, rates, linear), observed)
    jac = jac.reshape(-1, jac.shape[-1])
    return Quadratic(score, jac.T @ jac, jnp.concatenate([score_q, score_r]), noise_information)


def local(
    model: StateSpaceModel, prior: ParameterPrior, path: Gaussian, seq: Dataset, linearise: Tangent | Cubature = TANGENT
) -> Local:
    """The model of one sequence, linearised about the Gaussians of `path`, and its sensitivities at their means."""
    prepared = prepare(model, seq)
    affine, reading = linearised(model, path, prepared, linearise)
    return Local(prepared, affine, reading, *_sensitivities(model, prior, path, seq, prepared.inputs))


def _sensitivities(model: StateSpaceModel, prior: ParameterPrior, path: Gaussian, seq: Dataset, inputs: Inputs):
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


def readings_at(model: AbstractModel, one: tuple[Posterior, Prepared]) -> Float[Array, "time node obs"]:
    """The emission at the nodes of the posterior of one sequence."""
    posterior, seq = one
    nodes = jnp.concatenate([posterior.prev, posterior.next[-1:]])
    return jax.vmap(jax.vmap(model.emission, in_axes=(0, None)))(nodes, seq.inputs)
