"""Scale of all masses and of friction, which is not identifiable where nothing drives the machine."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..data.dataset import Dataset
from ..data.rig import Declared, Rig


def not_identifiable(rig: Rig, system: Any, data: Dataset) -> tuple[str, ...]:
    """The uncertain parameters that carry the scale of the machine, where it is not identifiable; else none.

    Without a torque the motion is the same when M(q) and c(q, v) are multiplied by one number, and the learned friction
    with them. That number is free as long as a change of the uncertain parameters multiplies M and c. Of the change
    that is the least in declared standard deviations, the parameter that moves by the most of them is held; and so on.
    """
    if rig.equations or rig.input_kinds or np.any(np.asarray(data.u)[np.asarray(data.valid)]):
        return ()  # the gains of servos are numbers of the machine, and `identifiability` looks at these
    rng, dof = np.random.default_rng(0), len(system.coordinates)
    q, v = (jnp.asarray(rng.uniform(-3.0, 3.0, (16, dof))) for _ in range(2))
    names = [name for name, declared in rig.bodies.items() if declared.std > 0]

    def terms(values):
        changed = system.with_parameters(dict(zip(names, values, strict=True)))
        return jnp.concatenate([jax.vmap(changed.mass)(q).ravel(), jax.vmap(changed.bias)(q, v).ravel()])

    values = [jnp.asarray(rig.parameters[name].mean, float) for name in names]
    whole, slopes = np.asarray(terms(values)), [np.asarray(slope) for slope in jax.jacfwd(terms)(values)]
    left, held = list(range(len(names))), []
    # Share of the equations of motion that may be missed by the parameters that scale them: rounding, in 32 bits too
    rounding = 1e-4
    while left:
        columns = np.stack([rig.parameters[names[i]].std * slopes[i] for i in left], axis=1)
        steps = np.linalg.lstsq(columns, whole, rcond=1e-9)[0]
        if np.linalg.norm(columns @ steps - whole) > rounding * np.linalg.norm(whole):
            break
        held.append(left.pop(int(np.argmax(np.abs(steps)))))
    return tuple(names[i] for i in held)


def holding(rig: Rig, names: tuple[str, ...]) -> Rig:
    """The rig with some parameters kept as they are declared."""
    kept = {name: Declared(rig.parameters[name].mean, 0.0) for name in names}
    return dataclasses.replace(rig, parameters={**rig.parameters, **kept}) if kept else rig
