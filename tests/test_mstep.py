"""The M-step's expansion of the log-likelihood: Fisher's identity, dense Fisher information, and the fit to it."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nnap_em.base.gaussian import Gaussian
from nnap_em.base.parallel import each
from nnap_em.estimate.em.mstep import ScoringMStep
from nnap_em.estimate.em.prior import ParameterPrior
from nnap_em.estimate.em.quadratic import Quadratic, local, locals_along, quadratic, readings_at
from nnap_em.estimate.em.weights import AT_REST, COULOMB, VISCOUS, Weights
from nnap_em.estimate.smoother.gaussian import ExtendedKalmanSmoother
from nnap_em.estimate.smoother.kalman import Tangent, kalman_filter, linear_reading
from nnap_em.estimate.smoother.posterior import Posterior
from nnap_em.estimate.smoother.start import StartBank
from nnap_em.logs.dataset import Dataset, active_steps
from nnap_em.machines.systems.slide import Slide
from nnap_em.model.base import prepare
from nnap_em.model.friction import FixedFriction, FrictionNetwork, NoFriction
from nnap_em.model.law import StribeckLaw
from nnap_em.model.simulate import simulate
from nnap_em.model.state_space import Inputs, StateSpaceModel

DT = 0.05
NODES = jnp.asarray([[-8.0, -2.0, 0.5, 3.0, 9.0]])  # beyond all speeds, so that the nodes interpolate v exactly
NO_FRICTION = NoFriction(jnp.ones(1))
MASS = ParameterPrior(("m",), jnp.asarray([1.2]), jnp.asarray([0.1]))


def _slide(unknown=NO_FRICTION) -> StateSpaceModel:
    start = Gaussian(jnp.asarray([0.2, 0.0]), jnp.diag(jnp.asarray([0.1, 0.3]) ** 2))
    log_q, log_r = 2 * jnp.log(jnp.asarray([0.01, 0.1])), 2 * jnp.log(jnp.asarray([0.02, 0.1]))
    return StateSpaceModel(Slide(m=jnp.asarray(1.3), joints=(1,)), unknown, start, log_q, log_r, (0, 1), DT)


def _rule(model, centre=None) -> ScoringMStep:
    centre = jnp.zeros(0) if centre is None else centre
    return ScoringMStep(MASS, centre, (True, True), (True, True), log_q_prior=model.log_q, linearise=Tangent())


class _Case(NamedTuple):
    """One sequence with its posterior, its expansion, and the likelihood that both belong to."""

    model: StateSpaceModel
    seq: Dataset
    posterior: Posterior
    expansion: Quadratic

    @property
    def speed(self):
        """Of every node half way through every step, had there been no kick."""
        return 0.5 * np.asarray(self.posterior.prev + self.posterior.next - self.posterior.kick)[..., 1]


@eqx.filter_jit
def _expand(model, data: Dataset):
    """Posterior and expansion of every sequence, linearised by tangents about the smoother's fixed point."""
    smoother = ExtendedKalmanSmoother(StartBank((1, 1)), iterations=20)
    posterior = jax.vmap(lambda seq: smoother(model, prepare(model, seq)))(data)

    def expand(posterior, seq):
        linear = local(model, MASS, posterior.state, seq, Tangent())
        read = readings_at(model, (posterior, linear.seq))
        return quadratic(model.log_q, model.log_r, model.start, linear, NODES, posterior, read)

    return posterior, jax.vmap(expand)(posterior, data)


class _Pushed(NamedTuple):
    """A model under a small extra force `force` - `damping` v."""

    model: StateSpaceModel
    force: jax.Array
    damping: jax.Array

    def transition(self, x, u):
        bent = eqx.tree_at(lambda m: m.unknown, self.model, lambda v: self.model.unknown(v) - self.damping * v)
        return bent.transition(x, u, self.force[None])


class _Knobs(NamedTuple):
    """All that the likelihood is differentiated by."""

    log_q: jax.Array
    log_r: jax.Array
    force: jax.Array
    damping: jax.Array
    mass: jax.Array


