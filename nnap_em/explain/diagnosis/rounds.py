"""One screening round: all candidates are screened, and the best are refitted until one is accepted."""

import functools
import math
from collections.abc import Callable, Iterable, Sequence
from typing import TypeVar, cast

import jax
import numpy as np

from ...base.deadline import TimeUp
from ...base.digits import share_of
from ...estimate.em.multistep import followed
from ...machines.systems import AbstractSystem
from ...model.effects import AbstractEffect
from ...model.state_space import StateSpaceModel
from .context import SearchContext, smooth
from .hypothesis import Evidence, Hypothesis
from .keys import Key, completed, complexity, contains, elsewhere, key_of, remainder_of, replaced, words
from .losses import MEASURE, ratio
from .outcome import Step, Suspect
from .propose import proposals, seeded, surroundings
from .screen import Screened, screen
from .search import Round
from .smoothed import SmoothedFit, extended
from .trial import Trial, null_of, with_candidate
from .verdict import EQUIVALENT, EXCEEDS, NAMED, SURVIVES, even, odds, simplest, suspected

_Law = TypeVar("_Law", Screened, Trial)
SHORTLIST = 8
"""Candidates that are refitted at most."""


def screening_round(context: SearchContext, hypothesis: Hypothesis, length: int) -> Round:
    """Screen everything that the machine may have over `length` rows, and refit the best until one is accepted."""
    if length < context.longest:
        hypothesis = hypothesis.refitted(cast(StateSpaceModel, context.stages[length][0].best))
    fit, whole = smooth(context, hypothesis, length)
    reach = f"{length * context.before.rig.dt:.2f} s"
    context.log(f"{MEASURE}, horizon {reach}: {whole.sum()} of {whole.size} sequences followed")
    step = Step(int(np.max(np.sum(np.asarray(fit.data.valid), axis=1))), (), (), None, MEASURE)
    if not fit.used.any():
        return Round(step)
    around = surroundings(context.before.rig, fit.model, fit.data, fit.path, fit.rows, change=context.change)
    seen = screen(fit, proposals(around, fit.model.effects))
    fresh = [s for s in seen if s.candidate.start.visible(around) and _fresh(s.candidate.start, hypothesis)]
    null = functools.cache(lambda: null_of(fit))

    def refitted(forms: Sequence[Screened]) -> Trial:
        case = with_candidate(forms, null(), fit)
        case = case if case.rejection else case._replace(before=explained(case, context.origin))
        _log(case, context)
        return case

    step, best, complete = decided(fresh, refitted, step, fit.model, context)
    return Round(step, best and joined(hypothesis, *best, context), complete)


def explained(case: Trial, fit: SmoothedFit | None) -> float:
    """Share of the squared error on the recordings of an earlier fit that a law removes; -inf without them."""
    if fit is None:
        return -np.inf
    full = fit.hypothesis.plus(case.effect, case.candidate)
    null = followed(fit.model, fit.m_step.prior, fit.path, fit.data)
    other = followed(full.model, full.m_step.prior, extended(full.model, fit.path, fit.data), fit.data)
    return 1 - ratio(null, other, fit.used, case.screened.band)


def joined(hypothesis: Hypothesis, case: Trial, equivalent: tuple[Key, ...], context: SearchContext) -> Hypothesis:
    """The hypothesis with a refitted law; a named law gives way to a remainder unless it explains most of both."""
    context.log(f"  added {words(key_of(case.effect))}")
    screened, share = case.screened, case.screened.share
    parts = sum(part > 0 for part in share.folds), len(share.folds)
    remainder, form = remainder_of(case.effect, hypothesis.model), replaced(case.effect, hypothesis.model)
    place = remainder if form is None else form
    law = None if place is None else hypothesis.evidence[place]
    both = case.removed if law is None else 1 - (1 - law.removed) * (1 - case.removed)
    stays = law is None or (form is None and 0 in even([law.removed, both]))
    removed = case.removed if stays else both  # over the model without the older law
    found = Evidence(math.nan, equivalent, share.left_out, screened.chance, parts, removed, case.candidate)
    following = case.after._replace(evidence=(*case.after.evidence[:-1], found))
    if stays or form is not None:  # its place is taken already
        return following
    context.log(f"  {words(key_of(hypothesis.model.effects[cast(int, remainder)]))} is a part of it, and is removed")
    return following.without(cast(int, remainder))


