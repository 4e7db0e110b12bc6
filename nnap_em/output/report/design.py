"""Everything that `nnap-em design` leaves behind: the inputs to be played, design.json and design.html."""

import json
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ...base.digits import counted, number
from ...base.files import check_own
from ...base.log import Log
from ...explain.design.criteria import after
from ...explain.design.experiment import Design
from ...explain.diagnosis.keys import key_of, listed, words
from ...explain.diagnosis.residual import Names, names_of
from ...logs.formats import write_csv
from .document import versions
from .html import Picture, Section, Table, picture, rendered, section, write_report
from .style import AFTER, BEFORE, ZERO_LINE, head, limits, styled, symbol

INPUT_DIR, MOTION_DIR = "inputs", "motion"
"""Folders of the files to be played, and of what the machine should then do."""
SEQUENCES_ACROSS = 3
"""Sequences in one figure."""


def write_design(out: Path, design: Design, *, seed: int, began: float, log: Log) -> None:
    """Write a designed experiment into the folder `out`; `began` is `time.perf_counter()` at the start."""
    files = _write_sequences(out, design)
    document = describe(design) | {
        "inputs": [f"{INPUT_DIR}/{file}" for file in files],
        "motion": [f"{MOTION_DIR}/{file}" for file in files],
        "seed": seed,
        "seconds": time.perf_counter() - began,
        "versions": versions(),
    }
    text = rendered("Next experiment for", document, _sections(document, design))
    write_report(out, "design", document, text, design.fitted.rig.named)
    log(document["verdict"])
    log(f"wrote {out / 'design.html'}, design.json and {counted(len(files), 'file')} in {out / INPUT_DIR}")


def check_places(out: Path, count: int) -> list[Path]:
    """Files of the design that is in `out`; StoreError where another would be replaced by one of `count` sequences."""
    check_own(out / f"design.{kind}" for kind in ("json", "html"))
    file = out / "design.json"
    document = json.loads(file.read_text()) if file.exists() else {}
    mine = [out / name for name in (*document.get("inputs", []), *document.get("motion", []))]
    check_own({out / folder / file for folder in (INPUT_DIR, MOTION_DIR) for file in _names(count)} - {*mine})
    return mine


def _names(count: int) -> list[str]:
    return [f"{i + 1:0{len(str(count))}d}.csv" for i in range(count)]


def _write_sequences(out: Path, design: Design) -> list[str]:
    """The files of all sequences; those of an older design go."""
    states, inputs = design.fitted.model.system.coordinates + design.fitted.model.system.rates, design.u
    files = _names(len(inputs))
    for old in check_places(out, len(files)):
        old.unlink(missing_ok=True)
    bands = {"": design.middle, "_low": design.low, "_high": design.high}
    for i, file in enumerate(files):
        columns = dict(zip(design.fitted.rig.input_columns, inputs[i].T, strict=True))
        write_csv(out / INPUT_DIR / file, {"time": design.t} | columns)
        columns = {f"{name}{end}": band[i, :, s] for s, name in enumerate(states) for end, band in bands.items()}
        write_csv(out / MOTION_DIR / file, {"time": design.t} | columns)
    return files


# --- in numbers and words


def describe(design: Design) -> dict[str, Any]:
    """Description of the experiment and of its expected information, as in design.json."""
    rig, system, limits = design.fitted.rig, design.fitted.model.system, design.limits
    states, inputs = system.coordinates + system.rates, rig.input_columns
    force = dict(zip(inputs, (system.force_unit(joint) for joint in system.joints), strict=True))
    ends = zip((*limits.low, *limits.lowest), (*limits.high, *limits.highest), strict=True)
    document = {
        "format": 1,
        "rig": rig.name,
        "system": rig.system,
        "units": {name: system.unit(name) for name in states} | force,
        "sequences": len(design.u),
        "seconds_each": float(design.t[-1]),
        "dt": rig.dt,
        "starts": [dict(zip(states, start.tolist(), strict=True)) for start in design.start],
        "limits": {
            "values": dict(zip((*inputs, *states), ([float(a), float(b)] for a, b in ends), strict=True)),
            "rate": dict(zip(inputs, limits.rate.tolist(), strict=True)),
            "declared": sorted({*rig.limits.values, *rig.limits.rate, *rig.limits.start}),
        },
        "friction": friction_entries(design) if rig.friction else [],
        "parameters": parameter_entries(design),
    }
    return document | {"verdict": _verdict(document)}


