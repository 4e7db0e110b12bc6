"""nnap-em design: the inputs to play next, so that the logs answer what is open."""

import argparse
import dataclasses
import json
import time
from pathlib import Path

import jax

from ..data.rig import read_rig
from ..experiment.experiment import check_question, design
from ..experiment.limits import DesignError
from ..experiment.rivals import Law, open_pairs, rivals
from ..fit.identify import Identified
from ..fit.store import Stored, fingerprint, model_file, read
from ..report.design import write_design
from ..storage.log import Log
from ..systems import specs
from .common import Bench, read_training, require_joints, resumable


def run(args: argparse.Namespace, log: Log) -> None:
    """Design, and report."""
    began = time.perf_counter()
    stored = read(model_file(args.folder))
    require_joints(stored.fitted.rig, "design")
    fitted, bench = _logs(args, stored)
    key, question, laws = jax.random.key(args.seed), vars(args)["for"], _wanted(args, fitted)
    check_question(question, fitted, bool(laws))
    with resumable(args, bench, log):
        data = bench.train.data
        pairs = rivals(fitted, data, laws, log) if question in ("all", "apart") else []
        designed = design(
            fitted, data, key=key, question=question, rivals=pairs,
            seconds=args.seconds, sequences=args.sequences, log=log,
        )  # fmt: skip
        write_design(args.out, designed, question=question, seed=args.seed, began=began, log=log)


def _logs(args: argparse.Namespace, stored: Stored) -> tuple[Identified, Bench]:
    """The logs of the fit, and the fit with the limits that their rig.toml declares now."""
    file, folders = model_file(args.folder), args.logs or list(map(Path, stored.notes.get("logs", [])))
    gone = next((folder for folder in folders if not folder.is_dir()), None)
    if not folders or gone:
        problem = f"its logs are not at {gone}" if gone else "it does not say where its logs are"
        raise DesignError(f"{file}: {problem}; give their folder with --logs FOLDER")
    rig = read_rig(folders[0] / "rig.toml", specs)
    train = read_training(rig, folders, args.trust_readings)
    if stored.fingerprint and fingerprint(train.data) != stored.fingerprint:
        wrong = "; give those with --logs FOLDER, or identify again with these"
        raise DesignError(f"{folders[0]}: not the logs, or not read as those, of the fit in {file}{wrong}")
    limited = dataclasses.replace(stored.fitted.rig, limits=rig.limits)
    return stored.fitted._replace(rig=limited), Bench(limited, train, None)


def _wanted(args: argparse.Namespace, fitted: Identified) -> list[tuple[Law | None, Law]]:
    """Laws to be discriminated: those that the report beside the model leaves open, and those that --rival names."""
    report = model_file(args.folder).with_name("report.json")
    pairs = open_pairs(json.loads(report.read_text())) if report.exists() else []
    laws = [Law(effect.name, effect.joint, effect.channel) for effect in fitted.model.effects] or [None]
    return pairs + [(law, _law(text)) for text in args.rival for law in laws]


def _law(text: str) -> Law:
    """NAME, NAME:JOINT or NAME:COLUMN."""
    name, _, place = text.partition(":")
    return Law(name, int(place)) if place.isdigit() else Law(name, None, place or None)
