"""Physical parameters that are estimated, of the machine and of the effects: one vector, with the declared prior."""

from collections.abc import Mapping

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ...machines.rig import Declared


class ParameterPrior(eqx.Module):
    """Physical parameters, estimated in standard deviations of the declared prior."""

    names: tuple[str, ...] = eqx.field(static=True)
    """Names of the system, "m2" or "forearm.mass", of a servo, "goal.kp", or of an effect by its place, "0.k"."""
    mean: Float[Array, " param"]
    std: Float[Array, " param"]

    @property
    def declared(self) -> tuple[str, ...]:
        """Those of the system and its servos, which stand first."""
        return tuple(name for name in self.names if not name.partition(".")[0].isdigit())

    def places(self, model) -> list:
        """The parameters in the model."""
        return [
            getattr(model.effects[int(at)], field) if at.isdigit() else model.parameter(name)
            for name, (at, _, field) in ((name, name.partition(".")) for name in self.names)
        ]

    def read(self, model) -> Float[Array, " param"]:
        """The model's values as (value - mean) / std."""
        if not self.names:
            return self.mean
        return (jnp.concatenate([jnp.ravel(a) for a in self.places(model)]) - self.mean) / self.std

    def write(self, model, z: Float[Array, " param"]):
        """The model with values mean + std z."""
        if not self.names:
            return model
        places = self.places(model)
        cuts = np.cumsum([a.size for a in places])[:-1]
        values = jnp.split(self.mean + self.std * z, cuts)
        shaped = [v.reshape(a.shape) for v, a in zip(values, places, strict=True)]
        return eqx.tree_at(self.places, model, shaped)

    def held(self, model) -> Bool[np.ndarray, " param"]:
        """Mask of the numbers that act as forces held over a step."""
        places = [name.partition(".")[0] for name in self.names]
        kinds = [at.isdigit() and model.effects[int(at)].held for at in places]
        flags = [np.full(np.size(a), k) for a, k in zip(self.places(model), kinds, strict=True)]
        return np.concatenate([np.zeros(0, bool), *flags])

    @property
    def size(self) -> int:
        """Number of estimated values."""
        return self.mean.shape[0]


def declared_prior(parameters: Mapping[str, Declared]) -> ParameterPrior:
    """The prior of the parameters that are uncertain, as they are declared."""
    free = {name: one for name, one in parameters.items() if one.std > 0}
    mean, std = (jnp.asarray([getattr(one, field) for one in free.values()], float) for field in ("mean", "std"))
    return ParameterPrior(tuple(free), mean, std)
