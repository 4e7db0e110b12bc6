"""A hobby servo from command to angle, open loop over 6 s, beside the six published models of the same servo.

    python benchmarks/xl330.py [--bam PYTHON] [--laws load] [--search SECONDS] [--seeds 0]

Raw logs of a Dynamixel XL330 that swings 0.49 kg at 0.1 m (`../shared/data/raw/README.md`), its firmware gain 100, 200
or 400.  Declared are weight, length and the law of the firmware: a position servo whose gain is proportional to the
columns of firmware gain and supply, numbers uncertain by half.  Six logs are fitted; two are left out, and nobody looks
at them before the end: 10h28m32 and 10h28m57, the test split that `../shared/data/measured/xl330` has had from the
start.  (The ninth log has its torque switched off.)  The published models, fitted to all nine, are simulated by their
own package, `better-actuator-models` 1.0.2, in an environment of its own, whose interpreter is PYTHON:

    python -m venv E && E/bin/pip install numpy colorama
    E/bin/pip install --no-deps --ignore-requires-python better-actuator-models==1.0.2

A number is the mean absolute error of the angle [mrad] at the same rows, 10 ms apart, of motions that begin at the
first reading; theirs begin at the first speed, too, and are integrated every 5 ms, as their own comparison does.
"""

import argparse
import json
import subprocess
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray

from nnap_em.data.dataset import Dataset
from nnap_em.data.formats import write_csv
from nnap_em.data.logs import read_logs
from nnap_em.data.rig import Rig, read_rig
from nnap_em.diagnosis.findings import findings
from nnap_em.diagnosis.search import diagnose
from nnap_em.effects.base import AbstractEffect, a
from nnap_em.effects.friction import LoadFriction
from nnap_em.effects.mounting import BaseTilt
from nnap_em.em.loop import start_state
from nnap_em.em.prior import ParameterPrior
from nnap_em.fit.identify import Identified, begin, identify, parameter_table
from nnap_em.fit.predict import predict
from nnap_em.systems import specs

jax.config.update("jax_enable_x64", True)
RAW = Path(__file__).resolve().parents[2] / "shared" / "data" / "raw" / "xl330"
LEFT_OUT = ("10h28m32", "10h28m57")
TILT = 0.05
"""Standard deviation of the zero of the angle [rad], where it is estimated (`--laws`)."""
OFF = "10h28m17"
"""Log with the torque switched off."""
FINE, DT, SECONDS = 0.005, 0.01, 5.98
DUTY = 4096 / (2 * np.pi) / (256 * 885)
"""Duty of a unit of firmware gain and a rad of error."""
KP = 0.0845 * 200 * 7.4 * DUTY
"""Gain at a firmware gain of 200 and a supply of 7.4 V, by `../shared/data/measured/xl330/source.toml` [N m/rad]."""
RIG = f"""format = 1
name = "xl330"
[model]
type = "pendulum"
m = 0.49
lc = 0.1
I = {{{{ mean = 0.0018, std = 0.0001 }}}}
g = 9.80665
friction = "unknown"
[input]
columns = ["goal"]
joints = [1]
kind = "position"
kp = {{{{ mean = {KP:.4g}, std = {KP / 2:.4g}, at = {{{{ gain = 200.0, supply = 7.4 }}}} }}}}
delay = {{{{ mean = 0.005, std = 0.005 }}}}
{{more}}
[sampling]
dt = {DT}
input_hold = "zero-order"
clock = "sequence"
[measurement]
columns = ["theta1"]
[measurement.noise_std]
theta1 = {2 * np.pi / 4096 / 12**0.5:.3g}
"""
PUBLISHED = """
import json, sys
from bam.model import load_model
from bam.simulate import Simulator
logs, models = json.load(sys.stdin)
print(json.dumps({name: [Simulator(load_model(name)).rollout_log(log, simulate_control=True)[0] for log in logs]
                  for name in models}))
"""


def raw(name: str) -> dict:
    """A raw log by the time in its name."""
    return json.loads(next(RAW.glob(f"*_{name}.json")).read_text())


def names() -> list[str]:
    """All logs with torque, by the time in their names."""
    every = sorted(path.stem.partition("_")[2] for path in RAW.glob("2026*.json"))
    return [name for name in every if name != OFF]


def column(log: dict, key: str, dt: float) -> np.ndarray:
    """An entry of a log on a uniform grid, by straight lines."""
    t = np.asarray([entry["timestamp"] for entry in log["entries"]])
    return np.interp(dt * np.arange(round(SECONDS / dt) + 1), t, [float(entry[key]) for entry in log["entries"]])


def held(log: dict, key: str) -> np.ndarray:
    """An entry of a log averaged over the row that holds it: what a servo gets until the next row."""
    fine = column(log, key, DT / 10)
    padded = np.append(fine, np.repeat(fine[-1], 9))
    return padded.reshape(-1, 10).mean(axis=1)


def write(folder: Path, supply: str, more: str) -> Rig:
    """A data set of the logs: train/ and test/."""
    for part in ("train", "test"):
        (folder / part).mkdir()
    for name in names():
        log = raw(name)
        t = DT * np.arange(round(SECONDS / DT) + 1)
        volts = held(log, "input_volts") if supply == "measured" else np.full(t.shape, log["vin"])
        columns = {"time": t, "goal": held(log, "goal_position"), "gain": np.full(t.shape, float(log["kp"]))}
        columns |= {"supply": volts, "theta1": column(log, "position", DT)}
        write_csv(folder / ("test" if name in LEFT_OUT else "train") / f"{name}.csv", columns)
    (folder / "rig.toml").write_text(RIG.format(more=more))
    return read_rig(folder / "rig.toml", specs)


