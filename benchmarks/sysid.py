"""Identification beside `mujoco.sysid`, the toolbox of the mujoco package: the table of docs/measured.md.

    pip install -e .[bench]
    python benchmarks/sysid.py [--data ../shared/data/measured] [--alone] [rig ...]     # alone: without the peer's rows

Both get the same training recordings and the same declared unknowns.  The peer fits them with joint damping and dry
friction (`damping`, `frictionloss`) by least squares of the angles over chunks of 0.5 s, each from measured states; a
declared standard deviation becomes bounds of three times it, as the toolbox knows no priors.  Predictions start every
0.25 s of every test recording; the errors are those of their end points: root mean square, and the median, which a few
starts near the upright do not rule.  The library starts from what it filtered (`predict`), and once more from the start
of the peer: angles as measured, rates as their differences.  Times are those of the processor, compiling included.

The arm as MJCF: of its bodies only first and second moments count, so that masses are chosen with which both inertias
are positive (published ones are not).  The coupled rotors are armatures of joint 1 and of a tendon theta1 - gr theta2.
"""

import argparse
import contextlib
import sys
import time
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import rollout, sysid
from runner import SHARED, made

from nnap_em.estimate.identify import Identified, identify
from nnap_em.estimate.predict import predict
from nnap_em.logs.dataset import Dataset
from nnap_em.logs.read import read_logs
from nnap_em.machines.rig import Rig, read_rig
from nnap_em.machines.systems import specs
from nnap_em.machines.systems.arm import TwoLinkArm

RIGS = ("dfki_c1", "dfki_c1_pert", "dfki_c0", "dfki_a0", "cloudpendulum")
HORIZONS = (0.25, 0.5, 1.0)
EVERY = 0.25
CHUNK = 0.5
"""Of a training recording, over which the peer predicts [s]."""
SUBSTEPS = 5
BOUND = 3.0
"""Standard deviations that a declared parameter may move."""
MJCF = """
<mujoco>
  <option timestep="{step}" gravity="0 0 -{g}" integrator="implicitfast"><flag contact="disable"/></option>
  <worldbody>
    <body name="link1">
      <inertial pos="0 0 -0.1" mass="1" diaginertia="1 1 1"/>
      <joint name="joint1" axis="0 -1 0"/>
      <body name="link2" pos="0 0 -{l1}">
        <inertial pos="0 0 -0.1" mass="1" diaginertia="1 1 1"/>
        <joint name="joint2" axis="0 -1 0"/>
      </body>
    </body>
  </worldbody>
  <tendon>
    <fixed name="rotor2"><joint joint="joint1" coef="1"/><joint joint="joint2" coef="{minus_gr}"/></fixed>
  </tendon>
  <actuator><motor joint="joint1"/><motor joint="joint2"/></actuator>
</mujoco>
"""


class Start(NamedTuple):
    """Where predictions begin: row `row` of sequence `seq`, with the state (theta1, theta2, dtheta1, dtheta2)."""

    seq: np.ndarray
    row: np.ndarray
    state: np.ndarray


def starts(data: Dataset, dt: float, every: float, ahead: float, first: float) -> Start:
    """Rows every some seconds that have `ahead` [s] after them, from readings up to that row only."""
    y, valid = np.asarray(data.y), np.asarray(data.valid)
    seq, row, state = [], [], []
    for s, count in enumerate(valid.sum(axis=1)):
        for k in range(round(first / dt), count - round(ahead / dt), round(every / dt)):
            q = y[s, max(k - 2, 0) : k + 1, :2]
            rate = (3 * q[-1] - 4 * q[-2] + q[-3]) / (2 * dt) if k > 1 else y[s, k, 2:]
            seq, row, state = [*seq, s], [*row, k], [*state, np.concatenate([q[-1], rate])]
    return Start(np.array(seq), np.array(row), np.array(state))


def torques(data: Dataset, start: Start, rows: int) -> np.ndarray:
    """Inputs of the rows after each start, (start, rows, input)."""
    return np.stack([np.asarray(data.u)[s, k : k + rows] for s, k in zip(start.seq, start.row, strict=True)])


def angles(data: Dataset, start: Start, row: int) -> np.ndarray:
    """Measured angles some rows after each start."""
    return np.asarray(data.y)[start.seq, start.row + row, :2]


