"""What was found, as it is told: each effect with its own curve, joint and units, whatever stands beside it."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import plant

from nnap_em.estimate.identify import Identified, begin
from nnap_em.explain.diagnosis.findings import advice, entry, findings, suspected, undecided, verdict
from nnap_em.explain.diagnosis.hypothesis import Evidence, Hypothesis
from nnap_em.explain.diagnosis.keys import key_of
from nnap_em.explain.diagnosis.outcome import Diagnosis, Step, Suspect
from nnap_em.logs.dataset import Dataset
from nnap_em.machines.rig import Declared, Rig
from nnap_em.model.effects import AbstractEffect, Candidate, catalogue
from nnap_em.model.effects.function import Axis

ROWS = 60
BODY = {name: Declared(value, 0.0) for name, value in plant.SYSTEMS["acrobot"].parameters.items()}
ARM = Rig("arm", "acrobot", BODY, True, ("u",), (2,), 0.02, "sequence", ("theta1", "theta2"),
          {"theta1": 0.01, "theta2": 0.01}, {})  # fmt: skip
SLIDE = Rig("slide", "slide", {"m": Declared(1.0, 0.0)}, True, ("u",), (1,), 0.02, "sequence", ("x",), {"x": 0.01}, {})


def _spring(joint: int) -> AbstractEffect:
    return catalogue["torsional_spring"](*map(jnp.asarray, (20.0, 1.0, 0.0, 0.0)), joint=joint)


def _function(signal: str, joint: int, slope: float) -> AbstractEffect:
    axis = Axis((signal,), -2.0, 2.0, False, 20)
    return catalogue["unknown_function"](slope * axis.centres(), (axis,), joint=joint)


@functools.cache
def _begun(name: str) -> Identified:
    """A fit to two sequences of a gentle motion, before its first epoch."""
    rig = {"arm": ARM, "slide": SLIDE}[name]
    t = np.tile(rig.dt * np.arange(ROWS), (2, 1))
    swing = 0.3 * np.sin(3 * t + np.array([[0.0], [1.0]]))[..., None]
    u, y = (np.repeat(swing, len(names), axis=2) for names in (rig.input_columns, rig.measured))
    return begin(rig, Dataset(t, u, y, np.ones(t.shape, bool)), key=jax.random.key(0))


def _closed(rig: Rig, *effects: AbstractEffect) -> Diagnosis:
    """A search that found these, in this order."""
    before = _begun(rig.name)
    hypothesis = Hypothesis(before.model, before.m_step)
    for effect in effects:
        candidate = Candidate(effect, (effect,), effect)
        hypothesis = hypothesis.plus(effect, candidate, Evidence(100.0))
    model, rule, found = hypothesis
    size = before.state.hessian.shape[0] + rule.prior.size - before.m_step.prior.size
    state = before.state._replace(model=model, best=model, hessian=1e4 * jnp.eye(size))
    bank = before.bank.padded(model.log_q.shape[0])
    return Diagnosis(before, before._replace(state=state, m_step=rule, bank=bank), found, ())


def test_a_learned_rest_is_told_with_its_law_and_the_next_function_keeps_its_joint():
    """The rest stands between the law that it completes and another finding."""
    effects = _spring(2), _function("theta2", 2, 1.0), _function("theta1", 1, -2.0)
    spring, other = findings(_closed(ARM, *effects))
    assert (spring.effect.name, other.effect.name) == ("torsional_spring", "unknown_function")
    assert "not quite of this form" in spring.sentence
    for finding, signal, joint, sign in ((spring, "theta2", 2, 1), (other, "theta1", 1, -1)):
        assert (finding.curve.signal, finding.curve.joint) == (signal, joint)
        assert np.sign(finding.curve.mean[-1] - finding.curve.mean[0]) == sign
        assert (finding.curve.std > 0).all()
    assert set(spring.parameters) == {"k", "theta0"} and not other.parameters
    for finding in (spring, other):
        assert entry(finding)["shape"]["kind"] == finding.shape.kind
        assert finding.shape.words in finding.sentence


def test_a_curve_has_the_units_of_its_machine():
    (finding,) = findings(_closed(SLIDE, _function("x", 1, 1.0)))
    assert (finding.curve.signal_unit, finding.curve.unit) == ("m", "N")
    assert "N/m" in finding.sentence and "N m" not in finding.sentence


def test_a_tilted_base_and_a_biased_first_angle_are_listed_with_each_other():
    bias = catalogue["sensor_bias"].of
    for law, same in (
        (catalogue["base_tilt"].of(0.1), {("sensor_bias", None, "theta1", ())}),
        (bias(0.1, channel="theta1"), {("base_tilt", None, None, ())}),
        (bias(0.1, channel="theta2"), set()),
    ):
        (finding,) = findings(_closed(ARM, law))
        assert set(finding.equivalent) == same


def test_a_law_by_many_steps_has_shares_and_one_that_was_read_off_has_nats():
    """And a law of known form no shape."""
    nats, shares = Evidence(100.0), Evidence(share=0.4, chance=0.02, parts=(4, 5), removed=0.5)
    diagnosis = _closed(ARM, _spring(2))
    for found, known in ((nats, {"log_likelihood_gain"}), (shares, {"share_of_error", "chance"})):
        (finding,) = findings(diagnosis._replace(evidence=(found,)))
        numbers = {name for name, value in finding.evidence.items() if name != "parts" and np.isfinite(value)}
        assert numbers == known and finding.evidence["parts"] == list(found.parts)
    assert finding.curve is None and finding.shape is None and "shape" not in entry(finding)


def test_a_law_without_a_word_of_its_own_in_the_report_keeps_its_name_and_meaning():
    loss = catalogue["one_sided_loss"](jnp.asarray(0.1), side=1, column="tau1", joint=1)
    (finding,) = findings(_closed(ARM, loss))
    reported = entry(finding)
    assert (reported["name"], reported["law"]) == ("unknown_function", "one sided loss of tau1 at joint 1")
    assert reported["meaning"] == loss.meaning != catalogue["unknown_function"].meaning


def _law(name: str) -> AbstractEffect:
    return catalogue[name](jnp.asarray(0.1), joint=2)


RIVALS = tuple(key_of(effect) for effect in (_law("dead_zone"), _spring(1)))
SUSPECT = Suspect(key_of(_law("motor_gain")), 0.18, 0.03)
LAST = Step(ROWS, (), (), None, 3, rivals=RIVALS, suspects=(SUSPECT,))
"""A round that saw a spring and a dead zone that are even, and suspects a gain."""


def test_what_cannot_be_told_is_a_verdict():
    rivals = undecided(_closed(ARM)._replace(steps=(Step(ROWS, (), (), RIVALS[0], 3), LAST)))
    text = verdict([], None, 3, rivals)
    assert "cannot tell" in text and "dead zone at joint 2 and torsional spring at joint 1" in text
    assert len(advice([], rivals)) == 2
    late = verdict([], None, unfinished="The search was stopped")
    assert late == "No effect was found yet. The search was stopped: more may be missing."


def test_a_suspect_is_named_with_its_share_and_the_chance_level():
    (suspect,) = suspected(_closed(ARM)._replace(steps=(LAST,)))
    assert [suspect[key] for key in ("name", "joint", "share_of_error", "chance")] == ["motor_gain", 2, 0.18, 0.03]
    removes = "would remove 18% of the squared prediction error, where chance removes up to 3%"
    assert suspect["description"] == f"motor gain at joint 2 {removes}"
    assert verdict([], None, 3, (), [suspect]).startswith("No effect is certain to be missing. Suspected: motor gain")
    assert "certain" not in verdict([], None) and not suspected(_closed(ARM))
    errs = "Something is missing in the model: x errs by 1 m."
    text = verdict([], None, 3, (), [suspect], misfit=errs, tried=97)
    assert text.startswith(f"{errs} None of 97 laws tried explains it for certain. Suspected: motor gain")
    assert verdict([], None, 3, misfit=errs, tried=97) == f"{errs} None of 97 laws tried explains it."
    assert (
        advice([], (), [suspect])[1] == f"To see a motor gain at joint 2 by itself: {catalogue['motor_gain'].confirm}"
    )
