"""The common work in the peers' hands: dynamax and cuthbert.

They get the transition as their user would write it, and this library's own in rows of their own.
"""

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
from common_work import Case, Size, common_logs, common_model, compiled

from nnap_em.model.state_space import Inputs, StateSpaceModel


def natural_transition(model: StateSpaceModel):
    """One Runge-Kutta step of the acrobot in plain jax.numpy, for one state."""
    arm, nets, dt = model.system, model.unknown.joints, model.dt

    def rate(x, u):
        q1, q2, v1, v2 = x
        coupling = arm.m2 * arm.l1 * arm.lc2
        m22 = arm.I2 + arm.m2 * arm.lc2**2
        m11 = arm.I1 + arm.m1 * arm.lc1**2 + m22 + arm.m2 * arm.l1**2 + 2 * coupling * jnp.cos(q2)
        m12 = m22 + coupling * jnp.cos(q2)
        h = coupling * jnp.sin(q2)
        outer = arm.m2 * arm.lc2 * arm.g * jnp.sin(q1 + q2)
        gravity = (arm.m1 * arm.lc1 + arm.m2 * arm.l1) * arm.g * jnp.sin(q1) + outer
        f1 = nets[0](v1) - gravity + h * v2 * (2 * v1 + v2)
        f2 = u[0] + nets[1](v2) - outer - h * v1**2
        det = m11 * m22 - m12**2
        return jnp.stack([v1, v2, (m22 * f1 - m12 * f2) / det, (m11 * f2 - m12 * f1) / det])

    def transition(x, u):
        k1 = rate(x, u)
        k2 = rate(x + 0.5 * dt * k1, u)
        k3 = rate(x + 0.5 * dt * k2, u)
        k4 = rate(x + dt * k3, u)
        return x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)

    return transition


def pick_transition(own: bool):
    """The transition that a peer is given, and the words that say so."""
    model = common_model()
    held = lambda x, u: model.transition(x, Inputs.held(u))  # noqa: E731
    return (held, ", our transition") if own else (natural_transition(model), "")


def dynamax_case(rule: str, own: bool, size: Size) -> Case:
    """dynamax's extended or unscented smoother."""
    transition, note = pick_transition(own)

    def prepare():
        from dynamax.nonlinear_gaussian_ssm import (
            ParamsNLGSSM,
            UKFHyperParams,
            extended_kalman_smoother,
            unscented_kalman_smoother,
        )

        model, data = common_model(), common_logs(size).data
        params = ParamsNLGSSM(
            initial_mean=model.start.mean,
            initial_covariance=model.start.cov,
            dynamics_function=transition,
            dynamics_covariance=jnp.diag(jnp.exp(model.log_q)),
            emission_function=lambda x, u: x[jnp.asarray([0, 2])],
            emission_covariance=jnp.diag(jnp.exp(model.log_r)),
        )
        cubature = UKFHyperParams(alpha=1.0, beta=0, kappa=0)  # the points that this library's sigma-point filter takes

        def one(y, u):
            before = jnp.concatenate([u[:1], u[:-1]])  # dynamax moves into row k under the input of row k
            if rule == "extended":
                return extended_kalman_smoother(params, y, inputs=before)
            return unscented_kalman_smoother(params, y, cubature, inputs=before)

        return compiled(jax.vmap(one), data.y, data.u)

    return Case("dynamax", f"{rule} smoother{note}", size, prepare, lambda posterior: posterior.smoothed_means)


def cuthbert_case(what: str, own: bool, size: Size, backward: Callable | None = None) -> Case:
    """cuthbert's bootstrap filter (systematic below half the sample size), and as many backward trajectories."""
    transition, note = pick_transition(own)

    def prepare():
        import cuthbert
        from cuthbert.smc import backward_sampler, particle_filter
        from cuthbertlib.resampling import adaptive, systematic

        model, data = common_model(), common_logs(size).data
        q, r, spread = (jnp.exp(0.5 * a) for a in (model.log_q, model.log_r, jnp.log(jnp.diag(model.start.cov))))

        def log_normal(e, std):
            return jnp.sum(-0.5 * (e / std) ** 2 - jnp.log(std) - 0.5 * math.log(2 * math.pi))

        def log_reading(x, y):
            return log_normal(y - x[jnp.asarray([0, 2])], r)

        init = lambda key: model.start.mean + spread * jax.random.normal(key, (4,))  # noqa: E731
        move = lambda key, x, now: transition(x, now["u"]) + q * jax.random.normal(key, (4,))  # noqa: E731
        weigh = lambda before, x, now: log_reading(x, now["y"])  # noqa: E731
        joint = lambda before, x, now: weigh(before, x, now) + log_normal(x - transition(before, now["u"]), q)  # noqa: E731
        resample = adaptive.ess_decorator(systematic.resampling, 0.5)
        forward = particle_filter.build_filter(init, move, weigh, size.particles, resample)

        def one(y, u, key):
            key_init, key_filter, key_paths = jax.random.split(key, 3)
            first = forward.init_prepare(key=key_init)
            first = first._replace(log_weights=jax.vmap(log_reading, (0, None))(first.particles, y[0]))
            states = cuthbert.filter(forward, {"y": y[1:], "u": u[:-1]}, first, key=key_filter)
            if backward is None:
                return states.particles, states.log_weights
            smoother = backward_sampler.build_smoother(joint, backward(), systematic.resampling, size.particles)
            return cuthbert.smoother(smoother, states, key=key_paths).particles, None

        return compiled(jax.vmap(one), data.y, data.u, jax.random.split(jax.random.key(2), size.sequences))

    def states(result):
        x, log_w = result
        if log_w is None:
            return jnp.mean(x, axis=2)
        return jnp.einsum("stpx,stp->stx", x, jax.nn.softmax(log_w, axis=-1))

    return Case("cuthbert", what + note, size, prepare, states)


def cuthbert_exact():
    """All particles weighed for each trajectory."""
    from cuthbertlib.smc.smoothing import exact_sampling

    return exact_sampling.simulate