def write(spec: mujoco.MjSpec, arm: dict[str, float], friction: np.ndarray) -> mujoco.MjModel:
    """The arm with viscous and dry friction (damping 1, 2, frictionloss 1, 2) as a compiled model."""
    moment = arm["m2"] * arm["lc2"]
    second = arm["I2"] + arm["m2"] * arm["lc2"] ** 2
    first = arm["I1"] + arm["m1"] * arm["lc1"] ** 2 + arm["m2"] * arm["l1"] ** 2
    pull = arm["m1"] * arm["lc1"] + arm["m2"] * arm["l1"]
    m2 = moment / arm["l1"] * np.sqrt(first / second)  # between what makes either inertia 0
    around, lean = first - m2 * arm["l1"] ** 2, pull - m2 * arm["l1"]
    m1 = max(arm["m1"], 2 * lean**2 / around)
    for name, mass, centre, inertia in (
        ("link1", m1, lean / m1, around - lean**2 / m1),
        ("link2", m2, moment / m2, second - moment**2 / m2),
    ):
        body = spec.body(name)
        body.mass, body.ipos, body.inertia = mass, [0, 0, -centre], [inertia] * 3
    spec.joint("joint1").armature = arm["gr"] ** 2 * arm["Ir"]
    spec.tendon("rotor2").armature = arm["Ir"]
    for j in (0, 1):
        joint = spec.joint(f"joint{j + 1}")
        joint.damping, joint.frictionloss = [friction[j], 0.0, 0.0], friction[j + 2]
    return spec.compile()


def declared(rig: Rig) -> tuple[dict[str, float], dict[str, float]]:
    """Means and standard deviations of the model's parameters."""
    mean = TwoLinkArm.optional | {name: value.mean for name, value in rig.parameters.items()}
    return mean, {name: value.std for name, value in rig.parameters.items() if value.std > 1e-12}


def spec_of(rig: Rig) -> mujoco.MjSpec:
    """The arm of a rig, its declared parameters yet to be written."""
    mean, _ = declared(rig)
    text = MJCF.format(step=rig.dt / SUBSTEPS, g=mean["g"], l1=mean["l1"], minus_gr=-mean["gr"])
    return mujoco.MjSpec.from_string(text)


def check(rig: Rig) -> None:
    """The MJCF arm accelerates as the library's, without friction."""
    mean, _ = declared(rig)
    model = write(spec_of(rig), mean, np.zeros(4))
    arm = TwoLinkArm(**{name: jnp.asarray(value, float) for name, value in mean.items()}, joints=(1, 2))
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    for _ in range(5):
        data.qpos, data.qvel, data.ctrl = rng.normal(size=(3, 2))
        mujoco.mj_forward(model, data)
        q, v = jnp.asarray(data.qpos), jnp.asarray(data.qvel)
        acceleration = jnp.linalg.solve(arm.mass(q), jnp.asarray(data.ctrl) - arm.bias(q, v))
        np.testing.assert_allclose(data.qacc, acceleration, rtol=1e-6, atol=1e-6)


def fit_peer(rig: Rig, train: Dataset) -> mujoco.MjModel:
    """The arm fitted by mujoco.sysid."""
    mean, std = declared(rig)
    spec, names, rows = spec_of(rig), list(std), round(CHUNK / rig.dt)
    begin = starts(train, rig.dt, CHUNK, CHUNK, 0.0)
    size = float(np.sqrt(np.mean(np.asarray(train.u)[np.asarray(train.valid)] ** 2)))
    params = sysid.ParameterDict()
    params.add(sysid.Parameter("arm", np.zeros(len(names)), np.full(len(names), -BOUND), np.full(len(names), BOUND)))
    params.add(sysid.Parameter("friction", np.full(4, 0.05), np.zeros(4), np.ones(4)))

    def build(params: sysid.ParameterDict, spec: mujoco.MjSpec) -> mujoco.MjModel:
        moved = {n: mean[n] + std[n] * z for n, z in zip(names, params["arm"].value, strict=True)}
        return write(spec, mean | moved, size * params["friction"].value)

    first = build(params, spec)
    fine = rig.dt / SUBSTEPS * np.arange(rows * SUBSTEPS + 1)
    drive = np.repeat(torques(train, begin, rows), SUBSTEPS, axis=1)
    chunks = [
        sysid.SystemTrajectory(
            first,
            sysid.TimeSeries(fine, np.concatenate([u, u[-1:]])),
            sysid.TimeSeries(rig.dt * np.arange(1, rows + 1), np.asarray(train.y)[s, k + 1 : k + rows + 1, :2]),
            sysid.create_initial_state(first, x[:2], x[2:]),
            None,
        )
        for u, s, k, x in zip(drive, *begin, strict=True)
    ]

    def compare(params, predicted, measured, model, return_pred_all, *, state, **_):
        """Angles in rad; of the states, as sensors of a rollout are one step old."""
        series = sysid.TimeSeries(measured.times, state[SUBSTEPS - 1 :: SUBSTEPS, 1:3])
        return series.data - measured.data, series, measured

    def residual(x, params):
        """The toolbox's residual of all chunks, one column per point of a finite difference."""
        errors, *_ = sysid.model_residual(x, params, lambda p: build(p, spec), chunks, compare, n_threads=2)
        if x.ndim > 1:
            errors = errors.reshape(-1, x.shape[1], len(chunks)).transpose(2, 0, 1).reshape(-1, x.shape[1])
        else:
            errors = errors.ravel()
        return [errors], None, None

    with contextlib.redirect_stdout(sys.stderr):  # a line for every iteration
        optimum, _ = sysid.optimize(params, residual, verbose=False, max_iters=50)
    return build(optimum, spec)


