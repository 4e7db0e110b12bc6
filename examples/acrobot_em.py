"""The paper's section IV from a seed: friction of both joints of an acrobot whose second joint nobody measures.

Four models are trained on 20 simulated sequences: physics with a friction network, and a network alone, each with a
Gaussian (RTS) and with a particle smoother.  Written into `out/acrobot_em/`: the paper's figures 3 to 7 and a table.

    python examples/acrobot_em.py            # some minutes
    python examples/acrobot_em.py --quick    # a small one: the Gaussian smoothers only, about a minute
"""

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from blackbox import GradientMStep, build_network, forecast
from paper_figures import Band, Curve, Record, friction_epochs_figure, prediction_figure, states_figure

from nnap_em.base.files import cores
from nnap_em.base.parallel import use_every_device
from nnap_em.base.programs import use_older_emitters
from nnap_em.estimate.em.build import build
from nnap_em.estimate.em.loop import EMState, Schedule, e_step, fit, start_state
from nnap_em.estimate.em.mstep import AbstractMStep
from nnap_em.estimate.predict import given_samples
from nnap_em.estimate.smoother import AbstractSmoother
from nnap_em.estimate.smoother.gaussian import CubatureSmoother, ExtendedKalmanSmoother, GaussianSmoother
from nnap_em.estimate.smoother.particle import Guided, ParticleSmoother
from nnap_em.estimate.smoother.start import StartBank
from nnap_em.logs.dataset import Dataset
from nnap_em.machines.rig import Declared, Rig
from nnap_em.machines.systems.acrobot import table_i
from nnap_em.model.base import prepare
from nnap_em.model.simulate import Experiment, paper_experiment, paper_model

EPOCHS = (1, 5, 10, 20)
"""Shown in the figures."""
GIVEN = 1.0
"""Readings used before a prediction [s]."""


class Effort(NamedTuple):
    """How much is computed."""

    train: int = 20
    test: int = 5
    steps: int = 500
    epochs: int = 20
    network_epochs: int = 20
    particles: int = 300
    paths: int = 64
    network_particles: int = 150
    network_paths: int = 16
    gradient_steps: int = 300
    cloud: int = 2000
    particle_models: bool = True


QUICK = Effort(train=8, test=3, steps=300, epochs=10, network_epochs=5, gradient_steps=100, particle_models=False)


class Task(NamedTuple):
    """One model to be trained."""

    name: str
    model: Any
    smoother: AbstractSmoother
    m_step: AbstractMStep
    filter: Callable[[Any, Dataset, jax.Array], tuple[jax.Array, jax.Array]]
    """(model, one sequence, key) to mean and standard deviation of the filtered states."""
    schedule: Schedule
    epochs: int


class Trained(NamedTuple):
    """A trained model and those on the way to it."""

    task: Task
    model: Any
    stages: dict[int, Any]
    last: int
    seconds: float


def declare() -> Rig:
    """What an owner of the acrobot would write down: Table I, and that joint 1 is read."""
    return Rig(
        name="paper",
        system="acrobot",
        parameters={name: Declared(value, 0.0) for name, value in table_i.items()},
        friction=True,
        input_columns=("u",),
        input_joints=(2,),
        dt=0.01,
        clock="sequence",
        measured=("theta1", "dtheta1"),
        noise_std={},
        start={"theta2": Declared(0.0, 0.5), "dtheta1": Declared(0.0, 0.02), "dtheta2": Declared(0.0, 0.02)},
    )


def gaussian_filter(smoother: GaussianSmoother):
    """Mean and standard deviation of the Gaussian filter."""

    def run(model, seq: Dataset, key):
        state = smoother.path(model, prepare(model, seq))[0].state
        return state.mean, jnp.sqrt(jnp.diagonal(state.cov, axis1=1, axis2=2))

    return run


def particle_cloud(smoother: ParticleSmoother):
    """Weighted mean and standard deviation of the particles; their log weights are up to a constant of each time."""

    def run(model, seq: Dataset, key):
        history = smoother.history(model, prepare(model, seq), key=key)
        x = jnp.swapaxes(history.x, 1, 2).astype(history.scale.dtype)
        x = history.origin[:, None] + history.scale[None, None] * x
        weight = jax.nn.softmax(history.log_w, axis=1)[..., None].astype(x.dtype)
        mean = jnp.sum(weight * x, axis=1)
        return mean, jnp.sqrt(jnp.sum(weight * (x - mean[:, None]) ** 2, axis=1))

    return run


