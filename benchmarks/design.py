"""What is a designed experiment worth?  Played on `examples/plant.py`, which shares no code with the library.

    python benchmarks/design.py friction --seeds 5 --out OUT     # some three minutes a seed, half a core
    python benchmarks/design.py friction --rate 4 --out OUT      # torque may change 4 times as fast as in the logs
    python benchmarks/design.py table --out OUT                  # the tables of docs/results/design.md

friction: an acrobot whose joint 1 is measured alone, 30 s of sines.  Then 30 s more, designed or of the same sines: how
wide is the friction band near rest (the lowest fifth of the velocities in the first logs) as stated, and how far is it
from the truth?
"""

import argparse
import dataclasses
import json
import platform
import time
from datetime import date
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import plant

import nnap_em
from nnap_em.base.files import cores, replace_text
from nnap_em.cli import common
from nnap_em.estimate.identify import Identified, friction_table, identify
from nnap_em.explain.design.criteria import after
from nnap_em.explain.design.experiment import Design, design
from nnap_em.logs.dataset import Dataset, pad
from nnap_em.machines.limits import Bounds

SEQUENCES = 6
"""Of 5 s: 30 s."""
PLAYS = 17
"""How often the machine plays a design, for limits: 6 sequences and 5 seeds make 510."""


def logs(case: plant.Case, folder: Path):
    """The rig, and its training logs."""
    plant.write(case, folder)
    rig = nnap_em.read_rig(folder / "rig.toml")
    return rig, nnap_em.read_logs(folder / "train", rig).data


def play(case: plant.Case, designed: Design, seed: int) -> tuple[np.ndarray, Dataset]:
    """What the machine does with a design: its states, and the logs of it."""
    machine, rng = plant.build(case), np.random.default_rng([seed, 7])
    u = designed.u[..., 0]
    start = designed.start + rng.standard_normal(designed.start.shape) * [0.03, 0.03, 0.0, 0.0]
    x = plant.simulate(machine, start, u, np.zeros(len(u)), case.process * rng.standard_normal((*u.shape, machine.dof)))
    y = plant.readings(machine._replace(case=case._replace(seed=10_000 + seed)), x)
    return x, pad([(designed.t, a[:, None], b) for a, b in zip(u, y, strict=True)])


def joined(*parts: Dataset) -> Dataset:
    """Sequences of equal length."""
    return Dataset(*(np.concatenate([np.asarray(getattr(p, name)) for p in parts]) for name in Dataset._fields))


def some(data: Dataset, which: slice) -> Dataset:
    """A part of the sequences."""
    return Dataset(*(np.asarray(a)[which] for a in data))


def near_rest(case: plant.Case, fitted: Identified, grid: np.ndarray) -> dict[str, list[float]]:
    """Stated and true error of friction, rms over `grid`, for every joint."""
    table, machine = friction_table(fitted, jnp.asarray(grid)), plant.build(case)
    pairs = zip(machine.friction, grid, strict=True)
    truth = np.stack([plant.friction_torque(case.friction_shape, f, v) for f, v in pairs])
    rms = lambda a: np.sqrt(np.mean(np.asarray(a) ** 2, axis=1)).tolist()  # noqa: E731
    return {"stated": rms(table.std), "true": rms(np.asarray(table.torque) - truth)}


def expected(designed: Design, information, grid: np.ndarray) -> list[float]:
    """The band that a design promises, rms over `grid`."""
    nodes = np.asarray(designed.fit.nodes)
    cov = after(np.asarray(designed.fit.cov), information.information)[: nodes.size, : nodes.size]
    out = []
    for j, v in enumerate(grid):
        weights = np.stack([np.interp(v, nodes[j], row) for row in np.eye(nodes.shape[1])], axis=1)
        block = cov[j * nodes.shape[1] : (j + 1) * nodes.shape[1], j * nodes.shape[1] : (j + 1) * nodes.shape[1]]
        out.append(float(np.sqrt(np.mean(np.einsum("vi,ij,vj->v", weights, block, weights)))))
    return out


def broken(designed: Design, x: np.ndarray) -> list[bool]:
    """Which sequences leave the limits."""
    low, high = designed.limits.lowest, designed.limits.highest
    u, most = designed.u, designed.limits.rate * (designed.t[1] - designed.t[0])
    tame = (u >= designed.limits.low - 1e-9).all((1, 2)) & (u <= designed.limits.high + 1e-9).all((1, 2))
    tame &= (np.abs(np.diff(u, axis=1)) <= most + 1e-9).all((1, 2))
    return (~(tame & (x >= low).all((1, 2)) & (x <= high).all((1, 2)))).tolist()


