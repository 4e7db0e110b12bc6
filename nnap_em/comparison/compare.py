"""Two or more fits of one machine side by side: the numbers that changed, those that did not, and one pooled answer."""

import itertools
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from ..data.machine import unpacked
from ..diagnosis.findings import Estimate, estimates
from ..diagnosis.hypothesis import covariances
from ..diagnosis.keys import Key, key_of, listed, words
from ..diagnosis.statistics import holm
from ..fit.identify import Identified, friction_table, nodes_between, parameter_table
from ..fit.store import model_file, read
from ..model.friction import FrictionNetwork
from ..model.law import CALLED, LAW_UNITS, fit_law
from ..numerics.digits import counted
from .pooling import JointTest, Pooled, joint_test, pool

CHANGED = 0.01
"""Corrected p-value below which a quantity counts as changed [probability of naming any change where there is none].

A hundred comparisons of machines that did not change give one false alarm, whatever the number of quantities; a change
by five of its standard deviations still counts among ten thousand quantities."""
LEAST_SHARED = 0.5
"""Smallest share of the range that two fits visited together which both visited [1]; below it the page warns.

Friction depends on velocity and on load: where most of a range was visited by one fit only, the curves can differ
there by what the other had to guess."""


class CompareError(ValueError):
    """Fits that cannot be compared: the message names them and the reason, with a hint."""


class Fit(NamedTuple):
    """One of the fits."""

    name: str
    fitted: Identified
    velocity: Float[np.ndarray, "dof 2"]
    """Lowest and highest velocity that it visited [rad/s]."""
    load: Float[np.ndarray, "dof 2"]
    """Lowest and highest torque of the drive [N m]; NaN where it is not known or nothing drives the joint."""
    fingerprint: str = ""
    """Fingerprint of its logs; empty where it is not known."""


class Number(NamedTuple):
    """An estimated number in every fit."""

    name: str
    unit: str
    value: Float[np.ndarray, " fit"]
    """NaN in a fit that does not estimate it."""
    std: Float[np.ndarray, " fit"]
    pooled: Pooled
    test: JointTest | None
    """None where fewer than two fits estimate it."""

    @property
    def changed(self) -> bool:
        """True where it differs by more than the stated errors explain."""
        return self.test is not None and self.test.p_value < CHANGED


class Curve(NamedTuple):
    """The friction of a joint in every fit that learned it."""

    joint: int
    """Counted from 1."""
    fits: tuple[int, ...]
    """Places of these fits."""
    velocity: Float[np.ndarray, " node"]
    """Velocities that all of them visited [rad/s]."""
    torque: Float[np.ndarray, "fit node"]
    """[N m]"""
    cov: Float[np.ndarray, "fit node node"]
    """[N^2 m^2]"""
    units: tuple[str, str]
    """Units of velocity and torque."""
    pooled: Pooled
    test: JointTest
    law: tuple[Number, ...]
    """The Stribeck numbers; their tests locate the change of a curve, and are no quantities of their own."""

    @property
    def std(self) -> Float[np.ndarray, "fit node"]:
        """Standard deviation of the torque [N m]."""
        return np.sqrt(np.diagonal(self.cov, axis1=1, axis2=2))

    @property
    def name(self) -> str:
        """Name for a reader."""
        return f"friction of joint {self.joint}"

    @property
    def changed(self) -> bool:
        """True where it differs by more than the stated errors explain."""
        return self.test.p_value < CHANGED

    @property
    def impossible(self) -> str:
        """Change of a Stribeck number that friction cannot have, in words; empty where there is none."""
        numbers = dict(zip(CALLED, self.law, strict=False))
        if self.changed and numbers["constant"].changed:
            return f"joint {self.joint} by a constant"
        far = numbers["viscous"].value / np.where(numbers["viscous"].std > 0, numbers["viscous"].std, np.inf)
        # standard deviations from 0 in one fit, and in the other, from which on it cannot have gone so
        gone = self.changed and np.nanmax(far) > 5.0 and np.nanmin(far) < 2.0
        return f"joint {self.joint} to a viscous friction of 0" if gone and numbers["viscous"].changed else ""

    @property
    def parts(self) -> tuple[Number, ...]:
        """The Stribeck numbers that changed, of a curve that did."""
        return tuple(number for number in self.law if self.changed and number.changed)


class Cause(NamedTuple):
    """A change from one fit to the other, by their recordings (`cause.explained`)."""

    text: str
    bent: str
    """Reason for which friction curves differ with it; empty where it is friction that changed."""
    judged: tuple[str, ...]
    """Sentences on the errors of each fit on the recordings of the other."""


