"""Write a data set with known truth.

examples:
  nnap-em simulate bench
  nnap-em simulate bench --system slide --sequences 8 --test 4 --steps 300 --seed 7
  nnap-em simulate bench --measured theta1 --measurement-noise 0.005 0.05

OUT gets rig.toml, train/, test/, and truth/ with all states and the true friction.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from ..base.digits import counted
from ..base.files import whole_folder
from ..base.log import Log
from ..errors import DataError
from ..logs.formats import write_csv
from ..machines.rig import Rig, nearest, write_rig
from ..machines.systems import specs
from ..model.simulate import Experiment, declared, examples, sensed, sweep_experiment
from ..model.state_space import StateSpaceModel
from ..output.report.tables import visited_nodes, write_friction


def run(args: argparse.Namespace, log: Log) -> None:
    """Write it, whole or not at all."""
    with whole_folder(args.out) as part:
        model, sweep = examples[args.system]()
        measured = args.measured and _states(args.measured, specs[args.system].states)
        model = sensed(model, measured, args.process_noise, args.measurement_noise)
        count, key = args.sequences + args.test, jax.random.key(args.seed)
        experiment = sweep_experiment(model, sweep, count, args.steps, key=key)
        _write(part, model, declared(args.system, model), experiment, args.sequences)
    log(f"wrote {args.sequences} training and {counted(args.test, 'test sequence')} to {args.out}")


def _states(names: Sequence[str], states: Sequence[str]) -> tuple[str, ...]:
    for name in names:
        if name not in states:
            raise DataError(f"--measured {name}: no state of this system; {nearest(name, states)}")
    if len(set(names)) < len(names):
        raise DataError(f"--measured {' '.join(names)}: a state stands there twice; name each once")
    return tuple(names)


def _write(folder: Path, model: StateSpaceModel, rig: Rig, experiment: Experiment, training: int) -> None:
    write_rig(rig, folder / "rig.toml")
    system, dof = model.system, len(model.system.rates)
    for i, x in enumerate(np.asarray(experiment.x)):
        t, u, y, _ = (np.asarray(a[i]) for a in experiment.data)
        known = {"time": t} | dict(zip(rig.input_columns, u.T, strict=True))
        file = f"train/{i:03d}.csv" if i < training else f"test/{i - training:03d}.csv"
        write_csv(folder / file, known | dict(zip(rig.measured, y.T, strict=True)))
        write_csv(folder / "truth" / file, known | dict(zip(system.coordinates + system.rates, x.T, strict=True)))
    velocity = visited_nodes(np.asarray(experiment.x)[..., dof:].reshape(-1, dof))
    torque = np.asarray(jax.vmap(model.unknown)(jnp.asarray(velocity.T)).T)
    write_friction(folder / "truth" / "friction.csv", velocity, torque, np.zeros_like(torque))
