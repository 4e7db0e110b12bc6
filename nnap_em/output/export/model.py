"""A fitted model for other programs: its numbers as JSON."""

import math
from pathlib import Path
from typing import Any

import numpy as np

from ... import __version__
from ...base.files import replace_own
from ...errors import ExportError
from ...estimate.identify import Identified, friction_table, parameter_table
from ...machines.systems import AbstractPlant
from ...model.effects import AbstractEffect
from ...model.state_space import StateSpaceModel
from ..report.tables import json_text


def write_model(fitted: Identified, out: Path | str) -> None:
    """Write parameters.json, all numbers of the model with their units, to a folder.

    Args:
        fitted: the model.
        out: the folder.

    Raises:
        ExportError: its inputs are commands of servos; nothing is written.

    Example:
        >>> from nnap_em.output import export
        >>> export.write_model(fit, f"{folder}/plain")
    """
    if fitted.model.servos:
        raise ExportError(
            "its inputs are commands of servos, of which parameters.json has none; use --mjcf, --urdf or --c"
        )
    replace_own({Path(out) / "parameters.json": json_text(parameters(fitted))})


def parameters(fitted: Identified) -> dict[str, Any]:
    """All numbers of the model, with units, as JSON has them."""
    rig, model = fitted.rig, fitted.model
    system, states = model.system, states_of(model)
    estimated = parameter_table(fitted)
    values = {name: (pair.mean, pair.std) for name, pair in rig.parameters.items()} | estimated
    return {
        "format": 1,
        "versions": {"nnap_em": __version__},
        "rig": rig.name,
        "system": rig.system,
        "states": [{"name": n, "unit": system.unit(n)} for n in system.states],
        "inputs": [
            {"name": n, "joint": drive.get("joint"), "unit": unit}
            for (n, unit), drive in zip(inputs_of(fitted).items(), system.drives, strict=True)
        ],
        "sensors": [{"name": name, "unit": unit} for name, unit in system.sensors.items()],
        "measured": list(rig.measured),
        "dt": {"value": model.dt, "unit": rig.time_unit},
        "parameters": {
            n: {"value": v, "std": s, "unit": rig.unit(n), "estimated": n in estimated} for n, (v, s) in values.items()
        },
        "noise": {
            "measurement_std": _pairs(rig.measured, np.exp(0.5 * np.asarray(model.log_r))),
            "process_std_per_step": _pairs(states, np.exp(0.5 * np.asarray(model.log_q))),
        },
        "start": {
            "mean": _pairs(states, np.asarray(model.start.mean)),
            "std": _pairs(states, np.sqrt(np.diag(np.asarray(model.start.cov)))),
        },
        "friction": {"joints": _friction(fitted)} if rig.friction else None,
        "effects": [_effect(effect, system) for effect in model.effects],
    }


def inputs_of(fitted: Identified) -> dict[str, str]:
    """Inputs and their units."""
    rig, pairs = fitted.rig, zip(fitted.rig.input_columns, fitted.rig.input_joints, strict=True)
    return {name: rig.unit(name) if rig.equations else fitted.model.system.force_unit(joint) for name, joint in pairs}


def states_of(model: StateSpaceModel) -> tuple[str, ...]:
    """States of the plant, and a name for each state of memory."""
    names = model.system.states
    return names + tuple(f"memory{i + 1}" for i in range(model.log_q.shape[0] - len(names)))


def _pairs(names: tuple[str, ...], values: np.ndarray) -> dict[str, float]:
    return dict(zip(names, values.tolist(), strict=True))


def _friction(fitted: Identified) -> list[dict[str, Any]]:
    table = friction_table(fitted, fitted.m_step.weights(fitted.model).nodes)
    columns = {"velocity": table.velocity, "torque": table.torque, "torque_std": table.std}
    return [
        {"joint": j + 1, "velocity_unit": rate, "torque_unit": force}
        | {name: np.asarray(values[j]).tolist() for name, values in columns.items()}
        for j, (rate, force) in enumerate(table.units)
    ]


def _effect(effect: AbstractEffect, system: AbstractPlant) -> dict[str, Any]:
    units = effect.units_on(system)
    values = {name: float(value) for name, value in effect.values().items()}
    return {
        "name": effect.name,
        "joint": effect.joint,
        "channel": effect.channel,
        "parameters": {n: {"value": v if math.isfinite(v) else None, "unit": units[n]} for n, v in values.items()},
    }