class Comparison(NamedTuple):
    """Fits of one machine side by side."""

    fits: tuple[Fit, ...]
    curves: tuple[Curve, ...]
    numbers: tuple[Number, ...]
    """Parameters of the machine and of effects."""
    differences: tuple[str, ...]
    """Effects and parameters that some fits have and others lack."""
    warnings: tuple[str, ...]
    cause: Cause | None = None
    """None where the recordings are not at hand, or no quantity differs."""
    widened: Mapping[str, float] = {}
    """Multiple of the stated errors to which those of a quantity are widened, as recordings show no change."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the fits."""
        return tuple(fit.name for fit in self.fits)

    @property
    def changed(self) -> tuple[str, ...]:
        """Quantities that changed."""
        return tuple(quantity.name for quantity in (*self.curves, *self.numbers) if quantity.changed)

    @property
    def verdict(self) -> str:
        """The outcome: the quantities that changed, then the effects and parameters that some fits lack."""
        cause = [] if self.cause is None else [self.cause.text]
        return " ".join([*cause, self._tested, *(f"{text[0].upper()}{text[1:]}." for text in self.differences)])

    @property
    def other(self) -> str:
        """Reason for which something other than friction changed; empty where there is none, or recordings decide."""
        bent = [curve for curve in self.curves if curve.changed]
        if self.cause is not None:
            return self.cause.bent if bent else ""
        # joints wear one by one; a load, a sensor or the supply bends every curve
        reasons = ["several at once"] if len(bent) >= 2 else []
        reasons += [curve.impossible for curve in bent if curve.impossible]
        other = "something other than friction changed, such as a load or a sensor"
        return f"{listed(reasons)}: {other}" if reasons else ""

    @property
    def _tested(self) -> str:
        """The outcome of the tests in one sentence."""
        tests = sum(number.test is not None for number in self.numbers) + len(self.curves)
        between = f"between {listed(self.names)}"
        if self.widened:
            verb = "differs" if len(self.widened) == 1 else "differ"
            times = listed([f"{ratio:.1f}" for ratio in self.widened.values()])
            text = f"{listed([*self.widened])} {verb} {between} by {times} times the stated errors, now widened by that"
            return f"{text[0].upper()}{text[1:]}: the recordings do not confirm it."
        if not self.changed:
            nothing = "No tested quantity" if self.differences else "Nothing"
            tested = counted(tests, "quantity", "quantities")
            return f"{nothing} changed {between} beyond the stated errors: {tested} tested at {CHANGED:.0%}."
        changed = []
        bent = [f"joint {curve.joint}" for curve in self.curves if curve.changed]
        moved = [number.name for number in self.numbers if number.changed]
        if self.other:
            also = f" Different as well: {listed(moved)}." if moved else ""
            return f"The friction curves of {listed(bent)} differ {between}, {self.other}.{also}"
        for curve in self.curves:
            parts = f" ({listed([part.name for part in curve.parts])})" if curve.parts else ""
            changed += [f"the {curve.name}{parts}"] * curve.changed
        unchanged = tests - len(changed) - len(moved)
        others = counted(unchanged, "other quantity", "other quantities")
        others = f"{others} did not" if unchanged else "no other quantity was tested"
        verb = "differed" if self.cause and self.cause.bent else "changed"
        text = f"{listed([*changed, *moved])} {verb} {between}; {others}."
        return text[0].upper() + text[1:]

    def __str__(self) -> str:
        return "\n  ".join(["Comparison", self.verdict, *self.warnings])


def compare(*fits: Path | str | Identified, names: Sequence[str] = ()) -> Comparison:
    """Compare two or more fits of one machine.

    Every parameter and every friction curve is tested for a change by `pooling.joint_test` with the covariance that
    its fits state; p-values are corrected for the number of quantities [Holm 1979, Scand. J. Stat. 6, 65]. The prior
    draws all fits to one value, which only makes alarms rarer.

    Args:
        *fits: folders or files of `identify` and `diagnose`, or fitted models.
        names: a name for each, for the reader; without them those of the files.

    Returns:
        Curves, parameters and effects with their changes and p-values; `print` shows a table.

    Raises:
        CompareError: the fits are fewer than two, the same, or of different machines.
        StoreError: a file is no fit.

    Example:
        >>> [fit.name for fit in nnap_em.compare(fit, other, names=("January", "June")).fits]
        ['January', 'June']
    """
    opened = [_opened(fit) for fit in fits]
    labels = tuple(names) or _labels(fits, opened)
    if len(opened) < 2:
        raise CompareError(f"{len(opened) or 'no'} fit is given; give two or more, of one machine")
    if len(set(labels)) != len(opened):
        raise CompareError(f"names {', '.join(labels)} for {len(opened)} fits; give each fit a name of its own")
    together = tuple(fit._replace(name=label) for fit, label in zip(opened, labels, strict=True))
    for one, two in itertools.combinations(together, 2):
        _check(one, two)
    return _beside(together, {})


