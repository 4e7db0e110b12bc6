"""Everything that `nnap-em diagnose` leaves behind: report.json, report.html and tables."""

import io
import platform
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

from . import __version__
from . import diagnosis_plots as plots
from .data import Logs
from .diagnose import Finding, advice, curve, entry, friction_change, verdict
from .files import replace_text
from .identify import Identified, friction_table, parameter_table
from .look import words
from .loop import Closed
from .page import Picture, page
from .predict import GIVEN, HORIZONS, horizon_errors, predict
from .residual import Residual, names_of, residual, tests
from .rig import parameter_unit
from .tables import masked, state_unit, visited_nodes, write_friction, write_json

Say = Callable[[str], None]


def write_diagnosis(
    out: Path,
    closed: Closed,
    found: list[Finding],
    train: Logs,
    test: Logs | None,
    *,
    seed: int,
    began: float,
    say: Say,
) -> None:
    """Write the report of a closed loop into the folder `out`; `began` is `time.perf_counter()` at the start."""
    names = names_of(closed.before)
    sides = {"before": closed.before, "after": closed.after}
    if not found:
        sides = {"before": closed.before}
    predictions = {n: predict(f, test.data, GIVEN, key=jax.random.key(0)) for n, f in sides.items()} if test else {}
    error = None
    if test:
        errors = {n: horizon_errors(p, sides[n], test.data, GIVEN) for n, p in predictions.items()}
        error = {"given_s": GIVEN, "horizons_s": list(HORIZONS), "before": errors["before"]}
        error["after"] = errors.get("after", errors["before"])
    residuals = {n: residual(f, train.data) for n, f in sides.items()}
    lacked = residual(closed.after, train.data, add_back=True) if found else residuals["before"]
    visited = _visited(residuals["before"], closed.before)
    told = {n: tests(r, names) for n, r in residuals.items()}
    document = {
        "format": 1,
        "rig": closed.before.rig.name,
        "system": closed.before.rig.system,
        "verdict": verdict(found, error, sum(t.p_value < 0.01 and not t.slight for t in told["before"])),
        "effects": [entry(f) for f in found],
        "error": error,
        "error_note": None if test else "no test sequences (FOLDER/test/*.csv), so no prediction error",
        "models": {"before": "before.npz", "after": "after.npz"},
        "friction_change": friction_change(closed, visited),
        "tests": {n: [t._asdict() for t in each] for n, each in told.items()},
        "parameters": {n: _parameters(f) for n, f in (("before", closed.before), ("after", closed.after))},
        "noise": {n: _noise(f) for n, f in (("before", closed.before), ("after", closed.after))},
        "looks": [_look(closed, step) for step in closed.steps],
        "masked": masked(train, test),
        "next": advice(found),
        "seed": seed,
        "versions": {"nnap_em": __version__, "python": platform.python_version()}
        | {name: version(name) for name in ("jax", "jaxlib", "equinox", "numpy")},
    }
    figures: list[Picture] = []

    def add(place: str, title: str, caption: str, figure: Figure) -> None:
        image = io.BytesIO()
        figure.savefig(image, format="svg")
        figures.append(Picture(title, caption, image.getvalue(), place))

    if error:
        units = {n: state_unit(closed.before.model.system, n) for n in names.measured}
        add("error", "Prediction error before and after", "On test sequences that no fit and no choice has seen.",
            plots.error_figure(error, units))  # fmt: skip
    add(
        "residual",
        "The force that the declared model lacks",
        "What the smoothed motion asks for beyond the declared model, against everything that could cause it.",
        plots.residual_figure(lacked, names, residuals.get("after")),
    )
    for i in range(len(found)):
        drawn = curve(closed.after, i)
        if drawn is not None:
            label_y = f"torque at joint {found[i].effect.joint} [N m]"
            picture = plots.effect_figure(drawn.x, drawn.mean, drawn.std, label_x=drawn.label, label_y=label_y)
            add(
                "found",
                f"The learned function of {drawn.label}",
                "With its 90 % band, without its mean.",
                picture,
            )
    if closed.before.rig.friction:
        tables = {n: friction_table(f, jnp.asarray(visited)) for n, f in sides.items()}
        for name, table in tables.items():
            columns = (np.asarray(a) for a in (table.velocity, table.torque, table.std))
            write_friction(out / f"friction_{name}.csv", *columns)
        add(
            "error",
            "Learned friction",
            "A missing effect bends the friction that is learned without it.",
            plots.friction_pair_figure(
                tables["before"], tables.get("after", tables["before"]), rotary=closed.before.model.system.angles
            ),
        )
    if test:
        number = int(np.argmax(np.sum(np.asarray(test.data.valid), axis=1)))
        rows = np.asarray(test.data.valid[number])
        pair = {n: (np.asarray(p.mean)[number][rows], np.asarray(p.std)[number][rows]) for n, p in predictions.items()}
        t, y = np.asarray(test.data.t[number])[rows], np.asarray(test.data.y[number])[rows]
        picture = plots.prediction_pair_figure(t, y, names, pair["before"], pair.get("after", pair["before"]), GIVEN)
        add("error", "One test sequence", f"Predicted from its first second ({test.files[number]}).", picture)
    add(
        "residual",
        "One-step errors",
        "Left: they should not remember each other. Right: they should follow the line.",
        plots.innovation_figure(residuals["before"], names, residuals.get("after")),
    )
    if closed.steps:
        first = next((s for s in closed.steps if s.accepted), closed.steps[0])
        chosen = words(first.accepted) if first.accepted else None
        entries = [(words(key), gain) for key, gain in first.screened[:10]]
        add("details", "The first look", "Gain of the likelihood that each candidate promises, before any refit.",
            plots.screen_figure(entries, chosen=chosen))  # fmt: skip
    document["seconds"] = time.perf_counter() - began
    write_json(out / "report.json", document)
    replace_text(out / "report.html", page(document, figures))
    say(document["verdict"])
    say(f"wrote {out / 'report.html'} and report.json")


def _parameters(fitted: Identified) -> dict[str, Any]:
    return {n: {"value": v, "std": s, "unit": parameter_unit(n)} for n, (v, s) in parameter_table(fitted).items()}


def _noise(fitted: Identified) -> dict[str, Any]:
    names = fitted.rig.measured
    reading = dict(zip(names, np.exp(0.5 * np.asarray(fitted.model.log_r)).tolist(), strict=True))
    system = fitted.model.system
    states = system.coordinates + system.rates
    kicks = np.exp(0.5 * np.asarray(fitted.model.log_q)).tolist()
    return {"measurement": reading, "process_per_step": dict(zip(states, kicks, strict=False))}


def _look(closed: Closed, step) -> dict[str, Any]:
    def told(entries):
        return [
            {"name": k[0], "joint": k[1], "channel": k[2], "inputs": list(k[3]), "gain": gain} for k, gain in entries
        ]

    return {
        "horizon_s": step.horizon * closed.before.rig.dt,
        "screened": told(step.screened[:10]),
        "refitted": told(step.refitted),
        "accepted": words(step.accepted) if step.accepted else None,
    }


def _visited(found: Residual, fitted: Identified) -> np.ndarray:
    """Velocities of each joint that the paths visit, dense near rest."""
    dof = len(fitted.model.system.coordinates)
    inside = found.valid & found.used[:, None] & np.isfinite(found.state).all(axis=-1)
    return visited_nodes(found.state[inside][:, dof : 2 * dof])
