"""Fits that do not describe their motion, and numbers that left their declaration, from both sides of the bounds."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nnap_em.data.dataset import Dataset
from nnap_em.data.rig import Declared, Rig
from nnap_em.em.build import measure_scales
from nnap_em.fit.identify import Identified, begin
from nnap_em.fit.misfit import LEFT, PUSHED, UNPREDICTED, misfits, moved
from nnap_em.report import identification

DT, ROWS = 0.02, 121
RIG = Rig("slide", "slide", {"m": Declared(1.0, 0.1)}, False, ("u",), (1,), DT, "sequence", ("x",), {"x": 0.01}, {})


def _data() -> Dataset:
    t = np.tile(DT * np.arange(ROWS), (2, 1))
    swing = 0.3 * np.sin(3 * t + np.array([[0.0], [1.0]]))[..., None]
    return Dataset(t, swing, swing, np.ones(t.shape, bool))


@pytest.fixture(scope="module")
def fitted() -> Identified:
    return begin(RIG, _data(), key=jax.random.key(0))


def _pushed(fitted: Identified, share: float) -> Identified:
    """The fit with random accelerations of this share of the motion's."""
    size = measure_scales(RIG, fitted.model.system, _data()).acceleration
    log_q = fitted.model.log_q.at[1:].set(2 * jnp.log(share * DT * size))
    return fitted._replace(state=fitted.state._replace(best=eqx.tree_at(lambda m: m.log_q, fitted.model, log_q)))


def _error(share: float) -> dict:
    """An error over 1 s of this share of the motion in that time."""
    y = _data().y[:, 51:101, 0]
    size = float(np.sqrt(np.mean((y - y.mean(axis=1, keepdims=True)) ** 2)))
    return {"horizons_s": [0.5, 1.0], "fit": {"x": [0.0, share * size]}}


@pytest.mark.parametrize(
    ("push", "error", "said"),
    [
        (1.01 * PUSHED, None, True),
        (0.99 * PUSHED, None, False),
        (1.01 * PUSHED, 1.01 * UNPREDICTED, True),
        (1.01 * PUSHED, 0.99 * UNPREDICTED, False),  # it predicts all the same
    ],
)
def test_a_motion_that_is_taken_for_random_and_not_predicted_is_said(fitted, push, error, said):
    test = None if error is None else _data()
    found = misfits(_pushed(fitted, push), _data(), None if error is None else _error(error), test)
    assert [one.name for one in found] == ["x"] * said
    assert all("random forces accelerate x by" in one.sentence and "m/s^2" in one.sentence for one in found)


@pytest.mark.parametrize(("distance", "said"), [(1.01 * LEFT, True), (-1.01 * LEFT, True), (0.99 * LEFT, False)])
def test_a_number_far_from_its_declaration_is_said_with_its_meaning(fitted, distance, said):
    model = fitted.m_step.prior.write(fitted.model, jnp.asarray([distance]))
    there = fitted._replace(state=fitted.state._replace(best=model))
    sentences = [one.sentence for one in moved(there)]
    assert [text.partition(" kg is 3.0 std from what is declared (1): ")[::2] for text in sentences] == [
        (f"m = {1 + 0.1 * distance:.4g}", "something is missing in the model, or rig.toml is wrong.")
    ] * said
    assert identification._verdict(there, 2, 0).endswith(" ".join(sentences) or "in 0 epochs.")


def test_a_trusted_number_cannot_move():
    trusted = dataclasses.replace(RIG, parameters={"m": Declared(1.0, 0.0)})
    assert moved(begin(trusted, _data(), key=jax.random.key(0))) == []


def test_the_first_sentence_of_a_fit_says_that_it_does_not_describe_the_motion(fitted):
    text = identification._verdict(fitted, 2, 0, ["u has the wrong sign"])
    first = "The fit does not describe the motion, do not use it: u has the wrong sign. Fitted m to 2 sequences"
    assert text.startswith(first)
