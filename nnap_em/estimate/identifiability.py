"""Identifiability: uncertain numbers that no motion depends on, or only in combination with others."""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.linalg import null_space
from scipy.sparse.csgraph import connected_components

from ..logs.dataset import Dataset
from ..machines.rig import Declared, Rig
from ..machines.systems import AbstractSystem
from ..model import hooks
from ..model.servo import Servo, unlimited

SHARE_LEFT = 1e-6
"""Share of a parameter's own column that must be left when those of the others are taken out of it."""
_MOMENTS = ("delay", "limit")
"""Numbers of a servo that the slopes of its torque do not know."""
_POWERS = 4
"""Powers of a rate that stand for a learned friction."""
_ROUNDING = 1e-4
"""Share of the equations of motion that the parameters that scale them may miss: rounding, in 32 bits too."""


class Identifiability(NamedTuple):
    """Uncertain parameters that keep, alone or along a combination, what was declared."""

    never: tuple[str, ...] = ()
    """Numbers that no motion depends on."""
    together: tuple[tuple[str, ...], ...] = ()
    """Groups of which motions depend on fewer combinations than members; learned friction may be one of them."""


def identifiability(rig: Rig, system: AbstractSystem, servos: tuple[Servo, ...] = ()) -> Identifiability:
    """Base parameters: combinations of uncertain parameters that the inverse dynamics M(q) a + c(q, v) depends on.

    [Gautier & Khalil 1990, IEEE Trans. Robotics and Automation 6(3): base parameters]  By the null space of its
    derivatives at random states, each in declared standard deviations.  With servos, whose torque is no column, it is
    M(q) a + c(q, v) - tau(u, q, v), at the accelerations that the servos give, beside a learned friction of the joints.
    Delays and limits are left out: only single moments depend on them.
    """
    columns, friction, _ = _columns(rig, system, servos)
    size = {name: np.linalg.norm(column) for name, column in columns.items()}
    labels = [name for name in columns if size[name] > SHARE_LEFT * max(size.values())]
    never, scaled = (
        tuple(name for name in columns if name not in labels),
        [columns[name] / size[name] for name in labels],
    )
    if not labels:
        return Identifiability(never)
    if servos and rig.friction:
        labels += [f"the learned friction of joint {1 + i // _POWERS}" for i in range(friction.shape[1])]
        scaled += [*(friction / np.linalg.norm(friction, axis=0)).T]
    free = np.asarray(null_space(np.stack(scaled, axis=1), rcond=SHARE_LEFT))
    shared = np.abs(free @ free.T) > SHARE_LEFT
    groups = connected_components(shared)[1]
    together = [np.flatnonzero(groups == group) for group in dict.fromkeys(groups[np.diag(shared)])]
    return Identifiability(never, tuple(tuple(dict.fromkeys(labels[i] for i in group)) for group in together))


def _columns(
    rig: Rig, system: AbstractSystem, servos: tuple[Servo, ...] = ()
) -> tuple[dict[str, Float[np.ndarray, " row"]], Float[np.ndarray, "row curve"], Float[np.ndarray, " row"]]:
    """Derivatives of the inverse dynamics at random states by the uncertain parameters, in declared standard
    deviations, functions of each joint's rate, and the inverse dynamics themselves.
    """
    rng, dof = np.random.default_rng(0), len(system.coordinates)
    q, v, a = (jnp.asarray(rng.uniform(-3.0, 3.0, (8 + 4 * dof, dof)), float) for _ in range(3))
    u = jnp.asarray(rng.uniform(-3.0, 3.0, (8 + 4 * dof, len(system.joints))), float)
    servos = tuple(unlimited(servo.at(None)) for servo in servos)
    drives = {f"{servo.column}.{key}": value for servo in servos for key, value in servo.values.items()}
    std = {name: of.std for name, of in rig.parameters.items() if of.std > 0}
    std = {name: one for name, one in std.items() if name in rig.bodies or name.rpartition(".")[2] not in _MOMENTS}
    if not std:
        return {}, np.zeros((0, 0)), np.zeros(0)
    values = {name: drives[name] if name in drives else system.parameter(name) for name in std}

    def driven(system, servos, q, v, u):
        if not servos:
            return jnp.zeros_like(q)
        (fed,), _ = hooks.arriving((), servos, system, u[None], hooks.Sampling(1.0).through)
        return system.drive(hooks.driven((), servos, system, fed, q, v))

    def force(values, a):
        other = system.with_parameters({name: value for name, value in values.items() if name not in drives})
        others = tuple(servo.with_values(values) for servo in servos)
        needed = lambda q, v, a, u: other.mass(q) @ a + other.bias(q, v) - driven(other, others, q, v, u)  # noqa: E731
        return jax.vmap(needed)(q, v, a, u).ravel()

    if servos:
        accelerations = lambda q, v, u: jnp.stack(system.acceleration(q, v, driven(system, servos, q, v, u)))  # noqa: E731
        a = jax.jit(jax.vmap(accelerations))(q, v, u)
    slopes, whole = jax.jit(jax.jacfwd(lambda *at: 2 * (force(*at),), has_aux=True))(values, a)
    powers = np.asarray(v)[:, :, None] ** np.arange(_POWERS)
    curves = np.einsum("rjp,ij->rijp", powers, np.eye(dof)).reshape(q.size, -1)
    return {name: std[name] * np.asarray(slopes[name], float) for name in std}, curves, np.asarray(whole)


def sentences(result: Identifiability) -> list[str]:
    """Sentences of a report on parameters that are not identifiable."""
    never = f"no motion depends on {', '.join(result.never)}: kept as declared; declare them as numbers"
    kept = "only in combination: along the rest they keep what is declared, and their std says so"
    return [never] * bool(result.never) + [f"motions determine {', '.join(g)} {kept}" for g in result.together]


def not_identifiable(rig: Rig, system: Any, data: Dataset) -> tuple[str, ...]:
    """The uncertain parameters that carry the scale of the machine, where it is not identifiable; else none.

    Without a torque the motion is the same when M(q) and c(q, v) are multiplied by one number, and the learned friction
    with them. That number is free as long as a change of the uncertain parameters multiplies M and c. Of the change
    that is the least in declared standard deviations, the parameter that moves by the most of them is held; and so on.
    """
    if rig.equations or rig.input_kinds or np.any(np.asarray(data.u)[np.asarray(data.valid)]):
        return ()  # the gains of servos are numbers of the machine
    (left, _, whole), held = _columns(rig, system), []
    while left:
        columns = np.stack([*left.values()], axis=1)
        steps = np.linalg.lstsq(columns, whole, rcond=1e-9)[0]
        if np.linalg.norm(columns @ steps - whole) > _ROUNDING * np.linalg.norm(whole):
            break
        held.append([*left][int(np.argmax(np.abs(steps)))])
        del left[held[-1]]
    return tuple(held)


def holding(rig: Rig, names: tuple[str, ...]) -> Rig:
    """The rig with some parameters kept as they are declared."""
    kept = {name: Declared(rig.parameters[name].mean, 0.0) for name in names}
    return dataclasses.replace(rig, parameters={**rig.parameters, **kept}) if kept else rig
