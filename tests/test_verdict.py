"""Numbers that decide whether an effect enters a model or leaves it, from both sides."""

import math

import pytest

from nnap_em.explain.diagnosis import verdict

FALLS = (0.3, 0.3, 0.3, 0.3)


def test_the_smaller_share_counts():
    assert verdict.Share(0.3, 0.2, FALLS).least == verdict.Share(0.2, 0.3, FALLS).least == 0.2


PARTS = (
    (FALLS, False, True),
    ((0.3, 0.3, 0.3, -0.5), False, True),
    ((0.3, 0.3, -0.01, -0.05), False, False),  # two of four disagree
    ((0.9, 0.9, 0.15), True, True),  # a function that answers a disturbance removes the floor on every part
    ((0.9, 0.9, 0.149), True, False),
)


def test_the_error_falls_on_most_parts():
    assert [verdict.agreed(parts, 0.15, responds=responds) for parts, responds, _ in PARTS] == [ok for *_, ok in PARTS]


def test_a_remainder_comes_before_a_named_law_and_that_before_a_free_one():
    assert [verdict.odds(complexity) for complexity in (-1, 0, 1, 2)] == pytest.approx([1.0, 0.6, 0.36, 0.216])
    required = [verdict.required(0.15, complexity) for complexity in (-1, 0, 1, 3)]
    assert required == pytest.approx([0.15, 0.15, 0.25, 0.25 / 0.36])


def test_a_later_law_removes_much_of_what_is_left_and_something_of_the_first_error():
    """On a real arm a delay removes 0.53 of the 0.27 that a cogging leaves, an alias 0.27 of the 0.18 of a bump."""
    removed = ((), (0.2,), (0.5, 0.5), (0.73,), (0.82,), (0.999,))
    floors = [0.15, 0.168, 0.3, 0.289, 0.354, 4.743]
    assert [verdict.least_share(some) for some in removed] == pytest.approx(floors, abs=1e-3)


def test_the_simplest_law_counts_that_explains_nine_tenths_of_the_best():
    cases = ((0.5, 0.46, 0.4), (0.5, 0.44, 0.4), (0.5, 0.46, 0.45), (0.5, 0.1, 0.1))
    assert [verdict.simplest(values, (2, 0, 1), values) for values in cases] == [1, 0, 1, 0]
    assert verdict.simplest((0.5, 0.5), (0, 0), (1.0, 2.0)) == 1


def test_a_refit_vetoes_what_is_impossible_or_small():
    assert "without physical meaning" in verdict.veto(False, 0.2, 0.15)
    # what is lost without an effect is most of the floor
    for removed, floor, fine in ((0.09, 0.15, 1), (0.089, 0.15, 0), (math.nan, 0.15, 0), (0.03, 0.04, 1)):
        reason = verdict.veto(True, removed, floor)
        assert (reason is None) == verdict.needed(removed, floor) == bool(fine) and (fine or "removes" in reason)


def test_of_few_recordings_a_standard_deviation_is_hardly_known():
    for count, sure, unsure in ((10**6, 2.1, 1.9), (6, 2.7, 2.6), (2, 14.1, 13.9)):
        assert verdict.doubtful((20.0, sure), count) is None and verdict.doubtful((20.0, unsure), count) == 1


def test_a_suspect_removes_half_of_the_floor_and_twice_what_chance_does():
    cases = ((0.075, 0.0), (0.12, 0.06), (0.074, 0.0), (0.12, 0.061), (0.9, 0.46))
    assert [verdict.suspected(share, 0.15, chance) for share, chance in cases] == [1, 1, 0, 0, 0]
