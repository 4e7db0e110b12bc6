"""Study of `diagnose` on equations: how often it names the law that they lack, and none where nothing is missing.

Machines are simulated here with NumPy alone, in classical Runge-Kutta steps, so that no law of the finder makes them.

    python benchmarks/equations.py                                  # all 38 cases
    python benchmarks/equations.py leak bend --seeds 3              # some
"""

import argparse
import json
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from nnap_em.explain.diagnosis.diagnose import diagnose
from nnap_em.explain.diagnosis.keys import Key, key_of, words
from nnap_em.logs.dataset import pad
from nnap_em.machines.rig import read_rig
from nnap_em.machines.systems import specs

STEPS = 20
"""Runge-Kutta steps in a row."""
TANKS = """inputs = { u = "V" }
states = { h1 = "V", h2 = "V" }
rates = { h1 = "k4*u - k1*sqrt(h1)", h2 = "k1*sqrt(h1) - k3*sqrt(h2)" }
k1 = { mean = 0.05, std = 0.03 }
k3 = { mean = 0.05, std = 0.03 }
k4 = { mean = 0.05, std = 0.03 }"""
MOTOR = """inputs = { u = "V" }
states = { i = "A", w = "rad/s" }
rates = { i = "(u - R*i - K*w)/L", w = "(K*i - b*w)/J" }
R = 1.0
L = 0.03
K = { mean = 0.1, std = 0.03 }
b = { mean = 0.002, std = 0.002 }
J = { mean = 0.002, std = 0.001 }"""
HEATERS = """inputs = { Q1 = "%", Q2 = "%" }
states = { T1 = "K", T2 = "K" }
rates = { T1 = "a1*Q1 - T1/c1", T2 = "a2*Q2 - T2/c2" }
a1 = { mean = 0.006, std = 0.003 }
a2 = { mean = 0.006, std = 0.003 }
c1 = { mean = 120.0, std = 50.0 }
c2 = { mean = 120.0, std = 50.0 }"""


class Plant(NamedTuple):
    """A machine: its declaration, sample interval [s], readings with noise, levels of its inputs, and its start."""

    declared: str
    dt: float
    columns: dict[str, tuple[str, float]]
    levels: tuple[float, float]
    hold: int
    """Rows for which an input stays, on average."""
    start: tuple[float, ...]
    rate: Callable[..., list]
    """Derivatives by state and inputs, of what is declared."""


def _root(x):
    return np.sqrt(max(x, 0.0))


PLANTS = {
    "tanks": Plant(
        TANKS, 4.0, {"y": ("h2", 0.016)}, (1.5, 4.0), 12, (4.0, 4.5),
        lambda x, u: [0.045 * u[0] - 0.06 * _root(x[0]), 0.06 * _root(x[0]) - 0.055 * _root(x[1])],
    ),
    "motor": Plant(
        MOTOR, 0.01, {"w": ("w", 0.3)}, (-6.0, 6.0), 15, (0.0, 0.0),
        lambda x, u: [(u[0] - x[0] - 0.12 * x[1]) / 0.03, (0.12 * x[0] - 0.003 * x[1]) / 0.0025],
    ),
    "heaters": Plant(
        HEATERS, 5.0, {"y1": ("T1", 0.1), "y2": ("T2", 0.1)}, (0.0, 100.0), 15, (0.0, 0.0),
        lambda x, u: [0.007 * u[0] - x[0] / 150, 0.005 * u[1] - x[1] / 140],
    ),
}  # fmt: skip


class Case(NamedTuple):
    """A machine with a law that its declaration lacks."""

    plant: str
    right: tuple[tuple[str, set[str]], ...] = ()
    """Port or reading of the law and its signals: what is named must have them."""
    push: Callable[..., list] = lambda x, u: [0.0, 0.0]
    """Missing flow by state and input, added to the rates of the states."""
    lag: float = 0.0
    """Time constant of the first input [s]."""
    reading: Callable[[np.ndarray], np.ndarray] = lambda x: x


def _spill(x, u):
    flow = 0.045 * u[0] / (1 + np.exp(min((7.0 - x[0]) / 0.1, 50.0)))
    return [-flow, 0.75 * flow]


