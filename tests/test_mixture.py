"""The Gaussian-sum smoother: moments of its parts, its branches, and a grid over a state that may have two signs."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from nnap_em.base.gaussian import Gaussian
from nnap_em.estimate.em.loop import _replaced, e_step
from nnap_em.estimate.smoother.gaussian import CubatureSmoother
from nnap_em.estimate.smoother.kalman import Affine, Filtered, Reading
from nnap_em.estimate.smoother.mixture import WIDE_STD, Components, Tree, branch, merged, split
from nnap_em.estimate.smoother.start import StartBank
from nnap_em.logs.dataset import Dataset
from nnap_em.model.base import AbstractModel

ROWS = 60
KEY = jax.random.key(0)


class _Fall(AbstractModel):
    """An angle that falls from upright to either side, x' = x + dt (x - x^3 / 4), of which x^2 is read, or x itself.

    The input u is 0 where the square is read and 1 where the angle is.
    """

    log_q: jax.Array
    log_r: jax.Array
    start: Gaussian
    measured: tuple[int, ...] = eqx.field(static=True, default=())
    dt: float = eqx.field(static=True, default=0.05)

    def transition(self, x, u, force=None):
        return x + self.dt * (x - x**3 / 4)

    def emission(self, x, u):
        return jnp.where(u > 0, x, x**2)


def _model(mean: float = 0.05) -> _Fall:
    start = Gaussian(jnp.asarray([mean]), jnp.asarray([[0.25**2]]))
    return _Fall(jnp.log(jnp.asarray([4e-4])), jnp.log(jnp.asarray([0.01])), start)


def _logs(signs, last: int) -> Dataset:
    """One sequence for each side, whose angle is read in the rows from `last` on."""
    rng = np.random.default_rng(0)
    x = np.zeros((len(signs), ROWS))
    x[:, 0] = 0.1 * np.asarray(signs)
    for k in range(1, ROWS):
        x[:, k] = x[:, k - 1] + 0.05 * (x[:, k - 1] - x[:, k - 1] ** 3 / 4) + 0.02 * rng.normal(size=len(signs))
    u = np.broadcast_to(np.arange(ROWS) >= last, x.shape).astype(float)
    y = np.where(u > 0, x, x**2) + 0.1 * rng.normal(size=x.shape)
    t = np.broadcast_to(0.05 * np.arange(ROWS), x.shape)
    return Dataset(*map(jnp.asarray, (t, u[..., None], y[..., None], np.ones(x.shape, bool))))


def _grid(model: _Fall, seq: Dataset) -> tuple[np.ndarray, np.ndarray, float]:
    """Nodes, posterior over them in every row, and log p(y), by sums over a fine grid."""
    x = np.linspace(-3.5, 3.5, 1001)
    width, q, r = x[1] - x[0], np.exp(np.asarray(model.log_q))[0], np.exp(np.asarray(model.log_r))[0]
    to = np.asarray(model.transition(x, None))
    kernel = np.exp(-0.5 * (x[:, None] - to[None]) ** 2 / q) / np.sqrt(2 * np.pi * q) * width
    y, u = np.asarray(seq.y)[:, 0], np.asarray(seq.u)[:, 0]
    seen = np.where(u[:, None] > 0, x[None], x[None] ** 2)
    like = np.exp(-0.5 * (y[:, None] - seen) ** 2 / r) / np.sqrt(2 * np.pi * r)
    mean, var = np.asarray(model.start.mean)[0], np.asarray(model.start.cov)[0, 0]
    density = np.exp(-0.5 * (x - mean) ** 2 / var) / np.sqrt(2 * np.pi * var) * width
    ahead, loglik = [], 0.0
    for k in range(len(y)):
        density = (kernel @ density if k else density) * like[k]
        loglik += np.log(density.sum())
        density = density / density.sum()
        ahead.append(density)
    back, out = np.ones_like(x), []
    for k in reversed(range(len(y))):
        both = ahead[k] * back
        out.append(both / both.sum())
        back = kernel.T @ (like[k] * back)
        back = back / back.max()
    return x, np.stack(out[::-1]), loglik


_split = jax.jit(split, static_argnums=1)
_merged = jax.jit(merged)


def _moments(mixture: Components) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    weight = np.exp(np.asarray(mixture.log_weight))
    mean, cov = map(np.asarray, mixture.state)
    whole = np.einsum("k,ki->i", weight, mean) / weight.sum()
    off = mean - whole
    return weight.sum(), whole, np.einsum("k,kij->ij", weight, cov + off[:, :, None] * off[:, None, :]) / weight.sum()


def _components(seed: int, places: int = 4) -> Components:
    """Two of them, and free places."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(places, 3, 3))
    state = Gaussian(jnp.asarray(rng.normal(size=(places, 3))), jnp.asarray(root @ root.swapaxes(1, 2)))
    log_weight = jnp.where(jnp.arange(places) < 2, jnp.asarray(rng.normal(size=places)), -jnp.inf)
    return Components(state, log_weight, jnp.arange(places))


