"""Friction with memory against a static map: docs/results/memory.md.

python benchmarks/memory.py [--cases lugre dahl bristle static] [--hidden] [--seeds 0]
python benchmarks/memory.py --measured ../shared/data/measured

The simulated acrobot and its friction laws are NumPy here and share no code with the library: at joint 1 LuGre [Canudas
de Wit et al. 1995], Dahl [1968] or an elasto-plastic bristle [Dupont et al. 2002], at joint 2 static Stribeck friction.
"""

import argparse
import dataclasses
import os
import platform
import sys
import time
from collections.abc import Sequence
from datetime import date
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from nnap_em.data.dataset import Dataset
from nnap_em.data.logs import read_logs
from nnap_em.data.rig import Declared, Rig, read_rig
from nnap_em.diagnosis.memory import identify
from nnap_em.fit.identify import Identified, friction_table
from nnap_em.fit.predict import horizon_errors, posterior_of, predict
from nnap_em.model import hooks
from nnap_em.systems import specs

DT, ROWS, SUBSTEPS = 0.01, 501, 20
KICK = 2e-3
"""Process noise of both rates per step [rad/s]."""
NOISE = (0.002, 0.02)
"""Noise of angles [rad] and rates [rad/s]."""
BODIES = {"m1": 0.235, "m2": 0.25, "l1": 0.275, "l2": 0.285, "lc1": 0.1375, "lc2": 0.1425,
          "I1": 0.235 * 0.275**2 / 12, "I2": 0.25 * 0.285**2 / 12, "g": 9.81}  # fmt: skip
NEAR = 10
"""Rows on either side of a reversal that count as around it."""


class Stribeck(NamedTuple):
    """Static friction."""

    coulomb: float
    breakaway: float
    velocity: float
    viscous: float

    def __call__(self, z, v):
        """Torque, and the rate of the hidden state."""
        level = self.coulomb + (self.breakaway - self.coulomb) * np.exp(-((v / self.velocity) ** 2))
        return -level * np.tanh(v / 0.02) - self.viscous * v, np.zeros_like(v)


class LuGre(NamedTuple):
    """Bristle with Stribeck level; z is its deflection [rad]."""

    coulomb: float
    breakaway: float
    velocity: float
    viscous: float
    stiffness: float
    damping: float

    def __call__(self, z, v):
        """Torque, and the rate of the hidden state."""
        level = self.coulomb + (self.breakaway - self.coulomb) * np.exp(-((v / self.velocity) ** 2))
        rate = v - np.abs(v) * self.stiffness * z / level
        return -self.stiffness * z - self.damping * rate - self.viscous * v, rate


class Dahl(NamedTuple):
    """Dahl's law with exponent 1.5."""

    coulomb: float
    viscous: float
    stiffness: float

    def __call__(self, z, v):
        """Torque, and the rate of the hidden state."""
        left = 1 - self.stiffness * z / self.coulomb * np.sign(v)
        return -self.stiffness * z - self.viscous * v, v * np.sign(left) * np.abs(left) ** 1.5


class Bristle(NamedTuple):
    """Elastic up to a share of the breakaway deflection, then plastic."""

    coulomb: float
    viscous: float
    stiffness: float
    damping: float
    share: float

    def __call__(self, z, v):
        """Torque, and the rate of the hidden state."""
        most = self.coulomb / self.stiffness
        first = self.share * most
        phase = np.clip((np.abs(z) - 0.5 * (most + first)) / (most - first), -0.5, 0.5)
        slip = np.where(z * v < 0, 0.0, 0.5 * np.sin(np.pi * phase) + 0.5)
        rate = v * (1 - slip * np.sign(v) * z / most)
        return -self.stiffness * z - self.damping * rate - self.viscous * v, rate


LAWS = {
    "lugre": LuGre(0.030, 0.045, 0.35, 0.007, 2.0, 0.01),
    "dahl": Dahl(0.035, 0.007, 3.0),
    "bristle": Bristle(0.035, 0.007, 2.0, 0.01, 0.5),
    "static": Stribeck(0.030, 0.045, 0.35, 0.007),
}
ELBOW = Stribeck(0.017, 0.027, 0.40, 0.0035)