def decided(
    fresh: Sequence[Screened],
    refitted: Callable[[Sequence[Screened]], Trial],
    step: Step,
    model: StateSpaceModel,
    context: SearchContext,
) -> tuple[Step, tuple[Trial, tuple[Key, ...]] | None, bool]:
    """The best laws of a screen, `refitted` from their starts that explain as much, until none that is left at the same
    band may be worth more than the best of them: a refit removes less than a linear screen saw, or more. The round, the
    law that is accepted with those that the data cannot distinguish from it, and False where the time was up before.
    """
    ranked = best_of_kind(s for s in fresh if seeded(s.candidate, s.coefficients).is_physical())
    step = step._replace(screened=tuple((key_of(s.candidate.start), s.listed) for s in ranked))
    admitted = [s for s in ranked if s.reached]
    tried: list[Trial] = []
    complete = True
    try:
        while admitted and (room := SHORTLIST - len(tried)) > 0:
            group = _group(admitted, model)[:room]
            tried += [refitted(_forms(s, fresh)) for s in group]
            admitted = [s for s in admitted if not any(s is other for other in group)]
            possible, left = [case for case in tried if case.rejection is None], _band(admitted, group[0].band)
            removed = _largest(possible, [case.removed for case in possible], model)
            if removed > EXCEEDS * _largest(left, [s.share.least for s in left], model):
                break
    except TimeUp:
        complete = False
    if admissible := _settled([case for case in tried if case.rejection is None], model):
        return *_accepted(admissible, step._replace(refitted=_removals(tried)), model, context), complete
    judged = {key_of(case.candidate.start) for case in tried}
    suspects = _suspects([s for s in ranked if key_of(s.candidate.start) not in judged])
    return step._replace(refitted=_removals(tried), suspects=suspects, untried=len(admitted)), None, complete


def _group(admitted: Sequence[Screened], model: StateSpaceModel) -> list[Screened]:
    """Laws that are refitted beside each other: the best of the first band, and each of them at its other places. A law
    that a free function contains, or the reverse, comes in the form that explains as much as the better one, and as
    itself where that is the function: a refit may show that it explains as much.
    """
    band = _band(admitted, min(s.band for s in admitted))
    values = [s.ratio for s in band]
    worths = _worths(band, values, model)
    group: list[Screened] = []
    for i in sorted(even(worths), key=lambda i: -worths[i]):
        form = _form(band[i], band, values, model)
        group += [form, band[i]] if complexity(form.candidate.start) > complexity(band[i].candidate.start) else [form]
    group += [s for law in group for s in admitted if elsewhere(key_of(s.candidate.start), key_of(law.candidate.start))]
    return list({id(s): s for s in group}.values())


def _band(laws: Sequence[Screened], band: int) -> list[Screened]:
    return [s for s in laws if s.band == band]


def reductions(shares: Sequence[float]) -> list[float]:
    """Logs of the error without a law over that with it, from shares removed: where nearly all goes the rest counts."""
    return [-math.log1p(-share) for share in shares]


def _largest(laws: Sequence[_Law], shares: Sequence[float], model: StateSpaceModel) -> float:
    return max(_worths(laws, reductions(shares), model), default=0.0)


def _settled(cases: list[Trial], model: StateSpaceModel) -> list[Trial]:
    """The laws without the worse of two, of which refits put one first and the screen the other: large errors weigh in
    one more than in the other. Each is judged at the scale of what it leaves: on a real arm a gain is before the
    one-sided loss that is missing after their refits, on another a saturation by the screen; so judged the loss leaves
    0.84 and 0.68 of what they leave.
    """
    if not cases:
        return cases
    by = [case.removed for case in cases], [case.screened.share.least for case in cases]
    both = [cases[int(np.argmax(_worths(cases, reductions(shares), model)))] for shares in by]
    worths = _worths(both, reductions([case.own for case in both]), model)
    if both[0] is both[1] or len(even(worths)) == 2:
        return cases
    return [case for case in cases if case is not both[int(np.argmin(worths))]]


def _accepted(
    admissible: list[Trial], step: Step, model: StateSpaceModel, context: SearchContext
) -> tuple[Step, tuple[Trial, tuple[Key, ...]] | None]:
    """Choose among refitted laws: the simplest at the place that is worth most, in its simplest form. None where one
    that is worth as much is of another cause, nor a free function where no error rose since a fit. Forms of a law are
    compared by what they leave.
    """
    values = [case.removed for case in admissible]
    worths = _worths(admissible, values, model)
    leader = admissible[simplest(worths, _complexities(admissible, model), values)]
    best = _form(leader, admissible, reductions(values), model)
    law = best.candidate.start
    tied = [case for case in (admissible[i] for i in even(worths)) if case is not leader]
    rivals = [case for case in tied if other_cause(case.effect, law, model.system)]
    if rivals:
        keys = tuple(key_of(case.effect) for case in (best, *rivals))
        context.log(f"  cannot tell: {', '.join(map(words, keys))} explain the same; none is added")
        return step._replace(rivals=keys), None
    if not (law.named or context.functions):
        context.log(f"  {words(key_of(law))} is no change: errors have not risen since the fit")
        return step._replace(suspects=_suspects([best.screened])), None
    same = [key_of(case.effect) for case in tied if case.effect.named]
    equivalent = tuple(key for key in dict.fromkeys(same) if key != key_of(law))
    return step._replace(accepted=key_of(best.effect)), (best, equivalent)


