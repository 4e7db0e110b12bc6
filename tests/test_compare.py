"""Fits side by side: a change that was made is named and nothing else, and alarms are as frequent as the level says."""

import dataclasses
import json
import math
from pathlib import Path

import jax
import jax.numpy as jnp
import jax.scipy.linalg
import numpy as np
import pytest
import scipy.stats
from helpers import nnap
from rigs import slide_logs, slide_rig

from nnap_em import compare
from nnap_em.errors import CompareError
from nnap_em.estimate.identify import Identified, identify
from nnap_em.estimate.store import load, save
from nnap_em.explain.compare.compare import CHANGED, Comparison, corrected, quantity
from nnap_em.explain.compare.pooling import LEAST_VARIANCE, apart, joint_test, pool
from nnap_em.explain.diagnosis.hypothesis import Hypothesis
from nnap_em.machines.rig import Declared
from nnap_em.model.effects.base import one
from nnap_em.model.effects.friction import LoadFriction
from nnap_em.output.report.comparison import describe, rows, table
from nnap_em.output.report.tables import plain

GROWN = 0.25
"""Growth of the Coulomb friction, which is 1 [N]."""


@pytest.fixture(scope="module")
def fits(tmp_path_factory, slide_fit) -> tuple[Path, Path]:
    """Folders of the fit of a slide, and of one of the same slide when its friction had grown."""
    root = tmp_path_factory.mktemp("compare")
    grown = identify(slide_rig(), slide_logs(2, GROWN), key=jax.random.key(0))
    for name, fitted in {"first": slide_fit, "grown": grown}.items():
        save(root / name / "model.npz", fitted)
    return root / "first", root / "grown"


@pytest.fixture(scope="module")
def changed(fits) -> Comparison:
    return compare(fits[0], str(fits[1] / "model.npz"))


def test_friction_that_grew_is_named_and_nothing_else(changed):
    assert changed.names == ("first", "grown") and changed.changed == ("friction of joint 1",)
    assert changed.verdict == (
        "1 of 2 tested quantities changed between first and grown beyond the stated errors (at 1%): "
        "friction of joint 1; `diagnose --from` names the reason."
    )
    curve = changed.quantities[0]
    assert curve.rows[0] == ("Coulomb", "N")
    grew, std = curve.value[1, 0] - curve.value[0, 0], math.hypot(*curve.std[:, 0])
    assert grew == pytest.approx(GROWN, abs=3 * std)
    assert curve.difference[0] == pytest.approx(grew / std)


# --- statistics against closed forms


def _curve_like(rng, nodes: int, fits: int) -> np.ndarray:
    """Covariances of smooth curves, all but singular, of another length and size for each fit."""
    x = np.linspace(-1, 1, nodes)
    kernel = lambda length: np.exp(-((x[:, None] - x) ** 2) / length**2)  # noqa: E731
    scale = np.exp(rng.normal(0, 0.3, (fits, nodes)))
    return np.stack([np.outer(s, s) * (kernel(0.1 + 0.1 * i) + 1e-10 * np.eye(nodes)) for i, s in enumerate(scale)])


def test_alarms_are_as_frequent_as_the_level_says():
    """Draws from stated posteriors of one machine: two curves and two numbers, at the level and at a coarser one."""
    fits, draws = 2, 1200
    rng = np.random.default_rng(fits)
    covs = [_curve_like(rng, 15, fits), _curve_like(rng, 9, fits), *rng.uniform(0.5, 2, (2, fits, 1, 1))]
    roots = [np.linalg.cholesky(cov) for cov in covs]
    alone, together = np.zeros((draws, len(covs))), np.zeros(draws)
    blank = quantity("m", (("m", "kg"),), np.ones((2, 1)), np.ones((2, 1)))
    for i in range(draws):
        tests = [
            joint_test(np.einsum("fab,fb->fa", root, rng.standard_normal(root.shape[:2])), cov)
            for root, cov in zip(roots, covs, strict=True)
        ]
        alone[i] = [test.p_value for test in tests]
        together[i] = min(each.test.p_value for each in corrected([blank._replace(test=test) for test in tests]))
    for level in (CHANGED, 0.1):
        # Holm's level for independent tests of true hypotheses: 1 - (1 - level / n)^n
        wanted = 1 - (1 - level / len(covs)) ** len(covs)
        assert np.mean(together < level) == pytest.approx(wanted, abs=4 * math.sqrt(wanted / draws))
        np.testing.assert_allclose(np.mean(alone < level, axis=0), level, atol=4 * math.sqrt(level / draws))


