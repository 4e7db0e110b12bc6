"""Content of report.json that fits of all commands share."""

import platform
import time
from collections.abc import Mapping
from importlib.metadata import version
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from ... import __version__
from ...estimate.identifiability import identifiability, sentences
from ...estimate.identify import FrictionTable, Identified, parameter_table
from ...estimate.predict import Prediction, given_of, horizon_errors, horizons_of, predict
from ...explain.diagnosis.hypothesis import covariances
from ...logs.dataset import stepped
from ...logs.read import Logs
from ...model.effects.equations import UnknownTerm
from ...model.law import LAW_UNITS, PARAMETERS, describe, fit_law, passed


def shared(fitted: Identified, train: Logs, test: Logs | None, *, seed: int, began: float) -> dict[str, Any]:
    """The keys of every report; `began` is `time.perf_counter()` at the start."""
    system = fitted.model.system
    return {
        "format": 1,
        "rig": fitted.rig.name,
        "system": fitted.rig.system,
        "units": {name: system.unit(name) for name in (*system.readable, "time")},
        "error_note": None if test else "no test sequences (FOLDER/test/*.csv), so no prediction error",
        "masked": masked(train, test),
        "undetermined": []
        if fitted.rig.equations
        else sentences(identifiability(fitted.rig, system, fitted.model.servos or ())),
        "seed": seed,
        "seconds": time.perf_counter() - began,
        "versions": versions(),
    }


def versions() -> dict[str, str]:
    """Versions of this package, of Python, and of packages that affect the last digits."""
    names = ("jax", "jaxlib", "equinox", "numpy")
    return {"nnap_em": __version__, "python": platform.python_version()} | {name: version(name) for name in names}


def masked(train: Logs, test: Logs | None) -> list[dict[str, Any]]:
    """Readings of the logs that no fit and no filter used."""
    parts = (("train", train), ("test", test))
    return [{"part": part, **entry._asdict()} for part, logs in parts if logs for entry in logs.masked]


def parameters(fitted: Identified) -> dict[str, Any]:
    """Estimated physical parameters."""
    return {n: {"value": v, "std": s, "unit": fitted.rig.unit(n)} for n, (v, s) in parameter_table(fitted).items()}


def unknown_terms(fitted: Identified) -> list[dict[str, Any]]:
    """Unknown terms of equations as tables over the ranges of their signals, with standard deviations."""
    system, out = fitted.model.system, []
    numbers = covariances(fitted.model, fitted.m_step, fitted.state.hessian)
    for effect, cov in zip(fitted.model.effects, numbers, strict=True):
        if isinstance(effect, UnknownTerm):
            table = dict(zip(("places", "value", "std"), effect.table(cov), strict=True))
            unit = system.port_unit(system.ports.index(str(effect.channel)) + 1)
            signals = {name: system.unit(name) for name in effect.reads}
            out.append({"name": effect.label, "enters": effect.channel, "signals": signals, "unit": unit} | table)
    return out


def noise(fitted: Identified) -> dict[str, Any]:
    """Standard deviations of readings, and of what pushes the states in every step."""
    system, estimated = fitted.model.system, fitted.m_step.learn_r
    reading, kick = (np.exp(0.5 * np.asarray(log)).tolist() for log in (fitted.model.log_r, fitted.model.log_q))
    return {
        "measurement": {
            name: {"std": std, "estimated": learned, "unit": system.unit(name)}
            for name, std, learned in zip(fitted.rig.measured, reading, estimated, strict=True)
        },
        "process_per_step": {
            name: {"std": std, "unit": system.unit(name)}
            for name, std in zip(system.states, kick, strict=False)  # behind these: memory
        },
    }


def predictions(sides: Mapping[str, Identified], train: Logs, test: Logs, seed: int) -> dict[str, Prediction]:
    """Predictions of the test sequences, from their first readings, by every model with the same random numbers.

    They are smoothed by the program that smoothed `train`, unless that has more than eight times their rows.
    """
    key, rows, longer = jax.random.key(seed), test.data.t.shape[1], train.data.t.shape[1]
    data = stepped(test.data, longer if longer <= 8 * rows else 0)
    every = {name: predict(fitted, data, given_of(fitted), key=key) for name, fitted in sides.items()}
    out = jax.device_put(jax.tree.map(lambda a: np.asarray(a)[:, :rows], every))
    return {name: out[name] for name in sides}  # JAX sorts names


def errors(predicted: Mapping[str, Prediction], sides: Mapping[str, Identified], test: Logs) -> dict[str, Any]:
    """Errors of the predictions, for every column and horizon; `reach_s` is where the longest sequence ends."""
    first = next(iter(sides.values()))
    given, horizons = given_of(first), horizons_of(first)
    by_model = {name: horizon_errors(p, sides[name], test.data, given, horizons) for name, p in predicted.items()}
    t, valid = (np.asarray(a) for a in (test.data.t, test.data.valid))
    return {
        "given_s": given,
        "time_unit": first.rig.time_unit,
        **({"judged_s": horizons[-1]} if first.model.system.simulated else {}),
        "horizons_s": list(horizons),
        "reach_s": float(np.max((t - t[:, :1])[valid])) - given,
        **by_model,
    }


def friction_law(
    fitted: Identified, table: FrictionTable, velocity: Float[np.ndarray, "sample dof"]
) -> list[dict[str, Any]]:
    """The Stribeck law nearest to each learned map, as far as `velocity` in all rows resolves it."""
    system, fast = fitted.model.system, passed(velocity, np.asarray(table.velocity))
    law = fit_law(table.velocity, table.torque, table.cov, fast)
    out = []
    for j, text in enumerate(describe(law, system.coordinates, system.angles)):
        numbers = zip(PARAMETERS, law.value[j].tolist(), law.std[j].tolist(), LAW_UNITS[system.angles[j]], strict=True)
        terms = {name: {"value": value, "std": std, "unit": unit} for name, value, std, unit in numbers}
        out.append({"joint": j + 1, "parameters": terms, "text": text})
    return out
