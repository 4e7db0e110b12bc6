"""Find what changed between fits of one machine.

examples:
  nnap-em compare monday friday
  nnap-em compare january february march --out year
  nnap-em compare unit7/model.npz unit8/model.npz --out units

Each FIT is the output of identify or diagnose for the same machine: other logs, another day, another unit.  Prints
every estimated number of all fits with its standard deviation, a pooled value, and a p-value: the chance of such a
difference where nothing changed.  Friction curves are compared on the velocities that all fits visited.  OUT gets
compare.html (read this one) and compare.json.
"""

import argparse

from ..comparison.cause import Recorded, explained
from ..comparison.compare import Comparison, compare
from ..data.dataset import DataError
from ..data.rig import RigError
from ..fit.store import model_file, read
from ..report.comparison import table, write_comparison
from ..storage.log import Log
from .common import logs_of, require_joints


def run(args: argparse.Namespace, log: Log) -> None:
    """Print the table; write the page if requested."""
    comparison = compare(*args.fits)
    if len(args.fits) == 2 and comparison.changed:
        comparison = _explained(args, comparison, log)
    print(table(comparison))
    if args.out is not None:
        write_comparison(args.out, comparison)
        log(f"wrote {args.out / 'compare.html'} and compare.json")


def _explained(args: argparse.Namespace, comparison: Comparison, log: Log) -> Comparison:
    """The comparison with what changed by the recordings, where they are at hand."""
    files = [model_file(path) for path in args.fits]
    try:
        require_joints(comparison.fits[0].fitted.rig, "recordings")
        logs = [logs_of(file, read(file), [], False) for file in files]
    except (DataError, RigError) as error:
        log(f"{error}; what changed is not searched in recordings")
        return comparison
    first, second = (Recorded(rig, train.data) for rig, train in logs)
    log("something changed: each fit on the recordings of the other, and the search for one law behind it ...")
    return explained(comparison, first, second, log)
