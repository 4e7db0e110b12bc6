"""Machines drawn from the posterior of a fit: a table of their numbers, and a file for a simulator each."""

import dataclasses
from pathlib import Path

import numpy as np
from jaxtyping import PRNGKeyArray

from ..data.formats import write_csv
from ..fit.identify import Identified
from ..fit.predict import drawn_paths
from ..systems.tree import Tree
from .friction import FrictionForm, friction_forms
from .mjcf import write_variant

TABLE = "draws.csv"


def write_draws(fitted: Identified, out: Path | str, count: int, *, key: PRNGKeyArray) -> None:
    """Write draws of the posterior: draws.csv, and draw_00.xml, ... for a machine from a file.

    A row of draws.csv has friction per joint (`JOINT.coulomb`, `.breakaway`, `.stribeck`, `.viscous`, `.offset`), the
    estimated parameters of the machine, and those of every effect (`EFFECT.JOINT.NAME`), in SI units.

    Args:
        fitted: the model.
        out: the folder.
        count: number of draws.
        key: random key of the draws.
    """
    out = Path(out)
    paths = drawn_paths(fitted, count, key=key)
    columns: dict[str, list[float]] = {}
    width = len(str(count - 1))
    for i in range(count):
        drawn = paths.prior.write(paths.model, paths.parameters[i])
        if isinstance(drawn.system, Tree):
            drawn = dataclasses.replace(drawn, system=drawn.system.reached_from(paths.model.system))
        forms = friction_forms(fitted, np.asarray(paths.tables[i]))
        row: dict[str, float] = {"draw": i}
        for name, form in zip(drawn.system.coordinates, forms, strict=True):
            row |= {f"{name}.{what}": getattr(form, what) for what in FrictionForm._fields[:5]}
        row |= {name: float(drawn.parameter(name)) for name in paths.prior.declared}
        for effect in drawn.effects:
            at = effect.joint or effect.channel or "all"
            row |= {f"{effect.name}.{at}.{name}": float(value) for name, value in effect.values().items()}
        for name, value in row.items():
            columns.setdefault(name, []).append(value)
        if isinstance(drawn.system, Tree):
            write_variant(fitted, drawn, forms, out / f"draw_{i:0{width}d}.xml")
    write_csv(out / TABLE, {name: np.asarray(values, float) for name, values in columns.items()})
