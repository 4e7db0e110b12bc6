"""Find what the declared model lacks, add it and report before and after.

examples:
  nnap-em diagnose bench --out found
  nnap-em diagnose february --from fit --out changed  what changed since a fit: a law, a number, or nothing
  nnap-em diagnose bench --out found --minutes 5    answer after about that time; the same once more goes on

Fits the declared unknowns, finds what the model lacks, adds it and fits again.  OUT gets report.html (read this one),
report.json, before.npz and after.npz (for nnap-em predict and smooth) and friction tables of both.
test/ serves for the reported errors only.  After Ctrl-C the same command goes on, with the same numbers.  Exit status
3 where even the last model does not describe the motion.
"""

import argparse
import math
import time

import jax

from ..diagnosis.findings import findings
from ..diagnosis.search import diagnose
from ..fit.store import AFTER_FILE, fingerprint, save
from ..report.diagnosis import write_diagnosis
from ..storage.log import Log
from .common import (
    MISFIT_STATUS,
    check_out,
    go_on,
    logs_at,
    origin,
    own_logs,
    read_bench,
    remove_reports,
    resumable,
    warn_of_logs,
)


def run(args: argparse.Namespace, log: Log) -> int:
    """Find it, and report; the test logs serve for the reported errors alone."""
    began = time.perf_counter()
    # Share of the minutes given after which the search begins no new step. The fit of the last law over the whole
    # length and the page come after it: 17 of 105 s on a real double pendulum.
    search_share = 0.8
    seconds = search_share * 60.0 * args.minutes if args.minutes else math.inf
    bench = read_bench(args.folder, args.trust_readings, args.more)
    warn_of_logs(args.folder, bench)
    check_out(args.out)
    start = origin(args, bench, log)
    own = start and own_logs(args, start, log)
    if (args.out / AFTER_FILE).exists():
        log(f"the diagnosis in {args.out} will be replaced")
    with resumable(args, bench, log) as journal:

        def report(text: str) -> None:
            left = f"[{_clock(60.0 * args.minutes - (time.perf_counter() - began))}] " if args.minutes else ""
            log(left + bench.rig.named(text))

        spent = time.perf_counter() - began
        key = jax.random.key(args.seed)
        began_from = {"start": start and start.fitted, "own": own}
        seconds -= spent
        diagnosis = diagnose(bench.rig, bench.train.data, key=key, log=report, seconds=seconds, **began_from)
        journal.open = not diagnosis.complete and not diagnosis.failure  # the same steps would fail again
        accepted, mark = findings(diagnosis), fingerprint(bench.train.data)
        remove_reports(args.out)
        notes = {"settings": {"seed": args.seed}, "logs": logs_at(args)}
        for name, fitted in (("before.npz", diagnosis.before), (AFTER_FILE, diagnosis.after)):
            save(args.out / name, fitted, fingerprint=mark, notes=notes)
        described = write_diagnosis(
            args.out, diagnosis, accepted, bench.train, bench.test, seed=args.seed, began=began, log=report
        )
    if journal.open:
        log(go_on(journal))
    return 0 if described else MISFIT_STATUS


def _clock(seconds: float) -> str:
    """Time that is left, or by which it is exceeded, in minutes and seconds."""
    minutes, remainder = divmod(round(abs(seconds)), 60)
    return f"{minutes}:{remainder:02} {'left' if seconds > 0 else 'over'}"
