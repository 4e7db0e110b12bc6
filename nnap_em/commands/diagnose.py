"""nnap-em diagnose: find what the declared model lacks."""

import argparse
import time

import jax

from ..diagnose.findings import findings
from ..diagnose.search import close_the_loop
from ..em.store import fingerprint, save
from ..report.diagnosis import write_diagnosis
from .common import Say, read_bench, resumable, warn_of_torques


def run(args: argparse.Namespace, say: Say) -> None:
    """Find it, and report; the test logs serve for the reported errors alone."""
    began = time.perf_counter()
    bench = read_bench(args.folder, args.trust_readings, args.more)
    warn_of_torques(args.folder, bench)
    with resumable(args, bench, say):
        told = lambda text: say(bench.rig.named(text))  # noqa: E731
        closed = close_the_loop(bench.rig, bench.train.data, key=jax.random.key(args.seed), say=told)
        found, mark = findings(closed), fingerprint(bench.train.data)
        for name in ("report.json", "report.html"):  # older ones are not of the models that are written now
            (args.out / name).unlink(missing_ok=True)
        notes = {"settings": {"seed": args.seed}, "logs": list(map(str, (args.folder, *args.more)))}
        for name, fitted in (("before", closed.before), ("after", closed.after)):
            save(args.out / f"{name}.npz", fitted, fingerprint=mark, notes=notes)
        write_diagnosis(args.out, closed, found, bench.train, bench.test, seed=args.seed, began=began, say=told)
