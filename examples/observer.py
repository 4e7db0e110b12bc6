"""A controller over the observer: an acrobot whose elbow nobody measures pumps itself up.

The plant is that of `plant.py`, which shares no code with the library. Logs of it, with joint 1 read alone, are fitted.
Then the elbow is to follow the swing of the shoulder, theta2 = atan(dtheta1), which adds energy in every swing [Spong
1995, IEEE Control Systems 15(1)]; it starts half a radian off in the mean, and is pushed after five seconds. The same
controller runs without the observer, theta2 from the model and the torque alone. Written into `out/observer/`: the rig,
the fit, the observer as C99, and observer.png.

    python examples/observer.py                     # a minute or two
    python examples/observer.py --seconds 20 --seed 3
"""

import argparse
import sys
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import plant
from matplotlib.figure import Figure

import nnap_em
from nnap_em.base.programs import use_older_emitters
from nnap_em.estimate.observer import Observer
from nnap_em.output.export import write_observer

STIFFNESS, DAMPING, MOST = 1.5, 0.12, 0.8
"""Gains of the controller [N m/rad, N m s/rad], and its largest torque [N m]."""
PUSH = 5.0
"""Time of the push, of 3 rad/s on the elbow [s]."""


class Run(NamedTuple):
    """One run of the closed loop."""

    time: np.ndarray
    target: np.ndarray
    true: np.ndarray
    """States of the plant."""
    mean: np.ndarray
    """Estimates of the observer."""
    std: np.ndarray

    @property
    def error(self) -> float:
        """RMS distance of theta2 from its target [rad]."""
        return float(np.sqrt(np.mean((self.true[:, 1] - self.target) ** 2)))


def closed_loop(case: plant.Case, online: Observer, seconds: float, seed: int, reads: bool) -> Run:
    """The plant under the controller; `reads`: with readings, else the observer is the model alone."""
    true, rng, rows = plant.build(case), np.random.default_rng([seed, 48]), round(seconds / plant.DT)
    start = np.array([[1.0, plant.THETA2_STD * rng.standard_normal(), 0.0, 0.0]])
    x, u = start @ plant.lift(true).T, np.zeros((1, rows + 1))
    state, states, means, stds, targets = online.start(), [], [], [], []
    for k in range(rows):
        y = plant.noise_free(true, x)[0] + rng.standard_normal(2) * case.noise
        if k == 0 and not reads:  # it knows where the shoulder stands, and no more
            state = online.step(state, jnp.zeros(1), jnp.asarray(y))
        else:
            state = online.step(state, jnp.asarray(u[:, k - 1]), jnp.asarray(y if reads else np.full(2, np.nan)))
        mean = np.asarray(state.mean)
        targets.append(np.arctan(y[1]))
        torque = STIFFNESS * (targets[-1] - mean[1]) - DAMPING * mean[3]
        u[0, k] = np.clip(torque, -MOST, MOST)
        states.append(x[0])
        means.append(mean)
        stds.append(np.sqrt(np.diag(np.asarray(state.cov))))
        x = plant.step(true, x, u, k, np.array([k * plant.DT]))
        x[:, 2:4] += case.process * rng.standard_normal((1, 2))
        x[:, 3] += 3.0 * (k == round(PUSH / plant.DT))
    return Run(plant.DT * np.arange(rows), *map(np.stack, (targets, states, means, stds)))


def figure(runs: dict[str, Run]) -> Figure:
    """Target, angle and estimate of theta2 with and without readings."""
    drawing = Figure(figsize=(8, 5), layout="constrained")
    for axes, (name, run) in zip(drawing.subplots(len(runs), 1, sharex=True, sharey=True), runs.items(), strict=True):
        mean, std = run.mean[:, 1], run.std[:, 1]
        axes.fill_between(run.time, mean - 2 * std, mean + 2 * std, color="tab:orange", alpha=0.25, lw=0)
        axes.plot(run.time, run.target, "k:", label="target")
        axes.plot(run.time, run.true[:, 1], color="tab:blue", label="theta2")
        axes.plot(run.time, mean, color="tab:orange", lw=1, label="estimate, two standard deviations")
        axes.set(title=f"{name}: {run.error:.2f} rad from the target (RMS)", ylabel="theta2 [rad]", ylim=(-4, 4))
    axes.set_xlabel("time [s]")
    axes.legend(loc="lower right", ncols=3)
    return drawing


def main() -> int:
    """Fit, close the loop, draw."""
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--seconds", type=float, default=10.0)
    arguments.add_argument("--seed", type=int, default=1)
    arguments.add_argument("--sequences", type=int, default=12, help="logs of 3 s that are fitted (12)")
    arguments.add_argument("--out", type=Path, default=Path("out/observer"))
    args = arguments.parse_args()
    jax.config.update("jax_enable_x64", True)
    use_older_emitters()
    case = plant.Case(sequences=args.sequences, tests=1, steps=300, seed=args.seed, start="anywhere")
    plant.write(case, args.out / "rig")
    rig = nnap_em.read_rig(args.out / "rig" / "rig.toml")
    fitted = nnap_em.identify(rig, nnap_em.read_logs(args.out / "rig" / "train", rig).data, key=jax.random.key(0))
    nnap_em.save(args.out / "fit" / "model.npz", fitted)
    write_observer(fitted, args.out / "arm.c")
    online = nnap_em.observer(fitted)
    runs = {
        name: closed_loop(case, online, args.seconds, args.seed, reads)
        for name, reads in (("with the observer", True), ("without: the model alone", False))
    }
    for name, run in runs.items():
        print(f"{name}: theta2 is {run.error:.2f} rad from its target (RMS), the shoulder swings by", end=" ")
        print(f"{np.abs(run.true[-200:, 0]).max():.1f} rad in the last two seconds")
    estimate = runs["with the observer"]
    settled = estimate.time > 1.0
    off = np.sqrt(np.mean((estimate.mean - estimate.true[:, :4])[settled, 1] ** 2))
    print(f"theta2 is estimated to {off:.3f} rad (RMS, from 1 s on); nobody reads it")
    figure(runs).savefig(args.out / "observer.png", dpi=120)
    return 0


if __name__ == "__main__":
    sys.exit(main())
