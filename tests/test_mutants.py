"""The tests turn red where the core is broken: some of the mutants, and all of them still apply."""

import ast
import re

import pytest
from mutants import MUTANTS, ROOT, copy, run

OFTEN = ("sign of friction", "M-step without its prior")
"""The others: `benchmarks/mutation.py`."""
CHOSEN = [mutant for mutant in MUTANTS if mutant.what in OFTEN]


def test_every_mutant_is_a_change_of_one_place_and_names_a_test():
    assert len({mutant.what for mutant in MUTANTS}) == len(MUTANTS) and len(CHOSEN) == len(OFTEN)
    for mutant in MUTANTS:
        text = (ROOT / "nnap_em" / mutant.file).read_text()
        assert text.count(mutant.text) == 1, mutant.what
        broken = text.replace(mutant.text, mutant.instead)
        assert ast.dump(ast.parse(broken)) != ast.dump(ast.parse(text)), mutant.what
        file, _, name = mutant.test.partition("::")
        assert re.search(rf"^def {name.partition('[')[0]}\(", (ROOT / "tests" / file).read_text(), re.MULTILINE), name


def test_a_copy_is_green(tmp_path):
    """Their tests pass where nothing is broken."""
    outcome = run(copy(tmp_path), *(mutant.test for mutant in CHOSEN))
    assert (outcome.passed, outcome.failed) == (2, 0), outcome.said


@pytest.mark.parametrize("mutant", CHOSEN, ids=lambda mutant: mutant.what.replace(" ", "-"))
def test_a_broken_copy_is_red(mutant, tmp_path):
    outcome = run(copy(tmp_path, mutant), mutant.test)
    assert outcome.failed == 1 and outcome.asserted, outcome.said
