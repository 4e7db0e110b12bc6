"""Find the inputs to play next.

examples:
  nnap-em design found --out next                   what the last report leaves open, all together
  nnap-em design fit --out next --for friction --seconds 60 --sequences 12
  nnap-em design found --out next --for discriminate --rival actuator_lag
  nnap-em diagnose bench --more next/logs --out again

FIT is the output of identify or diagnose.  OUT gets inputs/*.csv (time and inputs, ready to be played), motion/*.csv
(what should then happen), design.json and design.html (read this one).  Nothing goes beyond [limits] of rig.toml, or
where nothing is declared beyond what the logs visited.  QUESTION: friction, parameters, the name of one, discriminate
(laws that the logs leave open), or all.
"""

import argparse
import dataclasses
import json
import time

import jax

from ..experiment.experiment import check_question, design
from ..experiment.rivals import Law, open_pairs, rivals
from ..fit.identify import Identified
from ..fit.store import Stored, model_file, read
from ..report.design import write_design
from ..storage.log import Log
from .common import Bench, logs_of, require_joints, resumable


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
        pairs = rivals(fitted, data, laws, log) if question in ("all", "discriminate") else []
        designed = design(
            fitted, data, key=key, question=question, rivals=pairs,
            seconds=args.seconds, sequences=args.sequences, log=log,
        )  # fmt: skip
        write_design(args.out, designed, question=question, seed=args.seed, began=began, log=log)


def _logs(args: argparse.Namespace, stored: Stored) -> tuple[Identified, Bench]:
    """The logs of the fit, and the fit with the limits that their rig.toml declares now."""
    rig, train = logs_of(model_file(args.folder), stored, args.logs, args.trust_readings)
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