@eqx.filter_jit
def _gradient(case: _Case) -> _Knobs:
    """Gradient of the Kalman likelihood, linearised about the path of `case`."""
    model, zero = case.model, jnp.zeros(())
    seq = prepare(model, case.seq)

    def loglik(knobs: _Knobs):
        noisy = eqx.tree_at(lambda m: (m.log_q, m.log_r), MASS.write(model, knobs.mass), knobs[:2])
        pushed = _Pushed(noisy, knobs.force, knobs.damping)
        about = lambda x, u: Tangent()(pushed, Gaussian(x, jnp.eye(2)), u)  # noqa: E731
        affine = jax.vmap(about)(case.posterior.state.mean, seq.inputs)
        reading = jax.vmap(lambda x, u: linear_reading(noisy, x, u))(case.posterior.state.mean, seq.inputs)
        return kalman_filter(noisy.log_q, noisy.log_r, model.start, affine, reading, seq).loglik

    return jax.jacfwd(loglik)(_Knobs(model.log_q, model.log_r, zero, zero, MASS.read(model)))


@pytest.fixture(scope="module")
def slides():
    """200 sequences of the slide, a fifth of the readings missing (the same in all), the last five rows padding."""
    model, time = _slide(), 40
    key_run, key_gap, key_start = jax.random.split(jax.random.key(0), 3)
    unit = jax.random.normal(key_start, (200, 2))
    x0 = model.start.mean[None] + unit * jnp.sqrt(jnp.diag(model.start.cov))[None]
    u = jnp.broadcast_to(jnp.sin(jnp.arange(float(time)) * DT * 5)[None, :, None], (200, time, 1))
    data = simulate(model, x0, u, key=key_run).data
    gone = (jax.random.uniform(key_gap, data.y.shape[1:]) < 0.2)[None]
    valid = jnp.broadcast_to(jnp.arange(time)[None] < time - 5, (200, time))
    data = data._replace(y=jnp.where(gone | ~valid[..., None], jnp.nan, data.y), valid=valid)
    return model, data, *_expand(model, data)


@pytest.fixture(scope="module")
def slide(slides):
    return _Case(slides[0], *jax.tree.map(lambda a: a[0], slides[1:]))


def test_score_is_the_gradient_of_the_likelihood(slide):
    """Fisher's identity: exact for the Gaussian smoother at fixed linearisation."""
    gradient = _gradient(slide)
    noise = jnp.concatenate([gradient.log_q, gradient.log_r])
    # rounding times the condition of the covariances, 1e4, in twenty passes
    np.testing.assert_allclose(slide.expansion.noise_score, noise, rtol=1e-7, atol=1e-7)
    # the weights of the nodes sum to 1, so the sum of the node scores belongs to a constant force
    assert float(jnp.sum(slide.expansion.score[:-1])) == pytest.approx(float(gradient.force), rel=1e-6)
    assert float(slide.expansion.score[-1]) == pytest.approx(float(gradient.mass[0]), rel=1e-6)
    # the nodes interpolate: sum_i v_i score_i belongs to a force proportional to velocity
    push, q = DT / float(slide.model.system.m), jnp.exp(slide.model.log_q[1])
    inside = active_steps(slide.seq.valid)[:-1]
    information = push**2 * jnp.sum(jnp.where(inside, slide.speed.mean(1) ** 2, 0.0)) / q
    # what differs: velocity within a step, of order (dt force / m), in units of the standard deviation
    off = float(slide.expansion.score[:-1] @ NODES[0] + gradient.damping)
    assert abs(off) < 0.05 * float(jnp.sqrt(information))


def _dense_readings(model, seq: Dataset, log_q, log_r):
    """Covariance of all readings of a linear model, and the map from kicks of every step to them."""
    time, n = seq.t.shape[0], 2
    f = np.asarray(Tangent()(model, Gaussian(jnp.zeros(n), jnp.eye(n)), Inputs.held(jnp.zeros(1))).matrix)
    inside = np.asarray(active_steps(seq.valid))
    transfer = np.zeros((time, time, n, n))  # effect on x_k of what is added at x_j
    for j in range(time):
        transfer[j, j] = np.eye(n)
        for k in range(j, time - 1):
            transfer[k + 1, j] = (f if inside[k] else np.eye(n)) @ transfer[k, j]
    seen = (~np.isnan(np.asarray(seq.y)) & np.asarray(seq.valid)[:, None]).ravel()
    maps = [transfer[:, j].reshape(-1, n)[seen] for j in range(time)]  # both states are read
    cov = maps[0] @ np.asarray(model.start.cov) @ maps[0].T + np.diag(np.tile(np.exp(log_r), time)[seen])
    for j in range(1, time):
        cov = cov + inside[j - 1] * (maps[j] * np.exp(log_q)) @ maps[j].T
    return cov, maps, inside