def test_split_and_merge_keep_weight_mean_and_covariance():
    for seed, wide in ((0, 1e-3), (1, 1e-3), (2, 1e3)):
        before = _components(seed)
        parts = _split(before, (0, 2), wide)
        assert np.isfinite(parts.log_weight).sum() == (4 if wide < 1 else 2)
        for after in (parts, _merged(_merged(parts)), _merged(_merged(_merged(parts)))):
            for a, b in zip(_moments(after), _moments(before), strict=True):
                np.testing.assert_allclose(a, b, rtol=1e-10)


def test_a_split_narrows_the_angle_and_only_components_that_are_wide():
    before = _components(1)
    std = np.sqrt(np.asarray(before.state.cov)[:2, 0, 0])
    parts = _split(before, (0, 0), float(std.mean()))  # one of the two is wider
    after = np.sqrt(np.asarray(parts.state.cov)[:, 0, 0])
    assert np.argmax(std) == int(parts.source[-1]) == int(parts.source[-2])
    np.testing.assert_allclose(after[[np.argmax(std), -2, -1]], 2 / 3 * std.max(), rtol=1e-12)
    np.testing.assert_allclose(after[np.argmin(std)], std.min(), rtol=1e-15)


def test_the_pair_with_the_smallest_bound_is_merged():
    """Two that are nearly the same become one before others that are far and as heavy."""
    place = np.asarray([0.0, 5.0, 0.1, -7.0])
    state = Gaussian(jnp.asarray(place[:, None] * [1.0, 0.0, 0.0]), jnp.tile(jnp.eye(3)[None], (4, 1, 1)))
    one = _merged(Components(state, jnp.log(jnp.asarray([0.3, 0.2, 0.3, 0.2])), jnp.asarray([7, 8, 9, 6])))
    np.testing.assert_allclose(np.sort(np.asarray(one.state.mean)[:, 0]), [-7.0, 0.05, 5.0], rtol=1e-12)
    assert set(np.asarray(one.source).tolist()) == {6, 7, 8}


def test_a_branch_goes_back_from_place_to_place():
    """Every number is ten times its row and the place; states and steps are those after the splits."""
    rows, places, last = 5, 3, 2
    at = 10.0 * np.arange(rows)[:, None] + np.arange(places)
    source = np.random.default_rng(0).integers(0, places, at.shape)
    one, square = jnp.asarray(at)[..., None], jnp.asarray(at)[..., None, None]
    state, affine = Gaussian(one, square), Affine(square, one, square)
    tree = Filtered(state, state, one, one, square, affine, Reading(square, one), jnp.asarray(at))
    chain = jax.jit(branch)(Tree(tree, jnp.asarray(source), jnp.asarray(at[-1])), jnp.asarray(last))
    place, expected = last, []
    for k in reversed(range(rows)):
        expected.append((at[k, place], at[k, source[k, place]]))
        place = source[k, place]
    after, before = np.transpose(expected[::-1])
    for parts, value in (((chain.state, chain.affine), after), ((chain.predicted, chain.reading), before)):
        for leaf in jax.tree.leaves(parts):
            np.testing.assert_array_equal(np.ravel(leaf), value)
    np.testing.assert_array_equal(chain.gain.ravel(), before)
    assert float(chain.loglik) == at[-1, last]


