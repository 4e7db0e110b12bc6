"""What is a designed experiment worth?  Played on `examples/plant.py`, which shares no code with the library.

    python benchmarks/design.py friction --seeds 5 --out OUT     # some three minutes a seed, half a core
    python benchmarks/design.py apart --seeds 5 --out OUT        # half an hour a seed; --quick is shorter
    python benchmarks/design.py friction --rate 4 --out OUT      # torque may change 4 times as fast as in the logs
    python benchmarks/design.py table --out OUT                  # the tables of docs/results/design.md

friction: an acrobot whose joint 1 is measured alone, 30 s of sines.  Then 30 s more, designed or of the same sines: how
wide is the friction band near rest (the lowest fifth of the velocities in the first logs) as stated, and how far is it
from the truth?

apart: two laws that 30 s of sines leave equivalent, then 30 s designed: which is named?
"""

import argparse
import dataclasses
import json
import math
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
from nnap_em.commands import common
from nnap_em.data.dataset import Dataset, pad
from nnap_em.data.limits import Bounds
from nnap_em.diagnosis.rivals import with_rival
from nnap_em.experiment.criteria import after
from nnap_em.experiment.experiment import Design, design
from nnap_em.experiment.rivals import Law, Rivals
from nnap_em.fit.identify import Identified, friction_table, identify
from nnap_em.storage.files import cores, replace_text

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


def allowed(fits: list[Identified], first: Dataset, rate: float | None) -> list[Identified]:
    """The fits, whose owner lets torque change `rate` times as fast as it did in the logs; None: as fast."""
    if rate is None:
        return fits
    rig = fits[0].rig
    top = rate * float(np.abs(np.diff(first.u, axis=1)).max()) / rig.dt
    rig = dataclasses.replace(rig, limits=Bounds(rate={column: (-top, top) for column in rig.input_columns}))
    return [fit._replace(rig=rig) for fit in fits]


def friction(seed: int, out: Path, quick: bool = False, rate: float | None = None) -> dict[str, Any]:
    """One rig; there is no quick run."""
    case = plant.Case(sequences=2 * SEQUENCES, tests=1, torque="sine", seed=seed)
    rig, data = logs(case, out / f"rig_{seed}")
    first, key = some(data, slice(SEQUENCES)), jax.random.key(seed)
    (base,) = allowed([identify(rig, first, key=key)], first, rate)
    began = time.perf_counter()
    designed = design(base, first, key=key, question="friction", seconds=5.0 * SEQUENCES, sequences=SEQUENCES)
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


HALVES = 6
"""Strengths that are tried, each half of the one before, until the first logs leave a pair equivalent."""
PAIRS = {
    "delay or lag": (Law("input_delay", 2), Law("actuator_lag", 2)),
    "gain or saturation": (Law("motor_gain", 2), Law("saturation", 2)),
    "brake or friction by position": (Law("eddy_brake", 2), Law("position_dependent_friction", 2)),
    "tilt or spring": (Law("base_tilt"), Law("torsional_spring", 1)),
    "payload or centre of mass": (Law("payload", 2), Law("center_of_mass", 2)),
}
EVEN = 5.0
"""Log-likelihood [nat] within which two laws are equivalent, as in a diagnosis."""
STRENGTH = {"delay": 1, "tau": 1, "mass": 1, "dlc": 1, "angle": 1, "k": 1, "c": 1, "depth": 1}
"""Parameters that are halved; of gain and limit it is what they take away."""


def weaker(effect: dict[str, Any], share: float, top: float) -> dict[str, Any]:
    """An effect a share as strong, where the largest input is `top`."""
    out = dict(effect)
    for name, value in effect.items():
        if name in STRENGTH:
            out[name] = share * value
        elif name == "gain":
            out[name] = 1 - share * (1 - value)
        elif name == "limit":
            out[name] = top - share * (top - value)
    return out


def ahead(rig, data: Dataset, laws, key) -> tuple[float, list[Identified], list[float]]:
    """Log-likelihood of the first law over the second [nat], both fits, and by how much each is above none."""
    base = identify(rig, data, key=key)
    fits = [with_rival(base, data, None, law.means) for law in laws]
    none, *tops = (float(np.sum(np.nan_to_num(np.asarray(fit.state.top), nan=-1e6))) for fit in (base, *fits))
    return tops[0] - tops[1], fits, [top - none for top in tops]