def steady(law, v):
    """Torque of a law that slides at `v` for long [N m]."""
    if isinstance(law, Stribeck):
        return law(0.0, v)[0]
    rise = (law.breakaway - law.coulomb) * np.exp(-((v / law.velocity) ** 2)) if isinstance(law, LuGre) else 0.0
    return law((law.coulomb + rise) / law.stiffness * np.sign(v), v)[0]


def accelerations(q, v, tau):
    """Joint accelerations of the acrobot [rad/s^2]; leading axis the joint."""
    b = BODIES
    turn, reach = b["m2"] * b["l1"] * b["lc2"] * np.cos(q[1]), b["m2"] * b["l1"] * b["lc2"] * np.sin(q[1])
    m22 = b["I2"] + b["m2"] * b["lc2"] ** 2
    m12 = m22 + turn
    m11 = b["I1"] + b["m1"] * b["lc1"] ** 2 + b["m2"] * b["l1"] ** 2 + m22 + 2 * turn
    far = b["m2"] * b["lc2"] * b["g"] * np.sin(q[0] + q[1])
    near = (b["m1"] * b["lc1"] + b["m2"] * b["l1"]) * b["g"] * np.sin(q[0])
    first = tau[0] + reach * (2 * v[0] * v[1] + v[1] ** 2) - near - far
    second = tau[1] - reach * v[0] ** 2 - far
    whole = m11 * m22 - m12**2
    return np.stack([(m22 * first - m12 * second) / whole, (m11 * second - m12 * first) / whole])


def roll(laws: Sequence[Any], x, u, rng: np.random.Generator | None = None):
    """States (q, v, z) [6, seq] from `x` under inputs `u` [time, seq], and the friction torques; RK4."""

    def rate(x, u):
        friction, slip = zip(*(law(x[4 + j], x[2 + j]) for j, law in enumerate(laws)), strict=True)
        tau = np.stack(friction) + np.stack([np.zeros_like(u), u])
        return np.concatenate([x[2:4], accelerations(x[:2], x[2:4], tau), np.stack(slip)])

    states, torques, h = [], [], DT / SUBSTEPS
    for torque in u:
        states.append(x)
        torques.append(np.stack([law(x[4 + j], x[2 + j])[0] for j, law in enumerate(laws)]))
        for _ in range(SUBSTEPS):
            a = rate(x, torque)
            b = rate(x + h / 2 * a, torque)
            c = rate(x + h / 2 * b, torque)
            x = x + h / 6 * (a + 2 * b + 2 * c + rate(x + h * c, torque))
        if rng is not None:
            x = np.concatenate([x[:2], x[2:4] + KICK * rng.standard_normal(x[2:4].shape), x[4:]])
    return np.stack(states).transpose(2, 0, 1), np.stack(torques).transpose(2, 0, 1)


class Run(NamedTuple):
    """Simulated logs and their truth."""

    data: Dataset
    x: np.ndarray
    torque: np.ndarray


def simulate(laws: Sequence[Any], seed: int, hidden: bool, sequences: int = 10) -> Run:
    """Sinusoidal torques at joint 2, starts in the upper half plane, as in the paper."""
    rng = np.random.default_rng(seed)
    t = DT * np.arange(ROWS)
    amplitude, period, phase = (rng.uniform(*r, sequences) for r in ((0.05, 0.3), (0.5, 3.0), (0, 2 * np.pi)))
    u = amplitude * np.sin(2 * np.pi * t[:, None] / period + phase)
    first = np.stack([rng.uniform(np.pi / 2, 3 * np.pi / 2, sequences), 0.2 * rng.standard_normal(sequences)])
    x, torque = roll(laws, np.concatenate([first, np.zeros((4, sequences))]), u, rng)
    y = x[..., :4] + rng.standard_normal((*x.shape[:2], 4)) * np.repeat(NOISE, 2)
    y = y[..., [0, 2]] if hidden else y
    return Run(Dataset(np.tile(t, (sequences, 1)), u.T[..., None], y, np.ones(y.shape[:2], bool)), x, torque)


