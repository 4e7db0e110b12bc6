"""What several tests make: logs and their text, a declared model, and what a search knows of it."""

import contextlib
import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import plant

from nnap_em.base.gaussian import Gaussian
from nnap_em.cli import main as cli
from nnap_em.estimate.em.build import build_system
from nnap_em.estimate.em.mstep import ScoringMStep
from nnap_em.estimate.em.prior import ParameterPrior
from nnap_em.estimate.em.servos import build_servos
from nnap_em.estimate.identify import Identified, begin
from nnap_em.explain.diagnosis.residual import Residual
from nnap_em.logs.dataset import Dataset
from nnap_em.logs.formats import columns_of, table_of
from nnap_em.machines.rig import Rig, read_rig, write_rig
from nnap_em.machines.systems import specs, systems
from nnap_em.machines.systems.slide import Slide
from nnap_em.model.effects.base import SearchScales
from nnap_em.model.friction import FixedFriction, NoFriction
from nnap_em.model.law import StribeckLaw
from nnap_em.model.state_space import StateSpaceModel, with_effects


@contextlib.contextmanager
def optimised() -> Iterator[None]:
    """Compile to run fast what is compiled inside: for tests that run longer than they compile."""
    before = jax.config.read("jax_disable_most_optimizations")
    jax.config.update("jax_disable_most_optimizations", False)
    try:
        yield
    finally:
        jax.config.update("jax_disable_most_optimizations", before)


@contextlib.contextmanager
def compiled() -> Iterator[list[str]]:
    """Names of the programs that are compiled inside, or taken from the cache of an earlier run."""
    names: list[str] = []

    def listen(event: str, duration: float, **labels: object) -> None:
        if event == "/jax/core/compile/backend_compile_duration":
            names.append(str(labels.get("fun_name")))

    jax.monitoring.register_event_duration_secs_listener(listen)
    yield names
    jax.monitoring.unregister_event_duration_listener(listen)


def nnap(*words: object) -> int:
    """Exit status of a command in this process."""
    return cli.main([str(word) for word in words])


def written_again(rig: Rig, folder: Path) -> Rig:
    """The rig that `read_rig` gives back after `write_rig` wrote it."""
    write_rig(rig, folder / "again.toml")
    return read_rig(folder / "again.toml", specs)


def rig_of(folder: Path, text: str) -> Rig:
    """The rig of this text, which is written to rig.toml in the folder."""
    (folder / "rig.toml").write_text(text)
    return read_rig(folder / "rig.toml", specs)


def data_sets(shared: Path) -> list[Path]:
    """The rig.toml of every shared data set without a fault; one with a fault has an expected.txt."""
    paths = sorted((shared / "data").glob("*/*/rig.toml"))
    return [path for path in paths if (path.parent / "train").is_dir() and not path.with_name("expected.txt").exists()]


def begun(rig: Rig, data: Dataset) -> Identified:
    """A fit that no epoch has changed, as certain of every weight."""
    fitted = begin(rig, data, key=jax.random.key(0))
    information = 1e3 * jnp.eye(fitted.state.hessian.shape[0])
    return fitted._replace(state=fitted.state._replace(hessian=information, loglik=jnp.zeros(1)))


def swing_rig(**changes) -> Rig:
    """The declaration of what `swing` writes."""
    fields = {"dt": 0.01, "clock": "sequence", "measured": ("theta1", "dtheta1")} | changes
    return Rig("bench", "acrobot", {}, True, ("u",), (2,), noise_std={}, start={}, **fields)


def swing(rows: int = 201, dt: float = 0.01, phase: float = 0.0) -> dict[str, np.ndarray]:
    """Two rad to and fro, with its exact rate."""
    t = dt * np.arange(rows)
    theta, rate = 2.0 * np.sin(3.0 * t + phase), 6.0 * np.cos(3.0 * t + phase)
    return {"time": t, "u": 0.1 * np.sin(t + phase), "theta1": theta, "dtheta1": rate}


def csv_text(columns: dict[str, np.ndarray]) -> str:
    """A log as the text of its file."""
    rows = [",".join(f"{x:.9g}" for x in row) for row in zip(*columns.values(), strict=True)]
    return "\n".join([",".join(columns), *rows]) + "\n"


def read_table(path: Path, required: Sequence[str], gaps: Sequence[str] = ()) -> np.ndarray:
    """Columns of a log as those of a sequence are read."""
    return columns_of(table_of(path), required, gaps)


def with_field(line: int, column: str, text: str) -> Callable[[str], str]:
    """A change of one field of the file; `line` as an editor counts."""

    def change(content: str) -> str:
        lines = [row.split(",") for row in content.splitlines()]
        lines[line - 1][lines[0].index(column)] = text
        return "\n".join(map(",".join, lines)) + "\n"

    return change


