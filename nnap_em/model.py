"""The hidden Markov model: x_{k+1} = f(x_k, u_k) + w_k, y_k = g(x_k) + v_k."""

from abc import abstractmethod
from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .gaussian import Gaussian, spd_solve
from .ode import integrate
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
        """Mean of the state one sample later."""

    @abstractmethod
    def emission(self, x: Float[Array, " state"]) -> Float[Array, " obs"]:
        """Mean of the reading."""


class StateSpaceModel(AbstractModel):
    """Known physics with an unknown torque, observed through noise [paper, eqs. 6 to 8 and 16]."""

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

    def rate(
        self, x: Float[Array, " state"], u: Float[Array, " input"], force: Float[Array, " dof"]
    ) -> Float[Array, " state"]:
        """Time derivative of the state under inputs u and an extra generalised force [N m]."""
        q, v = jnp.split(x, 2)
        total = self.system.drive(u) + self.unknown(v) + force - self.system.bias(q, v)
        return jnp.concatenate([v, spd_solve(self.system.mass(q), total)])

    def transition(
        self, x: Float[Array, " state"], u: Float[Array, " input"], force: Float[Array, " dof"] | None = None
    ) -> Float[Array, " state"]:
        """Mean of the state one sample later."""
        extra = jnp.zeros(x.shape[0] // 2, x.dtype) if force is None else force
        return integrate(lambda x: self.rate(x, u, extra), x, self.dt, self.substeps)

    def emission(self, x: Float[Array, " state"]) -> Float[Array, " obs"]:
        """Mean of the reading."""
        return jnp.stack([x[i] for i in self.measured])