def declared(hidden: bool, memory: bool) -> Rig:
    """The acrobot with all bodies known."""
    measured = ("theta1", "dtheta1") if hidden else ("theta1", "theta2", "dtheta1", "dtheta2")
    noise = {name: NOISE[name.startswith("d")] for name in measured}
    start = {"theta2": Declared(0.0, 0.2), "dtheta2": Declared(0.0, 0.05)} if hidden else {}
    bodies = {name: Declared(value, 0.0) for name, value in BODIES.items()}
    return Rig("memory", "acrobot", bodies, True, ("u",), (2,), DT, "sequence", measured, noise, start, memory=memory)


def friction(fitted: Identified, data: Dataset):
    """Friction torque of both joints along smoothed states [N m]."""
    model, path = fitted.model, posterior_of(fitted, data).state.mean

    def one(x, u):
        scene = model.scene(x, u)
        return hooks._total(model.effects, scene, x[4:], jnp.zeros(2))

    along = jax.vmap(lambda seq, x: jax.vmap(one)(x, model.inputs(seq)))
    return np.asarray(along(jax.tree.map(jnp.asarray, data), path))


def around_reversals(v) -> np.ndarray:
    """Rows within NEAR of a change of direction; the first second apart."""
    turns = np.zeros(v.shape, bool)
    turns[:, 1:] = np.sign(v[:, 1:]) != np.sign(v[:, :-1])
    near = np.stack([np.convolve(row, np.ones(2 * NEAR + 1), "same") > 0 for row in turns])
    near[:, : round(1 / DT)] = False
    return near


def covered(fitted: Identified, law, v) -> tuple[float, float]:
    """Share [%] of 220 of the slowest fifth of velocities `v` of joint 1 at which the 90 % band holds the law's steady
    friction, and RMS of its error over the standard deviation."""
    slow = np.sort(v[np.abs(v) < np.quantile(np.abs(v), 0.2)])
    slow = slow[np.linspace(0, len(slow) - 1, 220).astype(int)]
    table = friction_table(fitted, jnp.asarray(np.stack([slow, slow])))
    z = (np.asarray(table.torque)[0] - steady(law, slow)) / np.asarray(table.std)[0]
    return float(100 * np.mean(np.abs(z) < 1.645)), float(np.sqrt(np.mean(z**2)))


def ahead(fitted: Identified, laws: Sequence[Any], run: Run, given: float) -> tuple[float, float]:
    """RMS error of both angles over 1 s after `given` [s] of readings [rad]: of the fit, and of the true laws from the
    same smoothed state and the true hidden one."""
    last = round(given / DT)
    rows = np.arange(last, last + round(1 / DT) + 1)
    known = run.data._replace(valid=np.arange(ROWS)[None] <= last + np.zeros((len(run.x), 1)))
    x0 = np.asarray(posterior_of(fitted, known).state.mean)[:, last]
    model = fitted.model

    def one(x, seq):
        inputs = jax.tree.map(lambda a: a[rows], model.inputs(seq))
        return jax.lax.scan(lambda x, u: (model.transition(x, u), x), x, inputs)[1]

    path = np.asarray(jax.jit(jax.vmap(one))(jnp.asarray(x0), jax.tree.map(jnp.asarray, run.data)))[..., :2]
    start = np.concatenate([x0[:, :4], run.x[:, last, 4:]], axis=1).T
    true = roll(laws, start, np.asarray(run.data.u)[:, rows, 0].T)[0][..., :2]
    goal = run.x[:, rows, :2]
    return tuple(float(np.sqrt(np.median(np.mean((p - goal) ** 2, axis=(1, 2))))) for p in (path, true))  # type: ignore


