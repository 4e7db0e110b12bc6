"""Numbers that decide whether an effect enters a model or leaves it, from both sides."""

import math

import pytest

from nnap_em.diagnosis.verdict import (
    AGREE,
    CHANCE,
    EQUIVALENT,
    HARM,
    KEEP,
    MULTI_STEP,
    NAMED,
    REASONS,
    SUSPECT,
    Rejection,
    Share,
    agreed,
    even,
    needed,
    odds,
    required,
    sensible,
    simplest,
    suspected,
    veto,
)
from nnap_em.numerics.digits import share_of

FALLS = (0.3, 0.3, 0.3, 0.3)


def test_what_counts_is_fifteen_per_cent_of_a_multi_step_error():
    assert MULTI_STEP == 0.15


def test_the_smaller_share_counts():
    assert Share(0.3, 0.2, FALLS).least == Share(0.2, 0.3, FALLS).least == 0.2


@pytest.mark.parametrize(
    ("folds", "fine"),
    [
        (FALLS, True),
        ((0.3, 0.3, 0.3, -0.05), True),
        ((0.3, 0.3, -0.01, -0.05), False),  # two of four disagree
        ((0.5, 0.5, 0.5, -0.099), True),
        ((0.5, 0.5, 0.5, -0.101), False),  # one is harmed
    ],
)
def test_the_error_falls_on_most_parts_and_rises_on_none_by_much(folds, fine):
    assert (AGREE, HARM) == (0.75, 2 / 3)
    assert agreed(folds, 0.15) == fine


@pytest.mark.parametrize(("least", "fine"), [(0.15, True), (0.149, False)])
def test_a_function_that_answers_a_disturbance_removes_the_floor_on_every_part(least, fine):
    assert agreed((0.9, 0.9, least), 0.15, responds=True) == fine


@pytest.mark.parametrize(
    ("multiple", "linear", "fine"),
    [
        (0.31, False, True),
        (0.29, False, False),  # a fifth of a dead zone is another one
        (2.9, False, True),
        (3.1, False, False),
        (-1.0, False, False),
        (-9.0, True, True),
    ],
)
def test_a_multiple_of_a_law_that_is_not_linear_is_near_its_probe(multiple, linear, fine):
    assert sensible(multiple, 0.0, 1.0, linear=linear) == fine


@pytest.mark.parametrize(("far", "survived", "fine"), [(2.9, 0.06, True), (3.1, 0.06, False), (2.9, 0.04, False)])
def test_a_law_far_beyond_its_prior_or_within_the_span_of_the_nuisance_is_none(far, survived, fine):
    """A scale of a sensor of 3.07 is 4.1 standard deviations of its prior from 1."""
    assert sensible(1.0, far, survived, linear=True) == fine


def test_a_remainder_comes_before_a_named_law_and_that_before_a_free_one():
    remainder, named, one, two = map(odds, (-1, 0, 1, 2))
    assert NAMED == 0.6
    assert named == pytest.approx(NAMED * remainder)
    assert one == pytest.approx(NAMED * named)
    assert two == pytest.approx(NAMED * one)


@pytest.mark.parametrize(
    ("values", "chosen"),
    [
        ((0.5, 0.46, 0.4), 1),  # nine tenths of the best, and simpler
        ((0.5, 0.44, 0.4), 0),
        ((0.5, 0.46, 0.45), 1),  # the simplest of three
        ((0.5, 0.1, 0.1), 0),
    ],
)
def test_the_simplest_law_counts_that_explains_nine_tenths_of_the_best(values, chosen):
    assert EQUIVALENT == 0.9
    assert simplest(values, (2, 0, 1), values) == chosen
    assert simplest((0.5, 0.5), (0, 0), (1.0, 2.0)) == 1
    assert even((0.5, 0.46, 0.44)) == [0, 1]


def test_a_law_without_a_name_has_higher_bars():
    assert required(0.15, 0) == 0.15
    assert required(0.15, 1) == pytest.approx(0.25)
    assert required(0.15, 3) == pytest.approx(0.25 / 0.36)


SOUND = {"possible": True, "certainty": 12.0, "amplitude": math.inf, "removed": 0.2, "floor": 0.15, "complexity": 0}


@pytest.mark.parametrize(
    ("numbers", "code"),
    [
        ({}, None),
        ({"possible": False}, "impossible"),
        ({"certainty": 5.1}, None),
        ({"certainty": 4.9}, "uncertain"),
        ({"certainty": math.nan}, "uncertain"),
        ({"amplitude": 2.1}, None),
        ({"amplitude": 1.9}, "undetermined"),  # an amplitude of 0.20 +- 0.83 is no ripple
        ({"removed": 0.09}, None),
        ({"removed": 0.089}, "small"),
        ({"removed": math.nan}, "small"),
        ({"removed": 0.03, "floor": 0.04}, None),
        ({"removed": 0.151, "complexity": 1}, None),
        ({"removed": 0.149, "complexity": 1}, "small"),  # many numbers fit many things a little
    ],
)
def test_a_refit_vetoes_what_is_impossible_uncertain_or_small(numbers, code):
    reason = veto(**(SOUND | numbers))
    assert (reason and reason.code) == code
    assert reason is None or reason.sentence


def test_every_reason_has_a_sentence():
    assert {"impossible", "uncertain", "undetermined", "small", "before"} == set(REASONS)


def test_what_is_lost_without_an_effect_is_most_of_the_floor():
    assert pytest.approx(0.09) == KEEP * 0.15
    assert needed(0.09, 0.15) and not needed(0.0899, 0.15) and not needed(math.nan, 0.15)


@pytest.mark.parametrize(
    ("share", "chance", "listed"),
    [(0.075, 0.0, True), (0.074, 0.0, False), (0.12, 0.06, True), (0.12, 0.061, False), (0.9, 0.46, False)],
)
def test_a_suspect_removes_half_of_the_floor_and_twice_what_chance_does(share, chance, listed):
    assert (SUSPECT, CHANCE) == (0.5, 2.0)
    assert suspected(share, 0.15, chance) == listed


def test_a_share_beyond_one_is_no_percentage():
    assert Rejection("small", 0.05).sentence == "removes 5.0% of the squared error after its refit"
    assert "none of the squared error, which grows to 3.20 times itself" in Rejection("small", -2.2).sentence
    assert share_of(1.203, "the error") == "more than all of the error"
