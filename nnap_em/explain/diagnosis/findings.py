"""The outcome of the search in words and numbers: effects, their uncertainty, the error that they remove."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from ...base.digits import finite, number, share_of, with_std
from ...model.effects import AbstractEffect, catalogue, fields
from ...model.effects.base import Curve
from .hypothesis import covariances
from .keys import Key, key_of, listed, place_of, remainder_of, with_article, words
from .outcome import Diagnosis
from .shapes import Shape, shape
from .verdict import EQUIVALENT, RISEN


class Estimate(NamedTuple):
    """A reported parameter."""

    value: float
    std: float
    unit: str


def estimates(effect: AbstractEffect, cov: Float[np.ndarray, "param param"], system: Any) -> dict[str, Estimate]:
    """The reported parameters of an effect; standard deviations by the delta method from those of its own numbers."""
    (values, slopes), unit = _reported(effect), effect.units_on(system)
    slopes = {name: np.asarray(slope) for name, slope in slopes.items()}
    stds = {name: math.sqrt(max(0.0, float(slope @ cov @ slope))) for name, slope in slopes.items()}
    return {n: Estimate(float(values[n]), stds[n], unit[n]) for n in unit if n in values}  # in the order of the law


@eqx.filter_jit
def _reported(effect: AbstractEffect):
    """The reported parameters, and how they move with the effect's own numbers."""
    names = fields(effect)
    numbers, unravel = ravel_pytree([getattr(effect, name) for name in names])

    def reported(numbers: Float[Array, " param"]) -> dict[str, Array]:
        changed = eqx.tree_at(lambda e: [getattr(e, name) for name in names], effect, unravel(numbers))
        return changed.values()

    return reported(numbers), jax.jacfwd(reported)(numbers)


class Finding(NamedTuple):
    """One effect as it is reported."""

    effect: AbstractEffect
    parameters: dict[str, Estimate]
    evidence: dict[str, Any]
    equivalent: tuple[Key, ...]
    sentence: str
    curve: Curve | None = None
    """Learned form: the function itself, or the remainder beside a law."""
    shape: Shape | None = None
    """Description of the curve."""
    left: bool = False
    """True if the curve is the remainder beside the law."""


def findings(diagnosis: Diagnosis) -> list[Finding]:
    """The effects that a diagnosis added, each with its numbers, sentence and equivalents, in the order of their
    acceptance; none where nothing was found: `print(diagnosis)` shows whether the logs were undecided.

    Example:
        >>> [finding.sentence for finding in nnap_em.findings(diagnosis)]
        []
    """
    fitted, model = diagnosis.after, diagnosis.after.model
    numbers = covariances(model, fitted.m_step, fitted.state.hessian)
    laws = [None if (place := remainder_of(e, model)) is None else model.effects[place] for e in model.effects]
    entries = list(zip(model.effects, diagnosis.evidence, numbers, laws, strict=True))
    out = []
    for effect, record, cov, law in entries:
        if law is not None or record is None:
            continue  # reported with the law that it completes, or of the fit from which the search began
        drawn = effect.curve(cov, model.system)
        parameters = estimates(effect, cov, model.system)
        sizes = ", ".join(map(" = ".join, _texts(parameters).items()))
        remainder = next((e.curve(c, model.system) for e, _, c, of in entries if of is effect), None)
        form, remains = (shape(one) if one else None for one in (drawn, remainder))
        sentence = ": ".join(filter(None, (words(key_of(effect)), sizes, form.words if form else "")))
        if remainder is not None and remains is not None:
            left = f"{np.ptp(remainder.mean):.2g} {remainder.unit}: {remains.words}"
            sentence += f"; the law is not quite of this form, what is left has {left}"
        none = dict.fromkeys(("p_value", "held_out_gain"), math.nan)  # of a search by likelihood: files keep their keys
        found = {"share_of_error": record.share, "chance": record.chance, "parts": list(record.parts)}
        evidence = {"log_likelihood_gain": record.gain} | none | found
        beside = drawn is None and remainder is not None
        equivalent = tuple(dict.fromkeys([*effect.same_as(model.system, fitted.rig.measured), *record.equivalent]))
        one = Finding(effect, parameters, evidence, equivalent, sentence, drawn or remainder, form or remains, beside)
        out.append(one)
    return out


