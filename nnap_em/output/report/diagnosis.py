"""Everything that `nnap-em diagnose` leaves behind: report.json, report.html and tables."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from ...base.log import Log
from ...estimate.identify import FrictionTable, friction_table
from ...estimate.misfit import moved
from ...estimate.predict import Prediction
from ...explain.diagnosis.diagnose import unbranched
from ...explain.diagnosis.findings import Finding, advice, changes, entry, suspected, undecided, verdict
from ...explain.diagnosis.interventions import Intervention
from ...explain.diagnosis.keys import Key, key_of, place_of, words
from ...explain.diagnosis.outcome import Diagnosis, Step
from ...explain.diagnosis.residual import Names, Residual, names_of, residual
from ...explain.diagnosis.statistics import tests
from ...logs.read import Logs
from .document import errors, noise, parameters, predictions, shared
from .fit_plots import effect_figure, error_figure, friction_figure, prediction_figure
from .html import Picture, picture, write_report
from .page import page
from .residual_plots import innovation_figure, residual_figure
from .tables import visited_nodes, write_friction
from .wording import duration, reached


def write_diagnosis(
    out: Path,
    diagnosis: Diagnosis,
    accepted: list[Finding],
    train: Logs,
    test: Logs | None,
    *,
    seed: int,
    began: float,
    log: Log,
) -> bool:
    """Write the report of a diagnosis into the folder `out`; `began` is `time.perf_counter()` at the start.

    True where the model with all that was found describes the motion.
    """
    names, both = names_of(diagnosis.before), {"before": diagnosis.before, "after": diagnosis.after}
    sides = both if accepted else {"before": diagnosis.before}
    predicted = predictions(sides, train, test, seed) if test else {}
    error = errors(predicted, sides, test) if test else None
    if error:
        error.setdefault("after", error["before"])
    searched = {name: fitted._replace(smoother=unbranched(fitted.bank)) for name, fitted in sides.items()}
    left = {name: residual(fitted, train.data) for name, fitted in searched.items()}
    tested = {name: tests(each, names) for name, each in left.items()}
    before, dof = left["before"], len(names.rates)
    followed = before.valid & before.used[:, None] & np.isfinite(before.state).all(axis=-1)
    velocities = before.state[followed][:, dof : 2 * dof]
    nodes = visited_nodes(velocities) if names.rates else np.zeros((0, 2))
    tables = {n: friction_table(f, jnp.asarray(nodes)) for n, f in sides.items() if diagnosis.before.rig.friction}
    for name, table in tables.items():
        write_friction(out / f"friction_{name}.csv", *map(np.asarray, (table.velocity, table.torque, table.std)))
    figures = [
        *_error_pictures(error, predicted, tables, names, test),
        *_residual_pictures(left, names),
        *_effect_pictures(accepted),
    ]
    rivals, suspects = undecided(diagnosis), suspected(diagnosis)
    failed = sum(t.p_value < 0.01 and not t.slight for t in tested["before"])
    after = diagnosis.after
    tried = len({key for step in diagnosis.steps for key, _ in (*step.screened, *step.refitted)})
    far, misfit = moved(after.rig, after.m_step.prior, after.model), after.misfit
    outcome = verdict(accepted, error, failed, rivals, suspects, diagnosis.unfinished, misfit=misfit.text, tried=tried)
    if diagnosis.change:
        outcome, far = changes(diagnosis, accepted, error), []
    command = "nnap-em design FIT --out NEXT, FIT this folder: the most informative inputs, ready to be played."
    designed = [command] if diagnosis.before.rig.input_columns and not diagnosis.before.rig.equations else []
    document = shared(diagnosis.before, train, test, seed=seed, began=began) | {
        "verdict": " ".join([outcome, *[misfit.text] * (misfit.text not in outcome), *(one.sentence for one in far)]),
        "misfit": [misfit.text] if misfit.useless else [],
        "accuracy": {name: fitted.misfit for name, fitted in both.items()},
        "moved": far,
        "complete": diagnosis.complete,
        "since_fit": {"risen": diagnosis.risen} if diagnosis.change else None,
        "effects": [entry(f) for f in accepted],
        "interventions": [_disturbance(force, train.files) for force in diagnosis.interventions],
        "error": error,
        "models": {name: f"{name}.npz" for name in both},
        "tests": {name: [t._asdict() for t in each] for name, each in tested.items()},
        "parameters": {name: parameters(fitted) for name, fitted in both.items()},
        "noise": {name: noise(fitted) for name, fitted in both.items()},
        "rounds": [_round(step, diagnosis.before.rig.dt) for step in diagnosis.steps],
        "undecided": [place_of(key) for key in rivals],
        "suspects": suspects,
        "next": [*advice(accepted, rivals, suspects), *designed],
    }
    write_report(out, "report", document, page(document, figures), diagnosis.before.rig.named)
    log(document["verdict"])
    log(f"wrote {out / 'report.html'} and report.json")
    return not misfit.useless


def _error_pictures(
    error: dict[str, Any] | None,
    predicted: Mapping[str, Prediction],
    tables: Mapping[str, FrictionTable],
    names: Names,
    test: Logs | None,
) -> list[Picture]:
    """Pictures of prediction errors, of the learned friction, and of the prediction of the longest test sequence."""
    alone = lambda sides: sides if "after" in sides else {"fit": sides["before"]}  # noqa: E731
    errors, friction, motion = [], [], []
    if error and test and reached(error):
        both = {name: error[name] for name in predicted}
        figure = error_figure({name: error[name] for name in ("horizons_s", "reach_s")} | alone(both), names)
        caption = "On test sequences that no fit and no choice has seen."
        errors.append(picture("error", "Prediction error", caption, figure))
        longest, given = int(np.argmax(np.sum(np.asarray(test.data.valid), axis=1))), error["given_s"]
        figure = prediction_figure(alone(predicted), test.data, names, given, longest)
        caption = f"The longest one ({test.files[longest]}), predicted from its first {duration(error, given)}."
        motion.append(picture("error", "One test sequence", caption, figure))
    if tables:
        caption = "A missing effect bends the friction that is learned without it." if len(tables) > 1 else ""
        figure = friction_figure(alone(tables), names, title="Learned friction")
        friction.append(picture("error", "Learned friction", caption, figure))
    return [*errors, *friction, *motion]


def _residual_pictures(left: Mapping[str, Residual], names: Names) -> list[Picture]:
    before, after, out = left["before"], left.get("after"), []
    if names.coordinates:
        title = "The force that the declared model lacks"
        caption = "What the smoothed motion needs beyond the declared model, against everything that could cause it."
        lacking = after.without_effects() if after else before
        out.append(picture("residual", title, caption, residual_figure(lacking, names, after)))
    caption = "Their autocorrelation should stay within its bounds."
    return [*out, picture("residual", "One-step errors", caption, innovation_figure(before, names, after))]


def _effect_pictures(accepted: list[Finding]) -> list[Picture]:
    out = []
    for finding in accepted:
        if (curve := finding.curve) is not None:
            name = words(key_of(finding.effect))
            title = f"What is left of {name}, a function of {curve.signal}" if finding.left else f"The learned {name}"
            out.append(picture("found", title, "With its 90 % band, without its mean.", effect_figure(curve)))
    return out


def _round(step: Step, dt: float) -> dict[str, Any]:
    return {
        "horizon_s": step.horizon * dt,
        "measure": step.measure,
        "screened": [_screened(*each) for each in step.screened[:10]],
        "refitted": [_screened(*each) for each in step.refitted],
        "accepted": words(step.accepted) if step.accepted else None,
        "untried": step.untried,
    }


def _disturbance(force: Intervention, files: Sequence[str]) -> dict[str, Any]:
    interval = {"joint": force.joint, "from": force.from_s, "to": force.to_s}
    return {"file": files[force.sequence], **interval, "size": force.size, "std": force.std, "unit": force.unit}


def _screened(key: Key, gain: float) -> dict[str, Any]:
    return place_of(key) | {"name": key[0], "gain": gain}