def make_tasks(rig: Rig, data: Dataset, effort: Effort, *, key) -> list[Task]:
    """The four models before training; friction starts at nearly none, networks at random."""
    key_friction, key_network, key_draw = jax.random.split(key, 3)
    hybrid = build(rig, data, key=key_friction)
    network = build_network(data, (0, 2), 4, rig.dt, key=key_network, width=32)
    rule = GradientMStep(key_draw, steps=effort.gradient_steps)
    rts, ekf = CubatureSmoother(hybrid.bank), CubatureSmoother(hybrid.bank, iterations=0)
    plain = StartBank((1, 1, 1, 1))
    network_rts, network_ekf = ExtendedKalmanSmoother(plain), ExtendedKalmanSmoother(plain, iterations=0)
    whole = Schedule(first=data.t.shape[1])

    def particles(guide, count, paths):
        return ParticleSmoother(guide, num_particles=count, num_paths=paths)

    def cloud(guide):
        return particle_cloud(ParticleSmoother(guide, Guided(), num_particles=effort.cloud))

    rough = particles(network_rts, effort.network_particles, effort.network_paths)
    fine = particles(rts, effort.particles, effort.paths)
    tasks = [
        Task("hybrid, RTS", hybrid.model, rts, hybrid.mstep, gaussian_filter(ekf), Schedule(), effort.epochs),
        Task("hybrid, particles", hybrid.model, fine, hybrid.mstep, cloud(rts), Schedule(), effort.epochs),
        Task(
            "data-driven, RTS", network, network_rts, rule, gaussian_filter(network_ekf), whole, effort.network_epochs
        ),
        Task("data-driven, particles", network, rough, rule, cloud(network_rts), whole, effort.network_epochs),
    ]
    return tasks if effort.particle_models else tasks[::2]


def train(task: Task, data: Dataset, *, key) -> Trained:
    """EM, with the models of some epochs kept."""
    stages: dict[int, Any] = {}
    began = time.perf_counter()

    def watch(state: EMState, seen: int, used: np.ndarray) -> None:
        if state.epoch in EPOCHS:
            stages[state.epoch] = state.model
        seconds = time.perf_counter() - began
        say(
            f"  {task.name}: epoch {state.epoch:2d}, {seen} samples, {used.sum()} of {used.size} sequences, "
            f"log-likelihood {state.loglik[-1]:.1f}, {seconds:.0f} s"
        )

    say(f"{task.name} ...")
    state = start_state(task.model, task.m_step, key=key)
    state = fit(
        state, data, task.smoother, task.m_step, epochs=task.epochs, schedule=task.schedule, tolerance=0.1, watch=watch
    )
    for epoch in (e for e in EPOCHS if e >= state.epoch):
        stages[epoch] = state.best
    return Trained(task, state.best, stages, state.epoch, time.perf_counter() - began)


def say(text: str) -> None:
    """Print at once."""
    print(text, flush=True)


def rms(error, axis=None) -> np.ndarray:
    """Root mean square."""
    return np.sqrt(np.mean(np.asarray(error) ** 2, axis=axis))


def friction_error(model, truth, x) -> np.ndarray:
    """RMS(tau_hat - tau_true) / RMS(tau_true) of each joint over the visited velocities."""
    v = x[..., 2:].reshape(-1, 2)
    hat, true = (jax.vmap(m.unknown)(v) for m in (model, truth))
    return rms(hat - true, 0) / rms(true, 0)


_smooth = eqx.filter_jit(e_step)


def smoothing_error(model, smoother, train: Experiment, *, key) -> float:
    """RMS error of the smoothed theta2 [rad]."""
    return float(rms(_smooth(model, train.data, smoother, key=key).state.mean[..., 1] - train.x[..., 1]))


