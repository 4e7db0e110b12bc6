"""Friction of the paper's acrobot, identified from joint 1 alone: the tables of docs/results/identify.md.

    python benchmarks/identify.py [--seeds 5] [--test 100] [--smoother cubature particle] [--start-std 0.5]

For every seed: 20 x 500 training samples with the noise of the paper's case, friction from a random network, noise not
declared; 100 fresh test sequences.  Compared with the true model in the same filter and with the Cramer-Rao limit of
the data set (information of the linearised model, for the ten parameters of the true law and for the network).
"""

import argparse
import sys
import time

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from runner import made

from nnap_em.estimate.em.loop import Schedule, e_step, em_step
from nnap_em.estimate.em.quadratic import local, quadratic, readings_at
from nnap_em.estimate.identify import Identified, begin, friction_table, identify
from nnap_em.estimate.predict import predict
from nnap_em.estimate.smoother.gaussian import CubatureSmoother, ExtendedKalmanSmoother
from nnap_em.estimate.smoother.particle.smoother import banked
from nnap_em.estimate.smoother.start import StartBank
from nnap_em.machines.rig import Declared, Rig
from nnap_em.machines.systems.acrobot import table_i
from nnap_em.model.friction import FixedFriction
from nnap_em.model.simulate import paper_experiment, paper_model

whole = Schedule(first=501)
one_start = StartBank((1, 1, 1, 1))
recipes = {
    "naive": (lambda bank: ExtendedKalmanSmoother(one_start, iterations=0), whole),
    "extended": (ExtendedKalmanSmoother, Schedule()),
    "cubature": (CubatureSmoother, Schedule()),
    "particle": (banked, Schedule()),
}
"""Smoother and schedule; `naive`: one start, no relinearisation, whole sequences from the first epoch on."""


def paper_rig(start_std: float) -> Rig:
    """What the owner of the paper's acrobot declares: Table I, no noise, the start's prior."""
    start = {"theta2": Declared(0.0, start_std), "dtheta1": Declared(0.0, 0.02), "dtheta2": Declared(0.0, 0.02)}
    parameters = {name: Declared(value, 0.0) for name, value in table_i.items()}
    return Rig("paper", "acrobot", parameters, True, ("u",), (2,), 0.01, "sequence", ("theta1", "dtheta1"), {}, start)


def visited(x, bins: int = 2001):
    """Velocities of each joint and how often they occur."""
    edges = [np.linspace(-a, a, bins) for a in np.abs(np.asarray(x)[..., 2:]).max((0, 1))]
    counts = [np.histogram(np.asarray(x)[..., 2 + j].ravel(), e)[0] for j, e in enumerate(edges)]
    return jnp.asarray([0.5 * (e[1:] + e[:-1]) for e in edges]), jnp.asarray(counts, float)


def nrmse(error, truth, count):
    """Root mean square of the error over that of the true torque, over the visited velocities, per joint."""
    return np.asarray(jnp.sqrt(jnp.sum(count * error**2, axis=1) / jnp.sum(count * truth**2, axis=1)))


def theta2_rmse(fitted: Identified, smoother, data, x):
    """Smoothing error of theta2 [rad] per sequence."""
    posterior = eqx.filter_jit(e_step)(fitted.model, data, smoother(fitted.bank), key=jax.random.key(0))
    return np.sqrt(np.mean((np.asarray(posterior.state.mean - x)[..., 1]) ** 2, axis=1))


def prediction_scores(fitted: Identified, test, given: float = 1.0):
    """Median RMSE [rad] of theta1, theta2 over 1 s and 2 s, and the share of the 90 % band's hits over 1 s."""
    p = predict(fitted, test.data, given, key=jax.random.key(5))
    since = np.asarray(test.data.t) - given
    error = np.asarray(p.mean) - np.asarray(test.x)
    scores = {}
    for seconds in (1.0, 2.0):
        inside = (since[0] > 1e-6) & (since[0] <= seconds + 1e-6)
        scores[seconds] = np.median(np.sqrt(np.mean(error[:, inside, :2] ** 2, axis=1)), axis=0)
    inside = (since[0] > 1e-6) & (since[0] <= 1 + 1e-6)
    hits = np.abs(error[:, inside, :2]) <= 1.645 * np.asarray(p.std)[:, inside, :2]
    return scores, hits.mean()


def cramer_rao(truth_fit: Identified, fitted: Identified, truth, smoother, data, velocity, count, torque):
    """NRMSE limits per joint: of the true law's own parameters, and of the network."""
    weights = fitted.m_step.weights(fitted.model)
    nodes = weights.nodes
    posterior = eqx.filter_jit(e_step)(truth_fit.model, data, smoother(fitted.bank), key=jax.random.key(0))
    model = truth_fit.model

    @jax.jit
    @jax.vmap
    def information_of(posterior, seq):
        linear = local(model, fitted.m_step.prior, posterior.state, seq)
        read = readings_at(model, (posterior, linear.seq))
        return quadratic(model.log_q, model.log_r, model.start, linear, nodes, posterior, read).information

    information = jnp.sum(information_of(posterior, data), axis=0)
    flat, law = ravel_pytree(truth.unknown)

    def limit(at_nodes, at_velocity, precision):
        cov = jnp.linalg.inv(at_nodes.T @ information @ at_nodes + precision)
        variance = jnp.einsum("jvp,pq,jvq->jv", at_velocity, cov, at_velocity)
        return nrmse(jnp.sqrt(variance), torque, count)

    def by_law(v):
        return jax.jacfwd(lambda p: jax.vmap(law(p))(v.T).T)(flat)

    law_limit = limit(by_law(nodes).reshape(-1, flat.shape[0]), by_law(velocity), 1e-9 * jnp.eye(flat.shape[0]))
    w = weights.read(fitted.model)

    def by_network(v):
        return jax.jacfwd(lambda w: jax.vmap(weights.write(fitted.model, w).unknown)(v.T).T)(w)

    net_limit = limit(by_network(nodes).reshape(-1, w.shape[0]), by_network(velocity), jnp.diag(weights.precision(w)))
    return law_limit, net_limit