def test_information_is_the_dense_fisher_information(slide):
    model, seq = slide.model, slide.seq
    cov, maps, inside = _dense_readings(model, seq, np.asarray(model.log_q), np.asarray(model.log_r))
    tent = np.stack([np.interp(slide.speed, NODES[0], e).mean(1) for e in np.eye(5)], axis=1)  # steps, nodes
    force = np.asarray([DT**2 / 2, DT]) / 1.3  # of x and dx to a constant force over one step
    mass = -0.1 * np.asarray(seq.u) / 1.3 * force[None]
    columns = np.concatenate([force[None, :, None] * tent[:, None, :], mass[:-1, :, None]], axis=2)
    jac = sum(inside[k] * maps[k + 1] @ columns[k] for k in range(len(columns)))
    expected = jac.T @ np.linalg.solve(cov, jac)
    value = slide.expansion.information
    np.testing.assert_allclose(value, expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())  # condition of cov: 1e4


def test_noise_information_is_fishers_on_average(slides):
    """Sequence by sequence it holds sampled innovations; its mean is tr(S^-1 dS S^-1 dS) / 2."""
    model, data, _, each = slides
    n = len(data.t)
    seq = jax.tree.map(lambda a: a[0], data)
    log = np.concatenate([model.log_q, model.log_r])
    cov = lambda log: _dense_readings(model, seq, log[:2], log[2:])[0]  # noqa: E731
    h = 1e-4
    slopes = [np.linalg.solve(cov(log), (cov(log + h * e) - cov(log - h * e)) / (2 * h)) for e in np.eye(4)]
    expected = np.asarray([[0.5 * np.trace(a @ b) for a in slopes] for b in slopes])
    information = np.asarray(each.noise_information)
    np.testing.assert_array_less(
        np.abs(information.mean(0) - expected), 4.5 * information.std(0) / np.sqrt(n) + 1e-6 * expected.max()
    )
    # and the scores of draws from the model scatter around 0 with that covariance (16 entries: 4.5 standard errors)
    score = np.asarray(each.noise_score)
    np.testing.assert_array_less(np.abs(score.mean(0)), 4.5 * np.sqrt(np.diag(expected) / n))
    np.testing.assert_allclose(score.T @ score / n, expected, atol=4.5 * np.diag(expected).max() * np.sqrt(2 / n))


def test_fit_reaches_the_optimum_of_the_penalised_likelihood():
    unknown = FrictionNetwork(jnp.asarray([6.0]), jnp.asarray([1.0]), key=jax.random.key(3))
    model = _slide(unknown)
    nodes = unknown.nodes(21)
    middle = 0.3 * jax.random.normal(jax.random.key(1), unknown.weights().shape)
    weights = Weights(MASS, nodes, 1.0, middle, jnp.asarray([0.3]))
    # of 400 readings of an interpolated torque and of the mass
    rng, ends = np.random.default_rng(0), np.asarray(nodes)[0]
    speed, mass = rng.normal(size=(2, 400))
    rows = np.stack([*(np.interp(speed * ends[-1] / 2, ends, e) for e in np.eye(21)), mass], axis=1)
    target, information = jnp.asarray([*(-np.tanh(3 * ends) - 0.1 * ends), 0.5]), jnp.asarray(rows.T @ rows / 0.1**2)
    w0 = weights.read(model)
    phi0 = weights.phi(model.unknown, w0)
    score = information @ (target - phi0)
    w = weights.fit(model.unknown, w0, score, information, 500)
    odd = np.abs(phi0[:21] - phi0[:21][::-1])
    spread = jnp.asarray(0.3**2 * (1.0 + np.diag(np.minimum(1.0, odd / np.median(odd)) ** 2 + AT_REST**2)))

    @jax.jit
    def loss(w):
        """Minus the log-likelihood, ridge and symmetry prior, up to constants; written for the target, not phi0."""
        phi = jnp.concatenate([jax.vmap(lambda v: unknown.with_weights(w[:-1])(v))(nodes.T)[:, 0], w[-1:]])
        even = 0.5 * (phi[:21] + phi[:21][::-1])
        d = phi - target
        ridge = jnp.sum((w[:-1] - middle) ** 2) + w[-1] ** 2
        asymmetry = even @ jnp.linalg.solve(spread, even)
        return 0.5 * d @ information @ d + 0.5 * ridge + 0.5 * asymmetry

    assert float(loss(w0)) - float(loss(w)) > 1e3
    # the loop ends when its smoothed gain is below 1e-3 nats a step; what is left must not matter (a nat = 1 std)
    gradient = jax.jit(jax.grad(loss))(w)
    jac = jax.jacobian(lambda w: weights.phi(model.unknown, w))(w)
    hessian = jac.T @ (information + weights.symmetry(model.unknown, w0)) @ jac + np.diag(weights.precision(w))
    assert 0.5 * float(gradient @ jnp.linalg.solve(hessian, gradient)) < 0.01  # Newton decrement [nats]


