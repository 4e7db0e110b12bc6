"""Watch a machine, recording by recording.

examples:
  nnap-em monitor fit logs --out trend
  nnap-em monitor fit logs --out trend --resume     judge the recordings that came since
  nnap-em monitor fit logs --out trend --rate 0.01  an alarm in a hundred recordings by chance, not in a thousand

FOLDER holds recordings of one machine, by name in order of time.  Each is judged beside the recordings of the fit:
multi-step errors, and the change of friction and of estimated numbers that it shows alone.  After an alarm the
recordings since the change (of many the last, as many as the fit had) are searched for what changed, as by nnap-em
diagnose --from.  A recording with a broken sensor, another unit or another clock is not judged, and listed.  OUT gets
monitor.html (read this one) and monitor.json.  Exit status 4 where the machine changed.
"""

import argparse
import hashlib
import json
import warnings
from pathlib import Path
from typing import Any

import jax
import numpy as np

from ..comparison.monitor import Judged, Reference, judge, reference, trend
from ..data.dataset import DataError
from ..data.formats import log_files
from ..data.logs import DataWarning, Logs, read_logs, together
from ..data.rig import Rig
from ..diagnosis.change import changes
from ..diagnosis.findings import entry, findings
from ..diagnosis.search import diagnose
from ..diagnosis.smoothed import along
from ..em.build import build_system, measure_scales
from ..em.loop import SEARCHED
from ..fit.check import ERROR, torques
from ..fit.identify import Identified
from ..fit.store import model_file, read
from ..report.monitored import write_monitor
from ..storage.log import Log
from .common import logs_of, require_joints


def run(args: argparse.Namespace, log: Log) -> int:
    """Judge the recordings that are new, then all together."""
    file = model_file(args.model)
    stored = read(file)
    require_joints(stored.fitted.rig, "monitor")
    rig, own = logs_of(file, stored, args.logs, args.trust_readings)
    fitted, digest = stored.fitted, hashlib.sha256(file.read_bytes()).hexdigest()
    before = _kept(args.out / "monitor.json", digest) if args.resume else []
    paths = log_files(args.folder)
    fit = along(fitted, jax.device_put(own.data), fitted.smoother)
    beside, candidates = reference(fitted, fit)
    known = {(row["file"], row["sha256"]): row for row in before}
    rows = []
    for path in paths:
        mark = hashlib.sha256(path.read_bytes()).hexdigest()
        row = known.get((path.name, mark))
        if row is None:
            row = {"file": path.name, "sha256": mark} | _row(fitted, beside, candidates, rig, path, args.trust_readings)
            log(f"{path.name}: {row['reason'] or 'errors {:.2f} times those of the fit'.format(row['ratio'])}")
        rows.append(row)
    arrays = lambda row: (np.asarray(row["estimate"]), np.asarray(row["cov"]))  # noqa: E731
    judged = [None if row["reason"] else Judged(row["level"], *arrays(row)) for row in rows]
    seen = trend(beside, judged, args.rate)
    document: dict[str, Any] = {"fit": str(file), "sha256": digest, "rate": args.rate, "recordings": rows}
    if seen.alarm is not None:
        write_monitor(args.out, fitted, beside, seen, document, log)  # the search is long
        later = list(zip(paths, rows, strict=True))[seen.alarm.since :]
        since = [path for path, row in later if not row["reason"]][-len(beside.own) :]  # of a drift the last are alike
        log(f"alarm by the chart of {seen.alarm.chart}; what changed is searched in the last {len(since)} recordings")
        logs = {path.stem: read_logs(path, rig, trust=args.trust_readings) for path in since}
        whole = together(logs)
        key = jax.random.fold_in(fitted.state.key, SEARCHED)
        diagnosis = diagnose(rig, whole.data, key=key, log=log, start=fitted, own=own.data)
        accepted = findings(diagnosis)
        document |= {"effects": [entry(f) for f in accepted], "since_fit": changes(diagnosis, accepted)}
    write_monitor(args.out, fitted, beside, seen, document, log)
    return 4 if seen.alarm is not None else 0  # the exit status of a machine that changed


def _row(fitted: Identified, beside: Reference, candidates, rig: Rig, path: Path, trust: bool) -> dict[str, Any]:
    """One recording as the JSON holds it; `reason` where it is not judged."""
    nothing = {"ratio": None, "level": None, "estimate": None, "cov": None}
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DataWarning)
            logs = read_logs(path, rig, trust=trust)
    except DataError as error:
        return nothing | {"reason": str(error)}
    if reason := _broken(rig, logs):
        return nothing | {"reason": reason}
    found = judge(fitted, beside, candidates, logs.data)
    if isinstance(found, str):
        return nothing | {"reason": found}
    usual = float(np.median([each.level for each in beside.own]))
    values = {"estimate": found.estimate.tolist(), "cov": found.cov.tolist()}
    return {"reason": None, "ratio": float(np.exp(found.level - usual)), "level": found.level} | values


def _broken(rig: Rig, logs: Logs) -> str:
    """Reason against the sensors or inputs of a recording, as `check` has it; empty where there is none."""
    y, read = np.asarray(logs.data.y)[0], np.asarray(logs.as_read.y)[0]
    readings_left = 0.5  # share of the readings of a column that must be left for a recording to be judged
    for name, used, all_ in zip(rig.measured, y.T, read.T, strict=True):
        if np.isfinite(used).sum() < readings_left * np.isfinite(all_).sum():
            kinds = ", ".join(dict.fromkeys(m.kind for m in logs.masked if m.column == name))
            return f"most readings of {name} are not used: {kinds}"
    system = build_system(rig)
    data = type(logs.data)(*(np.asarray(part) for part in logs.data))
    results = torques(rig, system, data, measure_scales(rig, system, data))
    return "; ".join(result.text for result in results if result.mark == ERROR)


def _kept(path: Path, digest: str) -> list[dict[str, Any]]:
    """Recordings that were judged before by the same fit.

    Raises DataError where they were judged by another one.
    """
    if not path.exists():
        return []
    document = json.loads(path.read_text())
    if document.get("sha256") != digest:
        raise DataError(f"{path}: of another fit; leave --resume out to judge all recordings anew")
    return document["recordings"]