def published(python: str, logs: list[dict]) -> dict[str, list[np.ndarray]]:
    """Angles of the published models every `DT` [rad]."""
    keys, recordings = ("position", "speed", "goal_position"), []
    for log in logs:
        columns = {key: column(log, key, FINE).tolist() for key in keys}
        rows = [
            dict(zip(keys, row, strict=True)) | {"torque_enable": True} for row in zip(*columns.values(), strict=True)
        ]
        head = {key: log[key] for key in ("mass", "length", "kp", "vin")}
        recordings.append(head | {"arm_mass": 0.0, "dt": FINE, "entries": rows})
    models = sorted(map(str, RAW.glob("published_*.json")))
    done = subprocess.run(
        [python, "-c", PUBLISHED], input=json.dumps([recordings, models]), capture_output=True, text=True, check=True
    )
    angles = json.loads(done.stdout).items()
    return {Path(name).stem: [np.asarray(x)[:: round(DT / FINE)] for x in paths] for name, paths in angles}


def errors(angles: list[np.ndarray], logs: list[dict]) -> list[float]:
    """Mean absolute error of each log [mrad]."""
    return [1e3 * float(np.mean(np.abs(x - column(log, "position", DT)))) for x, log in zip(angles, logs, strict=True)]


def row(name: str, values: list[float]) -> str:
    """A row of the table: each log, then their mean."""
    return f"| {name} | {' | '.join(f'{x:.1f}' for x in values)} | {np.mean(values):.2f} |"


def fitted(rig: Rig, folder: Path, laws: tuple[AbstractEffect, ...], search: float, seed: int) -> Identified:
    """The fit of the six logs, with `laws`, or with those that a search of some seconds finds."""
    data, key = read_logs(folder / "train", rig).data, jax.random.key(seed)
    if search:
        outcome = diagnose(rig, data, key=key, seconds=search, log=print)
        for finding in findings(outcome):
            numbers = ", ".join(f"{name} {x.value:.4g} ± {x.std:.1g}" for name, x in finding.parameters.items())
            print(f"found: {finding.effect.name} {numbers}", flush=True)
        return outcome.after
    return identify(rig, data, key=key, start=started(rig, data, laws, key) if laws else None)


def started(rig: Rig, data: Dataset, laws: tuple[AbstractEffect, ...], key: PRNGKeyArray) -> Identified:
    """The problem with laws in it: the tilt, which is the first, is estimated, load friction stays as it is."""
    problem = begin(rig, data, key=key, effects=laws)
    old = problem.m_step.prior
    mean, std = jnp.append(old.mean, 0.0), jnp.append(old.std, TILT)
    rule = eqx.tree_at(lambda m: m.prior, problem.m_step, ParameterPrior((*old.names, "0.angle"), mean, std))
    return problem._replace(m_step=rule, state=start_state(problem.state.model, rule, key=problem.state.key))


def main() -> None:
    """Print a table of all models."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bam", metavar="PYTHON", help="interpreter with better-actuator-models")
    parser.add_argument("--supply", choices=("nominal", "measured"), default="nominal")
    parser.add_argument(
        "--laws", choices=("tilt", "load", "sides"), help="zero of the angle, load friction: declared, not searched"
    )
    parser.add_argument("--search", type=float, default=0.0, metavar="SECONDS")
    parser.add_argument("--more", default="", help="lines of [input]")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--train", action="store_true", help="errors of the logs of the fit, and of no other")
    args = parser.parse_args()
    wanted = [name for name in names() if (name in LEFT_OUT) != args.train]
    logs = [raw(name) for name in wanted]
    print(f"| MAE [mrad] | {' | '.join(wanted)} | mean |\n| {'--- | ' * (len(wanted) + 2)}")
    if args.bam:
        for name, angles in published(args.bam, logs).items():
            print(row(name, errors(angles, logs)), flush=True)
    for seed in args.seeds:
        began = time.perf_counter()
        with TemporaryDirectory() as text:
            rig = write(Path(text), args.supply, args.more)
            tilt, signals = BaseTilt(a(0.0)), ("goal", "dtheta1")
            law = LoadFriction(a(0.2), a(0.1), whole=True, names=signals, joint=1)
            sides = LoadFriction(a(0.2), a(0.1), load=a(0.1), names=signals, joint=1)
            laws = {None: (), "tilt": (tilt,), "load": (tilt, law), "sides": (tilt, sides)}
            fit = fitted(rig, Path(text), laws[args.laws], args.search, seed)
            data = read_logs(Path(text) / ("train" if args.train else "test"), rig).data
        mean = np.asarray(predict(fit, data, 0.0, key=jax.random.key(1)).mean)[..., 0]
        print(row(f"nnap_em, seed {seed}", errors(list(mean), logs)), flush=True)
        numbers = ", ".join(f"{name} {value:.4g} ± {std:.1g}" for name, (value, std) in parameter_table(fit).items())
        print(f"{numbers}; {fit.model}; {time.perf_counter() - began:.0f} s", flush=True)


if __name__ == "__main__":
    main()
