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

from ..base.log import Log
from ..estimate.store import AFTER_FILE
from ..explain.diagnosis.diagnose import diagnose
from ..explain.diagnosis.findings import findings
from ..output.report.diagnosis import write_diagnosis
from .common import MISFIT_STATUS, go_on, own_logs, prepared, resumable, write_models


def run(args: argparse.Namespace, log: Log) -> int:
    """Find it, and report; the test logs serve for the reported errors alone."""
    began = time.perf_counter()
    # Share of the minutes given after which the search begins no new step. The fit of the last law over the whole
    # length and the page come after it: 17 of 105 s on a real double pendulum.
    search_share = 0.8
    seconds = search_share * 60.0 * args.minutes if args.minutes else math.inf
    bench, start = prepared(args, AFTER_FILE, log)
    own = own_logs(args, start, log) if start else None
    with resumable(args, bench, log) as journal:

        def report(text: str) -> None:
            left = f"[{_clock(60.0 * args.minutes - (time.perf_counter() - began))}] " if args.minutes else ""
            log(left + bench.rig.named(text))

        diagnosis = diagnose(
            bench.rig, bench.train.data, key=jax.random.key(args.seed), log=report,
            seconds=seconds - (time.perf_counter() - began), start=start.fitted if start else None, own=own,
        )  # fmt: skip
        journal.open = not diagnosis.complete and not diagnosis.failure  # the same steps would fail again
        fits, settings = {"before.npz": diagnosis.before, AFTER_FILE: diagnosis.after}, {"seed": args.seed}
        write_models(args, fits, bench.train.data, settings=settings)
        described = write_diagnosis(
            args.out, diagnosis, findings(diagnosis), bench.train, bench.test,
            seed=args.seed, began=began, log=report,
        )  # fmt: skip
    if journal.open:
        log(go_on(journal))
    return 0 if described else MISFIT_STATUS


def _clock(seconds: float) -> str:
    minutes, remainder = divmod(round(abs(seconds)), 60)
    return f"{minutes}:{remainder:02} {'left' if seconds > 0 else 'over'}"
