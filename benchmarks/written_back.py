"""Machines from files of which one joint is read: their friction over seeds, and what the written file predicts.

    python benchmarks/written_back.py [--machine cartpole furuta] [--seeds 5]

Logs and truth are those of `examples/machine_files.py`: 8 sequences of 4 s made by MuJoCo.  The identified machine is
written as MJCF; that file and the one that came in are then played by MuJoCo along logs of another seed, from the true
states every half second.
"""

import argparse
import os
import platform
import sys
import time
from datetime import date
from pathlib import Path
from tempfile import TemporaryDirectory

import jax
import mujoco
import numpy as np

from nnap_em import identify
from nnap_em.commands.common import set_up
from nnap_em.data.machine import unpacked
from nnap_em.data.rig import read_rig
from nnap_em.export.mjcf import write_mjcf
from nnap_em.systems import specs

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "examples"))
from machine_files import CASES, DT, FINE, HERE, errors, friction, recorded

AHEAD = (25, 50, 100)
"""Rows."""


def ahead(text: str, x: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Root mean square error of the coordinates (row: horizon, column: joint) of MuJoCo with a file [m or rad]."""
    model = mujoco.MjModel.from_xml_string(text)
    model.opt.timestep, model.opt.integrator = DT / FINE, int(mujoco.mjtIntegrator.mjINT_IMPLICITFAST)
    model.jnt_limited[:] = 0
    wrong = []
    for path, push in zip(x, u, strict=True):
        for start in range(0, len(path) - max(AHEAD), 50):
            data, read = mujoco.MjData(model), []
            data.qpos[:], data.qvel[:] = np.split(path[start], 2)
            for k in range(start, start + max(AHEAD)):
                data.ctrl[:] = push[k]
                mujoco.mj_step(model, data, FINE)
                read.append(data.qpos - path[k + 1, : model.nv])
            wrong.append([read[rows - 1] for rows in AHEAD])
    return np.sqrt(np.mean(np.square(wrong), axis=0))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--machine", nargs="+", choices=CASES, default=list(CASES))
    parser.add_argument("--seeds", type=int, default=5)
    args = parser.parse_args()
    set_up()
    print(f"{date.today()}, {platform.machine()}, {jax.device_count()} devices, JAX {jax.__version__}, ", end="")
    print(f"load {os.getloadavg()[0]:.1f} before: {' '.join(['python', *sys.argv])}\n")
    print("| machine | seed | friction of joint 1 / 2, NRMSE | ", end="")
    print("error at 0.25, 0.5, 1 s, joint 1 / 2: the file that came in | the written one | s |")
    print("| --- " * 6 + "|")
    for machine in args.machine:
        case, text = CASES[machine], (HERE / f"{machine}.xml").read_text()
        law, noise = friction(case), np.asarray(case.noise)
        rig = read_rig(HERE / f"{machine}.toml", specs)
        read = [unpacked(rig.machine).states.index(name) for name in rig.measured]
        for seed in range(args.seeds):
            logs, x = recorded(text, law, case.push, noise, sequences=8, rows=400, seed=seed)
            began = time.perf_counter()
            fitted = identify(rig, logs._replace(y=logs.y[..., read]), key=jax.random.key(seed))
            took, missed = time.perf_counter() - began, errors(fitted.model.unknown, law, x)
            logs, x = recorded(text, law, case.push, noise, sequences=4, rows=400, seed=100 + seed)
            with TemporaryDirectory() as folder:
                write_mjcf(fitted, Path(folder) / "identified.xml")
                files = text, (Path(folder) / "identified.xml").read_text()
            said = [", ".join(" / ".join(f"{e:.2g}" for e in row) for row in ahead(one, x, logs.u)) for one in files]
            cells = machine, seed, " / ".join(f"{e:.3f}" for e in missed), *said, f"{took:.0f}"
            print(f"| {' | '.join(map(str, cells))} |", flush=True)


if __name__ == "__main__":
    main()
