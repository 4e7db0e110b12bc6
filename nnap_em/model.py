"""The hidden Markov model: x_{k+1} = f(x_k, u_k) + w_k, y_k = g(x_k) + v_k."""

from abc import abstractmethod
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .data import Dataset
from .effects.base import AbstractEffect, Scene
from .gaussian import Gaussian, spd_solve
from .ode import integrate
from .rig import parameter_unit
from .systems.base import AbstractSystem


class AbstractModel(eqx.Module):
    """All that smoothers and EM ask of a model."""

    start: eqx.AbstractVar[Gaussian]
    """Prior of the state in the first row."""
    log_q: eqx.AbstractVar[Float[Array, " state"]]
    """Log of the process-noise variance per step."""
    log_r: eqx.AbstractVar[Float[Array, " obs"]]
    """Log of the measurement variance."""
    measured: eqx.AbstractVar[tuple[int, ...]]
    """Which states are read, in the order of y."""
    dt: eqx.AbstractVar[float]
    """Sample interval [s]."""

    @abstractmethod
    def transition(self, x: Float[Array, " state"], u: Float[Array, " input"]) -> Float[Array, " state"]:
        """Mean of the state one sample later; `u` is a row of `inputs`."""

    @abstractmethod
    def emission(self, x: Float[Array, " state"], u: Float[Array, " input"] | None = None) -> Float[Array, " obs"]:
        """Mean of the reading; `u` is a row of `inputs`."""

    def inputs(self, seq: Dataset) -> Float[Array, "time input"]:
        """What acts from outside in every row."""
        return jnp.asarray(seq.u)


