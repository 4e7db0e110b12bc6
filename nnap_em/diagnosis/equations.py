"""Search for what equations lack: laws, and pairs of laws where no single one passes, by errors over long horizons.

Every candidate is fitted with all parameters by open-loop errors, whose starts know nothing of the readings that they
predict; the best are fitted again without parts of the recordings, and judged on these parts. A linear screen along
smoothed paths would favour laws of the readings themselves.
"""

import itertools
import math
import time
from collections.abc import Sequence
from typing import Any, NamedTuple, cast

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Bool, Float

from ..data.dataset import Dataset
from ..effects import AbstractEffect, Around, Candidate, SensorEffect, catalogue, flat
from ..effects.equations import PortEffect
from ..em.equations import motion
from ..fit.identify import Identified, fitted_to_horizon
from ..model.state_space import with_effects
from ..prediction_error import simulated
from ..prediction_error.multistep import Grid
from ..storage.log import Log
from .hypothesis import Found, Hypothesis
from .keys import Key, key_of, words
from .outcome import Diagnosis, Step, Suspect
from .trial import certainty
from .verdict import AGREE, CERTAIN, EQUIVALENT

SHARE, PAIR = 0.15, 0.3
"""Shares of the squared error on parts left out that a law, and a pair of laws, must remove."""
SUSPECT = 0.08
"""Share from which on a law is listed as a suspect."""
FOLDS, BLOCKS = 4, 8
"""Parts that are left out in turn, each of every fourth block of the rows."""
SHORTLIST, PARTNERS, JUDGED = 8, 30, 16
"""Laws that are judged on parts left out, laws of which pairs are tried, and pairs that are judged."""
MOST = 3
"""Laws at most, or one more where the last were a pair."""
QUICK, STEPS = 10, 15
"""Steps of a fit in a screen, and of one that is judged."""


class Case(NamedTuple):
    """Laws in the model, fitted."""

    laws: tuple[Candidate, ...]
    of: simulated.Simulated
    loss: float
    """Squared error with the prior."""
    share: float = math.nan
    """Share of the squared error that they remove on parts left out."""
    folds: tuple[float, ...] = ()

    @property
    def effects(self) -> tuple[AbstractEffect, ...]:
        """The laws with their numbers."""
        fitted = self.of.model.effects[len(self.of.model.effects) - len(self.laws) :]
        return tuple(_named(law.start, effect) for law, effect in zip(self.laws, fitted, strict=True))

    @property
    def keys(self) -> tuple[Key, ...]:
        """Their names."""
        return tuple(key_of(law.start) for law in self.laws)


class Search(NamedTuple):
    """Constants of a search."""

    before: Identified
    data: Dataset
    scale: Float[np.ndarray, "1 1 horizon obs"]
    log: Log
    until: float
    begin: Any = None
    """States at all starts, by the model without further laws."""

    def with_laws(self, hypothesis: Hypothesis, laws: Sequence[Candidate], starts: Sequence[Any]) -> Hypothesis:
        """The hypothesis with some laws more, which begin with the numbers of `starts`."""
        for law, start in zip(laws, starts, strict=True):
            lean = Candidate(_lean(law.start, self), (), _lean(law.spread, self))
            hypothesis = hypothesis.plus(_lean(start, self), lean)
        return hypothesis

    def fit(
        self, hypothesis: Hypothesis, every: Sequence[tuple[Sequence[Candidate], Sequence[Any]]], **options: Any
    ) -> list[Case]:
        """The hypothesis with each of some sets of laws, and the numbers that these begin with, fitted."""
        full = [self.with_laws(hypothesis, laws, starts) for laws, starts in every]
        groups: dict[Any, list[int]] = {}
        for i, one in enumerate(full):
            groups.setdefault(jax.tree.structure((one.model, one.m_step.prior)), []).append(i)
        cases: dict[int, Case] = {}
        for places in groups.values():
            models, priors = ([get(full[i]) for i in places] for get in (lambda h: h.model, lambda h: h.m_step.prior))
            fits = simulated.fit_all(models, priors, self.data, scale=self.scale, begin=self.begin, **options)
            for i, of in zip(places, fits, strict=True):
                cases[i] = Case(tuple(every[i][0]), of, self.loss(of) + float(of.z @ of.z))
        return [cases[i] for i in range(len(every))]

    def loss(self, of: simulated.Simulated, counts: Bool[np.ndarray, "seq start #horizon 1"] | None = None) -> float:
        """Squared error of the predictions that count."""
        known = simulated.observed(of)
        return simulated.cost(of.error, self.scale, known if counts is None else known & counts)

    def judged(self, hypothesis: Hypothesis, cases: Sequence[Case], null: Sequence[float]) -> list[Case]:
        """The cases with their errors on parts left out, beside those of `null` on each."""
        out = []
        for case, left in zip(cases, self.left_out(hypothesis, cases), strict=True):
            gains = tuple(1 - b / max(a, 1e-12) for a, b in zip(null, left, strict=True))
            out.append(case._replace(share=1 - sum(left) / max(sum(null), 1e-12), folds=gains))
        return out

    def left_out(self, hypothesis: Hypothesis, cases: Sequence[Case]) -> list[list[float]]:
        """Squared errors of every case on every part by the fit to the others."""
        every, out = [(case.laws, case.effects) for case in cases], [[] for _ in cases]
        for counts in folds(simulated.grid(self.before.model, self.data), *self.data.t.shape) if cases else ():
            for errors, case in zip(out, self.fit(hypothesis, every, counts=~counts, steps=STEPS), strict=True):
                errors.append(self.loss(case.of, counts))
        return out


