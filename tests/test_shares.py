"""The share of a squared error that candidates remove, against least squares; its parts and its placebos."""

import jax.numpy as jnp
import numpy as np
import pytest

from nnap_em.estimate.em.multistep import ratio
from nnap_em.explain.diagnosis.losses import Linearised
from nnap_em.explain.diagnosis.screen import Rows, fold_of, motions, project, shares, shifted, times
from nnap_em.logs.dataset import Dataset
from nnap_em.model.effects import Candidate, catalogue

GAIN = catalogue["motor_gain"](jnp.zeros(()), joint=1)
WIDE = catalogue["motor_gain"](jnp.asarray(1e9), joint=1)
ONE = catalogue["motor_gain"](jnp.ones(()), joint=1)


def _candidate(size: int) -> Candidate:
    """A linear law of so many strengths, nearly free."""
    return Candidate(GAIN, (ONE,) * size, WIDE)


def _rows(error, columns, fold, block=None, overlap=1.0) -> Rows:
    """Errors that no nuisance touches, sorted by part."""
    block = fold if block is None else block
    count = int(np.max(block, initial=0)) + 1
    order = np.argsort(fold * count + block, kind="stable")
    return Rows(error[order], columns[order], (fold * count + block)[order], count, overlap, np.ones(columns.shape[1]))


def _share(rows: Rows, size: int, timed: bool = False):
    """Shares of one candidate."""
    result = shares(rows, [_candidate(size)], [timed])
    return result.inside[0], result.left_out[0], result.folds[0], result.coefficients


def test_shares_are_those_of_least_squares():
    """Inside adjusted for directions, and by folds left out; two candidates of different size beside each other."""
    rng = np.random.default_rng(0)
    x, fold = rng.normal(size=(400, 3)), rng.permutation(np.repeat(np.arange(4), 100))
    e = x @ np.array([1.0, -0.5, 0.0]) + rng.normal(size=400)
    result = shares(_rows(e, x, fold), [_candidate(2), _candidate(1)], [True, True])
    fitted, squares, *_ = np.linalg.lstsq(x[:, :2], e, rcond=None)
    np.testing.assert_allclose(result.coefficients[:2], fitted, rtol=1e-6)
    raw = 1 - squares[0] / np.sum(e**2)
    assert result.inside[0] == pytest.approx(1 - (1 - raw) * 399 / 397, rel=1e-6)
    gone = 0.0
    for f in range(4):
        mask = fold == f
        coefficients = np.linalg.lstsq(x[~mask, :2], e[~mask], rcond=None)[0]
        before, after = np.sum(e[mask] ** 2), np.sum((e[mask] - x[mask, :2] @ coefficients) ** 2)
        assert result.folds[0, f] == pytest.approx(1 - after / before, rel=1e-6)
        gone += before - after
    assert result.left_out[0] == pytest.approx(gone / np.sum(e**2), rel=1e-6)
    assert result.left_out[1] < 0.02  # what is not there removes nothing of what is left out


def test_errors_that_overlap_count_for_less():
    """Of 400 errors four cover one moment: adjusted as for 100."""
    rng = np.random.default_rng(1)
    e, x = rng.normal(size=400), rng.normal(size=(400, 2))
    fold, block = np.repeat(np.arange(4), 100), np.tile(np.arange(4), 100)
    apart, together = (_share(_rows(e, x, fold, block, overlap), 2)[0] for overlap in (1.0, 4.0))
    assert (1 - together) / (1 - apart) == pytest.approx((99 / 97) / (399 / 397), rel=1e-6)


def test_the_nuisance_is_projected_out_by_ridge_regression():
    """Its prior draws the whole, not its change, towards zero; what has no weight does not count."""
    rng, size = np.random.default_rng(2), 5
    columns, value = rng.normal(size=(3, 20, 2, size + 2)), rng.normal(size=size)
    error = columns[..., :size] @ rng.normal(size=size) + 0.1 * rng.normal(size=(3, 20, 2))
    weight = rng.uniform(0.5, 2.0, (3, 20, 2)) * (rng.uniform(size=(3, 20, 2)) > 0.2)
    weight[1] = 0.0
    precision = np.diag(rng.uniform(1, 9, size))
    fold, none = np.repeat(np.arange(3)[:, None], 20, axis=1), np.zeros((3, 20), int)
    linearised = Linearised(error, columns, weight, 1.0, np.arange(20))
    rows = project(linearised, fold, none, precision, precision @ value)
    keep, root = weight > 0, np.sqrt(weight[weight > 0])
    e, wide = root * error[keep], root[:, None] * columns[keep]
    nuisance, candidate = wide[:, :size], wide[:, size:]
    prior = np.sqrt(precision)
    stacked = np.concatenate([nuisance, prior])
    taken = np.linalg.lstsq(stacked, np.concatenate([e, -prior @ value]), rcond=None)[0]
    np.testing.assert_allclose(rows.error, e - nuisance @ taken, atol=1e-9)
    explained = np.linalg.lstsq(stacked, np.concatenate([candidate, np.zeros((size, 2))]), rcond=None)[0]
    np.testing.assert_allclose(rows.columns, candidate - nuisance @ explained, atol=1e-9)
    assert np.unique(rows.cell).tolist() == [0, 2]


