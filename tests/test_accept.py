"""What the rules say of numbers: every threshold from both sides."""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
import pytest

from nnap_em.diagnose.accept import LikelihoodRule, ShareRule, SoonRule
from nnap_em.diagnose.evidence import Evidence, Screened, Share, price
from nnap_em.effects import Candidate, catalogue
from nnap_em.effects.function import Axis

READINGS = 4000
GAIN = catalogue["motor_gain"](jnp.zeros(()), joint=1)
LINEAR = Candidate(GAIN, (GAIN,), GAIN)
ZONE = catalogue["dead_zone"](jnp.ones(()), joint=1)
BENT = Candidate(ZONE, (ZONE,), ZONE)
AXIS = Axis(("x",), -2.0, 2.0, False, 20)
CURVE = catalogue["unknown_function"](AXIS.centres(), (AXIS,), joint=1)
FREE = Candidate(CURVE, (CURVE,), CURVE)


@dataclass
class Numbers(Evidence):
    """Evidence as it could be measured."""

    screened: Screened
    readings: int = READINGS
    directions: int = 1
    gain: float = 100.0
    certainty: float = 12.0
    held_out: float = 50.0
    error: float = 0.6
    unseen: float = 0.7
    foretold: float = 0.95
    soon: float = 1.0
    soon_unseen: float = 1.0


def _screened(
    inside=0.3, left_out=0.3, folds=(0.3, 0.3, 0.3, 0.3), gain=100.0, candidate=LINEAR, coefficient=1.0, left=1.0
):
    return Screened(candidate, np.array([coefficient]), 1, gain, Share(inside, left_out, folds, left))


NET = price(1, READINGS)  # 4.1 nat


@pytest.mark.parametrize(
    ("numbers", "sound"),
    [
        ({"gain": 12.1 + NET}, True),
        ({"gain": 11.9 + NET}, False),
        ({"gain": 30.0, "directions": 4}, True),
        ({"gain": 28.0, "directions": 4}, False),  # each direction costs
        ({"gain": 60.0 + NET, "readings": 29_000}, True),
        ({"gain": 57.0 + NET, "readings": 29_000}, False),  # many readings make certain of what nobody would notice
        ({"certainty": 5.1}, True),
        ({"certainty": 4.9}, False),
    ],
)
def test_one_step_likelihood_is_paid_for_and_certain(numbers, sound):
    verdict = LikelihoodRule().sound(Numbers(_screened(), **numbers))
    assert verdict.believed == sound
    assert verdict.reason


@pytest.mark.parametrize(("held_out", "believed"), [(30.0, True), (28.0, False), (-100.0, False)])
def test_a_third_of_the_gain_is_seen_on_what_is_left_out(held_out, believed):
    assert (
        LikelihoodRule().believes(Numbers(_screened(), gain=100.0 - 1.3 + NET, held_out=held_out)).believed == believed
    )


def test_half_the_bar_is_worth_a_refit():
    rule = LikelihoodRule()
    assert rule.worth_a_refit(6.1, READINGS) and not rule.worth_a_refit(5.9, READINGS)
    assert rule.promise(_screened(gain=20.0), READINGS) == pytest.approx(20.0 - NET)


def test_likelihood_is_looked_at_where_tracks_hold_and_shares_over_all():
    fitted = [60, 96, 154, 246, 393, 500]
    assert LikelihoodRule().horizons(fitted, 500) == [60, 96, 246, 500]
    assert ShareRule().horizons(fitted, 500) == [500]


@pytest.mark.parametrize(
    ("screened", "promise"),
    [
        ({}, 0.3),
        ({"inside": 0.2}, 0.2),
        ({"left_out": 0.1}, 0.1),
        ({"folds": (0.3, 0.3, 0.3, -0.05)}, 0.3),
        ({"folds": (0.3, 0.3, -0.01, -0.05)}, 0.0),  # two of four disagree
        ({"folds": (0.5, 0.5, 0.5, -0.11)}, 0.0),  # one is harmed
        ({"candidate": BENT, "coefficient": 0.5}, 0.3),
        ({"candidate": BENT, "coefficient": 0.2}, 0.0),  # a fifth of a dead zone is another one
        ({"candidate": BENT, "coefficient": -1.0}, 0.0),
        ({"coefficient": -1.0}, 0.3),
        ({"left": 0.34}, 0.3),
        ({"left": 0.32}, 0.0),  # a tenth of what there was at first goes by chance
    ],
)
def test_a_share_is_the_smaller_one_where_recordings_agree(screened, promise):
    assert ShareRule().promise(_screened(**screened), READINGS) == promise


@pytest.mark.parametrize(
    ("numbers", "believed"),
    [
        ({}, True),
        ({"gain": -1e3}, True),  # nats say nothing here
        ({"certainty": 4.9}, False),
        ({"error": 0.90}, True),
        ({"error": 0.92}, False),  # a refit that cannot keep most of 15 % is another law
        ({"error": 1.2}, False),
    ],
)
def test_a_refit_keeps_what_the_share_promised(numbers, believed):
    assert ShareRule().sound(Numbers(_screened(), **numbers)).believed == believed