def folds(at: Grid, sequences: int, rows: int) -> list[Bool[np.ndarray, "seq start horizon 1"]]:
    """Masks of the errors of every part, by the rows whose readings are predicted: a fit without a part has none of
    its readings, although predictions that it counts pass over it.  Blocks go on over all sequences.
    """
    row = at.starts(rows)[:, None] + np.asarray(at.ages)[None]
    block = (np.arange(sequences)[:, None, None] * rows + row) * BLOCKS // (sequences * rows)
    return [(block % FOLDS == part)[..., None] for part in range(FOLDS)]


def _lean(effect: AbstractEffect, search: Search) -> AbstractEffect:
    """A law as the formula that all laws of ports share: one program for all."""
    flow = getattr(effect, "flow", None)
    return flow(search.before.model.system) if flow else effect


def _named(law: AbstractEffect, fitted: AbstractEffect) -> AbstractEffect:
    """The law with the numbers of its fit."""
    if not hasattr(law, "flow"):
        return fitted
    numbers = lambda e: (e.strength, e.level, e.share)  # noqa: E731
    return eqx.tree_at(numbers, law, numbers(fitted))


def around_of(fitted: Identified, data: Dataset) -> Around:
    """Ranges of states, inputs and readings by a simulation of the fit."""
    model, rig = fitted.model, fitted.rig
    seen, valid = motion(model, data), np.asarray(data.valid)
    low, high = np.percentile(seen.x, [0.5, 99.5], axis=0)[:, : len(model.system.states)]
    u, y, t = (np.asarray(a)[valid] for a in (data.u, data.y, data.t))
    ends = [(float(np.nanmin(one)), float(np.nanmax(one))) for one in y.T]
    pairs = zip(model.system.states, low, high, strict=True)
    sizes = {name: (float(a), float(b)) for name, a, b in pairs if b > a}
    sizes |= {
        name: (float(a.min()), float(a.max())) for name, a in zip(rig.input_columns, u.T, strict=True) if np.ptp(a)
    }
    none = np.zeros(0)
    return Around(
        model.system, np.asarray(cast(Any, model.unknown).scale), none, none, low, high, none,
        rig.measured, np.array([b - a for a, b in ends]), rig.dt, (float(t.min()), float(t.max())), float(t.max()),
        rig.clock == "session", False, rig.input_columns, sizes, tuple(ends),
    )  # fmt: skip


def search_equations(before: Identified, data: Dataset, log: Log, until: float = math.inf) -> Diagnosis:
    """Laws that equations lack, added and fitted, one or two at a time, until none passes on parts left out."""
    hypothesis = Hypothesis(before.model, before.m_step, (None,) * len(before.model.effects))
    declared = len(before.model.effects)
    first = simulated.simulated(before.model, before.m_step.prior, data)
    search = Search(before, data, simulated.scale_of(first.error), log, until)
    around, steps, complete, left = around_of(before, data), [], True, 1.0
    kinds = [kind for kind in catalogue.values() if issubclass(kind, PortEffect | SensorEffect)]
    every = [candidate for kind in kinds for candidate in kind.candidates(around)]
    while len(hypothesis.model.effects) - declared < MOST:
        if time.monotonic() > until:
            complete = False
            break
        chosen, even, step = _round(search, hypothesis, every, left)
        steps.append(step)
        if chosen is None:
            break
        left *= 1 - chosen.share
        for law, effect in zip(chosen.laws, chosen.effects, strict=True):
            record = Found(math.nan, math.nan, math.nan, even, chosen.share, chosen.share)
            hypothesis = hypothesis.plus(effect, law, record)
            log(f"  added {words(key_of(effect))}")
        hypothesis = hypothesis.refitted(_with_numbers(hypothesis, chosen))
    if len(hypothesis.model.effects) == declared:
        return Diagnosis(before, before, (), tuple(steps), complete=complete)
    state = before.state._replace(best=hypothesis.model)
    after = fitted_to_horizon(before._replace(state=state, m_step=hypothesis.m_step), data)
    return Diagnosis(before, after, hypothesis.found, tuple(steps), complete=complete)  # type: ignore[arg-type]


