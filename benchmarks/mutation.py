"""Every place of `mutants.py` broken in turn: the list of docs/results/mutants.csv.

python benchmarks/mutation.py [--share 1/1] [--tests test_em.py test_mstep.py]
"""

import argparse
import csv
import sys
import tempfile
from pathlib import Path

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests"))
from mutants import MUTANTS, copy, run
from runner import made


def main() -> None:
    """Run the unbroken package, then every mutant, and print the list."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--share", default="1/1", help="i/n: every n-th mutant from the i-th on")
    parser.add_argument("--tests", nargs="*", default=[""], help="those alone whose test is in one of these files")
    args = parser.parse_args()
    first, every = map(int, args.share.split("/"))
    share = [mutant for mutant in MUTANTS[first - 1 :: every] if mutant.test.startswith(tuple(args.tests))]
    print(made())
    tests = sorted({mutant.test for mutant in share})
    with tempfile.TemporaryDirectory() as folder:
        sound = run(copy(Path(folder)), *tests)
    assert sound.passed >= len(tests) and not sound.failed, sound.said  # one of many cases counts as many
    print(f"Unbroken: {len(tests)} tests pass, {sound.passed} cases.\n")
    rows = csv.writer(sys.stdout, lineterminator="\n")
    rows.writerow(["broken", "in", "test", "state"])
    killed = 0
    for mutant in share:
        with tempfile.TemporaryDirectory() as folder:
            outcome = run(copy(Path(folder), mutant), mutant.test)
        dead = outcome.failed == 1 and outcome.asserted
        killed += dead
        state = "red" if dead else "green" if outcome.passed else "does not run"
        test = mutant.test.removeprefix("test_").replace(".py::test_", ": ").replace("_", " ")
        rows.writerow([mutant.what, mutant.file, test, state])
        sys.stdout.flush()
        if not dead:
            print(outcome.said[-3000:], file=sys.stderr, flush=True)
    print(f"\n{killed} of {len(share)} turn their test red.")


if __name__ == "__main__":
    main()