def verdict(
    accepted: Sequence[Finding],
    error: Mapping[str, Any] | None,
    failed: int = 0,
    rivals: Sequence[Key] = (),
    suspects: Sequence[Mapping[str, Any]] = (),
    unfinished: str = "",
    opening: str = "The model lacks",
    misfit: str = "",
    tried: int = 0,
) -> str:
    """The outcome in one sentence; `failed` tests of the one-step errors of the declared model failed clearly, `rivals`
    explain the same of what is left, and `suspects` remove more than chance. A second one has the reason for which the
    search is `unfinished`. `opening` begins the sentence that names laws. It names the column whose test error falls
    most, and trusts a finding where the geometric mean over all falls. Where none of the laws `tried` explains what
    predictions err, the sentence `misfit`, that comes first.
    """
    if unfinished:
        known = accepted or rivals or suspects
        first = "No effect was found yet."
        if known:
            first = verdict(accepted, error, failed, rivals, suspects, misfit=misfit, tried=tried)
        return f"{first} {unfinished}: more may be missing."
    if not accepted and rivals:
        same = f"{listed([*map(words, rivals)])} explain the same; none is added."
        return f"Something is missing, but these recordings cannot tell what: {same}"
    if not accepted and suspects:
        first, *remaining = suspects
        others = f" ({len(remaining)} more below)" if remaining else ""
        explains = f"{misfit} None of {tried} laws tried explains it for certain."
        none = explains if misfit else "No effect is certain to be missing."
        return f"{none} Suspected: {first['description']}{others}."
    if not accepted and misfit and tried:
        return f"{misfit} None of {tried} laws tried explains it."
    if not accepted and failed:
        none = "No single effect of the catalogue is certain to be missing, but the declared model does not explain"
        return f"{none} everything: {failed} tests of its one-step errors fail."
    if not accepted:
        return "Nothing is missing that these data could show: the declared model explains them."
    names, it = listed([_sized(finding) for finding in accepted]), "it" if len(accepted) == 1 else "them"
    text, grows = f"{opening} {names}", growth(error or {})
    if not error or not grows:
        return text + "."
    judged, pairs = _judged(error)
    unit = error.get("time_unit", "s")
    horizon = f"{min(judged, error.get('reach_s', judged)):.3g} {unit}"
    ratios = [(column, *pairs[column]) for column in sorted(grows, key=grows.__getitem__)]
    if sum(grows.values()) >= 0:
        column, before, after = ratios[-1]
        stays = f"the {horizon} prediction error of {column} does not fall with {it}"
        numbers = f"({before:.3g} before, {after:.3g} after)"
        return f"The training data support {names}, but on test data {stays} {numbers}: do not trust it."
    column, before, after = ratios[0]
    rising = [f"that of {c} rises from {b:.3g} to {a:.3g}" for c, b, a in ratios[1:] if a > b]
    rising += _risen_before(error, judged)
    of = "error of a free simulation" if "judged_s" in error else f"{horizon} prediction error"
    falls = f"the {of} of {column} falls from {before:.3g} to {after:.3g}"
    return f"{text}; with {it} {listed([falls, *rising])} on test data."


def changes(diagnosis: Diagnosis, accepted: Sequence[Finding], error: Mapping[str, Any] | None = None) -> str:
    """The outcome of a search that began from a fit in one sentence: what changed since, or that nothing did."""
    if not diagnosis.complete:
        first = changes(diagnosis._replace(complete=True), accepted, error)
        return f"{first} {diagnosis.unfinished}: more may have changed."
    if accepted:
        return verdict(accepted, error, opening="Changed since the fit:")
    test, rivals = diagnosis.risen, listed([*map(words, undecided(diagnosis))])
    tied = f" {rivals[0].upper()}{rivals[1:]} explain the same; none is added." if rivals else ""
    also = tied or "".join(f" Suspected: {suspect['description']}." for suspect in suspected(diagnosis)[:1])
    none = "Nothing is certain to have changed since the fit"
    if test is None:
        return f"{none}, whose own recordings are not at hand.{also}"
    size = f"errors are {number(test.ratio, 2)} times those on its recordings left out (p = {number(test.p_value, 2)})"
    if test.p_value < RISEN:
        return f"Something changed since the fit, and no law and no number is certain to explain it: {size}.{also}"
    if test.least >= RISEN:
        return f"{none}, and so few recordings cannot show it by errors: {size}.{also}"
    return f"{none if tied else 'Nothing changed since the fit that these recordings could show'}: {size}.{tied}"


def growth(error: Mapping[str, Any]) -> dict[str, float]:
    """Log of the test error 1 s ahead with the accepted effects over that without, by column; known ones alone."""
    return {column: math.log(max(a, 1e-300) / max(b, 1e-300)) for column, (b, a) in _judged(error)[1].items()}


def _risen_before(error: Mapping[str, Any], judged: float) -> list[str]:
    """The column whose test error rises most at a shorter horizon [s], if by more than laws that explain the same
    differ.
    """
    shorter = {horizon: _judged({**error, "judged_s": horizon})[1] for horizon in error["horizons_s"]}
    every = [(a / max(b, 1e-300), h, c, b, a) for h, of in shorter.items() if h < judged for c, (b, a) in of.items()]
    rise, horizon, column, before, after = max(every, default=(0.0, 0.0, "", 0.0, 0.0))
    unit = error.get("time_unit", "s")
    text = f"that of {column} at {horizon:.3g} {unit} rises from {before:.3g} to {after:.3g}"
    return [text] if rise**2 > 1 / EQUIVALENT else []