def declared_model(case: plant.Case) -> StateSpaceModel:
    """The declared model of a case, with its true friction."""
    kind = systems[case.system]
    values = {**kind.optional, **plant.SYSTEMS[case.system].parameters}
    system = kind(
        **{name: jnp.asarray(value, float) for name, value in values.items()},
        joints=(plant.SYSTEMS[case.system].driven,),
    )
    law = plant.drawn_friction(case)
    if any(e["name"] in plant.TRANSMISSION for e in case.effects):
        law[1]["b"] += 3e-4  # the simulator's motor has a drag of its own, which the joint feels
    column = lambda n: jnp.asarray([f[n] for f in law])  # noqa: E731
    friction = StribeckLaw(*(column(n) for n in ("Fc", "Fs", "vs", "b", "eps")))
    n = 2 * len(kind.coordinates)
    states = kind.coordinates + kind.rates
    return StateSpaceModel(
        system,
        FixedFriction(friction, jnp.ones(n // 2)),
        Gaussian(jnp.zeros(n), jnp.eye(n)),
        jnp.zeros(n),
        jnp.zeros(len(plant.measured(case))),
        tuple(states.index(c) for c in plant.measured(case)),
        plant.DT,
        10,
    )


def rate(model: StateSpaceModel, x: jax.Array, u: jax.Array, t: jax.Array) -> jax.Array:
    """Rate of change of a state under inputs, with none before them, at a moment."""
    row = Dataset(t[None] - 0.5 * model.dt, u[None], jnp.zeros((1, len(model.measured))), jnp.ones(1, bool))  # middle
    inputs = jax.tree.map(lambda a: a[0], model.inputs(row))
    return model.rate(x, inputs, jnp.zeros(len(model.system.coordinates)))


def around(model: StateSpaceModel) -> SearchScales:
    """What a search knows of a two-link arm: sizes of torques, rates and angles, all measured."""
    return SearchScales(
        model.system, np.ones(2), 10 * np.ones(2), np.zeros(2), -3 * np.ones(2), 3 * np.ones(2), np.ones(1),
        ("theta1", "theta2", "dtheta1", "dtheta2"), np.ones(4), 0.01, (0.0, 5.0), 5.0, True, True, ("u",),
    )  # fmt: skip


def right_residual(seed: int, shape: tuple[int, int], dof: int, read: int, **changes) -> Residual:
    """The residual of a right model along moving states: white noise; `shape` is (sequences, rows), `read` the number
    of readings.
    """
    rng = np.random.default_rng(seed)
    sequences, rows = shape
    walk = 0.1 * np.cumsum(rng.normal(size=(*shape, 2 * dof)), axis=1)
    forces = np.zeros((*shape, dof))
    return Residual(
        innovation=rng.normal(size=(*shape, read)),
        force=np.concatenate([rng.normal(size=(sequences, rows - 1, dof)), np.full((sequences, 1, dof), np.nan)], 1),
        force_std=forces + 1.0,
        partial_force=forces,
        partial_force_std=forces + 1.0,
        state=walk,
        predicted=walk,
        u=np.sin(0.1 * np.arange(rows) + rng.uniform(0, 6, size=(sequences, 1)))[..., None],
        t=np.tile(0.01 * np.arange(rows), (sequences, 1)),
        valid=np.ones(shape, bool),
        used=np.ones(sequences, bool),
    )._replace(**changes)


def slide() -> tuple[StateSpaceModel, ScoringMStep]:
    """A slide without friction whose mass, 1.2 kg, is known to 0.1 kg, and the rule that fits it."""
    start = Gaussian(jnp.zeros(2), jnp.eye(2))
    body = Slide(m=jnp.asarray(1.2), joints=(1,))
    model = StateSpaceModel(body, NoFriction(jnp.ones(1)), start, jnp.zeros(2), jnp.zeros(2), (0, 1), 0.05)
    prior = ParameterPrior(("m",), jnp.asarray([1.2]), jnp.asarray([0.1]))
    return model, ScoringMStep(prior, jnp.zeros(0), (True, True), (True, True), log_q_prior=model.log_q)


def rig_text(model: str, columns: str | Sequence[str], dt: float = 0.01) -> str:
    """rig.toml of the table [model] and those behind it, with the measured columns, by name or as the table itself."""
    measured = columns if isinstance(columns, str) else json.dumps([*columns])
    sampling = f'[sampling]\ndt = {dt}\ninput_hold = "zero-order"\nclock = "sequence"\n'
    return f'format = 1\nname = "bench"\n[model]\n{model}\n{sampling}[measurement]\ncolumns = {measured}\n'


def file_rig(file: str, columns: Sequence[str], more: str = "", friction: str = "unknown", dt: float = 0.01) -> str:
    """`rig_text` of a machine from a file; `more` continues its table [model]."""
    return rig_text(f'type = "mjcf"\nfile = "{file}"\nfriction = "{friction}"\n{more}', columns, dt)


PENDULUM = 'type = "pendulum"\nm = 0.5\nlc = 0.2\nI = 0.002\ng = 9.81\nfriction = "unknown"\n'


def pendulum_rig(columns: Sequence[str] = ("theta1", "dtheta1"), dt: float = 0.01) -> str:
    """rig.toml of a pendulum with the input `u`, of which these `columns` are measured."""
    return rig_text(f'{PENDULUM}[input]\ncolumns = ["u"]\njoints = [1]', columns, dt)


def chain_rig(columns: str, unknown: str = "") -> str:
    """rig.toml of two states in a chain, written as equations, with these `columns` and `unknown` terms."""
    model = """type = "equations"
inputs = { u = "V" }
states = { a = "V", b = "V" }
rates = { a = "k*u - a/ta", b = "(a - b)/2" }
k = { mean = 1.0, std = 0.3 }
ta = { mean = 4.0, std = 1.0 }
"""
    return rig_text(model + unknown, f"{{ {columns} }}", 0.5)


def servo_model(rig: Rig, effects=()) -> StateSpaceModel:
    """The machine with its servos, without friction."""
    system = build_system(rig)
    states, read = 2 * len(system.coordinates), tuple(range(len(rig.measured)))
    start, servos = Gaussian(jnp.zeros(states), jnp.eye(states)), build_servos(rig) or None
    none = NoFriction(jnp.ones(states // 2))
    model = StateSpaceModel(system, none, start, jnp.zeros(states), jnp.zeros(len(read)), read, rig.dt, servos=servos)
    return with_effects(model, effects)