def _stds(design: Design) -> dict[str, Float[np.ndarray, " phi"]]:
    """Standard deviations now, and after each of two experiments."""
    cov = np.asarray(design.fit.cov)
    sides = {"now": 0 * design.old, "expected": design.expected, "same_time_of_old_inputs": design.old}
    return {side: np.sqrt(np.diagonal(after(cov, information))) for side, information in sides.items()}


def friction_entries(design: Design) -> list[dict[str, Any]]:
    """Standard deviation of the friction of every joint near rest, now and after."""
    nodes, out = np.asarray(design.fit.nodes), []
    stds = {side: std[: nodes.size].reshape(nodes.shape) for side, std in _stds(design).items()}
    for j, v in enumerate(nodes):
        near = (design.criterion.weight[0, j] > 0) & (np.abs(v) <= design.slow[j])
        rms = {side: float(np.sqrt(np.mean(std[j][near] ** 2))) for side, std in stds.items()}
        out.append({"joint": j + 1, "near_rest_below": float(design.slow[j]), "near_rest": rms})
    return out


def parameter_entries(design: Design) -> dict[str, dict[str, Any]]:
    """Value and standard deviation of every estimated parameter, now and after."""
    prior, model = design.fit.prior, design.fit.model
    if not prior.size:
        return {}
    value = np.asarray(prior.mean + prior.std * prior.read(model))
    stds = {side: np.asarray(prior.std) * std[design.fit.nodes.size :] for side, std in _stds(design).items()}
    labels, units = [], []
    for name, place in zip(prior.names, prior.places(model), strict=True):
        whose, unit = name, design.fitted.rig.unit(name)
        if name not in prior.declared:
            at, _, field = name.partition(".")
            effect = model.effects[int(at)]
            whose, unit = f"{words(key_of(effect))}, {field}", effect.units_on(model.system).get(field, "SI")
        labels += [whose] if np.size(place) == 1 else [f"{whose} {i + 1}" for i in range(np.size(place))]
        units += [unit] * np.size(place)
    return {
        label: {"value": float(value[i]), "unit": units[i]} | {s: float(v[i]) for s, v in stds.items()}
        for i, label in enumerate(labels)
    }


def _verdict(document: dict[str, Any]) -> str:
    gains, near = [], [entry["near_rest"] for entry in document["friction"]]
    if near:
        times = {side: listed([number(std["now"] / std[side], 2) for std in near]) for side in near[0]}
        joints = f"joints {listed([str(f['joint']) for f in document['friction']])}" if len(near) > 1 else "the joint"
        old = f"as much time of the old inputs: {times['same_time_of_old_inputs']}"
        gains.append(f"the friction band near rest of {joints} {times['expected']} times narrower ({old})")
    surer = {name: p["now"] / p["expected"] for name, p in document["parameters"].items() if p["expected"] > 0}
    named = sorted((name for name, times in surer.items() if times > 1.1), key=lambda name: -surer[name])
    gains += [f"{name} {number(surer[name], 2)} times surer" for name in named[:3]]
    gains = gains or ["hardly anything surer: widen [limits], or give more --seconds"]
    what = f"{counted(document['sequences'], 'sequence')} of {number(document['seconds_each'])} s"
    return f"{what} should make {listed(gains)}."


# --- as a page


