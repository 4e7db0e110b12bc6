"""What logs of a machine that nothing drives cannot tell: the scale of all its masses and of its friction."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from ..data.dataset import Dataset
from ..data.rig import Declared, Rig
from ..systems import AbstractSystem

EXACT = 1e-4
"""Share of the equations of motion that may be missed by the parameters that scale them: rounding, in 32 bits too."""


def untold(rig: Rig, system: AbstractSystem, data: Dataset) -> str | None:
    """The uncertain mass or inertia that carries the scale which these logs cannot tell; None where they can.

    Without a torque the motion is the same when M(q) and b(q, v) are multiplied by one number, and the learned friction
    with them. That number is free where a change of the uncertain parameters multiplies M and b; the parameter that is
    declared most closely for its part in that change carries it.
    """
    names = [name for name, declared in rig.parameters.items() if declared.std > 0]
    if np.any(np.asarray(data.u)[np.asarray(data.valid)]) or not names:
        return None
    rng, dof = np.random.default_rng(0), len(system.coordinates)
    q, v = (jnp.asarray(rng.uniform(-3.0, 3.0, (16, dof))) for _ in range(2))

    def terms(values):
        changed = dataclasses.replace(system, **dict(zip(names, values, strict=True)))
        return jnp.concatenate([jax.vmap(changed.mass)(q).ravel(), jax.vmap(changed.bias)(q, v).ravel()])

    values = [jnp.asarray(rig.parameters[name].mean, float) for name in names]
    slopes = np.stack(jax.jacfwd(terms)(values), axis=1)
    whole = np.asarray(terms(values))
    step = np.linalg.lstsq(slopes, whole, rcond=1e-9)[0]
    if np.linalg.norm(slopes @ step - whole) > EXACT * np.linalg.norm(whole):
        return None
    std = np.array([rig.parameters[name].std for name in names])
    return names[int(np.argmax(np.abs(step) / std))]


def holding(rig: Rig, name: str | None) -> Rig:
    """The rig with one parameter kept as it is declared."""
    if name is None:
        return rig
    return dataclasses.replace(rig, parameters={**rig.parameters, name: Declared(rig.parameters[name].mean, 0.0)})
