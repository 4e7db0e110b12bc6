"""Numbers that decide whether an effect enters a model or leaves it, from both sides."""

import math

import pytest

from nnap_em.diagnosis import verdict

FALLS = (0.3, 0.3, 0.3, 0.3)


def test_the_smaller_share_counts():
    assert verdict.Share(0.3, 0.2, FALLS).least == verdict.Share(0.2, 0.3, FALLS).least == 0.2


PARTS = (
    (FALLS, False, True),
    ((0.3, 0.3, 0.3, -0.05), False, True),
    ((0.3, 0.3, -0.01, -0.05), False, False),  # two of four disagree
    ((0.5, 0.5, 0.5, -0.099), False, True),
    ((0.5, 0.5, 0.5, -0.101), False, False),  # one is harmed
    ((0.9, 0.9, 0.15), True, True),  # a function that answers a disturbance removes the floor on every part
    ((0.9, 0.9, 0.149), True, False),
)


def test_the_error_falls_on_most_parts_and_rises_on_none_by_much():
    assert [verdict.agreed(parts, 0.15, responds=responds) for parts, responds, _ in PARTS] == [ok for *_, ok in PARTS]


def test_a_law_far_beyond_its_prior_or_within_the_span_of_the_nuisance_is_none():
    """A scale of a sensor of 3.07 is 4.1 standard deviations of its prior from 1.  A multiple of a law that is not
    linear is near its probe: a fifth of a dead zone is another one.
    """
    numbers = ((2.9, 0.06, True), (3.1, 0.06, False), (2.9, 0.04, False))
    assert all(verdict.sensible(1.0, far, survived, linear=True) == fine for far, survived, fine in numbers)
    multiples = {0.31: True, 2.9: True, 0.29: False, 3.1: False, -1.0: False}
    assert {multiple: verdict.sensible(multiple, 0.0, 1.0, linear=False) for multiple in multiples} == multiples
    assert verdict.sensible(-9.0, 0.0, 1.0, linear=True)


def test_a_remainder_comes_before_a_named_law_and_that_before_a_free_one():
    assert [verdict.odds(complexity) for complexity in (-1, 0, 1, 2)] == pytest.approx([1.0, 0.6, 0.36, 0.216])
    required = [verdict.required(0.15, complexity) for complexity in (-1, 0, 1, 3)]
    assert required == pytest.approx([0.15, 0.15, 0.25, 0.25 / 0.36])


def test_the_simplest_law_counts_that_explains_nine_tenths_of_the_best():
    cases = ((0.5, 0.46, 0.4), (0.5, 0.44, 0.4), (0.5, 0.46, 0.45), (0.5, 0.1, 0.1))
    assert [verdict.simplest(values, (2, 0, 1), values) for values in cases] == [1, 0, 1, 0]
    assert verdict.simplest((0.5, 0.5), (0, 0), (1.0, 2.0)) == 1


SOUND = {"possible": True, "certainty": 12.0, "amplitude": math.inf, "removed": 0.2, "floor": 0.15, "complexity": 0}
VETOES = [
    ({}, None),
    ({"possible": False}, "without physical meaning"),
    ({"certainty": 5.1}, None),
    ({"certainty": 4.9}, "from none"),
    ({"certainty": math.nan}, "from none"),
    ({"amplitude": 2.1}, None),
    ({"amplitude": 1.9}, "an amplitude of 1.9"),  # an amplitude of 0.20 +- 0.83 is no ripple
    ({"removed": 0.09}, None),
    ({"removed": 0.089}, "removes"),
    ({"removed": math.nan}, "removes"),
    ({"removed": 0.03, "floor": 0.04}, None),
    ({"removed": 0.151, "complexity": 1}, None),
    ({"removed": 0.149, "complexity": 1}, "removes"),  # many numbers fit many things a little
]


def test_a_refit_vetoes_what_is_impossible_uncertain_or_small():
    for numbers, code in VETOES:
        reason = verdict.veto(**(SOUND | numbers))
        assert (reason is None) == (code is None) and (code or "") in (reason or ""), numbers
    # what is lost without an effect is most of the floor
    assert verdict.needed(0.09, 0.15) and not verdict.needed(0.0899, 0.15) and not verdict.needed(math.nan, 0.15)


def test_a_suspect_removes_half_of_the_floor_and_twice_what_chance_does():
    cases = ((0.075, 0.0), (0.12, 0.06), (0.074, 0.0), (0.12, 0.061), (0.9, 0.46))
    assert [verdict.suspected(share, 0.15, chance) for share, chance in cases] == [1, 1, 0, 0, 0]