def _sections(document: dict[str, Any], design: Design) -> list[Section | None]:
    names, friction, units = names_of(design.fitted), document["friction"], document["units"]
    declared, rate = document["limits"]["declared"], document["limits"]["rate"]
    known = []
    for f in friction:
        slow = f"below {number(f['near_rest_below'], 2)} {names.unit(names.rates[f['joint'] - 1])}"
        known.append([f"friction of joint {f['joint']} near rest", slow, *_gain(f["near_rest"])])
    known += [[name, f"{number(p['value'])} {p['unit']}", *_gain(p)] for name, p in document["parameters"].items()]
    states = [f"{name} [{units[name]}]" for name in document["starts"][0]]
    starts = [
        [file, *map(number, start.values())] for file, start in zip(document["inputs"], document["starts"], strict=True)
    ]
    limits = [
        [f"{name} [{units[name]}]", *map(number, pair), number(rate[name]) if name in rate else ""]
        for name, pair in document["limits"]["values"].items()
    ]
    return [
        section(
            "What it will tell",
            "Standard deviation of what is estimated: now, after as much time of the inputs that the logs of this fit "
            "were made with, and after the designed ones. Near rest: root mean square over the slowest fifth of the "
            "velocities that were visited.",
            Table(["", "value", "now", "old inputs", "designed", "smaller by"], known),
        ),
        section(
            "What to play",
            f"{document['sequences']} files, {document['inputs'][0]} and so on: time and inputs, each value held for "
            f"{number(document['dt'])} s. Set the machine by hand where the sequence begins, let it come to rest, and "
            "start the log with the first value. Put the logs beside the old ones: nnap-em diagnose OLD --more NEW "
            "--out OUT.",
            Table(["file", *states], starts),
            *_motions(design, names),
        ),
        section(
            "Limits",
            "No sequence left these in 500 motions with models from the posterior, process noise and starts that are a "
            "little off. "
            + (f"Declared: {', '.join(declared)}; the others" if declared else "None is declared: they")
            + " are the ranges of the logs. [limits] of rig.toml declares others.",
            Table(["", "lowest", "highest", "change per second"], limits),
        ),
    ]


def _gain(std: Mapping[str, float]) -> list[str]:
    """Standard deviations now and after each experiment, and the factor of the designed one."""
    sides = [std[side] for side in ("now", "same_time_of_old_inputs", "expected")]
    return [*(number(side, 2) for side in sides), f"{number(sides[0] / sides[2], 2) if sides[2] > 0 else '–'} ×"]


def _motions(design: Design, names: Names) -> list[Picture]:
    caption = (
        "Above what is to be played, below what the machine should do: the central 98 % of motions by models from the "
        "posterior. Dashed: limits."
    )
    out = []
    for first in range(0, len(design.u), SEQUENCES_ACROSS):
        which = range(first, min(first + SEQUENCES_ACROSS, len(design.u)))
        title = f"Sequences {which[0] + 1} to {which[-1] + 1}"
        out.append(picture("found", title, caption, motion_figure(design, names, which)))
    return out


@styled
def motion_figure(design: Design, names: Names, which: Sequence[int]) -> Figure:
    """Inputs and coordinates of some sequences, one below the other."""
    inputs, states = design.fitted.rig.input_columns, names.coordinates
    rows = len(inputs) + 2 * len(states)
    figure = Figure(figsize=(3.3 * max(len(which), 2), 0.6 + 1.35 * rows), layout="constrained")
    grid = figure.subplots(rows, len(which), sharex=True, sharey="row", squeeze=False)
    for column, i in enumerate(which):
        for k, ax in enumerate(grid[: len(inputs), column]):
            ax.step(design.t, design.u[i, :, k], where="post", color=ZERO_LINE, label="to be played")
            _within(ax, design.limits.low[k], design.limits.high[k], [design.u[..., k]])
        for s, ax in enumerate(grid[len(inputs) :, column]):
            low, middle, high = (band[i, :, s] for band in (design.low, design.middle, design.high))
            ax.fill_between(design.t, low, high, color=AFTER, alpha=0.25, lw=0, label="98 % of motions")
            ax.plot(design.t, middle, color=AFTER, label="expected")
            _within(ax, design.limits.lowest[s], design.limits.highest[s], [design.low[..., s], design.high[..., s]])
        grid[0, column].set_title(f"Sequence {i + 1}")
        grid[-1, column].set_xlabel("time [s]")
    for ax, name in zip(grid[:, 0], (*inputs, *states, *names.rates), strict=True):
        ax.set_ylabel(f"{symbol(name)} [{names.unit(name)}]")
    head(figure, "What to play, and what should happen", list(grid.ravel()))
    return figure


def _within(ax: Axes, low: float, high: float, shown: Sequence[Any]) -> None:
    ax.set_ylim(*limits(shown, 0.3))
    for edge in (low, high):
        ax.axhline(edge, color=BEFORE, ls="--", lw=0.9, label="limit")
