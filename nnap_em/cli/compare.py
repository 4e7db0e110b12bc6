"""Find what changed between fits of one machine.

examples:
  nnap-em compare monday friday
  nnap-em compare january february march --out year
  nnap-em compare unit7/model.npz unit8/model.npz --out units

Each FIT is the output of identify or diagnose for the same machine: other logs, another day, another unit.  Prints
every estimated number of all fits with its standard deviation, their difference in standard deviations, a p-value (the
chance of such a difference where nothing changed) and a pooled value.  Friction curves are compared on the velocities
that all fits know.  `nnap-em diagnose LOGS --from FIT` names what changed on the machine.  OUT gets compare.html and
compare.json.
"""

import argparse

from ..base.log import Log
from ..explain.compare.compare import compare
from ..output.report.comparison import table, write_comparison


def run(args: argparse.Namespace, log: Log) -> None:
    """Print the table; write the page if requested."""
    comparison = compare(*args.fits)
    print(table(comparison))
    if args.out is not None:
        write_comparison(args.out, comparison)
        log(f"wrote {args.out / 'compare.html'} and compare.json")
