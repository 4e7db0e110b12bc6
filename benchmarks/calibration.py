"""Simulation-based calibration of the friction bands: the table of docs/results/calibration.md.

python benchmarks/calibration.py [--draws 100]

A truth is drawn, logs are simulated with it and fitted, and the truth is looked up in the fitted band at five of the
velocities that were visited.  Drawn from the prior of the fit, its place in exact inference is uniform
[Talts et al. 2018, arXiv 1804.06788]; Stribeck laws with drawn parameters are what an owner has.
"""

import argparse
import dataclasses
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.stats
from runner import made

from nnap_em.estimate.identify import Identified, begin, friction_table, identify
from nnap_em.machines.rig import Declared, Rig
from nnap_em.model.law import StribeckLaw
from nnap_em.model.simulate import Experiment, Sweep, examples, sweep_experiment
from nnap_em.model.state_space import StateSpaceModel

QUANTILES = (0.1, 0.3, 0.5, 0.7, 0.9)
"""Of the visited velocities, where the truth is looked up."""


class Bench(NamedTuple):
    """A machine, its experiment, and the problem before the first epoch: one prior for all draws."""

    machine: StateSpaceModel
    sweep: Sweep
    start: Identified
    sequences: int
    steps: int

    def logs(self, law: Callable, key) -> Experiment:
        """An experiment on the machine under another friction."""
        truth = dataclasses.replace(self.machine, unknown=law)
        return sweep_experiment(truth, self.sweep, self.sequences, self.steps, key=key)


def slide_bench(sequences: int = 8, steps: int = 150) -> Bench:
    """The slide of `examples`, position and rate read, noise of the readings declared; scales from a pilot's logs."""
    machine, sweep = examples["slide"]()
    machine = dataclasses.replace(machine, measured=(0, 1), log_r=2 * jnp.log(jnp.asarray([1e-3, 0.05])))
    pilot = sweep_experiment(machine, sweep, sequences, steps, key=jax.random.key(99)).data
    read = {"x": 1e-3, "dx": 0.05}
    mass = {"m": Declared(float(machine.system.m), 0.0)}
    rig = Rig("slide", "slide", mass, True, ("u",), (1,), machine.dt, "sequence", tuple(read), read, {})
    start = begin(rig, pilot, key=jax.random.key(0))
    return Bench(machine, sweep, start, sequences, steps)


@eqx.filter_jit
def _log_pull(weights, unknown, middle, w):
    phi = weights.phi(unknown, middle + w)
    return -0.5 * phi @ weights.symmetry(unknown, middle + w) @ phi


def prior_draw(start: Identified, key, moves: int = 200):
    """A friction map from the prior of the M-step, by elliptical slice sampling [Murray, Adams & MacKay 2010].

    Its Gaussian part is that of the weights, its likelihood the pull towards odd symmetry.
    """
    weights, unknown = start.m_step.weights(start.model), start.model.unknown
    middle = weights.middle()
    rng = np.random.default_rng(np.asarray(jax.random.key_data(key)))

    log_pull = partial(_log_pull, weights, unknown, middle)
    std = 1 / np.sqrt(np.asarray(weights.precision(middle)))
    draw = lambda: rng.normal(size=middle.shape) * std  # noqa: E731
    state = draw()
    level = float(log_pull(state))
    for _ in range(moves):
        other, bar = draw(), level + np.log(rng.uniform())
        angle = rng.uniform(0, 2 * np.pi)
        low, high = angle - 2 * np.pi, angle
        while True:
            trial = state * np.cos(angle) + other * np.sin(angle)
            level = float(log_pull(trial))
            if level > bar:
                break
            low, high = (angle, high) if angle < 0 else (low, angle)
            angle = rng.uniform(low, high)
        state = trial
    return unknown.with_weights(middle + state)


def stribeck_draw(start: Identified, key) -> StribeckLaw:
    """Coulomb 0.5 to 1.5 N, breakaway up to half more, Stribeck speed 0.05 to 0.2 m/s, viscous 0.5 to 3 N s/m."""
    low, high = jnp.asarray([0.5, 1.0, 0.05, 0.5]), jnp.asarray([1.5, 1.5, 0.2, 3.0])
    coulomb, ratio, speed, viscous = jax.random.uniform(key, (4, 1), minval=low[:, None], maxval=high[:, None])
    return StribeckLaw(coulomb, coulomb * ratio, speed, viscous, 0.4 * speed)


DRAWS = {"the prior of the fit": prior_draw, "Stribeck laws": stribeck_draw}


def places(bench: Bench, draw: Callable, seed: int) -> np.ndarray:
    """(truth - mean) / std of the friction of one draw, at the quantiles of the visited velocities."""
    key_law, key_logs, key_fit = jax.random.split(jax.random.key(seed), 3)
    law = draw(bench.start, key_law)
    logs = bench.logs(law, key_logs)
    fitted = identify(bench.start.rig, logs.data, key=key_fit, start=bench.start)
    velocity = jnp.asarray(np.quantile(np.asarray(logs.x[..., 1]), QUANTILES))[None]
    table = friction_table(fitted, velocity)
    truth = jax.vmap(law)(velocity.T)[:, 0]
    return np.asarray((truth - table.torque[0]) / table.std[0])


def main() -> None:
    """Run the study and print its table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=100)
    count = parser.parse_args().draws
    jax.config.update("jax_enable_x64", True)
    print(made())
    bench = slide_bench()
    print(
        "| truth drawn from | quantile of velocity | in its 50 % band | in its 90 % band [%] | RMS of z | uniform, p |"
    )
    print("| --- | --- | --- | --- | --- | --- |")
    for name, draw in DRAWS.items():
        z = np.stack([places(bench, draw, seed) for seed in range(count)])
        for i, quantile in enumerate(QUANTILES):
            rank = np.histogram(scipy.stats.norm.cdf(z[:, i]), bins=10, range=(0, 1))[0]
            share = [100 * np.mean(np.abs(z[:, i]) < scipy.stats.norm.ppf(0.5 + 0.5 * level)) for level in (0.5, 0.9)]
            p = scipy.stats.chisquare(rank).pvalue
            rms = np.sqrt(np.mean(z[:, i] ** 2))
            print(f"| {name} | {quantile} | {share[0]:.0f} | {share[1]:.0f} | {rms:.2f} | {p:.2g} |", flush=True)


if __name__ == "__main__":
    main()
