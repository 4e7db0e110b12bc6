"""Search for what equations lack: laws, and pairs of laws where no single one passes, by errors over long horizons.

Every candidate is fitted with all parameters by open-loop errors; the best are fitted again without parts of the
recordings, and judged on these. A linear screen along smoothed paths would favour laws of the readings themselves.
"""

import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Bool, Float

from ...base.deadline import TimeUp, late
from ...base.log import Log
from ...estimate.em import simulated
from ...estimate.em.equations import free_term, motion
from ...estimate.identify import Identified, fitted_to_horizon
from ...logs.dataset import Dataset
from ...logs.noise import fast_reading_noise
from ...model.effects import AbstractEffect, Candidate, SearchScales, SensorEffect, catalogue, fields, flat
from ...model.effects.actuator import DriveEffect, MotorGain
from ...model.effects.equations import STRONG, InputBias, SignalEffect, lean, numbered
from ...model.state_space import with_effects
from .hypothesis import Addition, Evidence, Hypothesis, covariances
from .keys import Key, complexity, key_of, words
from .outcome import Step, Suspect
from .search import Method, Round
from .trial import certainty
from .verdict import AGREE, DETERMINED, EQUIVALENT, EQUIVALENT_NATS, MULTI_STEP, NAMED, WORSE, agreed, even, suspected

FOLDS, BLOCKS = 4, 16
"""Parts that are left out in turn, each of every fourth block of the rows: of twice as long ones the real tanks have
too few with an overflow, which then explains 0.16 of what is left out instead of 0.37."""
SHORTLIST, FREE, PARTNERS, PAIRS_JUDGED = 4, 2, 12, 8
"""Laws of one, of two and of three numbers, twice as many where these are as good, and free functions, that are judged
on parts left out; laws of which pairs are tried, and pairs judged."""
MEASURE = "share of the squared error"
GROWN = 64.0
"""Pace over which sizes of delays and lags are grown: an eighth of a slowest time constant."""
Cells = Float[np.ndarray, "*part age obs"]
"""Squared errors by age, the time since the start of a window: before the start is settled, and two later ones."""
FIRST_STEPS, JOINED_STEPS, SCREEN_STEPS, JUDGED_STEPS = 8, 4, 30, 30
"""Steps of the first fit of all (a leak takes more than four), of pairs, which begin with what was fitted, of the best,
and of one that is judged."""


class Case(NamedTuple):
    """Laws in the model, fitted."""

    laws: tuple[Candidate, ...]
    of: simulated.Simulated
    loss: float
    """Log of the posterior density, less."""
    share: float = math.nan
    left: float = math.nan
    """Share of the squared error on parts left out that they remove, and what they leave."""
    folds: tuple[float, ...] = ()
    harms: bool = False
    """True where some reading is worse with them, at some horizon."""

    @property
    def effects(self) -> tuple[AbstractEffect, ...]:
        """The laws with their numbers."""
        fitted = self.of.model.effects[len(self.of.model.effects) - len(self.laws) :]
        return tuple(numbered(law.start, effect) for law, effect in zip(self.laws, fitted, strict=True))

    @property
    def worth(self) -> float:
        """Share times prior odds."""
        return self.share * NAMED ** (len(self.laws) - 1 + sum(complexity(law.start) for law in self.laws))

    @property
    def sound(self) -> bool:
        """True for physical values."""
        return all(effect.is_physical() for effect in self.effects)

    @property
    def numbers(self) -> int:
        """Numbers that they have."""
        return sum(len(law.start.values()) or flat(law.start).size for law in self.laws)

    @property
    def keys(self) -> tuple[Key, ...]:
        """Their names."""
        return tuple(key_of(law.start) for law in self.laws)

    def places(self, system: Any) -> set[str | None]:
        """Ports, inputs and readings where they are, signals of which they are functions, states that readings have."""
        names = {name for key in self.keys for name in (key[2], *key[3])}
        names |= {name for parameter in names & {*system.of.parameters} for name in system.beside(parameter)}
        return names | {state for name in names if name in system.sensors and (state := system.state_of(name))}