def study(seed: int, name: str, tests: int, start_std: float) -> dict[str, float]:
    """All figures of one seed."""
    truth = paper_model(start_std=start_std)
    key = jax.random.key(seed)
    train = paper_experiment(truth, key=jax.random.fold_in(key, 0))
    test = paper_experiment(truth, tests, key=jax.random.fold_in(key, 1))
    rig, (smoother, schedule) = paper_rig(start_std), recipes[name]
    first = begin(rig, train.data, key=jax.random.fold_in(key, 2))
    began = time.perf_counter()
    step = em_step(first.model, train.data, smoother(first.bank), first.m_step.while_growing(), key)
    jax.block_until_ready(step[2])
    compile_s = time.perf_counter() - began
    lost = []
    began = time.perf_counter()
    fitted = identify(
        rig,
        train.data,
        key=key,
        smoother=smoother,
        schedule=schedule,
        start=first,
        watch=lambda s, n, used: lost.append((~used).sum()),
    )
    fit_s = time.perf_counter() - began
    velocity, count = visited(train.x)
    torque = jax.vmap(truth.unknown)(velocity.T).T
    table = friction_table(fitted, velocity)
    error = nrmse(table.torque - torque, torque, count)
    inside = np.abs(table.torque - torque) <= 1.645 * table.std
    known = eqx.tree_at(lambda m: m.unknown, truth, FixedFriction(truth.unknown, jnp.ones(2)))
    w = 1e12 * jnp.eye(4)  # nothing of it is unknown
    truth_fit = fitted._replace(state=fitted.state._replace(best=known, hessian=w))
    smooth_error = theta2_rmse(fitted, CubatureSmoother, train.data, train.x)
    smooth_truth = theta2_rmse(truth_fit, CubatureSmoother, train.data, train.x)
    scores, hits = prediction_scores(fitted, test)
    truth_scores, _ = prediction_scores(truth_fit, test)
    law, net = cramer_rao(truth_fit, fitted, truth, CubatureSmoother, train.data, velocity, count, torque)
    return {
        "friction NRMSE joint 1": error[0],
        "friction NRMSE joint 2": error[1],
        "Cramer-Rao limit of the true law, joint 1": law[0],
        "Cramer-Rao limit of the true law, joint 2": law[1],
        "Cramer-Rao limit of the network, joint 1": net[0],
        "Cramer-Rao limit of the network, joint 2": net[1],
        "theta2 smoothing RMSE [rad]": np.sqrt(np.mean(smooth_error**2)),
        "theta2 smoothing / true model": np.sqrt(np.mean(smooth_error**2) / np.mean(smooth_truth**2)),
        "theta2 prediction 1 s [rad]": scores[1.0][1],
        "theta2 prediction 1 s / true model": scores[1.0][1] / truth_scores[1.0][1],
        "theta2 prediction 2 s [rad]": scores[2.0][1],
        "theta2 prediction 2 s / true model": scores[2.0][1] / truth_scores[2.0][1],
        "sequences lost at the end (left out or theta2 off by > 0.3 rad)": float(
            max(lost[-1], (smooth_error > 0.3).sum())
        ),
        "coverage of the 90 % friction band [%]": 100 * float(np.sum(count * inside) / np.sum(count)),
        "coverage of the 90 % band of 1 s predictions [%]": 100 * float(hits),
        "epochs": float(fitted.state.epoch),
        "seconds for these epochs": fit_s,
        "seconds to compile": compile_s,
    }


def main() -> None:
    """Run the study and print its table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--test", type=int, default=100)
    parser.add_argument("--smoother", nargs="+", choices=recipes, default=list(recipes))
    parser.add_argument("--start-std", type=float, default=0.5, help="declared std of theta2 in the first row [rad]")
    args = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    lines = [made()]
    for name in args.smoother:
        rows = []
        for seed in range(args.seeds):
            rows.append(study(seed, name, args.test, args.start_std))
            print(name, seed, {k: round(float(v), 4) for k, v in rows[-1].items()}, file=sys.stderr, flush=True)
        lines += ["", f"### {name}", "", "| figure | median | lowest | highest |", "| --- | --- | --- | --- |"]
        for key in rows[0]:
            values = [row[key] for row in rows]
            lines.append(f"| {key} | {np.median(values):.4g} | {min(values):.4g} | {max(values):.4g} |")
    print("\n".join(lines))


if __name__ == "__main__":
    main()
