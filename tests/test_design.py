"""Designed experiments: inputs inside their limits, information by another road, and what a fit then states."""

import dataclasses
import itertools
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import nnap, written_again
from rigs import slide_logs, slide_rig

import nnap_em
from nnap_em.errors import DesignError, RigError, StoreError
from nnap_em.estimate.identify import Identified, identify, parameter_table
from nnap_em.estimate.predict import drawn_paths
from nnap_em.estimate.store import save
from nnap_em.explain.design.criteria import Criterion, after, share
from nnap_em.explain.design.experiment import design
from nnap_em.explain.design.information import Fit, information, known
from nnap_em.explain.design.limits import Limits, limits_of
from nnap_em.explain.design.play import Motions, allowed, motions
from nnap_em.explain.design.search import Effort
from nnap_em.explain.design.signals import FAMILIES, drawn, mutated, played
from nnap_em.logs.dataset import Dataset
from nnap_em.machines.limits import Bounds
from nnap_em.machines.rig import Rig, read_rig, write_rig
from nnap_em.machines.systems import specs
from nnap_em.model.simulate import examples
from nnap_em.output.report.design import check_places, write_design

LIMITS = Limits(
    np.asarray([-0.4, 0.1]), np.asarray([0.3, 0.5]), np.asarray([2.0, 1e9]),
    np.asarray([-2.0, -9.0]), np.asarray([2.0, 9.0]), np.zeros(2), np.zeros(2),
)  # fmt: skip
SMALL = Effort(pool=16, batch=16, rounds=2, tries=4)
THREE = {"seconds": 2.4, "sequences": 3, "effort": SMALL}


def test_inputs_keep_to_torque_and_its_change():
    """Every family and its mutations stay within both limits; numbers of a mutation stay between 0 and 1."""
    rng, t = np.random.default_rng(3), 0.01 * np.arange(301)
    proposals = drawn(rng, 40, 2, 2)
    other = mutated(rng, proposals, 0.5)
    assert other.shape.min() >= 0 and other.shape.max() <= 1 and np.abs(other.shape - proposals.shape).mean() > 0.2
    for proposal, family in itertools.product((proposals, other), range(len(FAMILIES))):
        u = played(proposal._replace(family=np.full(40, family)), LIMITS, t)
        assert np.all(u >= LIMITS.low[None, None]) and np.all(u <= LIMITS.high[None, None])
        change = np.abs(np.diff(u[..., 0], axis=1))
        assert change.max() <= 0.01 * LIMITS.rate[0] * (1 + 1e-9)
        assert np.abs(u[:, [0, -1], 0]).max() <= 0.01 * LIMITS.rate[0] * (1 + 1e-9)  # from rest, and back to it
        assert np.ptp(u[..., 0], axis=1).max() > 0.3  # and they are used


def test_covariance_after_more_information_is_that_of_the_sum_of_precisions():
    rng = np.random.default_rng(1)
    half, jac = rng.standard_normal((5, 5)), rng.standard_normal((3, 7, 5))
    cov, expected = half @ half.T, np.einsum("nri,nrj->nij", jac, jac)
    np.testing.assert_allclose(
        after(cov, expected), np.linalg.inv(np.linalg.inv(cov) + expected), rtol=1e-8, atol=1e-10
    )


def test_new_logs_tell_the_share_that_the_old_ones_told():
    """A posterior that is wider than the information of its logs says explains a share of it, by construction 0.3."""
    rng = np.random.default_rng(4)
    jac = rng.standard_normal((30, 4))
    prior, expected = 9 * np.eye(4), jac.T @ jac
    fit = lambda cov: Fit(None, None, None, jnp.asarray(cov), jnp.asarray(prior))  # type: ignore[arg-type]  # noqa: E731
    np.testing.assert_allclose(share(fit(after(prior, 0.3 * expected)), expected), 0.3, rtol=1e-4)
    assert share(fit(after(prior, 2.0 * expected)), expected) == 1.0


def test_friction_near_rest_counts_as_much_as_all_the_rest():
    """Torques of a joint at rest and at speed, in units of its friction: each bandwidth to the power of a half."""
    std, weight = np.asarray([0.4, 0.1]), np.asarray([[[0.0, 1.0]], [[1.0, 0.0]]])
    fit = Fit(None, None, np.asarray([[0.0, 9.0]]), np.diag(std**2), np.eye(2))  # type: ignore[arg-type]
    cost = Criterion(fit, np.asarray([2.0]), weight).cost
    nothing, slow = (np.diag([expected, 0.0]) / std**2 for expected in (0.0, 8.0))
    np.testing.assert_allclose(np.exp(cost(nothing)), np.sqrt(0.2 * 0.05), rtol=1e-9)
    np.testing.assert_allclose(cost(nothing) - cost(slow), 0.5 * np.log(3.0), rtol=1e-9)  # eightfold more information


# --- on a slide