class Search(NamedTuple):
    """Constants of a search."""

    before: Identified
    data: Dataset
    log: Log
    every: Sequence[Candidate]
    """Laws of the catalogue."""
    free: Callable[[int, Sequence[Key]], list[Candidate]]
    """Functions without a name of so many signals, those that extend some laws by one."""
    begin: Any = None
    """States at all starts, by the model without further laws."""
    scale: Any = None
    """Scale of its errors."""

    def with_laws(self, hypothesis: Hypothesis, laws: Sequence[Candidate], starts: Sequence[Any]) -> Hypothesis:
        """The hypothesis with some laws more, which begin with the numbers of `starts`."""
        system = hypothesis.model.system
        for law, start in zip(laws, starts, strict=True):
            none = law.start if law.start.linear else start
            law = Candidate(lean(none, system), (), lean(law.prior_std, system))
            hypothesis = hypothesis.plus(lean(start, system), law)
        return hypothesis

    def fit(
        self,
        hypothesis: Hypothesis,
        every: Sequence[tuple[Sequence[Candidate], Sequence[Any]]],
        begun: Sequence[Any] = (),
        **options: Any,
    ) -> dict[int, Case]:
        """The hypothesis with each of some sets of laws, and the numbers that these begin with, fitted, by their place;
        from the models `begun`, if there are any. What cannot be fitted, or not in time, is left out.
        """
        form = lambda pair: type(lean(pair[0].start, hypothesis.model.system)).__name__  # noqa: E731
        ordered = [sorted(zip(*one, strict=True), key=form) for one in every]
        full = [self.with_laws(hypothesis, [law for law, _ in one], [start for _, start in one]) for one in ordered]
        full = [one.refitted(model) for one, model in zip(full, begun, strict=True)] if begun else full
        groups: dict[Any, list[int]] = {}
        for i, one in enumerate(full):
            both = one.model, one.m_step.prior
            groups.setdefault((jax.tree.structure(both), *map(np.shape, jax.tree.leaves(both))), []).append(i)
        cases: dict[int, Case] = {}
        for places in groups.values():
            models, priors = ([get(full[i]) for i in places] for get in (lambda h: h.model, lambda h: h.m_step.prior))
            options |= {"scale": self.scale, "begin": self.begin}
            try:
                fits = simulated.fit_all(models, priors, self.data, **options)
            except (TimeUp, np.linalg.LinAlgError):
                continue
            for i, of in zip(places, fits, strict=True):
                density = simulated.log_posterior(of, self.scale, of.observed)
                cases[i] = Case(tuple(law for law, _ in ordered[i]), of, -density)
        return cases

    def loss(self, of: simulated.Simulated) -> float:
        """Squared error of the predictions."""
        return simulated.cost(of.error, self.scale, of.observed)

    def screened(
        self,
        hypothesis: Hypothesis,
        every: Sequence[tuple[Sequence[Candidate], Sequence[Any]]],
        most: int,
        steps: int = JOINED_STEPS,
    ) -> list[Case]:
        """The hypothesis with each set of laws, fitted, `most` of them to the end; the best of each, best first."""
        best: dict[tuple[Key, ...], Case] = {}
        for case in _ranked(self.fit(hypothesis, every, steps=steps).values()):
            best.setdefault(case.keys, case)
        few = [*best.values()][:most]
        models = [case.of.model for case in few]
        ended = self.fit(hypothesis, [(case.laws, case.effects) for case in few], models, steps=SCREEN_STEPS)
        return _ranked([*(ended.get(i, case) for i, case in enumerate(few)), *[*best.values()][most:]])

    def judged(self, hypothesis: Hypothesis, cases: Sequence[Case], null: Cells) -> list[Case]:
        """The cases with their errors on parts left out, beside those of `null` on each."""
        out = []
        for i, left in self.left_out(hypothesis, cases).items():
            before, after = (cells[:, 1:].sum(axis=(1, 2)) for cells in (null, left))
            gains = tuple((1 - after / np.maximum(before, 1e-12)).tolist())
            total = float(after.sum())
            share = 1 - total / max(float(before.sum()), 1e-12)
            out.append(cases[i]._replace(share=share, left=total, folds=gains, harms=worsens(null, left)))
        return out

    def room(self, of: simulated.Simulated) -> float:
        """Share of the squared error that is not noise of the readings: no law can remove more. The noise is the
        smallest of that of EM, that in the logs and that in the errors, half their mean square change from one to the
        next [von Neumann 1941, Annals of Mathematical Statistics 12(4), 367]: the last two hold a part of what is fast.
        """
        logs = np.array([fast_reading_noise(y) for y in np.moveaxis(np.asarray(self.data.y), -1, 0)])
        change = np.ma.mean(np.diff(np.ma.masked_invalid(of.error), axis=2) ** 2, axis=(0, 1, 2)) / 2
        every = np.exp(np.asarray(self.before.model.log_r)), logs**2, np.ma.filled(change, np.inf)
        return 1 - float(np.mean(np.min(every, axis=0) / self.scale**2))

    def cells(self, of: simulated.Simulated, counts: Bool[np.ndarray, "seq window #place 1"]) -> Cells:
        """Squared errors by age and reading: where the start is not settled all, later those that count, in halves."""
        at = simulated.windows(of.model, self.data)
        age, costs = np.arange(0, at.rows, at.every), simulated.costs(of.error, self.scale, of.observed)
        bounds = 0, at.settles, (at.settles + at.rows) // 2, at.rows
        ages = [(low <= age) & (age < high) for low, high in itertools.pairwise(bounds)]
        costs = costs * np.where((age < at.settles)[:, None], 1.0, counts)
        return np.stack([costs[:, :, some].sum(axis=(0, 1, 2)) for some in ages])

    def left_out(self, hypothesis: Hypothesis, cases: Sequence[Case]) -> dict[int, Cells]:
        """Squared errors of every case on every part by the fit to the others; only where all fits came to an end."""
        every, out = [(case.laws, case.effects) for case in cases], {i: [] for i in range(len(cases))}
        for counts in folds(simulated.windows(self.before.model, self.data), len(self.data.t)) if cases else ():
            fits = self.fit(hypothesis, every, [case.of.model for case in cases], counts=~counts, steps=JUDGED_STEPS)
            out = {i: [*errors, self.cells(fits[i].of, counts)] for i, errors in out.items() if i in fits}
        return {i: np.stack(parts) for i, parts in out.items()}


