"""The slide that many tests fit: its declaration and its logs, whose one shape makes one set of programs."""

import dataclasses

import equinox as eqx
import jax

from nnap_em.logs.dataset import Dataset
from nnap_em.machines.rig import Declared, Rig
from nnap_em.model.effects.base import AbstractEffect
from nnap_em.model.simulate import declared, examples, sweep_experiment
from nnap_em.model.state_space import with_effects


def slide_rig(friction: bool = True) -> Rig:
    """A slide of 1 kg, declared as 1.1 ± 0.1 kg, of which the position is read; its friction is unknown or none."""
    truth, _ = examples["slide"]()
    return dataclasses.replace(declared("slide", truth), parameters={"m": Declared(1.1, 0.1)}, friction=friction)


def slide_logs(
    seed: int,
    more: float = 0.0,
    sequences: int = 8,
    steps: int = 95,
    *,
    frictionless: bool = False,
    laws: tuple[AbstractEffect, ...] = (),
) -> Dataset:
    """Logs of that slide, swept; its dry friction has grown by `more` [N], or it has none, and `laws` act beside it."""
    truth, sweep = examples["slide"]()
    law = truth.unknown
    if frictionless:
        law = jax.tree.map(lambda a: 0 * a if a is not law.stribeck and a is not law.smooth else a, law)
        truth = eqx.tree_at(lambda m: m.unknown, truth, law)
    grown = eqx.tree_at(
        lambda m: (m.unknown.coulomb, m.unknown.breakaway), truth, (law.coulomb + more, law.breakaway + more)
    )
    return sweep_experiment(with_effects(grown, laws), sweep, sequences, steps, key=jax.random.key(seed)).data