def _with_numbers(hypothesis: Hypothesis, case: Case) -> Any:
    """The model of the hypothesis with the parameters of the case."""
    lean = case.of.model
    effects = tuple(_named(e, o) for e, o in zip(hypothesis.model.effects, lean.effects, strict=True))
    return eqx.tree_at(lambda m: m.system, with_effects(hypothesis.model, effects), lean.system)


def _round(
    search: Search, hypothesis: Hypothesis, every: Sequence[Candidate], remaining: float
) -> tuple[Case | None, tuple[Key, ...], Step]:
    """The laws that pass, if any do, single ones first, then pairs; and single ones that explain the same.

    Of the first error a share `remaining` is left, and a later law must remove as much of the first as a first one.
    """
    lean = hypothesis.refitted(
        with_effects(hypothesis.model, tuple(_lean(effect, search) for effect in hypothesis.model.effects))
    )
    search = search._replace(begin=simulated.filtered(lean.model, search.data))
    present = {key_of(effect) for effect in hypothesis.model.effects}
    null = search.fit(lean, [((), ())])[0]
    base = search.left_out(lean, [null])[0]
    fresh = [c for c in every if key_of(c.start) not in present]
    log, rows = search.log, search.data.t.shape[1]
    log(f"{len(fresh)} candidates; squared error {null.loss:.1f}, {sum(base):.1f} on parts left out")
    cases = search.fit(lean, [((c,), c.probes[:1]) for c in fresh], steps=QUICK)
    singles = _best_of_keys(sorted(cases, key=lambda case: case.loss))
    judged = search.judged(lean, singles[:SHORTLIST], base)
    for case in judged:
        _report(search, case)
    passing, tried = [case for case in judged if _passes(case, SHARE / remaining)], [*judged]
    if not passing and remaining > PAIR and time.monotonic() < search.until:
        both = itertools.combinations(singles[:PARTNERS], 2)
        joined = [((*a.laws, *b.laws), (*a.effects, *b.effects)) for a, b in both]
        pairs = sorted(search.fit(lean, joined, steps=QUICK), key=lambda case: case.loss)
        pairs = search.judged(lean, [case for case in pairs if _sound(case)][:JUDGED], base)
        for case in pairs:
            _report(search, case)
        passing = [case for case in pairs if _passes(case, PAIR / remaining)]
        tried += pairs
    listed = tuple((case.keys[0], 1 - case.loss / null.loss) for case in singles)
    refitted = tuple((case.keys[-1], case.share) for case in tried)
    best = _chosen(passing)
    suspects = ()
    if best is None:
        near = sorted((c for c in judged if c.share > SUSPECT and _sound(c)), key=lambda c: -c.share)
        suspects = tuple(Suspect(case.keys[0], case.share, 0.0) for case in near[:4])
    accepted = best.keys[0] if best else None
    step = Step(rows, listed, refitted, accepted, len(fresh), "share of the squared error", suspects=suspects)
    even = [case for case in passing if best and len(case.laws) == 1 and case.share >= EQUIVALENT * best.share]
    return best, tuple(case.keys[0] for case in even if case is not best), step


def _best_of_keys(cases: Sequence[Case]) -> list[Case]:
    """The best case of every law, best first."""
    best: dict[tuple[Key, ...], Case] = {}
    for case in cases:
        best.setdefault(case.keys, case)
    return list(best.values())


def _sound(case: Case) -> bool:
    """True for physical values that differ from none."""
    return all(effect.possible() for effect in case.effects)


def _passes(case: Case, share: float) -> bool:
    """True where the parts left out confirm that the laws remove a share of the squared error."""
    agree = sum(gain > 0 for gain in case.folds) >= AGREE * len(case.folds)
    return case.share >= share and agree and _sound(case) and _certain(case)


def _certain(case: Case) -> bool:
    """True where every strength differs from none."""
    cov = np.linalg.inv(simulated.precision(case.of, simulated.scale_of(case.of.error)))
    std, size = np.asarray(case.of.prior.std), sum(flat(law.start).size for law in case.laws)
    cov, place = (cov * np.outer(std, std))[-size:, -size:], 0
    for law, effect in zip(case.laws, case.effects, strict=True):
        part = slice(place, place := place + flat(law.start).size)
        if certainty(law, effect, cov[part, part]) < CERTAIN / 2:
            return False
    return True


def _chosen(passing: Sequence[Case]) -> Case | None:
    """The case of the largest share; of those even with it the one of the fewest numbers."""
    if not passing:
        return None
    top = max(case.share for case in passing)
    even = [case for case in passing if case.share >= EQUIVALENT * top]
    return min(even, key=lambda case: (sum(len(law.start.values()) for law in case.laws), -case.share))


def _report(search: Search, case: Case) -> None:
    values = ["; ".join(f"{n} {float(v):.3g}" for n, v in effect.values().items()) for effect in case.effects]
    laws = " and ".join(f"{words(key)} ({value})" for key, value in zip(case.keys, values, strict=True))
    search.log(f"  {laws}: {case.share:.0%} of the squared error on parts left out")