def worsens(before: Cells, after: Cells) -> bool:
    """True where the errors of some reading rise with laws, at some age, on most parts and in all to a multiple."""
    risen = (after > before).mean(axis=0) >= AGREE
    return bool(np.any(risen & (after.sum(axis=0) > WORSE * before.sum(axis=0))))


def folds(at: simulated.Windows, sequences: int) -> list[Bool[np.ndarray, "seq window place 1"]]:
    """Masks of the errors of every part: a fit without a part has none of its readings, although its simulations pass
    over it.  Blocks go on over all sequences.  What determines the start of a window is in no part, but in every fit.
    """
    rows = at.count * at.rows
    block = (np.arange(sequences)[:, None, None] * rows + at.row) * BLOCKS // (sequences * rows)
    settled = at.row - at.row[:, :1] >= at.settles
    return [(settled & (block % FOLDS == part))[..., None] for part in range(FOLDS)]


def around_of(fitted: Identified, data: Dataset) -> SearchScales:
    """Ranges of states, inputs and readings by a simulation of the fit."""
    model, rig = fitted.model, fitted.rig
    seen, valid = motion(model, data), np.asarray(data.valid)
    low, high = np.percentile(seen.x, [0.5, 99.5], axis=0)[:, : len(model.system.states)]
    u, y, t = (np.asarray(a)[valid] for a in (data.u, data.y, data.t))
    ranges = [(float(np.nanmin(a)), float(np.nanmax(a))) for a in (*y.T, *u.T)]
    ends = dict(zip(rig.measured, ranges, strict=False))
    inputs = zip(rig.input_columns, ranges[len(ends) :], strict=True)
    states = zip(model.system.states, zip(low.tolist(), high.tolist(), strict=True), strict=True)
    sizes = {name: (a, b) for name, (a, b) in (*states, *inputs) if b > a}
    none, wait, drive = np.zeros(0), max(rig.dt, model.pace / GROWN), np.max(np.abs(u), axis=0, initial=0.0)
    return SearchScales(
        model.system, np.asarray(cast(Any, model.unknown).scale), none, none, low, high, drive,
        rig.measured, np.array([b - a for a, b in ends.values()]), wait,
        (float(t.min()), float(t.max())), float(t.max()), rig.clock == "session", False, rig.input_columns, sizes, ends,
    )  # fmt: skip