def study(name: str, seed: int, hidden: bool) -> str:
    """A row of the table."""
    laws = (LAWS[name], ELBOW)
    train, test = (simulate(laws, 100 * seed + part, hidden) for part in (1, 2))
    fits, seconds = {}, {}
    for memory in (False, True):
        for _ in range(2 if name == "static" else 1):  # compiled the first time
            began = time.perf_counter()
            fits[memory] = identify(declared(hidden, memory), train.data, key=jax.random.key(seed))
            seconds[memory] = time.perf_counter() - began
    near = around_reversals(test.x[..., 2])
    rms, coming = {}, {}
    for memory, fitted in fits.items():
        miss = friction(fitted, test.data)[..., 0] - test.torque[..., 0]
        rms[memory] = np.sqrt(np.mean(miss[near] ** 2)), np.sqrt(np.mean(miss[:, 100:] ** 2))
        coming[memory] = np.mean([ahead(fitted, laws, test, given) for given in (1.0, 2.0, 3.0)], axis=0)
    band = [covered(fitted, laws[0], test.x[:, 100:, 2]) for fitted in fits.values()]
    print(fits[True].memory, file=sys.stderr)
    for effect in fits[True].model.effects:
        print({k: float(v) for k, v in effect.values().items()}, file=sys.stderr)
    return (
        f"| {name}{', joint 2 hidden' if hidden else ''} | {seed} | {rms[False][0]:.4f} | {rms[True][0]:.4f} "
        f"| {rms[True][0] / rms[False][0]:.2f} | {coming[False][0]:.4f} | {coming[True][0]:.4f} "
        f"| {coming[True][0] / coming[False][0]:.2f} | {coming[True][0] / coming[True][1]:.2f} "
        f"| {seconds[True] / seconds[False]:.2f} | {band[0][0]:.0f}, {band[1][0]:.0f} "
        f"| {band[0][1]:.2f}, {band[1][1]:.2f} |"
    )


def measured(folder: Path) -> None:
    """Test errors of a real rig, static map and memory."""
    rig = read_rig(folder / "rig.toml", specs)
    train, test = (read_logs(folder / part, rig) for part in ("train", "test"))
    errors, seconds = {}, {}
    for memory in (False, True):
        began = time.perf_counter()
        fitted = identify(dataclasses.replace(rig, memory=memory), train.data, key=jax.random.key(0))
        seconds[memory] = time.perf_counter() - began
        prediction = predict(fitted, test.data, 1.0, key=jax.random.key(0))
        errors[memory] = horizon_errors(prediction, fitted, test.data, 1.0, (0.25, 0.5))
    print(fitted.memory, file=sys.stderr)
    for effect in fitted.model.effects:
        print(effect.joint, {k: float(v) for k, v in effect.values().items()}, file=sys.stderr)
    for name, static in errors[False].items():
        if name in fitted.model.system.coordinates:
            dynamic = errors[True][name]
            shares = ", ".join(f"{d / s:.3f}" for d, s in zip(dynamic, static, strict=True))
            values = ", ".join(f"{s:.4g}" for s in static)
            spent = f"{seconds[True]:.0f} / {seconds[False]:.0f}"
            print(f"| {folder.name} {name} | {values} | {shares} | {spent} |", flush=True)


def main() -> None:
    """Run the study and print its table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", nargs="*", default=list(LAWS))
    parser.add_argument("--hidden", action="store_true")
    parser.add_argument("--seeds", type=int, nargs="*", default=[0])
    parser.add_argument("--measured", type=Path)
    parser.add_argument("--rigs", nargs="*", default=["xl330", "dfki_c0", "kr300"])
    args = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    print(
        f"{date.today()}, {platform.machine()}, {len(os.sched_getaffinity(0))} cores, "
        f"Python {platform.python_version()}, jax {jax.__version__}; `{' '.join(['python', *sys.argv])}`\n"
    )
    if args.measured:
        print("| reading | static, 0.25 and 0.5 s | with memory over static | seconds |\n| --- | --- | --- | --- |")
        for name in args.rigs:
            measured(args.measured / name)
        return
    print("| case | seed | torque error at reversals, static [N m] | memory | ratio | 1 s error, static [rad] | memory "
          "| ratio | over that of the true law | time | near rest in the 90 % band, static, memory [%] | RMS z |\n"
          + "| --- " * 12 + "|")  # fmt: skip
    for seed in args.seeds:
        for name in args.cases:
            print(study(name, seed, args.hidden), flush=True)


if __name__ == "__main__":
    main()