def _judged(error: Mapping[str, Any]) -> tuple[float, dict[str, tuple[float, float]]]:
    """Horizon [s] and, by column, test errors there without and with the accepted effects, where both are known."""
    judged = error.get("judged_s", 1.0)
    if judged not in (error.get("horizons_s") or []):
        return judged, {}
    at, before, after = error["horizons_s"].index(judged), error["before"], error["after"]
    pairs = {column: (before[column][at], after[column][at]) for column in before if column in after}
    return judged, {column: pair for column, pair in pairs.items() if all(map(finite, pair))}


def _texts(parameters: Mapping[str, Estimate]) -> dict[str, str]:
    return {n: f"{with_std(p.value, p.std)} {p.unit}".rstrip(" -") for n, p in parameters.items()}


def _sized(finding: Finding) -> str:
    """Name of a finding with its size, one of those that explain the same."""
    if not finding.equivalent:
        return _alone(finding)
    *some, last = [_alone(finding), *(with_article(words(key)) for key in finding.equivalent)]
    return f"one of {', '.join(some)} or {last}"


def _alone(finding: Finding) -> str:
    """Name of a finding with its size: the first parameter, or the range of its function."""
    name, curve = with_article(words(key_of(finding.effect))), finding.curve
    sizes = _texts(finding.parameters)
    if phrase := finding.effect.phrase(sizes):
        return phrase
    if sizes or curve is None:
        return f"{name} ({' = '.join(next(iter(sizes.items())))})" if sizes else name
    if not finding.effect.named:
        kind = "dry friction" if finding.effect.dry else "a force" if curve.unit == "N" else "a torque"
        name = f"{kind} at joint {finding.effect.joint} that depends on {listed(finding.effect.inputs_free())}"
    return f"{name} ({number(float(f'{np.ptp(curve.mean):.2g}'), 2)} {curve.unit} from trough to peak)"


def suspected(diagnosis: Diagnosis) -> list[dict[str, Any]]:
    """Suspects of the last round, best first, as the report has them: laws that remove more of the error than chance,
    and were not accepted; `chance` is the largest share of a law whose columns are shifted in time, NaN without any.
    """
    out = []
    for key, share, chance in [entry for step in diagnosis.last for entry in step.suspects]:
        text = f"{words(key)} would remove {share_of(share, 'the squared prediction error')}"
        by_chance = f"up to {chance:.0%}" if chance >= 0.005 else "less than 1%"
        text += f", where chance removes {by_chance}" if math.isfinite(chance) else ""
        more = {"description": text, "confirm": catalogue[key[0]].confirm}
        out.append(place_of(key) | {"share_of_error": share, "chance": chance} | more)
    return out


def undecided(diagnosis: Diagnosis) -> tuple[Key, ...]:
    """Laws of other causes that explain the same of what is left, so that none of them was added."""
    return tuple(key for step in diagnosis.last for key in step.rivals)


def advice(
    accepted: Sequence[Finding], rivals: Sequence[Key] = (), suspects: Sequence[Mapping[str, Any]] = ()
) -> list[str]:
    """Sentences on the next measurement."""
    out = [f"To discriminate {words(key)} from its rivals: {catalogue[key[0]].confirm}" for key in rivals]
    if suspects:  # what three recordings of a real arm left open, eleven decided
        out.append("To be sure of a suspect, record as many different motions again and diagnose all together.")
    out += [f"To see {with_article(one['law'])} by itself: {one['confirm']}" for one in suspects if one["confirm"]]
    for finding in accepted:
        if finding.effect.confirm:
            out.append(f"To be sure of the {words(key_of(finding.effect))}: {finding.effect.confirm}")
        out += [f"To discriminate it from {words(key)}: {catalogue[key[0]].confirm}" for key in finding.equivalent]
    more = "Longer or livelier recordings show weaker effects; drive every joint or input through its whole range."
    return out or [more]


def entry(finding: Finding) -> dict[str, Any]:
    """A finding as the report has it."""
    return {
        **({"shape": finding.shape.entry()} if finding.shape else {}),
        **place_of(key_of(finding.effect)),
        "meaning": finding.effect.meaning,
        "parameters": {n: p._asdict() for n, p in finding.parameters.items()},
        "evidence": finding.evidence,
        "equivalent": [place_of(key) for key in finding.equivalent],
        "description": finding.sentence,
        "confirm": finding.effect.confirm,
    }
