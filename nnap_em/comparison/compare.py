"""Two or more fits of one machine side by side: every number with its difference, its test and one pooled value."""

import itertools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..data.machine import unpacked
from ..diagnosis.findings import Estimate, estimates
from ..diagnosis.hypothesis import covariances
from ..diagnosis.keys import key_of, listed, words
from ..diagnosis.statistics import holm
from ..fit.identify import Identified, friction_table, nodes_between, parameter_table
from ..fit.store import model_file, read
from ..model.friction import FrictionNetwork
from ..model.law import CALLED, LAW_UNITS, fit_law
from ..numerics.digits import counted
from .pooling import JointTest, Pooled, apart, joint_test, pool

CHANGED = 0.01
"""Corrected p-value below which a quantity counts as changed [probability of naming any change where there is none].

A hundred comparisons of machines that did not change give one false alarm, whatever the number of quantities; a change
by five of its standard deviations still counts among ten thousand quantities."""


class CompareError(ValueError):
    """Fits that cannot be compared: the message names them and the reason, with a hint."""


class Fit(NamedTuple):
    """One of the fits."""

    name: str
    fitted: Identified
    fingerprint: str = ""
    """Fingerprint of its logs; empty where it is not known."""


class Quantity(NamedTuple):
    """An estimated number in every fit, or the numbers of a friction curve, which are tested as one."""

    name: str
    rows: tuple[tuple[str, str], ...]
    """Name and unit of each number."""
    value: Float[np.ndarray, "fit number"]
    """NaN in a fit that does not estimate it."""
    std: Float[np.ndarray, "fit number"]
    difference: Float[np.ndarray, " number"]
    """Difference between the fits [standard deviations]."""
    pooled: Pooled
    test: JointTest | None
    """None where fewer than two fits estimate it."""

    @property
    def changed(self) -> bool:
        """True where it differs by more than the stated errors explain."""
        return self.test is not None and self.test.p_value < CHANGED


class Comparison(NamedTuple):
    """Fits of one machine side by side."""

    fits: tuple[Fit, ...]
    quantities: tuple[Quantity, ...]
    warnings: tuple[str, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the fits."""
        return tuple(fit.name for fit in self.fits)

    @property
    def changed(self) -> tuple[str, ...]:
        """Quantities that changed."""
        return tuple(quantity.name for quantity in self.quantities if quantity.changed)

    @property
    def verdict(self) -> str:
        """The outcome of the tests in one sentence."""
        tested = counted(sum(q.test is not None for q in self.quantities), "tested quantity", "tested quantities")
        several = f"{len(self.changed) or 'None'} of {tested} changed between {listed(self.names)}"
        which = f": {listed(self.changed)}; `diagnose --from` names the reason" if self.changed else ""
        return f"{several} beyond the stated errors (at {CHANGED:.0%}){which}."

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
        Parameters and friction curves with their values, differences and p-values; `print` shows the outcome.

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
    pairs = list(itertools.combinations(together, 2))
    for one, two in pairs:
        _check(one, two)
    quantities = corrected([*_curves(together), *_numbers(together)])
    warnings = tuple(
        f"{one.name} and {two.name} are of the same logs: their errors are not independent"
        for one, two in pairs
        if one.fingerprint and one.fingerprint == two.fingerprint
    )
    return Comparison(together, quantities, warnings)


def corrected(quantities: Sequence[Quantity]) -> tuple[Quantity, ...]:
    """The quantities with p-values that are corrected for their number."""
    p = iter(holm([q.test.p_alone for q in quantities if q.test is not None]))
    return tuple(q if q.test is None else q._replace(test=q.test._replace(p_value=float(next(p)))) for q in quantities)


# --- the fits


def _opened(fit: Path | str | Identified) -> Fit:
    """A fit with all that is known of its logs."""
    if isinstance(fit, Identified):
        return Fit("", fit)
    stored = read(model_file(Path(fit)))
    return Fit("", stored.fitted, stored.fingerprint)


def _labels(sources: Sequence[Path | str | Identified], opened: Sequence[Fit]) -> tuple[str, ...]:
    """Short names that differ: of the folder, else the paths as they are given, else numbers."""
    short, full = [], []
    for source, fit in zip(sources, opened, strict=True):
        path = None if isinstance(source, Identified) else model_file(Path(source)).absolute()
        folder = path and (path.parent.name if path.stem in ("model", "after") else path.stem)
        short.append(folder or fit.fitted.rig.name)
        full.append(str(source) if folder else short[-1])
    numbered = [f"fit {i}" for i in range(1, len(short) + 1)]
    return tuple(next(labels for labels in (short, full, numbered) if len(set(labels)) == len(labels)))


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


def _curves(fits: Sequence[Fit]) -> Iterator[Quantity]:
    """The friction of every joint: a test of the curves on the velocities that all fits know, and Stribeck numbers."""
    networks = {i: fit.fitted.model.unknown for i, fit in enumerate(fits)}
    places = [i for i, network in networks.items() if isinstance(network, FrictionNetwork)]
    if not places:
        return
    reach = np.min([np.asarray(networks[i].speed) for i in places], axis=0)  # type: ignore[attr-defined]
    compared_velocities = 41  # velocities of a friction curve: as many as the M-step has
    nodes = nodes_between(-reach, reach, compared_velocities)
    tables = [friction_table(fits[i].fitted, jnp.asarray(nodes)) for i in places]
    for j, angle in enumerate(fits[0].fitted.model.system.angles[: len(nodes)]):
        torque, cov = np.stack([table.torque[j] for table in tables]), np.stack([table.cov[j] for table in tables])
        law = fit_law(np.stack([nodes[j]] * len(places)), torque, cov)
        value, std = np.full((2, len(fits), len(CALLED)), np.nan)
        value[places], std[places] = law.value, law.std
        test = joint_test(torque, cov) if len(places) > 1 else None
        rows = tuple(zip(CALLED, LAW_UNITS[angle], strict=True))
        yield quantity(f"friction of joint {j + 1}", rows, value, std, test)


def _numbers(fits: Sequence[Fit]) -> Iterator[Quantity]:
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
        yield number(name, next(entry.unit for entry in entries if entry is not None), value, std, prior)


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
) -> Quantity:
    """A number, tested and pooled over the fits that estimate it."""
    has = np.isfinite(value) & np.isfinite(std) & (std > 0)
    test = joint_test(value[has, None], std[has, None, None] ** 2) if has.sum() > 1 else None
    return quantity(name, ((name, unit),), value[:, None], std[:, None], test, prior_std)


def quantity(
    name: str,
    rows: tuple[tuple[str, str], ...],
    value: Float[np.ndarray, "fit number"],
    std: Float[np.ndarray, "fit number"],
    test: JointTest | None,
    prior_std: float = np.inf,
) -> Quantity:
    """Numbers with their differences, pooled over the fits that estimate them, the errors widened as the test has it.

    A prior of standard deviation `prior_std` is in all of them.
    """
    has = (np.isfinite(value) & np.isfinite(std) & (std > 0)).all(axis=1)
    values, stds = value[has], std[has]
    pooled = pool(values, stds, max(prior_std, stds.max(initial=0.0)), 1.0 if test is None else test.widened)
    return Quantity(name, rows, value, std, apart(values, stds), pooled, test)