def test_the_joint_test_is_hotellings_and_cochrans():
    rng = np.random.default_rng(3)
    root = rng.normal(size=(3, 4, 4))
    cov, value = root @ root.swapaxes(1, 2) + np.eye(4), rng.normal(size=(3, 4))
    apart, both = value[0] - value[1], cov[0] + cov[1]
    test = joint_test(value[:2], cov[:2])
    np.testing.assert_allclose(test.statistic, apart @ np.linalg.solve(both, apart), rtol=1e-9)
    weight = np.linalg.inv(cov)
    mean = np.linalg.solve(weight.sum(0), np.einsum("fab,fb->a", weight, value))
    q = np.einsum("fa,fab,fb", value - mean, weight, value - mean)
    test = joint_test(value, cov)
    np.testing.assert_allclose((test.statistic, test.freedom), (q, 8), rtol=1e-9)
    assert test.p_value == pytest.approx(scipy.stats.chi2.sf(q, 8))


def test_contrasts_that_only_the_network_knows_are_left_out():
    """Two numbers of correlation c have directions of variance 1 - c and 1 + c."""
    for share, freedom in ((0.99, 1), (1.01, 2)):
        near = 1 - share * LEAST_VARIANCE
        assert joint_test(np.zeros((2, 2)), np.stack([[[1.0, near], [near, 1.0]]] * 2)).freedom == freedom


def test_numbers_that_are_equally_sure_are_pooled_to_their_mean_and_differ_as_cochran_has_it():
    value, std = np.random.default_rng(5).normal(2.0, 3.0, (7, 4)), np.full((7, 4), 0.5)
    pooled = pool(value, std)
    np.testing.assert_allclose(pooled.value, value.mean(axis=0), rtol=1e-12)
    np.testing.assert_allclose(pooled.std, 0.5 / math.sqrt(7), rtol=1e-12)
    np.testing.assert_allclose(apart(value, std) ** 2, 6 * value.var(axis=0, ddof=1) / 0.25, rtol=1e-12)
    test = joint_test(value[:, :1], np.full((7, 1, 1), 0.25))  # of the first number alone
    assert apart(value, std)[0] ** 2 == pytest.approx(test.statistic)


def test_errors_of_fits_that_differ_are_widened_to_the_difference():
    """As Birge has it: with them the statistic is its degrees of freedom; two numbers 5 standard deviations apart."""
    row = (("m", "kg"),)
    far = quantity("m", row, np.asarray([[1.0], [1.0 + 5 * math.sqrt(2)]]), np.ones((2, 1)))
    assert far.difference[0] == pytest.approx(5.0)
    assert (far.pooled.value[0], far.pooled.std[0]) == pytest.approx((far.value.mean(), 5 / math.sqrt(2)))
    near = quantity("m", row, np.asarray([[1.0], [1.1]]), np.ones((2, 1)))
    assert near.pooled.std[0] == pytest.approx(1 / math.sqrt(2))


def test_a_prior_that_all_runs_share_counts_once():
    """Runs that tell nothing leave the prior; those that tell something its precision and theirs."""
    same = np.full((3, 1), 2.0)
    np.testing.assert_allclose(pool(same, np.full((3, 1), 0.4), 0.4).std, 0.4, rtol=1e-6)
    std = 1 / math.sqrt(1 / 0.4**2 + 1 / 0.2**2)
    np.testing.assert_allclose(pool(same, np.full((3, 1), std), 0.4).std, (1 / 0.16 + 3 / 0.04) ** -0.5, rtol=1e-9)


