"""Signs that a fitted model does not describe its machine: random forces as large as the motion, numbers far off."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from ..data.dataset import Dataset
from ..em.build import measure_scales
from .identify import Identified
from .predict import GIVEN

PUSHED = 0.85
"""Random acceleration of a fit as a share of that of the motion, from which on forces without a law move the joint.

With a torque of the wrong sign it is 1.1, with an encoder off by 10 degrees 0.13, on real double pendulums 0.2 to 0.5
and on a servo whose friction grows with the load 0.66.
"""
UNPREDICTED = 0.25
"""Error 1 s ahead on test sequences, as a share of the motion, below which a fit predicts whatever pushes."""
LEFT = 3.0
"""Distance of a fitted number from its declaration that is reported [standard deviations]: 1 in 370 by chance.
Three measured rigs with planted effects had 3.4 to 16 without their law, and 0.8 to 2.5 with it."""


class Misfit(NamedTuple):
    """A joint that random forces move."""

    name: str
    pushed: float
    """Random acceleration of the fit [rad/s^2, or m/s^2]."""
    moved: float
    """Acceleration of the motion [rad/s^2, or m/s^2]."""
    unit: str

    @property
    def sentence(self) -> str:
        """The two accelerations."""
        return f"random forces accelerate {self.name} by {self.pushed:.2g} {self.unit}, all forces by {self.moved:.2g}"


class Moved(NamedTuple):
    """A fitted number that has left its declaration."""

    name: str
    value: float
    declared: float
    distance: float
    """Standard deviations of the declaration."""
    unit: str

    @property
    def sentence(self) -> str:
        """Number, declaration and meaning."""
        number = f"{self.name} = {self.value:.4g} {self.unit}".strip()
        return (
            f"{number} is {abs(self.distance):.1f} std from what is declared ({self.declared:.4g}): something is "
            "missing in the model, or rig.toml is wrong."
        )


def moved(fitted: Identified) -> list[Moved]:
    """Numbers of the rig that the fit has moved by more than `LEFT` of their declared std, the farthest first."""
    prior = fitted.m_step.prior
    if not prior.declared:
        return []
    z = np.asarray(prior.read(fitted.model))[: len(prior.declared)]
    numbers = zip(prior.declared, z, np.asarray(prior.mean), np.asarray(prior.std), strict=False)
    far = [
        Moved(n, float(m + s * d), float(m), float(d), fitted.rig.unit(n)) for n, d, m, s in numbers if abs(d) > LEFT
    ]
    return sorted(far, key=lambda one: -abs(one.distance))


def misfits(fitted: Identified, data: Dataset, error: Mapping[str, Any] | None, test: Dataset | None) -> list[Misfit]:
    """Joints whose motion the fit takes for random; empty where it predicts the test sequences all the same, or where
    its epochs ended before it came to rest.

    The random acceleration is the process noise of a rate in a step over the length of the step.
    """
    if fitted.rise or fitted.rig.equations:
        return []
    rig, system, dof = fitted.rig, fitted.model.system, len(fitted.model.system.rates)
    moving = measure_scales(rig, system, data).acceleration
    pushed = np.exp(0.5 * np.asarray(fitted.model.log_q))[dof : 2 * dof] / rig.dt
    out = []
    for name, rate, random, real in zip(system.coordinates, system.rates, pushed, moving, strict=True):
        columns = [column for column in (name, rate) if column in rig.measured]
        if columns and random > PUSHED * real and not _predicted(columns[0], rig.measured, error, test):
            out.append(Misfit(name, float(random), float(real), f"{system.unit(rate)}^2"))
    return out


def _predicted(column: str, names: tuple[str, ...], error: Mapping[str, Any] | None, test: Dataset | None) -> bool:
    """True where the error over 1 s is small beside the motion in that time."""
    if not error or test is None or 1.0 not in error["horizons_s"]:
        return False
    y = np.asarray(test.y)[..., names.index(column)]
    since = np.asarray(test.t) - np.asarray(test.t)[:, :1] - GIVEN
    ahead = np.where(np.asarray(test.valid) & (since > 0) & (since <= 1.0), y, np.nan)
    ahead = ahead[np.isfinite(ahead).any(axis=1)]
    motion = np.sqrt(np.nanmean((ahead - np.nanmean(ahead, axis=1, keepdims=True)) ** 2)) if len(ahead) else 0.0
    return bool(error["fit"][column][error["horizons_s"].index(1.0)] < UNPREDICTED * motion)