CASES = {
    "tanks": Case("tanks"),
    "motor": Case("motor"),
    "leak": Case("tanks", (("h1", {"h1"}),), lambda x, u: [-0.006 * x[0], 0.0]),
    "transfer": Case("tanks", (("h1", {"h1", "h2", "u"}), ("h1", {"h1", "h2"})), _spill),
    "coupling": Case("heaters", (("T1", {"T1", "T2"}),), lambda x, u: [-0.004 * (x[0] - x[1]), 0.004 * (x[0] - x[1])]),
    "lag": Case("heaters", (("Q1", set()),), lag=40.0),
    "bend": Case("tanks", (("y", set()),), reading=lambda x: x + 0.3 * (x - 2) ** 2 / 6),
    "f(x1, u)": Case(
        "heaters",
        (("T1", {"T1", "Q1"}), ("a1", {"T1"})),
        lambda x, u: [-0.007 * u[0] * x[0] ** 2 / (x[0] ** 2 + 60.0**2), 0.0],
    ),
}
NULL, PLANTED = ("tanks", "motor"), tuple(name for name in CASES if name not in ("tanks", "motor"))


def simulate(case: Case, rows: int, seed: int):
    """Log of a case: time, inputs, noisy readings."""
    plant, rng = PLANTS[case.plant], np.random.default_rng(seed)
    inputs = plant.declared.split("\n")[0].count("=") - 1
    u = np.stack([_levels(rng, plant, rows) for _ in range(inputs)], axis=1)
    x, late, out = np.array(plant.start) + 0.0, u[0, 0], []
    h = plant.dt / STEPS

    def rate(x, u):
        return np.add(plant.rate(x, u), case.push(x, u))

    for row in u:
        out.append(x)
        for _ in range(STEPS):
            late = row[0] + (late - row[0]) * np.exp(-h / case.lag) if case.lag else row[0]
            now = np.array([late, *row[1:]])
            a = rate(x, now)
            b = rate(x + h / 2 * a, now)
            c = rate(x + h / 2 * b, now)
            x = x + h / 6 * (a + 2 * b + 2 * c + rate(x + h * c, now))
    names = [part.split("=")[0].strip() for part in plant.declared.split("\n")[1].split("{")[1].split(",")]
    states = dict(zip(names, np.array(out).T, strict=True))
    noise = rng.standard_normal((rows, len(plant.columns)))
    y = np.stack([case.reading(states[state]) for state, _ in plant.columns.values()], axis=1)
    y = y + noise * np.array([std for _, std in plant.columns.values()])
    return plant.dt * np.arange(rows), u, y


def _levels(rng, plant: Plant, rows: int) -> np.ndarray:
    """Steps at random times."""
    jump = rng.random(rows) < 1 / plant.hold
    jump[0] = True
    return rng.uniform(*plant.levels, rows)[np.maximum.accumulate(np.where(jump, np.arange(rows), 0))]


def rig_of(plant: Plant):
    """The declaration as a rig."""
    columns = ", ".join(f'{name} = "{state}"' for name, (state, _) in plant.columns.items())
    text = f'format = 1\nname = "r"\n[model]\ntype = "equations"\n{plant.declared}\n'
    text += f'[sampling]\ndt = {plant.dt}\ninput_hold = "zero-order"\nclock = "sequence"\n'
    text += f"[measurement]\ncolumns = {{ {columns} }}\n"
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "rig.toml").write_text(text)
        return read_rig(Path(folder) / "rig.toml", specs)


def is_right(case: Case, key: Key) -> bool:
    """True for a law at the port, or on the reading or input, that the case has, with its signals."""
    _, _, channel, signals = key
    return any(channel == place and signals_of <= set(signals) <= signals_of for place, signals_of in case.right)


def run(name: str, seed: int, rows: int, log: Callable[[str], None]) -> dict:
    """A search in a simulated log."""
    case, began = CASES[name], time.process_time()
    data = pad([simulate(case, rows, seed)])
    closed = diagnose(rig_of(PLANTS[case.plant]), data, key=jax.random.key(0), log=log)
    keys = [key_of(effect) for effect in closed.after.model.effects]
    right = any(is_right(case, key) for key in keys) if case.right else not keys
    seconds = time.process_time() - began
    return {
        "case": name,
        "seed": seed,
        "right": right,
        "others": sum(not is_right(case, key) for key in keys),
        "laws": [words(key) for key in keys],
        "share": [record.share for record in closed.evidence],
        "seconds": round(seconds, 1),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cases", nargs="*", choices=[*CASES, []], help="cases; without any, all")
    parser.add_argument("--seeds", type=int, help="seeds of every case; without it 10 of nothing missing, else 3")
    parser.add_argument("--rows", type=int, default=400)
    parser.add_argument("--verbose", action="store_true")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    log = (lambda text: print(f"{time.process_time():.0f} s", text)) if options.verbose else lambda text: None
    wanted = [(seed, name) for name in options.cases or CASES for seed in range(options.seeds or 10)]
    for seed, name in sorted(wanted, key=lambda one: one[0]):
        if options.seeds or name in NULL or seed < 3:
            print(json.dumps(run(name, seed, options.rows, log)), flush=True)


if __name__ == "__main__":
    main()