@pytest.fixture(scope="module")
def slide(slide_fit) -> tuple[Rig, Dataset, Identified]:
    """A slide whose mass is uncertain: rig, logs and fit."""
    return slide_rig(), Dataset(*map(jnp.asarray, slide_logs(0))), slide_fit


def test_information_along_the_logs_is_the_curvature_of_their_fit(slide):
    """The fit linearises over the whole posterior, a design along one motion: they agree to a few percent."""
    _, data, fitted = slide
    total = information(known(fitted), data, nnap_em.smooth(fitted, data).mean[:, None]).sum(axis=0)
    weights = fitted.m_step.weights(fitted.model)
    hessian = jnp.asarray(total) + weights.prior_precision(fitted.model.unknown)
    std, fits = (np.sqrt(np.diagonal(np.linalg.inv(np.asarray(h)))) for h in (hessian, fitted.state.hessian))
    np.testing.assert_allclose(std[-1], fits[-1], rtol=0.05)
    np.testing.assert_allclose(std, fits, rtol=0.15)  # friction bends near rest


@pytest.mark.slow  # fast: test_information_along_the_logs_is_the_curvature_of_their_fit
def test_what_is_promised_is_what_a_fit_then_states_and_the_truth_is_near(slide):
    """The design is played by the model that made the logs, with noise of its own."""
    rig, data, fitted = slide
    truth = examples["slide"]().model
    plan = {"seconds": 3.8, "sequences": 4, "effort": SMALL}
    designed = design(fitted, data, key=jax.random.key(1), **plan)
    made = nnap_em.simulate(truth, jnp.asarray(designed.start), jnp.asarray(designed.u), key=jax.random.key(9)).data
    both = Dataset(*(np.concatenate([a, b]) for a, b in zip(data, made, strict=True)))
    value, stated = parameter_table(identify(rig, both, key=jax.random.key(0)))["m"]
    std = lambda expected: 0.1 * np.sqrt(after(np.asarray(designed.fit.cov), expected)[-1, -1])  # noqa: E731
    assert 1 / 1.5 < std(designed.expected) / stated < 1.5
    assert abs(value - 1.0) < 4 * stated
    assert max(std(designed.expected), std(designed.old)) < std(0 * designed.old)


@pytest.fixture(scope="module")
def plan(slide):
    _, data, fitted = slide
    return design(fitted, data, key=jax.random.key(2), **THREE)


def test_no_motion_of_a_design_leaves_what_the_logs_visited(slide, plan):
    fitted = slide[-1]
    paths = drawn_paths(fitted, 300, key=jax.random.key(77))
    extremes = motions(paths, plan.limits, plan.t, plan.u, plan.start, 1, key=jax.random.key(78))
    assert np.all(np.asarray(extremes.lowest) >= plan.limits.lowest[None, None])
    assert np.all(np.asarray(extremes.highest) <= plan.limits.highest[None, None])
    whole, near = plan.criterion.weight
    np.testing.assert_allclose([whole.sum(), near.sum()], 1.0)
    speed = np.abs(np.asarray(plan.fit.nodes))  # the slowest rows once more by themselves
    assert speed[near > 0].max() <= plan.slow[0] < speed[whole > 0].max()


def test_what_can_be_played_is_written_with_a_page(slide, plan, tmp_path):
    """A design replaces its own files."""
    for _ in range(2):
        write_design(tmp_path, plan, seed=2, began=0.0, log=lambda text: None)
    document = json.loads((tmp_path / "design.json").read_text())
    assert document["inputs"] == [f"inputs/{i}.csv" for i in (1, 2, 3)] and document["seconds_each"] == plan.t[-1]
    for i, file in enumerate(document["inputs"]):
        table = np.genfromtxt(tmp_path / file, delimiter=",", names=True)
        assert table.dtype.names == ("time", "u")
        np.testing.assert_allclose(table["u"], plan.u[i, :, 0], rtol=1e-6, atol=1e-9)
    assert document["limits"]["values"]["u"] == [plan.limits.low[0], plan.limits.high[0]]
    (friction,), mass = document["friction"], document["parameters"]["m"]
    assert friction["near_rest"]["expected"] < friction["near_rest"]["now"] and mass["expected"] < mass["now"]
    assert mass["now"] == pytest.approx(parameter_table(slide[-1])["m"][1])
    html = (tmp_path / "design.html").read_text()
    assert html.count("<img") == 1 and "None is declared" in html and document["verdict"] in html
    (tmp_path / "inputs" / "4.csv").write_text("mine")
    with pytest.raises(StoreError, match=r"4\.csv"):
        check_places(tmp_path, 4)