def _complexities(laws: Sequence[_Law], model: StateSpaceModel) -> list[int]:
    return [complexity(law.candidate.start, model) for law in laws]


def _worths(laws: Sequence[_Law], values: Sequence[float], model: StateSpaceModel) -> list[float]:
    """Values times prior odds, by which laws of different causes are compared."""
    return [value * odds(number) for value, number in zip(values, _complexities(laws, model), strict=True)]


def _form(law: _Law, laws: Sequence[_Law], values: Sequence[float], model: StateSpaceModel) -> _Law:
    """Simplest among a law, the free functions that contain it and what it contains, that explains as much as the best.
    The parts left out of all are the same, so that they differ by what they explain: a bump is no ripple.
    """
    own = law.candidate.start
    one_cause = lambda other: contains(other, own, model.system) or contains(own, other, model.system)  # noqa: E731
    pairs = [(a, b) for a, b in zip(laws, values, strict=True) if a is law or one_cause(a.candidate.start)]
    some, explained = [a for a, _ in pairs], [value for _, value in pairs]
    return some[simplest(explained, _complexities(some, model), explained)]


def other_cause(one: AbstractEffect, best: AbstractEffect, system: AbstractSystem) -> bool:
    """True for laws of another kind and of other signals."""
    of_best, of_one = (set(effect.signals(system)) for effect in (best, one))
    same_law = one.named and one.name == best.name
    return not same_law and bool(of_best and of_one) and of_best.isdisjoint(of_one)


def _fresh(law: AbstractEffect, hypothesis: Hypothesis) -> bool:
    """True for a law that is new or takes the place of one, and for a change of a law of an earlier fit in its form."""
    model, found = hypothesis.model, hypothesis.evidence
    present = {key_of(effect) for effect, evidence in zip(model.effects, found, strict=True) if evidence is not None}
    place = replaced(law, model)
    new = key_of(law) not in present if place is None else found[place] is not None
    return new and not completed(law, model)


def best_of_kind(every: Iterable[Screened]) -> list[Screened]:
    """The best candidate of every kind, by its listed share."""
    best: dict[Key, Screened] = {}
    for screened in every:
        key = key_of(screened.candidate.start)
        if key not in best or best[key].rank < screened.rank:
            best[key] = screened
    return sorted(best.values(), key=lambda s: s.listed, reverse=True)


def _forms(law: Screened, every: Sequence[Screened]) -> list[Screened]:
    """A law and its other starts that explain as much; parts may contradict those."""
    shape = jax.tree.structure(law.candidate.start)
    same = [s for s in every if s.band == law.band and jax.tree.structure(s.candidate.start) == shape]
    near = [s for s in same if s.share.least >= EQUIVALENT * law.share.least]
    sound = lambda s: s.survived >= SURVIVES and seeded(s.candidate, s.coefficients).is_physical()  # noqa: E731
    return [s for s in near if s is law or sound(s)]


def _log(case: Trial, context: SearchContext) -> None:
    values = {n: float(f"{float(v):.4g}") for n, v in case.effect.values().items()}
    removed = (case.screened.share.least, case.foreseen, case.removed)
    screened, step, after = (share_of(share, "the squared error", 1) for share in removed)
    name, bar = words(key_of(case.effect)), f"bar {case.screened.bar:.1%}"
    text = f"{screened} by the linear screen, {step} along its step, {after} after it; {bar}"
    context.log(f"  refitted {name} {values}: {text}")
    if reason := case.rejection:
        context.log(f"  {name} {reason}")


def _removals(tried: Sequence[Trial]) -> tuple[tuple[Key, float], ...]:
    """Shares that laws remove after their refit, the best first."""
    return tuple(sorted(((key_of(case.effect), case.removed) for case in tried), key=lambda entry: -entry[1]))


def _suspects(ranked: Sequence[Screened]) -> tuple[Suspect, ...]:
    """Laws over chance after a round that accepted none: those near the best, of these the named ones first."""
    near = [s for s in ranked if s.listed >= NAMED * max(s.listed for s in ranked)]
    near.sort(key=lambda s: not s.candidate.start.named)
    over = [s for s in near if suspected(s.listed, s.floor, s.chance)]
    # four, as the right law was the fourth on a real arm with three recordings
    return tuple(Suspect(key_of(s.candidate.start), s.share.least, s.chance) for s in over[:4])