def free_functions(
    before: Identified, around: SearchScales, data: Dataset, count: int, extend: Sequence[Key]
) -> list[Candidate]:
    """Functions of some signals at every port, free of what the parameters can do; of two, those that extend some of
    one, as a function of two is seldom the same on average over either.
    """
    model, prior = before.model, before.m_step.prior
    system, seen, out = cast(Any, model.system), motion(model, data), []
    for port, reads in itertools.product(system.open_ports, itertools.combinations(around.sizes, count)):
        if count > 1 and not any(key[2] == port and {*key[3]} < {*reads} for key in extend):
            continue
        low, high = np.asarray([around.sizes[name] for name in reads]).T
        start = free_term(system, seen, prior.declared, port, reads, low, high)
        spread = jnp.full(start.weights.shape, STRONG * around.torque[system.ports.index(port)])
        wide, probe = (eqx.tree_at(lambda e: e.weights, start, size * spread) for size in (1.0, 1e-3))
        out.append(Candidate(start, (probe,), wide))
    return out


def by_simulation(before: Identified, data: Dataset, log: Log) -> Method:
    """The search for laws that equations lack, one or two at a time."""
    around = around_of(before, data)
    kinds = [kind for kind in catalogue.values() if issubclass(kind, SignalEffect | SensorEffect | DriveEffect)]
    every = [candidate for kind in kinds for candidate in kind.candidates(around)]
    search = Search(before, data, log, every, partial(free_functions, before, around, data))
    rows = int(np.asarray(data.valid).sum(axis=1).max())
    return Method(
        [rows],
        lambda hypothesis, rows: _round(search, hypothesis, rows),
        lambda hypothesis, _: before.state._replace(best=hypothesis.model),
        lambda hypothesis: _lost(search, hypothesis),
        lambda fitted: fitted_to_horizon(fitted, data),
        BLOCKS,
    )


def _prepared(search: Search, hypothesis: Hypothesis) -> tuple[Search, Hypothesis, Case | None]:
    """The search from the states that the hypothesis gives, in the scale of its errors; it without what laws need not
    have in a fit, and that fitted.
    """
    system = hypothesis.model.system
    bare = hypothesis.having(tuple(_lean(one, system) for one in hypothesis.additions))
    begin = simulated.filtered(bare.model, search.data)
    first = simulated.simulated(bare.model, bare.m_step.prior, search.data, begin)
    search = search._replace(begin=begin, scale=simulated.scale_of(first))
    null = search.fit(bare, [((), ())]).get(0)
    return search._replace(scale=simulated.scale_of(null.of)) if null else search, bare, null


def _lean(addition: Addition, system: Any) -> Addition:
    """An addition without what laws need not have in a fit."""
    law, names = addition.effect, fields(addition.effect)
    numbers = lambda effect: [getattr(effect, name) for name in names]  # noqa: E731
    unflat = ravel_pytree(numbers(law))[1]
    mean, std = (lean(eqx.tree_at(numbers, law, unflat(values)), system) for values in (addition.mean, addition.std))
    return Addition(lean(law, system), flat(mean), flat(std), addition.evidence)


def _lost(search: Search, hypothesis: Hypothesis) -> list[float]:
    """Share of the squared error on parts left out that goes with each law."""
    shares = [math.inf if evidence is None else evidence.share for evidence in hypothesis.evidence]
    laws = [i for i, evidence in enumerate(hypothesis.evidence) if evidence is not None]
    if len(laws) < 2:  # of one law the round has just said so
        return shares
    search, bare, full = _prepared(search, hypothesis)
    nothing = np.full((1, 2, 1), math.nan)
    left = lambda one, case: search.left_out(one, [case] if case else []).get(0, nothing)[:, 1:].sum()  # noqa: E731
    whole = left(bare, full)
    for i in laws:
        one = bare.without(i)
        share = 1 - whole / left(one, search.fit(one, [((), ())]).get(0))
        shares[i] = share if math.isfinite(share) else shares[i]
    return shares


