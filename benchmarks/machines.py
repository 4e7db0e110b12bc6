"""Time of a Runge-Kutta step of a machine from a file by its number of joints: the table of docs/results/machines.md.

    JAX_NUM_CPU_DEVICES=1 taskset -c 0 python benchmarks/machines.py [--rounds 7]

A step of the physics alone, without friction, over 10,000 states at a time, compile time apart; the least of rounds.
"""

import argparse
import os
import platform
import time
from datetime import date
from pathlib import Path
from tempfile import TemporaryDirectory

import jax
import jax.numpy as jnp
import numpy as np

from nnap_em.data.machine import packed, states
from nnap_em.machines.mjcf import read_machine
from nnap_em.model.simulate import examples
from nnap_em.numerics.ode import integrate
from nnap_em.systems import AbstractSystem, systems

jax.config.update("jax_enable_x64", True)
STATES = 10_000
ROOT = Path(__file__).resolve().parents[1]
AXES = ("0 0 1", "0 1 0", "0 1 0", "0 0 1", "0 1 0", "0 0 1", "0 1 0")
PLACES = ("0 0 0", "0 0 0.15", "0 0 0.3", "0.03 0 0.25", "0 0 0.1", "0 0 0.08", "0 0 0.06")
MASSES = (3.0, 2.5, 1.5, 0.8, 0.5, 0.3, 0.2)
CENTRES = (0.1, 0.15, 0.12, 0.06, 0.05, 0.03, 0.02)


def arm(joints: int) -> str:
    """An industrial arm of up to seven joints as MJCF: axes by turns upright and across, every inertia full."""
    head, tail = [], []
    for i in range(joints):
        k = 0.01 * MASSES[i]
        full = " ".join(f"{share * k:.4g}" for share in (1, 0.9, 0.5, 0.02, 0.01, -0.03))
        head += [
            f'<body name="link{i + 1}" pos="{PLACES[i]}">',
            f'<joint name="joint{i + 1}" axis="{AXES[i]}" armature="{0.05 / (i + 1):.4g}"/>',
            f'<inertial pos="{0.01 * i:.4g} 0.005 {CENTRES[i]}" mass="{MASSES[i]}" fullinertia="{full}"/>',
        ]
        tail += ["</body>"]
    motors = [f'<motor name="tau{i + 1}" joint="joint{i + 1}"/>' for i in range(joints)]
    parts = ['<mujoco model="arm"><compiler angle="radian"/><worldbody>', *head, '<site name="hand" pos="0 0 0.05"/>']
    return "\n".join([*parts, *tail, "</worldbody><actuator>", *motors, "</actuator></mujoco>"])


def tree(path: Path) -> AbstractSystem:
    """The machine in a file, all as it stands there."""
    machine = read_machine(path)
    count = len(machine.joints)
    whole = machine._replace(states=states(machine), gears=(1.0,) * count)
    return systems["mjcf"].declared({}, tuple(range(1, count + 1)), packed(whole))


def measured(system: AbstractSystem, rounds: int) -> tuple[float, float]:
    """Nanoseconds of a step of one state, and seconds until the first result."""
    dof = len(system.coordinates)

    def slopes(x):
        return *x[dof:], *system.acceleration(x[:dof], x[dof:], jnp.zeros(dof))

    step = jax.jit(jax.vmap(lambda x: integrate(slopes, x, 0.01, 1)))
    x = jnp.asarray(np.random.default_rng(0).uniform(-1.0, 1.0, (STATES, 2 * dof)))
    times = []
    for _ in range(rounds + 1):
        began = time.perf_counter()
        step(x).block_until_ready()
        times.append(time.perf_counter() - began)
    return 1e9 * min(times[1:]) / STATES, times[0]


def rows(folder: Path) -> dict[str, AbstractSystem]:
    """What is timed."""
    cases = {"acrobot, built in": examples["acrobot"]().model.system}
    for name in ("acrobot", "cartpole", "furuta"):
        cases[f"{name}.xml, 2 joints"] = tree(ROOT / "examples" / "machines" / f"{name}.xml")
    for count in range(1, 8):
        (folder / "arm.xml").write_text(arm(count))
        cases[f"arm, {count} joint{'s' * (count > 1)}"] = tree(folder / "arm.xml")
    return cases


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=7)
    rounds = parser.parse_args().rounds
    load = os.getloadavg()[0]
    print(f"{date.today()}, {platform.machine()}, JAX {jax.__version__}, load {load:.1f} before")
    print("\n| machine | a step [us] | compile [s] |\n| --- | --- | --- |")
    with TemporaryDirectory() as folder:
        for name, system in rows(Path(folder)).items():
            step, first = measured(system, rounds)
            print(f"| {name} | {step / 1e3:.3g} | {first:.1f} |", flush=True)


if __name__ == "__main__":
    main()
