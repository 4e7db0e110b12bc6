"""The outcome of the loop in words and numbers: what was found, how sure, and what it is worth."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .augment import blocks
from .effects import AbstractEffect, catalogue, fields, flat
from .effects.function import UnknownFunction
from .identify import Identified, friction_table
from .look import Key, key_of, rest_of, words
from .loop import Closed
from .systems import AbstractSystem
from .tables import state_unit


class Estimate(NamedTuple):
    """A reported parameter."""

    value: float
    std: float
    unit: str


def covariance(fitted: Identified) -> Float[np.ndarray, "param param"]:
    """Of all estimated parameters, friction integrated out (Laplace)."""
    prior = fitted.m_step.prior
    cov = np.linalg.inv(np.asarray(fitted.state.hessian))
    cut = cov.shape[0] - prior.size
    std = np.asarray(prior.std)
    return cov[cut:, cut:] * np.outer(std, std)


def estimates(fitted: Identified) -> list[dict[str, Estimate]]:
    """The reported parameters of every effect, in its order, with standard deviations by the delta method."""
    cov = covariance(fitted)
    out = []
    for effect, here in zip(fitted.model.effects, blocks(fitted.model, fitted.m_step), strict=True):
        own = cov[here, here]

        def reported(numbers: Float[Array, " param"], effect=effect) -> dict[str, Float[Array, ""]]:
            return _filled(effect, numbers).values()

        now = flat(effect)
        values, slopes = reported(now), jax.jacfwd(reported)(now)
        unit = units(effect, fitted.model.system)
        out.append(
            {
                name: Estimate(
                    float(values[name]),
                    float(np.sqrt(max(0.0, np.asarray(slopes[name]) @ own @ np.asarray(slopes[name])))),
                    unit[name],
                )
                for name in values
            }
        )
    return out


def _filled(effect: AbstractEffect, flat: Float[Array, " param"]) -> AbstractEffect:
    names = fields(effect)
    cuts = np.cumsum([np.size(getattr(effect, n)) for n in names])[:-1]
    made = object.__new__(type(effect))
    for name in effect.__dataclass_fields__:
        object.__setattr__(made, name, getattr(effect, name))
    for name, part in zip(names, jnp.split(flat, cuts), strict=True):
        object.__setattr__(made, name, part.reshape(jnp.shape(getattr(effect, name))))
    return made


def units(effect: AbstractEffect, system: AbstractSystem) -> dict[str, str]:
    """Units of the reported parameters on this machine and channel."""
    straight = effect.joint is not None and not system.angles[effect.joint - 1]
    out = {}
    for name, unit in effect.units.items():
        if unit == "unit of the channel":
            unit = state_unit(system, effect.channel or "")
        if effect.name == "air_drag" and effect.joint is None:
            unit = "N s^2/m^2"
        out[name] = unit.replace("N m", "N").replace("rad", "m") if straight else unit
    return out


class Curve(NamedTuple):
    """A learned function along one signal, its mean taken away."""

    label: str
    x: Float[np.ndarray, " node"]
    mean: Float[np.ndarray, " node"]
    """[N m]"""
    std: Float[np.ndarray, " node"]


def curve(fitted: Identified, place: int, nodes: int = 121) -> Curve | None:
    """The learned function of one signal; None for one of several."""
    effect = fitted.model.effects[place]
    if not isinstance(effect, UnknownFunction) or len(effect.axes) != 1:
        return None
    axis = effect.axes[0]
    x = np.linspace(float(axis.low), float(axis.high), nodes)
    basis = np.asarray(jax.vmap(axis.basis)(jnp.asarray(x)))
    basis = basis - basis.mean(axis=0)
    own = blocks(fitted.model, fitted.m_step)[place]
    cov = covariance(fitted)[own, own]
    std = np.sqrt(np.maximum(np.einsum("xi,ij,xj->x", basis, cov, basis), 0.0))
    return Curve(" + ".join(axis.names), x, basis @ np.asarray(effect.weights), std)


def shape(found: Curve, turns: bool) -> str:
    """A learned function in words: a period, a bump, or a slope."""
    y = found.mean
    size = f"{np.ptp(y):.2g} N m from trough to peak"
    if turns:
        power = np.abs(np.fft.rfft(y[:-1])) ** 2
        n = int(np.argmax(power[1:])) + 1
        if power[n] > 0.8 * power[1:].sum():
            return f"period {n} in {found.label}, {size}"
    line = np.polyfit(found.x, y, 1)
    if np.var(y - np.polyval(line, found.x)) < 0.15 * np.var(y):
        return f"nearly a straight line in {found.label}, slope {line[0]:.2g}"
    level = np.median(y)
    peak = int(np.argmax(np.abs(y - level)))
    inside = np.abs(y - level) > 0.5 * abs(y[peak] - level)
    width = inside.mean() * np.ptp(found.x)
    kind = "bump" if y[peak] > level else "dip"
    if width < 0.4 * np.ptp(found.x):
        return (
            f"a {kind} at {found.label} = {found.x[peak]:.2f}, about {width:.2f} wide, {y[peak] - level:.2g} N m high"
        )
    return f"a smooth function of {found.label}, largest at {found.x[int(np.argmax(y))]:.2f}, {size}"


class Finding(NamedTuple):
    """One effect as it is reported."""

    effect: AbstractEffect
    parameters: dict[str, Estimate]
    evidence: dict[str, float]
    equivalent: tuple[Key, ...]
    sentence: str


def findings(closed: Closed) -> list[Finding]:
    """All that was found, with what cannot be told from it."""
    model, out = closed.after.model, []
    rests = {i: rest_of(e, model) for i, e in enumerate(model.effects)}
    for i, (found, parameters) in enumerate(zip(closed.found, estimates(closed.after), strict=True)):
        if rests[i] is not None:
            continue  # told with the law that it completes
        effect = model.effects[i]
        numbers = ", ".join(f"{n} = {p.value:.4g} ± {p.std:.2g} {p.unit}".rstrip(" -") for n, p in parameters.items())
        drawn = curve(closed.after, i)
        told = shape(drawn, effect.axes[0].turns) if drawn and isinstance(effect, UnknownFunction) else numbers
        evidence = {
            "log_likelihood_gain": found.gain,
            "p_value": max(found.p_value, 1e-300),
            "held_out_gain": found.held_out,
        }
        sentence = f"{words(key_of(effect))}: {told}" if told else words(key_of(effect))
        rest = next((curve(closed.after, k) for k, of in rests.items() if of == i), None)
        if rest is not None:
            sentence += f"; the law is not quite of this form, what is left has {np.ptp(rest.mean):.2g} N m"
        out.append(Finding(effect, parameters, evidence, found.equivalent, sentence))
    return out


def verdict(found: Sequence[Finding], error: Mapping[str, Any] | None, failed: int = 0) -> str:
    """The outcome in one sentence; `failed` tests of the one-step errors of the declared model failed clearly."""
    if not found and failed:
        return (
            "No single effect of the catalogue is certain to be missing, but the declared model does not explain "
            f"everything: {failed} tests of its one-step errors fail."
        )
    if not found:
        return "Nothing is missing that these data could show: the declared model explains them."
    names = listed([words(key_of(f.effect)) for f in found])
    it = "it" if len(found) == 1 else "them"
    text = f"The model lacks {names}"
    if not error:
        return text + "."
    at = error["horizons_s"].index(1.0)
    ratios = [
        (c, error["before"][c][at], error["after"][c][at])
        for c in error["before"]
        if error["after"][c][at] and math.isfinite(error["before"][c][at])
    ]
    if not ratios:
        return text + "."
    column, before, after = ratios[0]
    if after >= before:
        return (
            f"The training data ask for {names}, but on test data the 1 s prediction error of {column} does not fall "
            f"with {it} ({before:.3g} before, {after:.3g} after): do not trust it."
        )
    return (
        f"{text}; with {it} the 1 s prediction error of {column} falls from {before:.3g} to {after:.3g} on test data."
    )


def listed(names: Sequence[str]) -> str:
    """Names as a sentence lists them."""
    return " and ".join(filter(None, (", ".join(names[:-1]), names[-1])))


def friction_change(closed: Closed, velocity: Float[np.ndarray, "dof node"]) -> str | None:
    """How far the missing effect had bent the learned friction."""
    if not (closed.found and closed.before.rig.friction):
        return None
    first, second = (np.asarray(friction_table(f, jnp.asarray(velocity)).torque) for f in (closed.before, closed.after))
    size = np.sqrt(np.mean(second**2, axis=1))
    share = np.sqrt(np.mean((first - second) ** 2, axis=1)) / np.maximum(size, 1e-12)
    parts = [f"joint {j + 1} by {100 * s:.0f} %" for j, s in enumerate(share)]
    return f"Without the effect the learned friction was bent: {', '.join(parts)} of its size."


def advice(found: Sequence[Finding]) -> list[str]:
    """What to look at next."""
    out = []
    for finding in found:
        if finding.effect.confirm:
            out.append(f"To be sure of the {words(key_of(finding.effect))}: {finding.effect.confirm}")
        for key in finding.equivalent:
            out.append(f"To tell it from {words(key)}: {catalogue[key[0]].confirm}")
    if not found:
        out.append(
            "Longer or livelier motion shows weaker effects; drive every joint through its whole range of speed."
        )
    return out


def entry(finding: Finding) -> dict[str, Any]:
    """A finding as the report has it."""
    name, joint, channel, inputs = key_of(finding.effect)
    return {
        "name": name,
        "joint": joint,
        "channel": channel,
        "inputs": list(inputs),
        "parameters": {n: p._asdict() for n, p in finding.parameters.items()},
        "evidence": finding.evidence,
        "equivalent": [{"name": k[0], "joint": k[1], "channel": k[2]} for k in finding.equivalent],
        "description": finding.sentence,
        "confirm": finding.effect.confirm,
    }
