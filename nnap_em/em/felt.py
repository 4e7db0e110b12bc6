"""Identifiability: uncertain numbers that no motion depends on, or only in combination with others."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..data.rig import Rig
from ..systems import AbstractSystem

LEAST = 1e-6
"""Share of a parameter's own column that must be left when those of the others are taken out of it."""


class Felt(NamedTuple):
    """Uncertain parameters that keep, alone or along a combination, what was declared."""

    never: tuple[str, ...]
    """Numbers that no motion depends on."""
    together: tuple[tuple[str, ...], ...]
    """Groups of which motions depend on fewer combinations than members."""


def felt(rig: Rig, system: AbstractSystem) -> Felt:
    """Base parameters: combinations of uncertain parameters that the inverse dynamics M(q) a + c(q, v) depends on.

    [Gautier & Khalil 1990, IEEE Trans. Robotics and Automation 6(3): base parameters]  By the null space of its
    derivatives at random states, each in declared standard deviations.
    """
    names = [name for name, declared in rig.parameters.items() if declared.std > 0]
    if not names:
        return Felt((), ())
    columns = _columns(system, names) * np.asarray([rig.parameters[name].std for name in names])[None, :]
    size = np.linalg.norm(columns, axis=0)
    never = [i for i in range(len(names)) if size[i] <= LEAST * size.max(initial=0.0)]
    left = [i for i in range(len(names)) if i not in never]
    _, values, rows = np.linalg.svd(columns[:, left] / size[left], full_matrices=True)
    rank = int(np.sum(values > LEAST * values.max(initial=1e-300)))
    shared = np.abs(rows[rank:].T @ rows[rank:])
    groups: list[set[int]] = []
    for i in np.flatnonzero(np.diag(shared) > LEAST):
        group = {int(i), *map(int, np.flatnonzero(shared[i] > LEAST))}
        for other in [g for g in groups if g & group]:
            groups.remove(other)
            group |= other
        groups.append(group)
    together = tuple(tuple(names[left[i]] for i in sorted(group)) for group in groups)
    return Felt(tuple(names[i] for i in never), together)


def _columns(system: AbstractSystem, names: list[str]) -> Float[np.ndarray, "row param"]:
    """Derivatives of the inverse dynamics at random states by the parameters."""
    rng, dof = np.random.default_rng(0), len(system.coordinates)
    q, v, a = (jnp.asarray(rng.uniform(-3.0, 3.0, (8 + 4 * dof, dof)), float) for _ in range(3))

    def force(values):
        changed = system.with_parameters(dict(zip(names, values, strict=True)))
        return jax.vmap(lambda q, v, a: changed.mass(q) @ a + changed.bias(q, v))(q, v, a).ravel()

    values = [system.parameter(name) for name in names]
    slopes = jax.jit(jax.jacfwd(force))(values)
    return np.stack([np.asarray(slope, np.float64) for slope in slopes], axis=1)


def sentences(found: Felt) -> list[str]:
    """Sentences of a report on parameters that are not identifiable."""
    out = []
    if found.never:
        out.append(f"no motion feels {', '.join(found.never)}: kept as declared; take out what you do not doubt")
    for group in found.together:
        text = f"motions tell {', '.join(group)} only in combination"
        out.append(f"{text}: along the rest they keep what is declared, and their std says so")
    return out