def test_a_part_with_hardly_any_error_is_harmed_by_what_that_is_of_an_average_one():
    """A step of 1 that two parts have and the third has not: it harms that by 2.4, where parts hold 1.34 on average."""
    error, fold = np.array([1.0, 1.0, 1.0, 1.0, -0.1, -0.1]), np.repeat(np.arange(3), 2)
    folds = _share(_rows(error, np.ones((6, 1)), fold), 1)[2]
    assert folds[2] == pytest.approx(-2.4 / (4.02 / 3))
    expected = 2 * 0.45 - 0.45**2  # of one of the full parts, from the mean 0.45 of the others
    assert folds[0] == pytest.approx(expected)


def test_folds_are_neighbours_and_pieces_where_there_are_few():
    ten = fold_of(np.ones(10, bool), np.arange(10), np.zeros((10, 3), int))[:, 0]
    np.testing.assert_array_equal(ten, np.repeat(range(5), 2))
    used = np.array([True, False, True, True])
    assert fold_of(used, np.arange(4), np.zeros((4, 2), int))[used][:, 0].tolist() == [0, 1, 2]
    assert fold_of(np.ones(1, bool), np.zeros(1, int), np.arange(8)[None] // 2)[0].tolist() == [0, 0, 1, 1, 2, 2, 3, 3]


def test_recordings_of_one_motion_are_left_out_together():
    """Three motions, the first played three times; two motions only, cut at the same times."""
    rng = np.random.default_rng(0)
    one, two, three = np.cumsum(rng.normal(size=(3, 200, 2)), axis=1)
    again = lambda motion: motion + 0.1 * motion.std() * rng.normal(size=motion.shape)  # noqa: E731
    late = again(one)
    late[150:] = np.nan
    state, used = np.stack([one, two, again(one), three, late, two]), np.array([True] * 5 + [False])
    motion = motions(state, used)
    assert motion[:5].tolist() == [0, 1, 0, 3, 0]
    assert fold_of(used, motion, np.zeros((6, 1), int))[used, 0].tolist() == [0, 1, 0, 2, 0]
    used[3] = False
    t = np.tile(0.1 * np.arange(8), (6, 1))
    part = fold_of(used, motions(state, used), times(t, Dataset(t, t, t, np.ones(t.shape, bool)), 4))
    assert part[0].tolist() == part[2].tolist() == part[4].tolist() == [0, 0, 1, 1, 2, 2, 3, 3]
    assert part[1].tolist() == [4, 4, 5, 5, 6, 6, 7, 7]
    state[:, :20] = state[0, :20]  # from one rest, of which one diverged early: no repetitions
    state[3, 12:] = np.nan
    assert motions(state[[1, 2, 3]], np.ones(3, bool)).tolist() == [0, 1, 2]


def test_what_happens_at_one_moment_of_every_recording_is_no_law():
    """A force in the second fifth of each of six recordings: seen on recordings left out, not on times left out."""
    rng = np.random.default_rng(0)
    fold, block = np.repeat(np.arange(6), 100), np.tile(np.repeat(np.arange(5), 20), 6)
    x = np.where(block == 1, 1.0, 0.0)[:, None] * rng.normal(size=(600, 1))
    e = 3.0 * x[:, 0] + 0.1 * rng.normal(size=600)
    of_time, other = (_share(_rows(e, x, fold, block), 1, timed)[1] for timed in (True, False))
    assert of_time > 0.9 and abs(other) < 1e-6


def test_the_placebo_of_a_constant_explains_nothing():
    """A constant in every sequence, a fold each, which a shift alone would leave as it is."""
    rng = np.random.default_rng(0)
    error, one = 1.0 + 0.5 * rng.normal(size=(12, 60, 1)), np.ones((12, 60, 1))
    linearised = Linearised(error, np.ones((12, 60, 1, 2)), one, 1.0, np.arange(60))
    moved = shifted(linearised, 1, rng)
    np.testing.assert_array_equal(moved.columns[..., 0], 1.0)  # the nuisance stays
    fold = np.repeat(np.arange(12), 60)
    rows = [_rows(error.ravel(), case.columns[..., 0, 1:].reshape(-1, 1), fold) for case in (linearised, moved)]
    true, chance = (_share(case, 1, timed=True)[1] for case in rows)
    assert true > 0.7 and chance < 0.1


def test_a_placebo_moves_the_moments_that_count():
    """A reading in every fifth row: none of these keeps its column; a sequence of few moments takes no part."""
    columns, weight = np.random.default_rng(0).normal(size=(1, 100, 1, 2)), np.zeros((1, 100, 1))
    weight[:, ::5] = 1.0
    many = Linearised(np.zeros((1, 100, 1)), columns, weight, 1.0, np.arange(100))
    before, after = columns[0, ::5, 0, 1], shifted(many, 1, np.random.default_rng(1)).columns[0, ::5, 0, 1]
    np.testing.assert_allclose(np.sort(np.abs(before)), np.sort(np.abs(after)))
    assert not np.any(np.isclose(before, after))
    few = Linearised(np.zeros((1, 3, 1)), columns[:, :3], np.ones((1, 3, 1)), 1.0, np.arange(3))
    assert not shifted(few, 1, np.random.default_rng(0)).columns[..., 1:].any()


def test_logs_too_short_for_a_fork_say_nothing():
    nothing = np.zeros((3, 0, 2, 1))
    assert ratio(nothing, nothing, np.ones(3, bool)) == 1.0
    empty = _rows(np.zeros(0), np.zeros((0, 2)), np.zeros(0, int))
    assert _share(empty, 2)[:2] == (0.0, 0.0)
    one = _rows(np.ones(9), np.ones((9, 2)), np.zeros(9, int))
    assert _share(one, 2)[:2] == (0.0, 0.0)  # nothing can be left out
