"""False alarms and found changes of `nnap-em compare`: the numbers of docs/compare.md.

python benchmarks/compare.py [--pairs 40]

A simulated slide whose mass is known to 10 % is fitted twice with unchanged friction, and once more with Coulomb and
breakaway friction that grew by some share of the Coulomb friction.
"""

import argparse
import dataclasses
import platform
from datetime import date

import equinox as eqx
import jax

from nnap_em import Identified, compare, identify
from nnap_em.comparison.compare import CHANGED
from nnap_em.data.rig import Declared
from nnap_em.model.simulate import declared, examples, sweep_experiment
from nnap_em.model.state_space import StateSpaceModel

SEQUENCES, STEPS, EPOCHS = 8, 150, 12
SHARES = (0.02, 0.05, 0.15)


def grown(model: StateSpaceModel, share: float) -> StateSpaceModel:
    """The slide with more dry friction."""
    friction = lambda m: (m.unknown.coulomb, m.unknown.breakaway)  # noqa: E731
    return eqx.tree_at(friction, model, [level + share * model.unknown.coulomb for level in friction(model)])


def fit(model: StateSpaceModel, seed: int) -> Identified:
    """Eight sequences of 1.5 s, identified."""
    sweep = examples["slide"]().sweep
    rig = dataclasses.replace(declared("slide", model), parameters={"m": Declared(1.0, 0.1)})
    data = sweep_experiment(model, sweep, SEQUENCES, STEPS, key=jax.random.key(seed)).data
    return identify(rig, data, key=jax.random.key(0), epochs=EPOCHS)


def main() -> None:
    """Print the table."""
    jax.config.update("jax_enable_x64", True)
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--pairs", type=int, default=40, help="of unchanged slides; half as many of each change (40)")
    pairs, truth = options.parse_args().pairs, examples["slide"]().model
    print(f"{date.today()}, {platform.machine()}, jax {jax.__version__}, level {CHANGED}\n")
    print("| Coulomb friction grew by | pairs | friction named | mass named |\n| --- | --- | --- | --- |")
    base = [fit(truth, 100 + i) for i in range(2 * pairs)]
    rows = {0.0: list(zip(base[::2], base[1::2], strict=True))}
    for share in SHARES:
        rows[share] = [(base[i], fit(grown(truth, share), 900 + i)) for i in range(pairs // 2)]
    for share, fits in rows.items():
        changes = [compare(*pair, names=("before", "after")).changed for pair in fits]
        friction, mass = (sum(name in changed for changed in changes) for name in ("friction of joint 1", "m"))
        print(f"| {share:.0%} | {len(fits)} | {friction} | {mass} |")


if __name__ == "__main__":
    main()
