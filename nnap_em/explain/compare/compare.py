"""Two or more fits of one machine side by side: every number with its difference, its test and one pooled value."""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ...base.digits import counted
from ...errors import CompareError
from ...estimate.identify import Identified, friction_table, nodes_between, parameter_table
from ...estimate.store import load, model_file
from ...machines.machine import unpacked
from ...machines.rig import Rig
from ...model.friction import FrictionNetwork
from ...model.law import CALLED, LAW_UNITS, fit_law
from ..diagnosis.findings import Estimate, estimates
from ..diagnosis.hypothesis import covariances
from ..diagnosis.keys import key_of, listed, words
from ..diagnosis.statistics import holm
from .pooling import JointTest, Pooled, apart, joint_test, pool

CHANGED = 0.01
"""Corrected p-value below which a quantity counts as changed [probability of naming any change where there is none].

A hundred comparisons of machines that did not change give one false alarm, whatever the number of quantities; a change
by five of its standard deviations still counts among ten thousand quantities."""


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
    """None where fewer than two fits estimate it; its p-value is corrected for the number of quantities."""

    @property
    def changed(self) -> bool:
        """True where it differs by more than the stated errors explain."""
        return self.test is not None and self.test.p_value < CHANGED


class Comparison(NamedTuple):
    """Fits of one machine side by side."""

    rig: Rig
    names: tuple[str, ...]
    """Names of the fits."""
    quantities: tuple[Quantity, ...]

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
        return f"Comparison\n  {self.verdict}"


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
        CompareError: the fits are fewer than two, or of different machines.
        StoreError: a file is no fit.

    Example:
        >>> nnap_em.compare(fit, other, names=("January", "June")).names
        ('January', 'June')
    """
    opened = [fit if isinstance(fit, Identified) else load(model_file(Path(fit))) for fit in fits]
    labels = tuple(names) or _labels(fits)
    if len(opened) < 2:
        raise CompareError(f"{len(opened) or 'no'} fit is given; give two or more, of one machine")
    if len({*labels}) != len(opened):
        raise CompareError(f"names {', '.join(labels)} for {len(opened)} fits; give each fit a name of its own")
    for name, fit in zip(labels[1:], opened[1:], strict=True):
        _check({labels[0]: opened[0], name: fit})
    return Comparison(opened[0].rig, labels, corrected([*_curves(opened), *_numbers(opened)]))


def corrected(quantities: Sequence[Quantity]) -> tuple[Quantity, ...]:
    """The quantities with p-values that are corrected for their number."""
    p = iter(holm([q.test.p_value for q in quantities if q.test is not None]))
    return tuple(q if q.test is None else q._replace(test=q.test._replace(p_value=float(next(p)))) for q in quantities)


# --- the fits


def _labels(fits: Sequence[Path | str | Identified]) -> tuple[str, ...]:
    """Short names of the fits: their folders, or the paths as they are given where two folders have one name."""
    short, full = [], []
    for i, fit in enumerate(fits, 1):
        path = None if isinstance(fit, Identified) else model_file(Path(fit)).absolute()
        short.append(f"fit {i}" if path is None else path.parent.name if path.stem in ("model", "after") else path.stem)
        full.append(f"fit {i}" if path is None else str(fit))
    return tuple(short if len({*short}) == len(short) else full)


def _check(pair: Mapping[str, Identified]) -> None:
    names, sides = " and ".join(pair), [_machine(fit) for fit in pair.values()]
    for what, one in sides[0].items():
        if (other := sides[1].get(what, one)) != one:
            values = f": {one} and {other}" if len(f"{one}{other}") < 80 else ""
            raise CompareError(f"{what} of {names} differs{values}; compare fits of one machine")


def _machine(fitted: Identified) -> dict[str, Any]:
    """All that fits of one machine have in common; its file counts without its path and its sensors."""
    rig, parameters = fitted.rig, fitted.rig.parameters
    return {
        "the system": rig.system,
        "the list of joints": listed(fitted.model.system.coordinates),
        "the list of parameters": listed(sorted(parameters)),
        "the text of the equations": rig.equations,
        "the machine file": rig.machine
        and unpacked(rig.machine)._replace(file="", joint_sensors=(), sites=(), sensors=()),
    } | {f"the trusted {name}": f"{number.mean:.6g}" for name, number in parameters.items() if number.std == 0}


# --- the quantities


def _curves(fits: Sequence[Identified]) -> Iterator[Quantity]:
    """The friction of every joint: a test of the curves on the velocities that all fits know, and Stribeck numbers."""
    networks = {i: fit.model.unknown for i, fit in enumerate(fits) if isinstance(fit.model.unknown, FrictionNetwork)}
    if not networks:
        return
    places, reach = [*networks], np.min([np.asarray(network.speed) for network in networks.values()], axis=0)
    nodes = nodes_between(-reach, reach, 41)  # as many as the M-step has
    tables = [friction_table(fits[i], jnp.asarray(nodes)) for i in places]
    for j, angle in enumerate(fits[0].model.system.angles[: len(nodes)]):
        torque, cov = np.stack([table.torque[j] for table in tables]), np.stack([table.cov[j] for table in tables])
        law = fit_law(np.stack([nodes[j]] * len(places)), torque, cov)
        value, std = np.full((2, len(fits), len(CALLED)), np.nan)
        value[places], std[places] = law.value, law.std
        test = joint_test(torque, cov) if len(places) > 1 else None
        yield quantity(
            f"friction of joint {j + 1}", tuple(zip(CALLED, LAW_UNITS[angle], strict=True)), value, std, test
        )


def _numbers(fits: Sequence[Identified]) -> Iterator[Quantity]:
    tables = [_estimates(fit) for fit in fits]
    for name in dict.fromkeys(itertools.chain(*tables)):
        entries = [table.get(name) for table in tables]
        value, std = (np.asarray([np.nan if entry is None else entry[i] for entry in entries], float) for i in range(2))
        if name.startswith("phase of"):  # the same after a whole turn
            first = value[np.isfinite(value)][0]
            value = first + np.remainder(value - first + np.pi, 2 * np.pi) - np.pi
        priors = (fit.rig.parameters[name].std for fit in fits if name in fit.rig.parameters)
        prior = min((prior for prior in priors if prior > 0), default=np.inf)
        unit = next(entry.unit for entry in entries if entry is not None)
        yield quantity(name, ((name, unit),), value[:, None], std[:, None], prior_std=prior)


def _estimates(fitted: Identified) -> dict[str, Estimate]:
    """The estimated parameters of the machine, and the reported ones of effects."""
    model = fitted.model
    pairs = zip(model.effects, covariances(model, fitted.m_step, fitted.state.hessian), strict=True)
    return {name: Estimate(*pair, fitted.rig.unit(name)) for name, pair in parameter_table(fitted).items()} | {
        f"{name} of {words(key_of(effect))}": estimate
        for effect, cov in pairs
        for name, estimate in estimates(effect, cov, model.system).items()
    }


def quantity(
    name: str,
    rows: tuple[tuple[str, str], ...],
    value: Float[np.ndarray, "fit number"],
    std: Float[np.ndarray, "fit number"],
    test: JointTest | None = None,
    prior_std: float = np.inf,
) -> Quantity:
    """Numbers with their differences, pooled over the fits that estimate them; their prior has std `prior_std`.

    One number alone is tested by its standard deviations.
    """
    has = (np.isfinite(value) & np.isfinite(std) & (std > 0)).all(axis=1)
    values, stds = value[has], std[has]
    if len(rows) == 1 and len(values) > 1:
        test = joint_test(values, stds[..., None] ** 2)
    pooled = pool(values, stds, max(prior_std, stds.max(initial=0.0)), test)
    return Quantity(name, rows, value, std, apart(values, stds), pooled, test)
