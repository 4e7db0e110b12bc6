"""Machine files written back: shapes, classes, mass matrix and bias force of MuJoCo before and after.

    python benchmarks/round_trip.py [FILE ...]

Without files: those of examples/machines and tests/machines, and an arm of six joints.  Every file is declared, begun
as a fit without logs of its own, and written as MJCF; MuJoCo then has both at random states.  Shapes whose files are
missing count on neither side.
"""

import argparse
import json
import os
import platform
import re
import sys
from datetime import date
from pathlib import Path
from tempfile import TemporaryDirectory

import jax
import mujoco
import numpy as np

from nnap_em import Dataset
from nnap_em.commands.common import set_up
from nnap_em.data.rig import read_rig
from nnap_em.export.mjcf import write_mjcf
from nnap_em.fit.identify import begin
from nnap_em.machines.mjcf import read_machine
from nnap_em.machines.spec import compiled, opened
from nnap_em.systems import specs

sys.path.insert(0, str(Path(__file__).resolve().parent))
from machines import ROOT, arm

RIG = """format = 1
name = "round"
[model]
type = "mjcf"
file = "{file}"
friction = "none"
[input]
columns = ["torque"]
joints = [1]
[sampling]
dt = 0.01
input_hold = "zero-order"
clock = "sequence"
[measurement]
columns = {joints}
"""


def through(path: Path, folder: Path) -> Path:
    """The file that is written of a machine, with all its numbers as they were."""
    joints = [joint.name for joint in read_machine(path).joints]
    (folder / "rig.toml").write_text(RIG.format(file=path.resolve(), joints=json.dumps(joints)))
    t = 0.01 * np.arange(60.0)[None]
    read = np.repeat(np.sin(t)[..., None], len(joints), axis=2)
    logs = Dataset(t, np.sin(t)[..., None], read, np.ones((1, 60), bool))
    write_mjcf(begin(read_rig(folder / "rig.toml", specs), logs, key=jax.random.key(0)), folder / "written.xml")
    return folder / "written.xml"


def shapes(model: mujoco.MjModel) -> np.ndarray:
    """Type, sizes, colour, and place in the world with all joints as declared, of every shape."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    parts = model.geom_type[:, None], model.geom_size, model.geom_rgba, data.geom_xpos, data.geom_xmat
    return np.concatenate(parts, axis=1)


def physics(model: mujoco.MjModel, states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mass matrix and bias force without springs at coordinates and rates."""
    data, mass, out = mujoco.MjData(model), np.zeros((model.nv, model.nv)), []
    for q, v in states:
        data.qpos[:], data.qvel[:] = q, v
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, mass)
        out.append((mass.copy(), data.qfrc_bias - data.qfrc_spring))
    masses, forces = zip(*out, strict=True)
    return np.array(masses), np.array(forces)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", nargs="*", type=Path)
    args = parser.parse_args()
    set_up()
    print(f"{date.today()}, {platform.machine()}, MuJoCo {mujoco.__version__}, load {os.getloadavg()[0]:.1f} before\n")
    print("| file | joints | shapes | classes | largest change of a shape | of the mass matrix | of the bias force |")
    print("| --- " * 7 + "|")
    with TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "arm.xml").write_text(arm(6))
        own = [*(ROOT / "examples/machines").glob("*.xml"), *(ROOT / "tests/machines").iterdir(), folder / "arm.xml"]
        for path in args.file or sorted(own):
            spec = opened(path)
            before, after = compiled(path, spec), mujoco.MjModel.from_xml_path(str(through(path, folder)))
            states = np.random.default_rng(0).uniform(-3.0, 3.0, (20, 2, before.nv))
            pairs = zip(physics(before, states), physics(after, states), strict=True)
            worst = [np.max(np.abs(one - other)) / max(np.max(np.abs(one)), 1.0) for one, other in pairs]
            texts = spec.to_xml(), (folder / "written.xml").read_text()
            classes = [len(re.findall("<default class=", text)) for text in texts]
            moved = np.max(np.abs(shapes(before) - shapes(after)), initial=0.0)
            counts = [" / ".join(map(str, pair)) for pair in ((before.ngeom, after.ngeom), classes)]
            cells = path.name, before.njnt, *counts, *(f"{x:.1g}" for x in (moved, *worst))
            print(f"| {' | '.join(map(str, cells))} |", flush=True)


if __name__ == "__main__":
    main()
