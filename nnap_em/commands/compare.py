"""nnap-em compare: fits of one machine side by side."""

import argparse

from ..comparison.compare import compare
from ..report.comparison import table, write_comparison
from ..storage.log import Log


def run(args: argparse.Namespace, log: Log) -> None:
    """Print the table; write the page if requested."""
    comparison = compare(*args.fits)
    print(table(comparison))
    if args.out is not None:
        write_comparison(args.out, comparison)
        log(f"wrote {args.out / 'compare.html'} and compare.json")