def _beside(fits: tuple[Fit, ...], widened: Mapping[str, float]) -> Comparison:
    """All quantities with their tests, and their p-values corrected for the number of quantities."""
    curves, numbers = tuple(_curves(fits, widened)), tuple(_numbers(fits, widened))
    tests = [quantity.test for quantity in (*curves, *numbers)]
    corrected = iter(corrected_tests([test for test in tests if test is not None]))
    curves = tuple(curve._replace(test=next(corrected)) for curve in curves)
    numbers = tuple(n if n.test is None else n._replace(test=next(corrected)) for n in numbers)
    return Comparison(fits, curves, numbers, tuple(_differences(fits)), tuple(_warnings(fits)), widened=widened)


def unconfirmed(comparison: Comparison) -> Comparison:
    """The same where recordings show no change: fits that differ by more than they state show what their errors are.

    Of each quantity that differs they are widened by (Q / degrees of freedom)^1/2 [Birge 1932, Phys. Rev. 40, 207].
    """
    tests = {each.name: each.test for each in (*comparison.curves, *comparison.numbers) if each.changed and each.test}
    return _beside(comparison.fits, {name: math.sqrt(test.statistic / test.freedom) for name, test in tests.items()})


def corrected_tests(tests: Sequence[JointTest]) -> list[JointTest]:
    """The tests with corrected p-values."""
    p = holm([test.p_alone for test in tests])
    return [test._replace(p_value=float(value)) for test, value in zip(tests, p, strict=True)]


# --- the fits


def _opened(fit: Path | str | Identified) -> Fit:
    """A fit with all that is known of its logs."""
    if isinstance(fit, Identified):
        return Fit("", fit, *_visited(fit, None))
    file = model_file(Path(fit))
    stored = read(file)
    return Fit("", stored.fitted, *_visited(stored.fitted, file), stored.fingerprint)


def _labels(sources: Sequence[Path | str | Identified], opened: Sequence[Fit]) -> tuple[str, ...]:
    """Short names that differ: of the folder, else the paths as they are given, else numbers."""
    paths = [None if isinstance(fit, Identified) else model_file(Path(fit)).absolute() for fit in sources]
    short = [
        fit.fitted.rig.name if path is None else path.parent.name if path.stem in ("model", "after") else path.stem
        for path, fit in zip(paths, opened, strict=True)
    ]
    full = [name if isinstance(fit, Identified) else str(fit) for name, fit in zip(short, sources, strict=True)]
    numbered = [f"fit {i}" for i in range(1, len(short) + 1)]
    return tuple(next(labels for labels in (short, full, numbered) if len(set(labels)) == len(labels)))


def _visited(fitted: Identified, file: Path | None) -> tuple[Float[np.ndarray, "dof 2"], Float[np.ndarray, "dof 2"]]:
    """Ranges of velocity and load: of the report beside the model, else of the network."""
    dof = len(fitted.model.system.coordinates)
    unknown = np.full((dof, 2), np.nan)
    if file is not None and (report := file.with_name("report.json")).exists():
        rows = json.loads(report.read_text()).get("visited") or []
        if len(rows) == dof:
            load = [row["load"] or [np.nan, np.nan] for row in rows]
            return np.asarray([row["velocity"] for row in rows], float), np.asarray(load, float)
    network = fitted.model.unknown
    if not isinstance(network, FrictionNetwork):
        return unknown, unknown
    speed = np.asarray(network.speed)
    return np.stack([-speed, speed], axis=1), unknown