def _round(search: Search, hypothesis: Hypothesis, rows: int) -> Round:
    """The laws that pass, if any do, and single ones that explain the same. Pairs, and functions without a name, are
    tried where no single law removes most of what can be removed.
    """
    present = {key_of(effect) for effect in hypothesis.model.effects}
    fresh = lambda c: key_of(c.start) not in present  # noqa: E731
    search, bare, null = _prepared(search, hypothesis)
    nothing = Round(Step(rows, (), (), None, MEASURE), complete=not late())
    if null is None:
        return nothing
    if not (parts := search.left_out(bare, [null])):
        return nothing
    some, whole, room = [*filter(fresh, search.every)], search.loss(null.of), search.room(null.of)
    search.log(f"{len(some)} candidates; {max(room, 0.0):.0%} of the squared error is not noise of the readings")
    if room < MULTI_STEP:
        return nothing
    singles = search.screened(bare, [((law,), law.probes[:1]) for law in some], 4 * PARTNERS, FIRST_STEPS)
    partners, short = [case for case in singles if case.sound][:PARTNERS], []
    for numbers in range(1, 4):
        sound = [case for case in singles if case.numbers == numbers and case.sound]
        gains = [1 - search.loss(case.of) / whole for case in sound]
        ties = len(even(gains)) if sound else 0  # as good as the best: the logs may not discriminate them
        short += sound[: min(max(SHORTLIST, ties), 2 * SHORTLIST)]
    short += [case for case in _first(singles) if case.sound and not any(case is other for other in short)]
    judged = search.judged(bare, short, parts[0])
    passing, tried = [case for case in judged if _passes(case)], [*judged]
    if room > max([MULTI_STEP, *(case.share for case in passing)]) / NAMED:  # else no pair, no function could be chosen
        both = itertools.combinations(partners, 2)
        joined = [((*a.laws, *b.laws), (*a.effects, *b.effects)) for a, b in both]
        pairs = search.screened(bare, joined, 2 * PAIRS_JUDGED)
        functions: list[Case] = []
        for signals in (1, 2):
            free = search.free(signals, [case.keys[0] for case in functions[:SHORTLIST]])
            starts = [((law,), law.probes[:1]) for law in free if fresh(law)]
            functions = _ranked([*functions, *search.screened(bare, starts, 2 * FREE, FIRST_STEPS)])
        best = [*[case for case in pairs if case.sound][:PAIRS_JUDGED], *functions[:FREE]]
        tried += search.judged(bare, best, parts[0])
        passing = [case for case in tried if _passes(case)]
    if passing:
        rivals = _rivals(search, bare, _chosen(passing)[0], [*partners, *_first(singles)], whole)
        unseen = [case for case in rivals if all(set(case.keys) != set(other.keys) for other in tried)]
        tried += search.judged(bare, unseen[:PAIRS_JUDGED], parts[0])
        passing = [case for case in tried if _passes(case)]
    for case in tried:
        values = ["; ".join(f"{n} {float(v):.3g}" for n, v in effect.values().items()) for effect in case.effects]
        laws = " and ".join(f"{words(key)} ({value})" for key, value in zip(case.keys, values, strict=True))
        search.log(f"  {laws}: {case.share:.0%} of the squared error on parts left out")
    listed = tuple((case.keys[0], 1 - search.loss(case.of) / whole) for case in singles)
    step = Step(rows, listed, tuple((case.keys[-1], case.share) for case in tried), None, MEASURE)
    complete = not late()
    if not passing:
        near = sorted((c for c in judged if suspected(c.share, MULTI_STEP) and c.sound), key=lambda c: -c.share)
        suspects = tuple(Suspect(case.keys[0], case.share, math.nan) for case in near[:4])
        return Round(step._replace(suspects=suspects), complete=complete)
    best, alike, tied = _chosen(passing)
    places = lambda case: case.places(bare.model.system)  # noqa: E731
    apart = lambda case: len(case.laws) == 1 and places(case).isdisjoint(places(best))  # noqa: E731
    if any(case.numbers <= best.numbers and apart(case) for case in alike):
        best, *alike = _ahead(search, bare, alike, partners, parts[0])
    if rivals := [case for case in alike if case.numbers <= best.numbers and apart(case)]:
        keys = tuple(key for case in (best, *rivals) for key in case.keys)
        search.log(f"  cannot tell: {', '.join(map(words, keys))} explain the same; none is added")
        return Round(step._replace(rivals=keys), complete=complete)
    for law, effect in zip(best.laws, best.effects, strict=True):
        same = _in_place_of(key_of(law.start), best, tied)
        record = Evidence(equivalent=same, share=best.share, removed=best.share, candidate=law)
        hypothesis = hypothesis.plus(effect, law, record)
        search.log(f"  added {words(key_of(effect))}")
    fitted, effects = best.of.model, hypothesis.model.effects
    effects = tuple(numbered(effect, of) for effect, of in zip(effects, fitted.effects, strict=True))
    model = eqx.tree_at(lambda m: m.system, with_effects(hypothesis.model, effects), fitted.system)
    return Round(step._replace(accepted=best.keys[0]), hypothesis.refitted(model), complete)


