"""What a fit with the true law in it errs on planted effects: the error that can be reached.

    python benchmarks/planted_truth.py out/planted docs/results/planted_truth.csv [RIG ...]

The fit of a rig as recorded with the planted law at its true numbers, on the test recordings with the effect in them,
beside what the records of `planted.py run` say. A machine with a cogging is another machine than that without: where
the cogging is as steep as gravity, the same error of its friction grows faster. Laws with numbers of their own.
"""

import csv
import json
import sys
import tempfile
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from planted_make import DATA, make
from planted_table import HORIZONS, errors
from scipy.linalg import block_diag
from scipy.optimize import least_squares

import nnap_em
from nnap_em.estimate.identify import Identified
from nnap_em.estimate.predict import given_of
from nnap_em.explain.diagnosis.hypothesis import Hypothesis, declared
from nnap_em.explain.diagnosis.propose import surroundings
from nnap_em.explain.diagnosis.smoothed import along
from nnap_em.logs.dataset import Dataset
from nnap_em.logs.read import sequences_of
from nnap_em.model.effects import Candidate, catalogue

SURE = 1e8
"""Precision of true numbers, over that of their prior."""


def _at(candidate: Candidate, true: dict[str, float]) -> Candidate | None:
    """The candidate at its true numbers; None where a law of its form has others."""
    moving, still = eqx.partition(candidate.probes[0], eqx.is_inexact_array)
    first, whole = ravel_pytree(moving)
    law = lambda x: eqx.combine(whole(jnp.asarray(x)), still)  # noqa: E731
    if not set(true) <= set(law(first).values()):
        return None

    def apart(x) -> list[float]:
        off = {name: float(law(x).values()[name]) - value for name, value in true.items()}
        return [2 * np.sin(d / 2) if name == "phase" else d for name, d in off.items()]

    best = least_squares(apart, np.asarray(first), xtol=1e-14, ftol=1e-14, gtol=1e-14)
    return candidate._replace(start=law(best.x)) if best.cost < 1e-10 else None


def true_fit(fit: Identified, train: Dataset, effects: list) -> Identified | None:
    """A fit of a rig as recorded with true laws in it; None where one has no numbers of its own."""
    seen = along(fit, train, fit.smoother)
    around = surroundings(fit.rig, fit.model, seen.data, seen.path, seen.rows, change=False)
    with_laws: Hypothesis = declared(fit)
    for effect in effects:
        place = effect.get("joint"), effect.get("channel")
        every = catalogue[effect["name"]].candidates(around)
        forms = (_at(c, effect["parameters"]) for c in every if (c.start.joint, c.start.channel) == place)
        form = next((form for form in forms if form is not None), None)
        if form is None:
            return None
        with_laws = with_laws.plus(form.start, form)
    more = with_laws.m_step.prior.size - fit.m_step.prior.size
    hessian = jnp.asarray(block_diag(fit.state.hessian, SURE * np.eye(more)))
    state = fit.state._replace(best=with_laws.model, hessian=hessian)
    return fit._replace(m_step=with_laws.m_step, state=state)


def predicted(fit: Identified, test: Dataset) -> tuple[float, ...]:
    """Errors of the measured angles together at the horizons [rad]."""
    given = given_of(fit)
    prediction = nnap_em.predict(fit, test, given, key=jax.random.key(0))
    found = nnap_em.horizon_errors(prediction, fit, test, given, HORIZONS)
    return errors({"error": {"horizons_s": list(HORIZONS), "true": found}}, "true")


def rows(name: str, folder: Path):
    """A line for each case of a rig."""
    rig = nnap_em.read_rig(DATA / name / "rig.toml")
    logs = lambda path: sequences_of(nnap_em.read_logs(path, rig), rig)  # noqa: E731
    train, kept = logs(DATA / name / "train"), folder / "fits" / f"{name}.npz"
    if not kept.exists():
        kept.parent.mkdir(exist_ok=True)
        nnap_em.save(kept, nnap_em.diagnose(rig, train, key=jax.random.key(0), seconds=0).before)
    for path in sorted(folder.glob(f"{name}-*.json")):
        record = json.loads(path.read_text())
        laws = record["truth"]["effects"]
        with tempfile.TemporaryDirectory() as case:
            make(record["case"], Path(case, "case"))
            test = logs(Path(case, "case", "test"))
        if laws and (fit := true_fit(nnap_em.load(kept), train, laws)):
            true, after = predicted(fit, test), errors(record["report"], "after")
            ratio = max(a / b for a, b in zip(after, true, strict=True))
            yield [record["case"], *(f"{e:.3g}" for e in (*true, *after)), f"{ratio:.2f}", record["code"]]


def main(folder: Path, out: Path, *names: str) -> None:
    """Write the table of some rigs, or of all of which there are records."""
    jax.config.update("jax_enable_x64", True)
    every = {json.loads(path.read_text())["truth"]["rig"] for path in folder.glob("*.json")}
    with out.open("w") as file:
        table = csv.writer(file, lineterminator="\n")
        errors_of = [f"{side} at {h:g} s [rad]" for side in ("true law", "found") for h in HORIZONS]
        table.writerow(["case", *errors_of, "largest ratio", "commit of the found"])
        for name in names or sorted(every):
            for row in rows(name, folder):
                table.writerow(row)
                file.flush()
                print(" | ".join(row), flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), *sys.argv[3:])