def _check(one: Fit, two: Fit) -> None:
    """Refuse fits of different machines, and a fit beside itself."""
    hint = "compare fits of one machine"
    a, b = one.fitted, two.fitted
    if a.rig.system != b.rig.system:
        raise CompareError(f"{one.name} is of system {a.rig.system} and {two.name} of {b.rig.system}; {hint}")
    joints = [listed(fit.model.system.coordinates) for fit in (a, b)]
    if joints[0] != joints[1]:
        raise CompareError(f"{one.name} has the joints {joints[0]} and {two.name} has {joints[1]}; {hint}")
    if lacking := sorted({*a.rig.parameters} ^ {*b.rig.parameters}):
        has, lacks = (one, two) if lacking[0] in a.rig.parameters else (two, one)
        raise CompareError(f"{has.name} declares {lacking[0]} and {lacks.name} does not; {hint}")
    for name, declared in a.rig.parameters.items():
        other = b.rig.parameters[name]
        if declared.std == other.std == 0 and declared.mean != other.mean:
            values = f"{declared.mean:.6g} in {one.name} and {other.mean:.6g} in {two.name}"
            raise CompareError(f"the trusted {name} is {values}; {hint}, or declare it as uncertain in both")
    if a.rig.equations != b.rig.equations:
        raise CompareError(f"the equations of {one.name} and {two.name} differ; {hint}")
    if a.rig.machine and _body(a) != _body(b):
        raise CompareError(f"the machine files of {one.name} and {two.name} differ; {hint}")
    if all(np.array_equal(x, y) for x, y in zip(_identity(a), _identity(b), strict=True)):
        raise CompareError(f"{one.name} and {two.name} are the same fit; give each fit once")


def _body(fitted: Identified):
    """The machine of a file without its path and its sensors."""
    return unpacked(fitted.rig.machine)._replace(file="", joint_sensors=(), sites=(), sensors=())


def _identity(fitted: Identified) -> tuple:
    """Numbers by which a fit is identified."""
    model, weights = fitted.model, fitted.m_step.weights(fitted.model)
    return weights.read(model), model.log_q, model.log_r, fitted.state.hessian, fitted.state.loglik


# --- the quantities


def _curves(fits: Sequence[Fit], widened: Mapping[str, float]) -> Iterator[Curve]:
    """The friction of every joint of which all fits visited a common range of velocities."""
    places = tuple(i for i, fit in enumerate(fits) if fit.fitted.rig.friction)
    if len(places) < 2:
        return
    ranges = np.stack([fits[i].velocity for i in places])
    low, high = ranges[:, :, 0].max(axis=0), ranges[:, :, 1].min(axis=0)
    common = low < high
    compared_velocities = 41  # velocities of a friction curve: as many as the M-step has
    nodes = nodes_between(np.where(common, low, -1.0), np.where(common, high, 1.0), compared_velocities)
    tables = [friction_table(fits[i].fitted, jnp.asarray(nodes)) for i in places]
    for j in np.flatnonzero(common):
        torque, cov = (
            np.stack([np.asarray(getattr(table, part)[j]) for table in tables]) for part in ("torque", "cov")
        )
        cov = widened.get(f"friction of joint {j + 1}", 1.0) ** 2 * cov
        std = np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
        angle = fits[0].fitted.model.system.angles[j]
        pooled, test = pool(torque, std), joint_test(torque, cov)
        law = _law(np.stack([nodes[j]] * len(places)), torque, cov, angle, places, len(fits))
        yield Curve(int(j) + 1, places, nodes[j], torque, cov, tables[0].units[j], pooled, test, law)


def _law(velocity, torque, cov, angle: bool, places: Sequence[int], count: int) -> tuple[Number, ...]:
    """Stribeck numbers of one joint, their p-values corrected among each other."""
    law_fit = fit_law(velocity, torque, cov)
    value, std = np.full((2, count, len(CALLED)), np.nan)
    value[list(places)], std[list(places)] = law_fit.value, law_fit.std
    rows = [
        number(name, unit, value[:, i], std[:, i])
        for i, (name, unit) in enumerate(zip(CALLED, LAW_UNITS[angle], strict=True))
    ]
    tests = corrected_tests([row.test for row in rows if row.test is not None])
    return tuple(row._replace(test=test) for row, test in zip(rows, tests, strict=True))


def _numbers(fits: Sequence[Fit], widened: Mapping[str, float]) -> Iterator[Number]:
    """The estimated parameters of the machine and of effects."""
    tables = [_estimates(fit.fitted) for fit in fits]
    periodic = "phase of"  # beginning of parameters of effects that are the same after a whole turn [rad]
    for name in dict.fromkeys(itertools.chain(*tables)):
        entries = [table.get(name) for table in tables]
        value, std = (np.asarray([np.nan if entry is None else entry[i] for entry in entries], float) for i in range(2))
        if name.startswith(periodic):
            first = value[np.isfinite(value)][0]
            value = first + np.remainder(value - first + np.pi, 2 * np.pi) - np.pi
        priors = (fit.fitted.rig.parameters[name].std for fit in fits if name in fit.fitted.rig.parameters)
        prior = min((prior for prior in priors if prior > 0), default=np.inf)
        unit, by = next(entry.unit for entry in entries if entry is not None), widened.get(name, 1.0)
        yield number(name, unit, value, by * std, by * prior)