def test_a_coarse_prior_lets_coulomb_and_constant_friction_be_hardly_holds_viscous_and_holds_the_rest():
    nodes = jnp.linspace(-2.0, 2.0, 11)[None]
    law = FixedFriction(lambda v: -jnp.sign(v), jnp.ones(1))
    prior = Weights(MASS, nodes, 1.0, jnp.zeros(0), jnp.asarray([0.3]), jnp.asarray(2.0))
    coarse = eqx.tree_at(lambda w: w.departure, prior, jnp.asarray(0.1))
    free, held = (np.asarray(w.symmetry(law, jnp.zeros(1)))[:11, :11] for w in (prior, coarse))
    v = np.asarray(nodes[0])
    coulomb = 2.0 * np.tanh(v / (COULOMB * 2.0)) - 0.7
    np.testing.assert_allclose((held - free) @ coulomb, 0.0, atol=1e-8)
    unit = np.linalg.qr(np.stack([np.ones(11), np.sign(v), v], axis=1))[0][:, 2]  # tanh is the sign at these nodes
    assert unit @ (held - free) @ unit == pytest.approx(VISCOUS / 0.03**2, rel=1e-6)
    bump = np.exp(-((v - 1.2) ** 2)) - np.exp(-((v + 1.2) ** 2))
    base = np.linalg.qr(np.stack([v, np.sign(v), np.ones(11)], axis=1))[0]
    beside = bump - base @ (base.T @ bump)
    expected = beside @ beside + VISCOUS * (unit @ bump) ** 2
    assert bump @ (held - free) @ bump == pytest.approx(expected / 0.03**2, rel=1e-6)


def test_symmetry_is_asked_of_every_node_only_while_the_horizon_grows():
    """The even part is an offset and a number at every node, which vanishes at rest with the odd part."""
    model = _slide(FrictionNetwork(jnp.asarray([6.0]), jnp.asarray([1.0]), key=jax.random.key(3)))
    rule = _rule(model, model.unknown.weights())
    law = FixedFriction(lambda v: -jnp.clip(v, -0.2, 0.2), jnp.ones(1))  # more than half of the nodes are at its level
    share = np.minimum(1.0, np.abs(np.asarray(rule.weights(model).nodes[0])) / 0.2)
    half = np.random.default_rng(0).normal(size=41)
    odd, even = half - half[::-1], half + half[::-1]
    for one, rough in ((rule.while_growing(), 1.0), (rule, 6.4)):
        precision = np.asarray(one.weights(model).symmetry(law, jnp.zeros(1)))[:41, :41]  # the last of all is the mass
        covariance = 0.1**2 * (1.0 + rough**2 * np.diag(share**2 + AT_REST**2))
        assert even @ precision @ even == pytest.approx(even @ np.linalg.solve(covariance, even), rel=1e-6)
        np.testing.assert_allclose(precision @ odd, 0.0, atol=1e-9 * np.abs(precision).max())