# --- the table


def _with_effect(fitted: Identified, mu: float) -> Identified:
    """The fit with friction that grows with the load, known to 0.01."""
    law = one(lambda mu: LoadFriction(mu, jnp.asarray(0.02), names=("u", "dx"), joint=1), mu, 0.05, 0.5)
    grown = Hypothesis(fitted.model, fitted.m_step, ()).plus(law.start, law)
    hessian = jax.scipy.linalg.block_diag(fitted.state.hessian, jnp.asarray([[(0.5 / 0.01) ** 2]]))
    state = fitted.state._replace(best=grown.model, hessian=hessian)
    return fitted._replace(state=state, m_step=grown.m_step)


def test_effects_are_compared_and_those_of_one_fit_stand_in_the_table(fits):
    first, second = map(load, (fit / "model.npz" for fit in fits))
    comparison = compare(_with_effect(first, 0.1), second)
    name = "mu of load friction of u and dx at joint 1"
    assert comparison.quantities[-1].test is None and comparison.names == ("fit 1", "fit 2")
    assert [row[0] for row in rows(comparison) if row[2] == "–" and row[-1] == "in one fit"] == [name]
    comparison = compare(_with_effect(first, 0.1), _with_effect(second, 0.2))  # known to 0.01 each
    assert name in comparison.changed
    np.testing.assert_allclose(comparison.quantities[-1].std, 0.01, rtol=1e-6)


# --- mistakes

OTHER = (
    ({}, {"system": "sled"}, "the system of a and b differs: slide and sled; compare fits of one machine"),
    ({}, {"parameters": {}}, "the list of parameters of a and b differs"),
    (*({"parameters": {"m": Declared(m, 0.0)}} for m in (1.0, 1.2)), r"the trusted m of a and b differs: 1 and 1\.2"),
)


def test_other_machines_are_refused(fits):
    pair = [load(fit / "model.npz") for fit in fits]
    for *changes, reason in OTHER:
        both = (fit._replace(rig=dataclasses.replace(fit.rig, **own)) for fit, own in zip(pair, changes, strict=True))
        with pytest.raises(CompareError, match=reason):
            compare(*both, names=("a", "b"))


def test_the_command_refuses_in_one_line(fits, tmp_path, capsys):
    with pytest.raises(CompareError, match="names a for 2 fits; give each fit a name of its own"):
        compare(*fits, names=("a",))
    text = tmp_path / "log.csv"
    text.write_text("time,u\n")
    for argv, reason in (
        ((fits[0],), "1 fit is given; give two or more, of one machine"),
        ((fits[0], fits[0]), "give each fit a name of its own"),
        ((fits[0], text), "no model, or damaged"),
        ((fits[0], tmp_path), "cannot be read"),
    ):
        assert nnap("compare", *argv, "--out", tmp_path / "out") == 2
        said = capsys.readouterr()
        assert said.out == "" and said.err.startswith("nnap-em: error: ") and said.err.count("\n") == 1
        assert reason in said.err
        assert not (tmp_path / "out").exists()


def test_the_command_prints_a_table_and_writes_a_page(fits, changed, tmp_path, capsys):
    assert nnap("compare", *fits, "--out", tmp_path / "out") == 0
    said = capsys.readouterr()
    assert said.out == table(changed) + "\n" and said.out.startswith(changed.verdict + "\n")
    lines = {line.split("  ")[0]: line for line in said.out.splitlines()}
    assert lines["friction of joint 1"].endswith("CHANGED") and "CHANGED" not in lines["m [kg]"]
    document = json.loads((tmp_path / "out/compare.json").read_text(), parse_constant=pytest.fail)
    assert document == plain(describe(changed))
    assert document["changed"] == ["friction of joint 1"]
    np.testing.assert_array_equal(document["quantities"][0]["value"], changed.quantities[0].value)
    html = (tmp_path / "out/compare.html").read_text()
    assert changed.verdict.partition(";")[0] in html and all(row[0].strip() in html for row in rows(changed))
