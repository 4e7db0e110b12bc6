"""One look: which law may take the place of which, and what is left of the one that goes."""

import equinox as eqx
import jax
import numpy as np
import plant
import pytest
from helpers import around, declared_model

from nnap_em.diagnose.accept import LikelihoodRule, ShareRule
from nnap_em.diagnose.case import held_out_gain
from nnap_em.diagnose.evidence import Projected, Screen
from nnap_em.diagnose.keys import key_of, replaced
from nnap_em.diagnose.look import Look, suspects
from nnap_em.diagnose.outcome import Step
from nnap_em.diagnose.refit import Trial
from nnap_em.effects import catalogue
from nnap_em.model.state_space import with_effects

MODEL = declared_model(plant.Case(steps=20, hidden=False))
AROUND = around(MODEL)


def _functions(joint: int, *names: str):
    """Functions of these signals at a joint: the one that repeats each turn, and the one that does not."""
    found = [c.start for c in catalogue["unknown_function"].candidates(AROUND) if c.start.joint == joint]
    turning, still = (e for e in found if e.inputs_named() == names and len(e.axes) == 1)
    return turning, still


def test_a_function_of_each_turn_and_one_of_all_turns_are_rivals():
    turning, still = _functions(2, "theta2")
    assert key_of(turning) == key_of(still)
    spring = catalogue["torsional_spring"].candidates(AROUND)[0].start
    model = with_effects(MODEL, (spring, turning))
    assert replaced(still, model) == 1
    assert replaced(turning, model) is None
    assert replaced(_functions(1, "theta1")[1], model) is None
    assert replaced(spring, model) is None


def test_one_repeats_each_turn_and_the_other_does_not():
    """Both are the same bump near zero; a turn further on only the one is there again."""
    turning, still = _functions(2, "theta2")
    for effect, again in ((turning, 1.0), (still, 0.0)):
        basis = jax.vmap(effect.axes[0].basis)(np.array([1.0, 1.0 + 2 * np.pi]))
        here, there = basis[:, int(np.argmax(basis[0]))]
        assert here > 0.8
        np.testing.assert_allclose(there, again * here, atol=1e-6)


def test_one_sequence_has_nothing_to_be_held_out(bench, monkeypatch):
    _, model, rule, data, path = bench

    def refit(*_, **__):
        raise AssertionError("refitted to the very sequence that should judge")

    monkeypatch.setattr("nnap_em.diagnose.case.refit", refit)
    null, full = (Trial(model, rule, path, gain * np.ones(4), np.eye(rule.prior.size)) for gain in (0.0, 100.0))
    assert held_out_gain(null, full, data, np.array([False, True, False, False])) == 0.0
    with pytest.raises(AssertionError, match="very sequence"):
        held_out_gain(null, full, data, np.array([False, True, True, False]))


def test_a_stop_that_yields_is_none():
    """One that a typical torque pushes in by half a radian, or whose ends nearly meet, is a spring in disguise."""
    stop = next(c for c in catalogue["hard_stop"].candidates(AROUND) if c.start.joint == 2).probes[0]
    assert stop.possible()
    half = np.log(2.0 * AROUND.torque[1])  # N m/rad
    assert eqx.tree_at(lambda s: s.stiffness, stop, half + 0.01).possible()
    assert not eqx.tree_at(lambda s: s.stiffness, stop, half - 0.01).possible()
    assert not eqx.tree_at(lambda s: s.lower, stop, stop.upper - 0.1).possible()


def _seen(*shares: tuple[str, float]) -> Look:
    """A look that screened these laws, best first."""
    screened = tuple(((name, 2, None, ()), share) for name, share in shares)
    return Look(Step(20, screened, (), None, 3), Screen((), Projected(np.zeros(0), np.zeros((0, 0)))), [], [])


SCREENED = (("unknown_function", 0.32), ("one_sided_loss", 0.25), ("load_friction", 0.21), ("payload", 0.18))


@pytest.mark.parametrize(
    ("chance", "names"),
    [
        (0.0, ["one_sided_loss", "load_friction", "unknown_function"]),  # .18 is less than .6 of the best
        (0.11, ["one_sided_loss", "unknown_function"]),  # .21 is within twice the chance level
        (0.17, []),
    ],
)
def test_suspects_are_near_the_best_and_over_chance_with_named_laws_first(chance, names):
    found = suspects(_seen(*SCREENED), ShareRule(), lambda: chance)
    assert [suspect.key[0] for suspect in found] == names
    assert all(suspect.chance == chance for suspect in found)


def test_chance_is_not_measured_where_nothing_is_suspected():
    def never():
        raise AssertionError

    assert suspects(_seen(("payload", 0.05)), ShareRule(), never) == ()
    assert suspects(_seen(("payload", 0.9)), LikelihoodRule(), never) == ()