def test_the_likelier_side_is_the_one_of_the_grid():
    """The side shows only at the end; before it a single Gaussian takes the one to which its mean leans."""
    model, data = _model(), _logs([1, -1], ROWS - 4)
    first = e_step(model, data, CubatureSmoother(StartBank((1,))), key=KEY)
    mixture = e_step(model, data, CubatureSmoother(StartBank((1,), (0,))), key=KEY)
    assert np.all(np.asarray(mixture.width) > WIDE_STD)
    for i in range(2):
        x, posterior, loglik = _grid(model, jax.tree.map(lambda a, i=i: a[i], data))
        mean = posterior @ x
        std = np.sqrt(posterior @ x**2 - mean**2)
        off = (np.asarray(mixture.state.mean)[i, :, 0] - mean) / std
        assert np.sqrt(np.mean(off**2)) < 0.3  # of a standard deviation: what linearisation costs
        np.testing.assert_allclose(mixture.loglik[i], loglik, atol=0.7)
        assert first.loglik[i] <= mixture.loglik[i]
    assert first.loglik[1] < mixture.loglik[1] - 5  # it was on the other side


def test_a_kept_path_is_followed_and_the_other_side_is_not_sought():
    """Right of the mixture's own path and left of it: about the former the same, about its mirror image the mirror."""
    model, data, bank = _model(mean=0.0), _logs([1, -1], ROWS), StartBank((1,), (0,))
    smoother = CubatureSmoother(bank)
    sought = e_step(model, data, smoother, key=KEY)
    mirrored = sought.state._replace(mean=-sought.state.mean)
    for side, kept in ((1, sought.state), (-1, mirrored)):
        about = e_step(model, data, smoother, key=KEY, kept=kept)
        np.testing.assert_allclose(
            about.state.mean[:, ROWS // 2 :], side * sought.state.mean[:, ROWS // 2 :], atol=1e-3
        )
        np.testing.assert_allclose(about.loglik, sought.loglik, atol=1e-3)


def test_what_is_narrow_keeps_its_numbers_and_else_the_likelier_of_both_paths_is_taken():
    """Each by the model linearised about itself, one nat to either side; no number is less likely than any."""
    model, data = _model(), _logs([1, -1], 0)  # read from the first row on
    first, same = (e_step(model, data, CubatureSmoother(StartBank((1,), angles)), key=KEY) for angles in ((), (0,)))
    assert np.all(np.asarray(same.width) < WIDE_STD)
    pairs = zip(jax.tree.leaves(first._replace(width=None)), jax.tree.leaves(same._replace(width=None)), strict=True)
    for a, b in pairs:  # two programs of the same numbers differ by rounding
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-14)
    first = jax.tree.map(lambda a: jnp.concatenate([a, a]), first)
    loglik = first.loglik + 30.0  # the first smoother's own are of models linearised about other paths
    second = first._replace(
        loglik=loglik + jnp.asarray([1.0, -1.0, jnp.nan, -1.0]), state=jax.tree.map(lambda a: a + 1, first.state)
    )
    posterior = _replaced(first, second, loglik.at[3].set(jnp.nan), np.arange(4))
    moved = np.asarray(posterior.state.mean - first.state.mean)[:, 0, 0]
    np.testing.assert_allclose(moved, [1.0, 0.0, 0.0, 1.0], atol=1e-12)
    np.testing.assert_array_equal(posterior.loglik[1:3], first.loglik[1:3])