def predict(model, smoother, data: Dataset, *, key):
    """Paths of the state of every sequence from the last of the readings up to GIVEN on."""
    key_smooth, key_path = jax.random.split(key)
    known = given_samples(data, GIVEN)
    last = int(known[0].sum()) - 1
    state = _smooth(model, data._replace(valid=jnp.asarray(known)), smoother, key=key_smooth).state
    keys = jax.random.split(key_path, data.u.shape[0])
    u = jax.tree.map(lambda a: a[:, last:-1], jax.vmap(model.inputs)(data))
    return state, last, _forecast(model, jax.tree.map(lambda a: a[:, last], state), u, keys)


@eqx.filter_jit
def _forecast(model, state, u, keys):
    return jax.vmap(lambda s, u, k: forecast(model, s, u, samples=100, key=k))(state, u, keys)


def prediction_errors(model, smoother, test: Experiment, horizons: list[float], *, key) -> list[np.ndarray]:
    """RMS error of the predicted angles over each horizon [s], the median of the sequences [rad]."""
    _, last, paths = predict(model, smoother, test.data, key=key)
    error = np.mean(paths, axis=1)[:, 1:, :2] - test.x[:, last + 1 :, :2]
    error = (error + np.pi) % (2 * np.pi) - np.pi
    return [np.median(rms(error[:, : round(h / model.dt)], 1), axis=0) for h in horizons]


def make_table(trained: list[Trained], truth, bank: StartBank, train: Experiment, test: Experiment, effort, key) -> str:
    """What was measured, as markdown."""
    cell = lambda value: "–" if value is None else f"{value:.3f}"  # noqa: E731
    longest = (test.x.shape[1] - 1) * truth.dt - GIVEN
    horizons = [h for h in (1.0, 2.0) if h <= longest + 1e-6]
    heads = ["model", "friction NRMSE joint 1", "joint 2", "θ₂ smoothing RMSE [rad]"]
    heads += [f"{name} predicted over {h:g} s [rad]" for h in horizons for name in ("θ₁", "θ₂")]
    rows = [[*heads, "epochs", "time [s]"], ["---"] * (len(heads) + 2)]
    judged = [("true model", truth, CubatureSmoother(bank), True, "", "")]
    for t in trained:
        physical = t.task.name.startswith("hybrid")
        judged.append((t.task.name, t.model, t.task.smoother, physical, str(t.last), f"{t.seconds:.0f}"))
    for name, model, smoother, physical, epochs, seconds in judged:
        friction = friction_error(model, truth, train.x) if physical and model is not truth else (None, None)
        smoothing = smoothing_error(model, smoother, train, key=key) if physical else None
        row = [name, *map(cell, friction), cell(smoothing)]
        for first, second in prediction_errors(model, smoother, test, horizons, key=key):
            row += [cell(first), cell(second if physical else None)]
        rows.append([*row, epochs, seconds])
        say("  " + ", ".join(rows[-1]))
    text = "\n".join("| " + " | ".join(row) + " |" for row in rows)
    e = effort
    notes = (
        "NRMSE = RMS(τ̂ - τ) / RMS(τ) over the visited velocities.",
        f"Predictions start after {GIVEN:g} s of readings; RMS over the horizon, median of {e.test} sequences.",
        "A data-driven model has no θ₂ of its own: its latent space is not unique.",
        f"{e.train} training sequences of {e.steps} samples.  Times include compilation.",
        f"Particles / paths: {e.particles} / {e.paths} (hybrid), {e.network_particles} / {e.network_paths} (network)."
        if e.particle_models
        else "Particle smoothers are left out.",
    )
    return "\n".join([text, "", *notes, ""])