@pytest.mark.parametrize(
    ("candidate", "left_out", "error", "believed"),
    [
        (FREE, 0.3, 0.84, True),
        (FREE, 0.3, 0.86, False),
        (FREE, 0.15, 0.71, False),  # half of it is not seen on what is left out
        (FREE, 0.15, 0.69, True),
        (LINEAR, 0.15, 0.86, True),  # one number
    ],
)
def test_what_has_no_name_is_worth_the_whole_share_after_its_refit(candidate, left_out, error, believed):
    evidence = Numbers(_screened(inside=0.3, left_out=left_out, candidate=candidate), error=error)
    assert ShareRule().sound(evidence).believed == believed


@pytest.mark.parametrize(("unseen", "believed"), [(0.7, True), (0.92, False), (9.7, False)])
def test_what_the_refit_gains_has_to_be_there_on_motions_that_it_left_out(unseen, believed):
    assert ShareRule().believes(Numbers(_screened(), error=0.2, unseen=unseen)).believed == believed


@pytest.mark.parametrize(
    ("law", "foretold", "believed"),
    [(LINEAR, 0.84, True), (LINEAR, 0.86, False), (LINEAR, 3.0, False), (FREE, 0.2, False)],
)
def test_a_named_law_may_be_foretold_where_half_of_the_motions_say_nothing_of_the_others(law, foretold, believed):
    evidence = Numbers(_screened(candidate=law), error=0.2, unseen=1.2, foretold=foretold)
    assert ShareRule().believes(evidence).believed == believed


def test_recordings_disagree_where_what_would_be_enough_harms_some():
    rule = ShareRule()
    assert rule.disputed(_screened(folds=(0.8, 0.8, 0.8, -0.6)))
    assert not rule.disputed(_screened())
    assert not rule.disputed(_screened(left_out=0.1, folds=(0.8, 0.8, 0.8, -0.6)))
    assert not rule.disputed(_screened(folds=(0.8, 0.8, 0.8, -0.6), left=0.2))
    assert not LikelihoodRule().disputed(_screened(folds=(0.8, 0.8, 0.8, -0.6)))


@pytest.mark.parametrize(
    ("share", "chance", "suspected"),
    [(0.075, 0.0, True), (0.074, 0.0, False), (0.12, 0.06, True), (0.12, 0.061, False), (0.9, 0.46, False)],
)
def test_a_suspect_removes_half_of_the_bar_and_twice_what_chance_does(share, chance, suspected):
    assert ShareRule().suspected(share, chance) == suspected
    assert not LikelihoodRule().suspected(share, chance)


def test_fifteen_per_cent_is_worth_a_refit_whatever_the_readings():
    rule = ShareRule()
    assert rule.worth_a_refit(0.15, 10) and not rule.worth_a_refit(0.149, 10**9)


def test_the_worth_of_a_refit_is_what_it_removes_as_far_as_that_was_seen_on_what_is_left_out():
    worth = ShareRule().worth
    assert worth(Numbers(_screened(), error=0.8)) == pytest.approx(0.2)
    assert worth(Numbers(_screened(inside=0.4, left_out=0.2), error=0.4)) == pytest.approx(0.3)
    assert worth(Numbers(_screened(inside=0.2, left_out=0.4), error=0.4)) == pytest.approx(0.6)


def test_a_rival_that_is_as_good_cannot_be_told():
    best = Numbers(_screened(), gain=100.0, error=0.5)
    for gain, error, even in ((96.0, 0.54, (True, True)), (94.0, 0.56, (False, False)), (90.0, 0.4, (False, True))):
        rival = Numbers(_screened(), gain=gain, error=error)
        assert (LikelihoodRule().even(best, rival), ShareRule().even(best, rival)) == even


def test_what_stays():
    for gain, error, stays in ((13.0, 2.0, (True, False)), (11.0, 0.5, (False, True)), (-5.0, 0.95, (False, False))):
        numbers = Numbers(_screened(), gain=gain, error=error)
        assert (LikelihoodRule().keeps(numbers).believed, ShareRule().keeps(numbers).believed) == stays
    assert ShareRule().keeps(Numbers(_screened(), error=1.3, soon=0.4)).believed  # a fast machine forgets


def test_only_named_laws_that_shout_are_looked_at_beyond_the_shares():
    rule = SoonRule()
    assert isinstance(ShareRule().beyond(), SoonRule) and LikelihoodRule().beyond() is rule.beyond() is None
    shout = _screened(gain=0.06 * READINGS)
    assert rule.promise(shout, READINGS) == pytest.approx(0.06 - NET / READINGS)
    assert rule.worth_a_refit(0.051, READINGS) and not rule.worth_a_refit(0.049, READINGS)
    assert rule.promise(shout._replace(candidate=FREE), READINGS) == 0.0


@pytest.mark.parametrize(
    ("numbers", "sound", "believed"),
    [
        ({"error": 1.4, "soon": 0.49, "soon_unseen": 0.69}, True, True),
        ({"error": 0.1, "soon": 0.51, "soon_unseen": 0.69}, False, True),
        ({"soon": 0.1, "soon_unseen": 0.71}, True, False),  # not on motions left out
        ({"soon": 0.1, "soon_unseen": 0.1, "certainty": 4.9}, False, True),
    ],
)
def test_where_a_machine_forgets_half_of_the_error_must_go_at_once(numbers, sound, believed):
    evidence = Numbers(_screened(), **numbers)
    assert SoonRule().keeps(evidence).believed == (numbers["soon"] <= 0.5)
    assert SoonRule().sound(evidence).believed == sound
    assert SoonRule().believes(evidence).believed == believed
    assert SoonRule().worth(evidence) == pytest.approx(1 - numbers["soon"])