def _estimates(fitted: Identified) -> dict[str, Estimate]:
    """The estimated parameters of the machine, and the reported ones of effects."""
    model = fitted.model
    pairs = zip(model.effects, covariances(model, fitted.m_step, fitted.state.hessian), strict=True)
    return {name: Estimate(*pair, fitted.rig.unit(name)) for name, pair in parameter_table(fitted).items()} | {
        f"{name} of {words(key_of(effect))}": estimate
        for effect, cov in pairs
        for name, estimate in estimates(effect, cov, model.system).items()
    }


def number(
    name: str, unit: str, value: Float[np.ndarray, " fit"], std: Float[np.ndarray, " fit"], prior_std: float = np.inf
) -> Number:
    """A number, tested and pooled over the fits that estimate it."""
    has = np.isfinite(value) & np.isfinite(std) & (std > 0)
    test = joint_test(value[has, None], std[has, None, None] ** 2) if has.sum() > 1 else None
    stds = std[has, None]
    return Number(name, unit, value, std, pool(value[has, None], stds, max(prior_std, stds.max(initial=0.0))), test)


# --- the rest that a reader should know


def _differences(fits: Sequence[Fit]) -> Iterator[str]:
    """Effects, learned friction and estimated parameters that some fits have and others lack."""

    def lines(name: str, has: Bool[np.ndarray, " fit"], lacking: str) -> Iterator[str]:
        if has.any() and not has.all():
            inside, outside = (
                [fit.name for fit, h in zip(fits, has, strict=True) if h == side] for side in (True, False)
            )
            yield f"{name} in {listed(inside)}, {lacking} in {listed(outside)}"

    keys: list[list[Key]] = [[key_of(effect) for effect in fit.fitted.model.effects] for fit in fits]
    for key in dict.fromkeys(itertools.chain(*keys)):
        yield from lines(f"{words(key)} is", np.asarray([key in held for held in keys]), "not")
    yield from lines("friction is learned", np.asarray([fit.fitted.rig.friction for fit in fits]), "not")
    tables = [parameter_table(fit.fitted) for fit in fits]
    for name in dict.fromkeys(itertools.chain(*tables)):
        yield from lines(f"{name} is estimated", np.asarray([name in table for table in tables]), "kept as declared")


def _warnings(fits: Sequence[Fit]) -> Iterator[str]:
    """Reasons for which a change would mean nothing."""
    for one, two in itertools.combinations(fits, 2):
        if one.fingerprint and one.fingerprint == two.fingerprint:
            yield f"{one.name} and {two.name} are of the same logs: their errors are not independent"
    if sum(fit.fitted.rig.friction for fit in fits) < 2:
        return
    system = fits[0].fitted.model.system
    units = {"velocity": [system.unit(rate) for rate in system.rates]}
    units["load"] = [system.force_unit(j + 1) for j in range(len(system.rates))]
    meaningless = "a change of its friction may be one of the motion, not of the machine"
    for kind, j in itertools.product(units, range(len(system.rates))):
        pairs = [(shared(getattr(a, kind)[j], getattr(b, kind)[j]), a, b) for a, b in itertools.combinations(fits, 2)]
        share, one, two = min(pairs, key=lambda pair: pair[0])
        if share < LEAST_SHARED:
            ranges = " and ".join(
                f"{fit.name} {getattr(fit, kind)[j][0]:.3g} to {getattr(fit, kind)[j][1]:.3g}" for fit in (one, two)
            )
            unmeasured = kind == "velocity" and share == 0
            means = "its friction is not compared" if unmeasured else meaningless
            yield f"joint {j + 1}: the {kind} ranges of {ranges} {units[kind][j]} share {share:.0%}; {means}"


def shared(one: Float[np.ndarray, " 2"], two: Float[np.ndarray, " 2"]) -> float:
    """Share of the range that two visited together which both visited; 1 where either is not known."""
    inside = min(one[1], two[1]) - max(one[0], two[0])
    union = max(one[1], two[1]) - min(one[0], two[0])
    return float(np.clip(inside / union, 0.0, 1.0)) if np.isfinite(union) and union > 0 else 1.0