def test_a_motion_is_allowed_that_stays_inside_its_limits_by_more_than_its_spread():
    """Limits 0 and 10, two paths each: well inside, beyond either end, and inside by less than their spread."""
    lowest = np.array([[4.0, 4.2], [-0.1, 4.0], [4.0, 4.2], [4.0, 4.2]])[..., None]
    highest = np.array([[6.0, 6.2], [6.0, 6.2], [6.0, 10.1], [5.0, 9.0]])[..., None]
    zero, ten = np.zeros(1), np.full(1, 10.0)
    limits = Limits(zero, ten, ten, zero, ten, zero, ten)
    trials = Motions(jnp.asarray(lowest), jnp.asarray(highest), jnp.zeros((4, 1, 1, 1)))
    np.testing.assert_array_equal(allowed(trials, limits), [True, False, False, False])
    lost = trials._replace(highest=trials.highest.at[0, 0].set(jnp.nan))
    assert not allowed(lost, limits)[0]


def test_declared_limits_hold_and_wrong_ones_are_told(slide):
    rig, data, fitted = slide
    path, used, system = np.zeros((8, 96, 2)), np.ones(8, bool), fitted.model.system
    path[:, :, 0] = np.linspace(-0.1, 0.2, 96)
    bounded = lambda **tables: dataclasses.replace(rig, limits=Bounds(**tables))  # noqa: E731
    plain = limits_of(rig, system, data, path, used)
    assert plain.low[0] == np.asarray(data.u).min() and plain.high[0] == np.asarray(data.u).max()
    declared = bounded(values={"u": (-1.0, 2.0), "x": (-0.5, 0.5)}, rate={"u": (-3.0, 3.0)}, start={"x": (-0.2, 0.3)})
    expected = limits_of(declared, system, data, path, used)
    assert (expected.low[0], expected.high[0], expected.rate[0]) == (-1.0, 2.0, 3.0)
    assert (expected.lowest[0], expected.highest[0], expected.first[0], expected.last[0]) == (-0.5, 0.5, -0.2, 0.3)
    with pytest.raises(DesignError, match=r"begin at x = 0.7 to 0.7, out of the limits .*\[limits.start\]"):
        limits_of(bounded(start={"x": (0.7, 0.7)}), system, data, path, used)
    with pytest.raises(DesignError, match=r"has no input.*\[input\]"):
        limits_of(dataclasses.replace(rig, input_columns=(), input_joints=()), system, data, path, used)
    with pytest.raises(DesignError, match=r"u never moved.*\[limits\]"):
        limits_of(rig, system, data._replace(u=np.zeros_like(data.u)), path, used)
    tight = fitted._replace(rig=bounded(values={"x": (-1e-4, 1e-4)}))
    with pytest.raises(DesignError, match=r"stay inside the limits; widen \[limits\]"):
        design(tight, data, key=jax.random.key(0), **THREE)
    with pytest.raises(DesignError, match="give more --seconds"):
        design(fitted, data, key=jax.random.key(0), seconds=0.1)


# --- the command


def test_logs_that_are_not_those_of_the_fit_are_refused(slide_fit, tmp_path, capsys):
    save(tmp_path / "fit" / "model.npz", slide_fit, fingerprint="other")
    other = tmp_path / "other"
    assert nnap("simulate", other, "--system", "slide", "--sequences", 8, "--test", 0, "--steps", 95) == 0
    assert nnap("design", tmp_path / "fit", "--logs", other, "--out", tmp_path / "next") == 2
    assert "not the logs, or not read as those, of the fit" in capsys.readouterr().err
    assert nnap("design", tmp_path / "fit", "--logs", tmp_path / "gone", "--out", tmp_path / "next") == 2
    assert "its logs are not at" in capsys.readouterr().err
    assert not (tmp_path / "next").exists()


# --- [limits] of rig.toml

BOUNDS = "\n[limits]\nu = 0.5\nx = [-1, 2.5]\n[limits.rate]\nu = 4\n[limits.start]\nx = 0.25\n"
WRONG = (
    ("[limits]\nU = 1", r"\[limits\] U: unknown table or key; did you mean 'u'"),
    ("[limits]\nu = 0", r"\[limits\] u: found 0; write .*above 0"),
    ("[limits]\nx = [2, 1]", r"\[limits\] x: found \[2, 1\]; write the lower bound first"),
    ("[limits.rate]\nx = 3", r"\[limits.rate\] x: unknown"),
)


def test_limits_are_read_and_written_and_wrong_ones_refused(tmp_path):
    path = tmp_path / "rig.toml"
    write_rig(slide_rig(), path)
    text = path.read_text()
    path.write_text(text + BOUNDS)
    rig = read_rig(path, specs)
    assert rig.limits == Bounds({"u": (-0.5, 0.5), "x": (-1.0, 2.5)}, {"u": (-4.0, 4.0)}, {"x": (0.25, 0.25)})
    assert written_again(rig, tmp_path) == rig
    for lines, reason in WRONG:
        path.write_text(f"{text}\n{lines}\n")
        with pytest.raises(RigError, match=reason):
            read_rig(path, specs)
