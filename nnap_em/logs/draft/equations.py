"""A first rig.toml of equations from the columns of a log: what follows the time are inputs, then readings."""

import math
import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ...errors import DataError
from ...machines.systems.expression import FUNCTIONS
from ...machines.table import toml_text
from ...machines.units import named_unit
from ..importing.files import reader
from ..importing.recording import Address
from ..noise import fast_reading_noise, resolution
from .draft import HEAD, Draft, addresses, columns_table, meaning, sampling


def draft_equations(path: Path) -> Draft:
    """The rig.toml for a CSV log, with one state for each reading and rates to be written."""
    topics = reader(path).topics(path)
    found: dict[str, Address] = {}
    units: dict[str, str] = {}
    for at in (Address(topic.name, field) for topic in topics for field in topic.fields):
        name, unit = _named(at.path)
        name = f"{name}_{len(found)}" if name in found else name
        found[name], units[name] = at, unit
    if not found:
        raise DataError(f"{path}: holds no column beside the time; give a log with inputs and readings")
    table = columns_table(path, found)
    columns = {name: values for name, values in table.items() if name in found}
    inputs = [name for name, values in columns.items() if _input(name, values)]
    inputs = (inputs or list(columns)[:1])[: len(columns) - 1]  # what is left is read
    readings = [name for name in columns if name not in inputs]
    names = {name: f"x{i}" for i, name in enumerate(readings, 1)}
    lines = [
        "[model]",
        'type = "equations"',
        f'inputs = {_declared({name: units[name] for name in inputs})}    # with units: {{ pump = "V" }}',
        f"states = {_declared({names[name]: units[name] for name in readings})}    # those not read, too; with units: "
        '{ h1 = "V" }',
        "# Derivatives of the states by time [1/s]; a number is trusted, { mean = 0.05, std = 0.03 } is estimated.",
        '# rates = ...    # such as { x1 = "k*pump - a*sqrt(x1)" }, and then k = { mean = 1.0, std = 1.0 }, ...',
        *sampling(table, math.inf),
        "",
        "[measurement]",
        f"columns = {{ {', '.join(f'{toml_text(name)} = {toml_text(state)}' for name, state in names.items())} }}",
        "",
        "[measurement.noise_std]    # read off the high frequencies; what is left out is estimated",
        *(f"# {toml_text(name)} = {fast_reading_noise(columns[name][None]):.2g}" for name in readings),
        "",
        "[start]    # the state in the first row, where it is known but not measured",
        *(f"# {state} = {{ mean = 0.0, std = 0.5 }}" for state in names.values()),
        *addresses(topics, found),
    ]
    head = HEAD.replace("# SI units: s, kg, m, rad, N m.  Fill", "# Units are yours; time is in s.  Fill")
    title = toml_text(path.resolve().parent.name or "rig")
    return Draft("\n".join([head.format(name=title), *lines]) + "\n")


def _named(field: str) -> tuple[str, str]:
    """The name of a column as a formula writes it, and its unit."""
    name, unit = named_unit(field)
    if bracket := re.fullmatch(r"(.+?)[ _]*[\[({]([^][(){}]*[^][(){}\d][^][(){}]*)[\])}]", field):
        name, unit = bracket.groups()
    name = re.sub(r"\W+", "_", name).strip("_")
    return (name if name.isidentifier() and name not in (*FUNCTIONS, "time") else f"c_{name}"), unit.strip()


def _declared(units: Mapping[str, str]) -> str:
    """Names with their units where all have one."""
    if units and all(units.values()):
        return f"{{ {', '.join(f'{toml_text(name)} = {toml_text(unit)}' for name, unit in units.items())} }}"
    return f"[{', '.join(map(toml_text, units))}]"


def _input(name: str, values: Float[np.ndarray, " time"]) -> bool:
    """True for a column that is called as an input, or that stands still most of the time."""
    still = float(np.mean(np.diff(values) == 0)) if len(values) > 1 else 0.0
    # Share of equal neighbours from which on a column is taken for an input: that of a reading changes in every row
    return meaning(name).kind == "input" or (still > 0.5 and resolution(values[None]) == 0.0)