def _ranked(cases: Iterable[Case]) -> list[Case]:
    """Fitted cases, the likeliest first."""
    return sorted(cases, key=lambda case: case.loss)


def _first(singles: Sequence[Case]) -> list[Case]:
    """Gains and biases of inputs, which are judged whatever they explain."""
    return [case for case in singles if isinstance(case.laws[0].start, MotorGain | InputBias)]


def _ahead(search: Search, bare: Hypothesis, laws: Sequence[Case], partners: Sequence[Case], null: Cells) -> list[Case]:
    """Cases that explain the same, the best first, without those that leave more once a further law is with each; from
    all starts of laws, of which many are near a better one by themselves.
    """
    least = []
    for case in laws:
        starts = [case.effects, *(law.probes[:1] for law in search.every if (key_of(law.start),) == case.keys)]
        others = [other for other in partners if other.keys[0] not in case.keys]
        pairs = [((*case.laws, *other.laws), (*start, *other.effects)) for other in others for start in starts]
        pairs = [pair for pair in search.screened(bare, pairs, PAIRS_JUDGED) if pair.sound][:SHORTLIST]
        least.append(min(search.judged(bare, pairs, null), key=lambda pair: pair.left, default=case))
    top = min(least, key=lambda case: case.left)
    order = sorted(range(len(laws)), key=lambda i: least[i].left)
    return [laws[i] for i in order if _as_likely(least[i], top) or EQUIVALENT * least[i].left <= top.left]


def _as_likely(case: Case, top: Case) -> bool:
    """True where a case is as likely as the best on parts left out."""
    return 0.5 * simulated.independent(top.of) * math.log(case.left / top.left) < EQUIVALENT_NATS


def _rivals(search: Search, bare: Hypothesis, best: Case, others: Sequence[Case], whole: float) -> list[Case]:
    """Laws of `best` with one of others in the place of each that explain as much of the error `whole`, best first."""
    sets = []
    for i in range(len(best.laws)):
        laws, effects = tuple(a[:i] + a[i + 1 :] for a in (best.laws, best.effects))
        fresh = [case for case in {id(case): case for case in others}.values() if case.keys[0] not in best.keys]
        sets += [((*laws, *case.laws), (*effects, *case.effects)) for case in fresh]
    fits = search.screened(bare, sets, 3 * PAIRS_JUDGED)
    explained = lambda case: 1 - search.loss(case.of) / whole  # noqa: E731
    return [case for case in fits if case.sound and explained(case) >= EQUIVALENT * explained(best)]


def _in_place_of(key: Key, best: Case, tied: Sequence[Case]) -> tuple[Key, ...]:
    """Named laws with which the others of `best` are worth as much as with the law `key` of it."""
    others, out = {*best.keys} - {key}, dict.fromkeys(())
    for case in tied:
        fresh = [law.start for law in case.laws if key_of(law.start) not in others]
        if len(case.laws) == len(best.laws) and len(fresh) == 1 and fresh[0].named:
            out[key_of(fresh[0])] = None
    return tuple(name for name in out if name != key)


def _passes(case: Case) -> bool:
    """True where the parts left out confirm that the laws remove a share of the squared error."""
    return case.worth >= MULTI_STEP and agreed(case.folds) and case.sound and not case.harms and _certain(case)


def _certain(case: Case) -> bool:
    """True where every strength is determined beside its level and share; parts left out confirm that it is there."""
    spreads = covariances(case.of.model, case.of, simulated.precision(case.of))[-len(case.laws) :]
    return all(certainty(*each) >= DETERMINED for each in zip(case.laws, case.effects, spreads, strict=True))


def _chosen(passing: Sequence[Case]) -> tuple[Case, list[Case], list[Case]]:
    """The case of the fewest numbers among those that explain the same as the best; all of these; and those, too, that
    are worth as much and leave as much. What explains the same is worth as much, and as likely on parts left out: few
    errors make much likely, and of a law that removes nearly all the rest counts.
    """
    worths = [case.worth for case in passing]
    top = passing[int(np.argmax(worths))]
    alike = [passing[i] for i in even(worths) if _as_likely(passing[i], top)]
    best = min(alike, key=lambda case: (case.numbers, case.left))
    rest = [case for case in (passing[i] for i in even(worths)) if EQUIVALENT * case.left <= top.left]
    return best, alike, [case for case in passing if any(case is other for other in (*alike, *rest))]