def apart(seed: int, out: Path, quick: bool = False, rate: float | None = None) -> dict[str, Any]:
    """All pairs, either law as the true one; a quick run leaves out what 30 s more of the same inputs tell."""
    out = out if rate is None else out.with_name(f"{out.name}_{rate:g}")
    rows = []
    for name, both in PAIRS.items():
        for turn in (both, both[::-1]):
            file = out / f"{seed}_{name}_{turn[0].name}.json".replace(" ", "_")
            if not file.exists():
                row = _discriminated(seed, name, turn, out, quick, rate)
                print(row, flush=True)
                replace_text(file, json.dumps(row) + "\n")
            rows.append(json.loads(file.read_text()))
    return {"seed": seed, "rows": rows}


def _discriminated(
    seed: int, name: str, laws: tuple[Law, Law], out: Path, quick: bool, rate: float | None
) -> dict[str, Any]:
    """A rig with the first law: what the first logs say, more of them, and a design."""
    key = jax.random.key(seed)
    spring = {"name": "torsional_spring", "joint": 1, "k": 0.06, "theta0": 0.0}
    (strong,) = plant.STRONG[laws[0].name] if laws[0].name != "torsional_spring" else (spring,)
    bare = plant.Case(sequences=2 * SEQUENCES, tests=1, torque="sine", seed=seed)
    top = float(np.abs(plant.torques(bare)[:SEQUENCES]).max())
    for n in range(HALVES):
        effect = weaker(strong | ({"joint": laws[0].joint} if laws[0].joint else {}), 0.5 ** (n + 1), top)
        case = bare._replace(effects=(effect,))
        rig, data = logs(case, out / "rig")
        first = some(data, slice(SEQUENCES))
        lead, fits, worth = ahead(rig, first, laws, key)
        if abs(lead) < EVEN:
            break
    row = {"pair": name, "true": laws[0].name, "effect": effect, "first": lead, "over_none": worth}
    row |= {"more": math.nan, "designed": math.nan}
    if abs(lead) >= EVEN:
        return row
    own, other = (0, 1) if lead > 0 else (1, 0)  # a diagnosis holds the likelier one
    pair = Rivals((str(laws[own]), str(laws[other])), fits[own], fits[other])
    began = time.perf_counter()
    fits = allowed(fits, first, rate)
    designed = design(
        fits[own], first, key=key, question="discriminate", rivals=[pair], seconds=5.0 * SEQUENCES, sequences=SEQUENCES
    )
    assert designed.discrimination is not None
    seconds, (_, new) = time.perf_counter() - began, play(case, designed, seed)
    leads = ahead(rig, joined(first, new), laws, key)[0]
    more = math.nan if quick else ahead(rig, data, laws, key)[0]
    far = {
        side: designed.discrimination.distance(t).tolist()
        for side, t in (("designed", designed.expected), ("old", designed.old))
    }
    return row | {"more": more, "designed": leads, "distance": far, "design_s": seconds}


JOBS = {"friction": friction, "apart": apart}


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
    lines += [
        "| seed | pair | true | lead of the true law [nat]: 30 s, 30 s more, designed |",
        "| --- | --- | --- | --- |",
    ]
    counts: dict[str, list[bool]] = {}
    for path in sorted(out.glob("apart*/*.json")):
        row, kind = json.loads(path.read_text()), path.parent.name
        if not math.isnan(row["designed"]):
            counts.setdefault(kind, []).append(row["designed"] >= EVEN)
        leads = ", ".join("-" if math.isnan(row[s]) else f"{row[s]:.1f}" for s in ("first", "more", "designed"))
        lines.append(f"| {kind} {path.name.split('_')[0]} | {row['pair']} | {row['true']} | {leads} |")
    right = (
        f"{kind}: discriminated and named right {sum(each)} of the {len(each)} left open."
        for kind, each in counts.items()
    )
    return "\n".join([*lines, "", *right])


def main() -> None:
    """Run a job for some seeds; what is done is kept."""
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("job", choices=[*JOBS, "table"])
    arguments.add_argument("--seeds", type=int, default=5)
    arguments.add_argument("--out", type=Path, required=True)
    arguments.add_argument("--rate", type=float, help="torque may change so many times as fast as in the logs")
    arguments.add_argument("--quick", action="store_true", help="apart without what 30 s more of the same inputs tell")
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
            row = JOBS[args.job](seed, args.out / args.job, args.quick, args.rate)
            row |= {
                "seconds": time.perf_counter() - began,
                "date": str(date.today()),
                "machine": f"{platform.machine()}, {cores()} cores",
            }
            replace_text(file, json.dumps(row, indent=1) + "\n")
        print(file.read_text(), flush=True)


if __name__ == "__main__":
    main()