def draw(trained: list[Trained], truth, train: Experiment, test: Experiment, out: Path, *, key) -> None:
    """The paper's figures 3 to 7, all of the same test sequence."""
    seq = jax.tree.map(lambda a: a[0], test.data)
    record = Record(np.asarray(seq.t), np.asarray(seq.y), truth.measured, np.asarray(test.x[0]))
    hybrid = [t for t in trained if t.task.name.startswith("hybrid")]
    network = [t for t in trained if not t.task.name.startswith("hybrid")]
    latent = "Hidden states of a data-driven model have no truth to compare with: its latent space is not unique."
    for number, group in ((3, network), (4, hybrid)):
        say(f"figure {number} ...")
        bands = {t.task.name: filtered(t, seq, key=key) for t in group}
        kind = "data-driven" if number == 3 else "physics-informed"
        figure = states_figure(
            bands,
            record,
            latent=number == 3,
            title=f"Filtered distributions during training, {kind} models",
            note=latent if number == 3 else "Only joint 1 is measured.  Shaded: 90 % band.",
        )
        figure.savefig(out / f"figure_{number}_filtered.png")
    for number, group in ((5, network), (6, hybrid)):
        say(f"figure {number} ...")
        bands = {t.task.name: predicted(t, test.data, key=key) for t in group}
        kind = "data-driven" if number == 5 else "physics-informed"
        figure = prediction_figure(
            bands,
            record,
            GIVEN,
            latent=number == 5,
            title=f"Predictions of the {kind} models",
            note=latent if number == 5 else "",
        )
        figure.savefig(out / f"figure_{number}_predicted.png")
    say("figure 7 ...")
    visited = [np.asarray(train.x[..., 2 + j]).ravel() for j in range(2)]
    reach = jnp.asarray([np.quantile(np.abs(v), 0.995) for v in visited])
    v = reach[:, None] * jnp.linspace(-1.0, 1.0, 401)[None]
    curves = {
        epoch: {t.task.name: Curve(np.asarray(v), torque(t.stages[epoch], v)) for t in hybrid}
        for epoch in EPOCHS
        if all(epoch in t.stages for t in hybrid)
    }
    early = [f"{t.task.name} came to rest at epoch {t.last}" for t in hybrid if t.last < max(EPOCHS)]
    figure = friction_epochs_figure(
        curves, truth=Curve(np.asarray(v), torque(truth, v)), visited=visited, note="; ".join(early)
    )
    figure.savefig(out / "figure_7_friction.png")


def torque(model, v) -> np.ndarray:
    """Friction torque of every joint at velocities v."""
    return np.asarray(jax.vmap(model.unknown)(v.T).T)


def filtered(t: Trained, seq: Dataset, *, key) -> dict[int, Band]:
    """Filtered distributions of one sequence with the models of some epochs."""
    run = eqx.filter_jit(t.task.filter)
    return {
        epoch: Band(np.asarray(seq.t), *(np.asarray(a) for a in run(model, seq, key)))
        for epoch, model in sorted(t.stages.items())
    }


def predicted(t: Trained, data: Dataset, *, key) -> Band:
    """Distribution of the first sequence: as known before GIVEN, predicted after."""
    state, last, paths = predict(t.model, t.task.smoother, data, key=key)
    std = np.sqrt(np.diagonal(state.cov[0], axis1=1, axis2=2))
    ahead = np.asarray(paths[0])
    mean = np.concatenate([state.mean[0][:last], ahead.mean(0)])
    return Band(np.asarray(data.t[0]), mean, np.concatenate([std[:last], ahead.std(0)]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else None)
    parser.add_argument("--out", type=Path, default=Path("out/acrobot_em"), help="folder for figures and table")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--quick", action="store_true", help="fewer sequences and epochs, no particles")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    jax.config.update("jax_enable_x64", True)
    use_older_emitters()
    jax.config.update("jax_num_cpu_devices", cores())
    use_every_device()
    jax.config.update("jax_compilation_cache_dir", str(Path(__file__).resolve().parents[1] / ".cache" / "jax"))
    effort = QUICK if options.quick else Effort()
    key_train, key_test, key_model, key_fit, key_judge = jax.random.split(jax.random.key(options.seed), 5)

    began = time.perf_counter()
    say(f"simulating {effort.train} + {effort.test} sequences ...")
    truth = paper_model()
    experiment = paper_experiment(truth, effort.train, effort.steps, key=key_train)
    test = paper_experiment(truth, effort.test, effort.steps, key=key_test)
    rig = declare()
    tasks = make_tasks(rig, experiment.data, effort, key=key_model)
    trained = [train(task, experiment.data, key=key_fit) for task in tasks]
    say("judging ...")
    bank = build(rig, experiment.data, key=key_model).bank
    table = make_table(trained, truth, bank, experiment, test, effort, key_judge)
    (options.out / "table.md").write_text(table, encoding="utf-8")
    draw(trained, truth, experiment, test, options.out, key=key_judge)
    say(f"\n{table}\n{time.perf_counter() - began:.0f} s in all; figures and table in {options.out}")


if __name__ == "__main__":
    main()