def allowed(fit: Identified, first: Dataset, rate: float | None) -> Identified:
    """The fit, whose owner lets torque change `rate` times as fast as it did in the logs; None: as fast."""
    if rate is None:
        return fit
    rig = fit.rig
    top = rate * float(np.abs(np.diff(first.u, axis=1)).max()) / rig.dt
    rig = dataclasses.replace(rig, limits=Bounds(rate={column: (-top, top) for column in rig.input_columns}))
    return fit._replace(rig=rig)


def friction(seed: int, out: Path, rate: float | None) -> dict[str, Any]:
    """One rig."""
    case = plant.Case(sequences=2 * SEQUENCES, tests=1, torque="sine", seed=seed)
    rig, data = logs(case, out / f"rig_{seed}")
    first, key = some(data, slice(SEQUENCES)), jax.random.key(seed)
    base = allowed(identify(rig, first, key=key), first, rate)
    began = time.perf_counter()
    designed = design(base, first, key=key, seconds=5.0 * SEQUENCES, sequences=SEQUENCES)
    seconds = time.perf_counter() - began
    _, new = play(case, designed, seed)
    fits = {"first": base, "more": identify(rig, data, key=key), "designed": identify(rig, joined(first, new), key=key)}
    grid = np.linspace(-designed.slow, designed.slow, 41).T
    plays = [b for n in range(PLAYS) for b in broken(designed, play(case, designed, 100 * seed + n)[0])]
    return {
        "seed": seed,
        "design_s": seconds,
        **{name: near_rest(case, fitted, grid) for name, fitted in fits.items()},
        "expected": {
            "designed": expected(designed, designed.expected, grid),
            "more": expected(designed, designed.old, grid),
        },
        "broken": int(np.sum(plays)),
        "plays": len(plays),
    }


def _near_rest_table(kind: str, rows: list[dict[str, Any]]) -> list[str]:
    """Bands and errors near rest, of designs with one allowance for the rate of torque."""
    lines = [
        f"{kind}:",
        "",
        "| seed | joint | stated: 30 s, 30 s more, designed [mN m] | ratio | predicted "
        "| true: the same [mN m] | ratio |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    stated, true = [], []
    for row in rows:
        for j in range(len(row["first"]["stated"])):
            sides = {
                kind: [1e3 * row[s][kind][j] for s in ("first", "more", "designed")] for kind in ("stated", "true")
            }
            ratios = {kind: values[2] / values[1] for kind, values in sides.items()}
            stated.append(ratios["stated"])
            true.append(ratios["true"])
            text = {kind: ", ".join(f"{v:.2g}" for v in values) for kind, values in sides.items()}
            predicted = 1e3 * row["expected"]["designed"][j]
            lines.append(
                f"| {row['seed']} | {j + 1} | {text['stated']} | {ratios['stated']:.2f} | {predicted:.2g} "
                f"| {text['true']} | {ratios['true']:.2f} |"
            )
    broken, plays = (sum(row[name] for row in rows) for name in ("broken", "plays"))
    means = f"Mean ratio: stated {np.mean(stated):.2f}, true {np.mean(true):.2f}."
    return [*lines, "", f"{means} Limits broken: {broken} of {plays} sequences played.", ""]


def table(out: Path) -> str:
    """What the files in `out` say, as Markdown."""
    lines = []
    kinds = {path.stem.rsplit("_", 1)[0] for path in out.glob("friction_*.json")}
    for kind in sorted(kinds):
        lines += _near_rest_table(kind, [json.loads(path.read_text()) for path in sorted(out.glob(f"{kind}_?.json"))])
    return "\n".join(lines)


def main() -> None:
    """Run a job for some seeds; what is done is kept."""
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("job", choices=["friction", "table"])
    arguments.add_argument("--seeds", type=int, default=5)
    arguments.add_argument("--out", type=Path, required=True)
    arguments.add_argument("--rate", type=float, help="torque may change so many times as fast as in the logs")
    args = arguments.parse_args()
    if args.job == "table":
        print(table(args.out))
        return
    common.set_up()
    for seed in range(1, args.seeds + 1):
        name = args.job if args.rate is None else f"{args.job}_{args.rate:g}"
        file = args.out / f"{name}_{seed}.json"
        if not file.exists():
            began = time.perf_counter()
            row = friction(seed, args.out / args.job, args.rate)
            row |= {
                "seconds": time.perf_counter() - began,
                "date": str(date.today()),
                "machine": f"{platform.machine()}, {cores()} cores",
            }
            replace_text(file, json.dumps(row, indent=1) + "\n")
        print(file.read_text(), flush=True)


if __name__ == "__main__":
    main()
