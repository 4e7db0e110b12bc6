"""Fits that do not describe their motion, and numbers that left their declaration, from both sides of the bounds."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nnap_em.estimate import misfit as bounds
from nnap_em.estimate.em.build import measure_scales
from nnap_em.estimate.identify import Identified, begin
from nnap_em.estimate.misfit import Accuracy, ahead, misfit, moved, simulating
from nnap_em.estimate.store import load, save
from nnap_em.logs.dataset import Dataset
from nnap_em.machines.rig import Declared, Rig
from nnap_em.output.report import identification

DT, ROWS = 0.02, 201
RIG = Rig("slide", "slide", {"m": Declared(1.0, 0.1)}, False, ("u",), (1,), DT, "sequence", ("x",), {"x": 0.01}, {})
GOOD = Accuracy("x", "m", (0.25, 0.5, 1.0), (0.03, 0.04, 0.05), (0.2, 0.4, 0.6), 0.01, 0.3)


def _data() -> Dataset:
    t = np.tile(DT * np.arange(ROWS), (2, 1))
    swing = 0.3 * np.sin(3 * t + np.array([[0.0], [1.0]]))[..., None]
    return Dataset(t, swing, swing, np.ones(t.shape, bool))


@pytest.fixture(scope="module")
def fitted() -> Identified:
    return begin(RIG, _data(), key=jax.random.key(0))


USELESS = [  # changes of a good row, and whether the fit is then useless
    ({"pushed": 1.01 * bounds.PUSHED, "error": (0.01, 0.01, 1.01 * bounds.UNPREDICTED * 0.6)}, True),
    ({"pushed": 0.99 * bounds.PUSHED, "error": (0.01, 0.01, 1.01 * bounds.UNPREDICTED * 0.6)}, False),
    ({"pushed": 1.01 * bounds.PUSHED, "error": (0.01, 0.01, 0.99 * bounds.UNPREDICTED * 0.6)}, False),
    ({"error": (1.01 * bounds.UNMOVED * 0.2, 5.0, 5.0)}, True),
    ({"error": (0.99 * bounds.UNMOVED * 0.2, 5.0, 5.0)}, False),  # of a chaotic motion the first moments alone
    ({"seconds": (), "error": (1.01 * bounds.UNMOVED * 0.2,), "motion": (0.2,)}, True),
]


def test_a_fit_that_predicts_nothing_or_takes_motion_for_random_is_useless():
    for changes, useless in USELESS:
        word = misfit([GOOD, GOOD._replace(column="y", **changes)])
        assert word.useless == useless == ("do not use it: y errs by " in word.text)
    said = "Something is missing in the model: y errs by 0.3 m 1 s ahead, 50 % of its motion; 0.25 s ahead by 0.101, 10"
    for noises, text in ((1.01 * bounds.BEYOND_NOISE, said), (0.99 * bounds.BEYOND_NOISE, "")):
        word = misfit([GOOD, GOOD._replace(column="y", error=(noises * 0.01, 0.2, 0.3))])
        assert not word.useless and word.text.startswith(text) and bool(word.text) == bool(text)
    restless = GOOD._replace(pushed=2.0, error=(0.01, 0.1, 0.5))
    assert misfit([restless]).useless and not misfit([restless], settled=False).useless
    assert misfit([]) == ("", False, ())


def test_accuracy_has_the_errors_beside_the_change_of_the_reading(fitted):
    """A sine of 3 rad/s over h: the mean square of its change is amplitude^2 (1 - cos 3 h)."""
    data, share = _data(), 0.7
    size = measure_scales(RIG, fitted.model.system, data).acceleration
    model = eqx.tree_at(lambda m: m.log_q, fitted.model, fitted.model.log_q.at[1:].set(2 * jnp.log(share * DT * size)))
    error = np.full((2, 5, 3, 1), 0.02)
    error[:, 1:3] = np.nan
    (row,) = ahead(RIG, model, error, data)
    assert (row.column, row.unit, row.pushed) == ("x", "m", pytest.approx(share))
    np.testing.assert_allclose(row.seconds, [0.26, 0.5, 1.0], atol=0.02)
    np.testing.assert_allclose(row.motion, 0.3 * np.sqrt(1 - np.cos(3 * np.array(row.seconds))), rtol=0.15)
    np.testing.assert_allclose(row.error, 0.02)
    assert row.noise == pytest.approx(float(np.exp(0.5 * model.log_r[0])))
    loud = data._replace(y=data.y + np.random.default_rng(0).normal(0, 0.05, data.y.shape))
    assert ahead(RIG, model, error, loud)[0].noise == pytest.approx(0.05, rel=0.1)
    assert ahead(RIG, model, np.full(error.shape, np.nan), data) == ()


def test_accuracy_of_free_simulations_is_beside_the_spread_of_the_reading(fitted):
    (row,) = simulating(RIG, fitted.model, np.full((2, 3, 4, 1), -0.1), _data())
    assert row.seconds == () and row.error == (pytest.approx(0.1),)
    assert row.motion == (pytest.approx(0.3 / np.sqrt(2), rel=0.05),)
    assert misfit(simulating(RIG, fitted.model, np.full((2, 3, 4, 1), np.inf), _data())).useless


def test_the_word_is_kept_with_the_model_and_printed(fitted, tmp_path):
    far = fitted._replace(accuracy=(GOOD._replace(error=(0.5, 0.5, 0.5)),))
    save(tmp_path / "model.npz", far)
    there = load(tmp_path / "model.npz")
    assert there.misfit == far.misfit and far.misfit.text and far.misfit.text in str(there)


def test_a_number_far_from_its_declaration_is_said_with_its_meaning(fitted):
    for distance, said in ((1.01 * bounds.LEFT, True), (-1.01 * bounds.LEFT, True), (0.99 * bounds.LEFT, False)):
        model = fitted.m_step.prior.write(fitted.model, jnp.asarray([distance]))
        there = fitted._replace(state=fitted.state._replace(best=model))
        far = moved(there.rig, there.m_step.prior, there.model)
        text = f"m = {1 + 0.1 * distance:.4g} kg is 3.0 std from what is declared (1): something is missing in the"
        assert [one.sentence.startswith(text) for one in far] == [True] * said
        assert identification._verdict(there, 2, 0, far=far).endswith(far[0].sentence if said else "in 0 epochs.")
    trusted = begin(replace(RIG, parameters={"m": Declared(1.0, 0.0)}), _data(), key=jax.random.key(0))
    assert moved(trusted.rig, trusted.m_step.prior, trusted.model) == []  # it cannot move


def test_the_first_sentence_of_a_fit_says_that_it_does_not_describe_the_motion(fitted):
    useless = fitted._replace(accuracy=(GOOD._replace(error=(1.0, 1.0, 1.0)),))
    text = identification._verdict(useless, 2, 0, ["u has the wrong sign"])
    assert text.startswith("The fit does not describe the motion, do not use it: x errs by 1 m 1 s ahead, ")
    assert "% of its acceleration. u has the wrong sign. Fitted m to 2 sequences" in text
    far = identification._verdict(fitted._replace(accuracy=(GOOD._replace(error=(0.15, 0.2, 0.2)),)), 2, 0)
    assert far.startswith("Fitted m to 2 sequences in 0 epochs. Something is missing in the model: x errs by")