def test_the_prior_of_maps_holds_friction_that_rises_steeply_near_rest_and_no_noise():
    """A slide's Stribeck law of four times the scale; with z normal, chi-square of 41 is below 75 in 999 of 1000."""
    top, count = 1.4, 41
    nodes = top / 300 * jnp.sinh(jnp.linspace(-1.0, 1.0, count) * jnp.arcsinh(300.0))[None]
    law = StribeckLaw(*(jnp.asarray([value]) for value in (1.0, 1.5, 0.05, 2.0, 0.02)))
    map_ = FixedFriction(law, jnp.asarray([0.4]))
    weights = Weights(MASS, nodes, 1.0, jnp.zeros(0), jnp.asarray([0.04]), jnp.asarray(6.4))
    precision = np.asarray(weights.prior_precision(map_))[:count, :count]
    torque = np.asarray(jax.vmap(law)(nodes.T))[:, 0]
    assert torque @ precision @ torque < 75
    odd = np.random.default_rng(0).normal(size=count) * np.sqrt(np.mean(torque**2))
    odd = (odd - odd[::-1]) / np.sqrt(2)
    assert odd @ precision @ odd > 10 * 75


def test_fit_of_parameters_is_ridge_regression_within_their_bounds():
    """The second parameter is where the first lets it: a step cut off at the bound would leave it elsewhere."""
    prior = ParameterPrior(("a", "b"), jnp.zeros(2), jnp.ones(2))
    normal, score = np.array([[51.0, 40.0], [40.0, 61.0]]), np.array([-70.0, 10.0])  # with the prior's own 1
    information = jnp.zeros((4, 4)).at[2:, 2:].set(normal - np.eye(2))
    free = np.linalg.solve(normal, score)  # -3.09, 2.19
    fit = jax.jit(
        lambda weights: weights.fit(NO_FRICTION, jnp.zeros(2), jnp.append(jnp.zeros(2), score), information, 200)
    )
    for least in (-jnp.inf, -2.0, 0.0):
        least = jnp.asarray([least])
        w = fit(Weights(prior, jnp.asarray([[-1.0, 1.0]]), 1.0, jnp.zeros(0), jnp.ones(1), least=least))
        bound = np.array([least[0], (score[1] - normal[0, 1] * least[0]) / normal[1, 1]])
        # the loop stops within 1e-3 nats
        np.testing.assert_allclose(w, bound if least[0] > free[0] else free, atol=np.sqrt(2 * 1e-3 / 20))
        assert w[0] >= least[0]
    written = Weights(MASS, jnp.zeros((1, 2)), 1.0, jnp.zeros(0), jnp.ones(1)).write(_slide(), w[1:])
    assert float(written.system.m) == pytest.approx(1.2 + 0.1 * float(w[1]), rel=1e-14)


def test_sequences_that_are_not_used_have_no_weight(slides):
    """A step with one of four left out, though it is garbage, is the step of the other three; each counts once."""
    model, data, posterior, expansion = slides
    data, posterior = jax.tree.map(lambda a: np.asarray(a[:5]), (data, posterior))
    rule = _rule(model)
    # and the likelihood along a path is that of the smoother which linearises there
    np.testing.assert_allclose(rule.loglik(model, posterior.state, data), posterior.loglik, rtol=1e-12)
    linear = locals_along(model, MASS, posterior.state, data, Tangent())
    read = each(readings_at, model, (posterior, linear.seq))

    def step(index, used):
        parts = jax.tree.map(lambda a: a[np.asarray(index)], (linear, posterior, read))
        far = jnp.where(jnp.asarray(used), 1.0, 1e3)
        spoilt = eqx.tree_at(lambda p: p[1].kick, parts, parts[1].kick * far[:, None, None, None])
        spoilt = eqx.tree_at(lambda p: p[1].state.mean, spoilt, spoilt[1].state.mean * far[:, None, None])
        core, hessian, kept = rule.advance(rule.core(model), *spoilt, jnp.asarray(used))
        np.testing.assert_array_equal(kept, used)
        return core[1:], hessian[-1:, -1:]

    some, others = step([0, 1, 2, 3], [True, False, True, True]), step([3, 2, 0, 4], [True, True, True, False])
    for a, b in zip(jax.tree.leaves(some), jax.tree.leaves(others), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-12)  # sums in another order
    (_, once), (_, twice) = step([0, 2, 1, 1], [True, True, False, False]), step([0, 2, 0, 2], [True] * 4)
    prior, both = np.eye(1), np.sum(expansion.information[np.array([0, 2]), -1:, -1:], axis=0)  # of the mass
    np.testing.assert_allclose(once - prior, both, rtol=1e-9)
    np.testing.assert_allclose(twice - prior, 2 * (once - prior), rtol=1e-9)
