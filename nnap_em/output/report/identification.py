"""Everything that `nnap-em identify` leaves behind beside the model: report.json, report.html, table and figure."""

import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ...base.digits import counted
from ...base.files import replace_bytes
from ...base.log import Log
from ...estimate.em.build import build_system
from ...estimate.em.loop import STEP_REFUSED
from ...estimate.identify import FrictionTable, Identified, friction_table
from ...estimate.misfit import Moved, moved
from ...estimate.predict import posterior_of
from ...explain.check import dynamics
from ...explain.diagnosis.keys import listed
from ...explain.diagnosis.residual import names_of
from ...logs.read import Logs
from .document import errors, friction_law, noise, parameters, predictions, shared, unknown_terms
from .fit_plots import error_figure, friction_figure, term_figure
from .html import Picture, picture, write_report
from .page import page
from .tables import visited_nodes, write_friction
from .wording import duration, reached


def write_identification(
    out: Path,
    fitted: Identified,
    train: Logs,
    test: Logs | None,
    epochs: list[dict[str, Any]],
    *,
    smoother: str,
    seed: int,
    began: float,
    log: Log,
) -> bool:
    """Write the report of a fit whose model is model.npz in `out`; `began` is `time.perf_counter()` at the start.

    True where the fit describes the motion.
    """
    figures: list[Picture] = []
    names, laws = names_of(fitted), None
    if fitted.rig.friction:
        velocities = _velocities(fitted, train, epochs)
        table = friction_table(fitted, jnp.asarray(visited_nodes(velocities)))
        laws = friction_law(fitted, table, velocities)
        write_friction(out / "friction.csv", *map(np.asarray, (table.velocity, table.torque, table.std)))
        figures.append(_draw(out / "friction.png", fitted, table, velocities))
    terms, sides = unknown_terms(fitted), {"fit": fitted}
    caption = (
        "Over the range of its signals in a simulation; the parameters of the equations have all that they can do."
    )
    for term in terms:
        if len(term["signals"]) < 3:
            figures.append(picture("found", f"Unknown term {term['name']}", caption, term_figure(term)))
    error = errors(predictions(sides, train, test, seed), sides, test) if test else None
    if error and reached(error):
        caption = "On test sequences that the fit has not seen."
        figures.append(picture("error", "Prediction error", caption, error_figure(error, names)))
    misfit, causes, far = fitted.misfit, [], moved(fitted.rig, fitted.m_step.prior, fitted.model)
    if misfit.useless and not fitted.rig.equations:
        causes = [one.text for one in dynamics(fitted.rig, build_system(fitted.rig), train.data) if one.mark != "ok"]
    entries = [{**epoch, "left_out": [train.files[i] for i in epoch["left_out"]]} for epoch in epochs]
    document = shared(fitted, train, test, seed=seed, began=began) | {
        "verdict": _verdict(fitted, len(train.files), len(entries[-1]["left_out"]), causes, far),
        "misfit": [misfit.text, *causes] if misfit.useless else [],
        "accuracy": misfit,
        "moved": far,
        "fit": error and {name: error[name] for name in ("given_s", "horizons_s")} | error["fit"],
        "error": error,
        "noise": noise(fitted),
        "parameters": parameters(fitted),
        "stopped": _stopped_early(fitted),
        "friction_law": laws,
        "unknown": terms,
        "log_likelihood": fitted.state.loglik.tolist(),
        "reached": float(np.nanmean(fitted.state.top)),
        "epochs": entries,
        "left_out": entries[-1]["left_out"],
        "smoother": smoother,
        "model": "model.npz",
    }
    _log_summary(document, log)
    write_report(out, "report", document, page(document, figures), fitted.rig.named)
    log(f"wrote {out / 'report.json'}" + ("" if test else f" ({document['error_note']})"))
    return not misfit.useless


def _verdict(
    fitted: Identified, sequences: int, diverged: int, causes: Sequence[str] = (), far: Sequence[Moved] = ()
) -> str:
    """The outcome of a fit: first, where it does not describe the motion, that; last numbers that left the rig's."""
    friction = [f"the friction of {counted(len(fitted.model.system.coordinates), 'joint')}"] * fitted.rig.friction
    estimated = listed([*friction, *parameters(fitted)]) or "the noise"
    used = f"{sequences - diverged} of " * bool(diverged) + counted(sequences, "sequence")
    rested = f" in {counted(fitted.state.epoch, 'epoch')}"
    rested += f", until {fitted.state.stop}" * (fitted.state.stop == STEP_REFUSED)
    early = f"; {_stopped_early(fitted)}" if fitted.rise else rested
    text, word = f"Fitted {estimated} to {used}{early}.", fitted.misfit.text
    causes = f"{'; '.join(causes)}." if causes else ""
    parts = [word, causes, text] if fitted.misfit.useless else [causes, text, word]
    return " ".join(part for part in (*parts, *(one.sentence for one in far)) if part)


def _stopped_early(fitted: Identified) -> str:
    """Sentence about a fit that its number of epochs ended; empty for one that came to rest."""
    if not fitted.rise:
        return ""
    how = f"while the log-likelihood still rose by {fitted.rise:.2g} nat a sequence"
    how = how if math.isfinite(fitted.rise) else "that mostly saw the beginning of the sequences"
    return f"stopped after {counted(fitted.state.epoch, 'epoch')} {how}: give it more with --epochs"


def _log_summary(document: dict[str, Any], log: Log) -> None:
    lines = [document["verdict"]] if document["accuracy"].text or document["moved"] else []
    lines += [*(law["text"] for law in document["friction_law"] or []), document["stopped"]]
    if document["left_out"]:
        lines.append(f"diverged, and left out of the last epoch: {listed(document['left_out'])}")
    error = document["error"] or {"fit": {}}
    for name, values in error["fit"].items():
        pairs = [(v, h) for h, v in zip(reached(error), values, strict=False) if not math.isnan(v)]
        lines.append(f"error {name}: " + ", ".join(f"{v:.3g} over {duration(error, h)}" for v, h in pairs))
    for name, entry in document["parameters"].items():
        lines.append(f"{name} = {entry['value']:.6g} +- {entry['std']:.2g} {entry['unit']}")
    for line in filter(None, lines):
        log(line)


def _velocities(fitted: Identified, train: Logs, epochs: list[dict[str, Any]]) -> Float[np.ndarray, "sample dof"]:
    mean = np.asarray(posterior_of(fitted, train.data).state.mean)
    valid = np.array(train.data.valid)
    valid[epochs[-1]["left_out"]] = False
    inside = valid & np.isfinite(mean).all(axis=-1)
    dof = len(fitted.model.system.coordinates)
    return mean[inside][:, dof : 2 * dof]


def _draw(path: Path, fitted: Identified, table: FrictionTable, visited: Float[np.ndarray, "sample dof"]) -> Picture:
    figure, image = friction_figure({"learned": table}, names_of(fitted), list(visited.T)), io.BytesIO()
    figure.savefig(image, format="png", metadata={"Software": "written by nnap_em"})
    replace_bytes(path, image.getvalue())
    return picture("found", "Learned friction", "With its 90 % band; below: where the data were.", figure)