def peer_paths(model: mujoco.MjModel, data: Dataset, start: Start, dt: float) -> np.ndarray:
    """Angles of the peer at the horizons after each start, (start, horizon, joint)."""
    initial = np.stack([sysid.create_initial_state(model, x[:2], x[2:]) for x in start.state])
    drive = np.repeat(torques(data, start, max(ends(dt))), SUBSTEPS, axis=1)
    state, _ = rollout.rollout(model, mujoco.MjData(model), initial, drive)
    return np.asarray(state)[:, [k * SUBSTEPS - 1 for k in ends(dt)], 1:3]


def same_start_paths(fitted: Identified, data: Dataset, start: Start, dt: float) -> np.ndarray:
    """The same of the library's model from the starts of the peer."""
    u = jnp.asarray(torques(data, start, max(ends(dt))))

    def one(x, u):
        rows = Dataset(dt * jnp.arange(len(u), dtype=float), u, jnp.zeros((len(u), 4)), jnp.ones(len(u), bool))
        return jax.lax.scan(lambda x, u: (fitted.model.transition(x, u),) * 2, x, fitted.model.inputs(rows))[1]

    path = np.asarray(jax.jit(jax.vmap(one))(jnp.asarray(start.state), u))
    return path[:, [k - 1 for k in ends(dt)], :2]


def predicted_paths(fitted: Identified, data: Dataset, start: Start, dt: float) -> np.ndarray:
    """The same of the library's predictions from all readings up to each start."""
    out = np.empty((len(start.row), len(HORIZONS), 2))
    for row in np.unique(start.row):
        mean = np.asarray(predict(fitted, data, row * dt, key=jax.random.key(0)).mean)
        mask = start.row == row
        out[mask] = mean[start.seq[mask]][:, [row + k for k in ends(dt)], :2]
    return out


def ends(dt: float) -> list[int]:
    """The horizons in rows."""
    return [round(h / dt) for h in HORIZONS]


def cells(path: np.ndarray, data: Dataset, start: Start, dt: float) -> list[str]:
    """Root mean square and median error per horizon and joint [rad], as text."""
    error = path - np.stack([angles(data, start, k) for k in ends(dt)], axis=1)
    error = (error + np.pi) % (2 * np.pi) - np.pi
    numbers = np.sqrt(np.mean(error**2, axis=0)), np.median(np.abs(error), axis=0)
    return ["; ".join(f"{a:.3f} / {b:.3f}" for a, b in table) for table in numbers]


def study(folder: Path, *, alone: bool) -> list[list[str]]:
    """Rows of the table: the peer unless the library is `alone`, the library, and it from the start of the peer."""
    rig = read_rig(folder / "rig.toml", specs)
    train, test = (jax.tree.map(jnp.asarray, read_logs(folder / part, rig).data) for part in ("train", "test"))
    check(rig)
    start = starts(test, rig.dt, EVERY, max(HORIZONS), EVERY)
    paths, began = {}, time.process_time()
    if not alone:
        peer = fit_peer(rig, train)
        paths["mujoco.sysid"] = peer_paths(peer, test, start, rig.dt), f"{time.process_time() - began:.0f}"
    began = time.process_time()
    fitted = identify(rig, train, key=jax.random.key(0))
    spent = time.process_time() - began
    paths["nnap-em"] = predicted_paths(fitted, test, start, rig.dt), f"{spent:.0f}"
    paths["nnap-em, same start"] = same_start_paths(fitted, test, start, rig.dt), "-"
    return [
        [folder.name, str(len(start.row)), who, *cells(path, test, start, rig.dt), spent]
        for who, (path, spent) in paths.items()
    ]


def main() -> None:
    """Print the table."""
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("rigs", nargs="*", default=RIGS)
    arguments.add_argument("--data", type=Path, default=SHARED / "measured")
    arguments.add_argument("--alone", action="store_true", help="without the peer's rows")
    args = arguments.parse_args()
    if not args.data.is_dir():
        sys.exit(f"error: {args.data} is not there: the recordings are no part of the repository")
    jax.config.update("jax_enable_x64", True)
    print(made("mujoco-core"))
    heads = ["rig", "starts", "fitted by", "theta1 / theta2 at 0.25; 0.5; 1 s, root mean square [rad]", "median", "s"]
    print(f"| {' | '.join(heads)} |\n|{' --- |' * len(heads)}")
    for name in args.rigs:
        for row in study(args.data / name, alone=args.alone):
            print(f"| {' | '.join(row)} |", flush=True)


if __name__ == "__main__":
    main()