class StateSpaceModel(AbstractModel):
    """Known physics with an unknown torque, observed through noise [paper, eqs. 6 to 8 and 16].

    The state is (q, v), then the memory of the effects in their order.
    """

    system: AbstractSystem
    unknown: Callable[[Float[Array, " dof"]], Float[Array, " dof"]]
    """Static map of joint velocity to torque, to be learned."""
    start: Gaussian
    """Prior of the state in the first row."""
    log_q: Float[Array, " state"]
    """Log of the process-noise variance per step [rad^2, (rad/s)^2]."""
    log_r: Float[Array, " obs"]
    """Log of the measurement variance."""
    measured: tuple[int, ...] = eqx.field(static=True)
    """Which states are read, in the order of y."""
    dt: float = eqx.field(static=True)
    """Sample interval [s]."""
    substeps: int = eqx.field(static=True, default=2)
    effects: tuple[AbstractEffect, ...] = ()
    """What the declared physics lacks."""

    def __str__(self) -> str:
        names = self.system.coordinates + self.system.rates
        noise = zip((names[i] for i in self.measured), np.exp(0.5 * np.asarray(self.log_r)), strict=True)
        reads = ", ".join(f"{name} (noise {std:.2g} {parameter_unit(name)})" for name, std in noise)
        found = [
            f"{effect.name}{f' at joint {effect.joint}' if effect.joint else ''}"
            + "".join(f", {name} = {float(value):.4g} {effect.units[name]}" for name, value in effect.values().items())
            for effect in self.effects
        ]
        return "\n  ".join([f"{self.system}, a row every {self.dt:g} s", f"reads: {reads}", *found])

    def inputs(self, seq: Dataset) -> Float[Array, "time input"]:
        """The inputs; with effects: what reaches the joints, the clock in the middle of the step [s], what reached the
        joints one row before, and the time since the first row [s].
        """
        if not self.effects:
            return jnp.asarray(seq.u)
        u = jnp.asarray(seq.u)
        for effect in self.effects:
            if effect.joint in self.system.joints:
                i = self.system.joints.index(effect.joint)
                u = u.at[:, i].set(effect.input(u[:, i], self.dt))
        before = jnp.concatenate([jnp.zeros_like(u[:1]), u[:-1]])
        middle = jnp.asarray(seq.t)[:, None] + 0.5 * self.dt
        age = jnp.asarray(seq.t)[:, None] - jnp.asarray(seq.t)[:1, None]
        return jnp.concatenate([u, middle, before, age], axis=1)

    def scene(self, x: Float[Array, " state"], u: Float[Array, " input"]) -> Scene:
        """What the effects see at one moment."""
        dof, drives = len(self.system.coordinates), len(self.system.joints)
        q, v = x[:dof], x[dof : 2 * dof]
        time = u[drives] if self.effects else jnp.zeros((), x.dtype)
        system = self.system
        for effect in self.effects:
            system = effect.physics(system, time)
        return Scene(system, q, v, system.drive(u[:drives]), time, self.unknown(v), self.unknown)

    def rate(
        self, x: Float[Array, " state"], u: Float[Array, " input"], force: Float[Array, " dof"]
    ) -> Float[Array, " state"]:
        """Time derivative of the state under inputs u and an extra generalised force [N m]."""
        dof = force.shape[0]
        memory, scene = x[2 * dof :], self.scene(x, u)
        system, q, v, torque = scene.system, scene.q, scene.v, scene.friction
        rates, place = [v], 2 * dof
        total = scene.drive + force - system.bias(q, v)
        rest = []
        for effect in self.effects:
            own = memory[place - 2 * dof : place - 2 * dof + effect.memory]
            torque = effect.friction(torque, scene)
            total = total + effect.force(scene, own)
            rest.append(effect.drift(scene, own))
            place += effect.memory
        rates.append(spd_solve(system.mass(q), total + torque))
        return jnp.concatenate(rates + rest)

    def transition(
        self, x: Float[Array, " state"], u: Float[Array, " input"], force: Float[Array, " dof"] | None = None
    ) -> Float[Array, " state"]:
        """Mean of the state one sample later."""
        extra = jnp.zeros(len(self.system.coordinates), x.dtype) if force is None else force
        return integrate(lambda x: self.rate(x, u, extra), x, self.dt, self.steps)

    @property
    def steps(self) -> int:
        """Integration steps of one sample, as many as the stiffest effect asks for."""
        return max([self.substeps, *(effect.substeps for effect in self.effects)])

    def readable(self, x: Float[Array, " state"], u: Float[Array, " input"] | None = None) -> Float[Array, " readable"]:
        """What sensors on all coordinates and rates would read without noise."""
        names = self.system.coordinates + self.system.rates
        r = x[: len(names)]

        def past(delay: Float[Array, ""]) -> Float[Array, " readable"]:
            """The state `delay` [s] ago, under the inputs of the row before, but no earlier than the first row."""
            assert u is not None
            drives = len(self.system.joints)
            before = jnp.concatenate([u[drives + 1 : 2 * drives + 1], u[drives:]])
            reach = jnp.minimum(delay, u[-1])
            still = jnp.zeros(len(self.system.coordinates), x.dtype)
            return integrate(lambda x: -reach * self.rate(x, before, still), x, 1.0, 3)[: len(names)]

        for effect in self.effects:
            for i, name in enumerate(names):
                if effect.channel in (name, "all"):
                    r = r.at[i].set(effect.reading(r[i], lambda delay, i=i: past(delay)[i]))
        return r

    def shown(self, x: Float[Array, " state"], u: Float[Array, " input"] | None = None) -> Float[Array, " readable"]:
        """Coordinates and rates; those that are measured as their sensors read them."""
        r = self.readable(x, u)
        return jnp.stack([r[i] if i in self.measured else x[i] for i in range(r.shape[0])])

    def emission(self, x: Float[Array, " state"], u: Float[Array, " input"] | None = None) -> Float[Array, " obs"]:
        """Mean of the reading."""
        r = self.readable(x, u)
        return jnp.stack([r[i] for i in self.measured])


def with_effects(model: StateSpaceModel, effects: tuple[AbstractEffect, ...]) -> StateSpaceModel:
    """`model` with other effects: memory states are dropped or begin at rest."""
    dof = len(model.system.coordinates)
    spread = [effect.memory_scale() for effect in effects if effect.memory]
    wide = jnp.concatenate([jnp.ones(0, model.log_q.dtype), *spread])
    mean = jnp.concatenate([model.start.mean[: 2 * dof], jnp.zeros_like(wide)])
    cov = jax.scipy.linalg.block_diag(model.start.cov[: 2 * dof, : 2 * dof], jnp.diag((0.1 * wide) ** 2))
    log_q = jnp.concatenate([model.log_q[: 2 * dof], 2 * jnp.log(1e-3 * wide)])
    return StateSpaceModel(
        system=model.system,
        unknown=model.unknown,
        start=Gaussian(mean, cov),
        log_q=log_q,
        log_r=model.log_r,
        measured=model.measured,
        dt=model.dt,
        substeps=model.substeps,
        effects=effects,
    )
