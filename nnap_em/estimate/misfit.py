"""Errors of the predictions of a fit beside its motion and its noise, and one word on them for every command."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..base.digits import number
from ..logs.dataset import Dataset
from ..logs.noise import reading_noise
from ..machines.rig import Rig
from ..model.state_space import StateSpaceModel
from .em.build import measure_scales
from .em.multistep import JUDGED, channels, grid_along
from .em.prior import ParameterPrior
from .em.simulated import Errors

PUSHED = 0.85
"""Random acceleration of a fit as a share of that of the motion, from which on forces without a law move the joint: 1.1
with a torque of the wrong sign, 0.13 with an encoder off by 10 degrees, 0.2 to 0.5 on real double pendulums."""
UNPREDICTED = 0.25
"""Error over the longest horizon as a share of the motion, below which a fit predicts whatever pushes."""
UNMOVED = 1.0
"""Error as a share of the motion at every horizon, from which on a prediction that nothing moves is as good."""
BEYOND_NOISE = 10.0
"""Error over the shortest horizon in standard deviations of the noise, from which on something is missing: 1.8 on
slides that lack nothing, 700 and more where a force, a rate or a drive was declared wrongly."""
RUNAWAY = 1e9
"""Error of a prediction that runs away [unit of the reading]."""
LEFT = 3.0
"""Distance of a fitted number from its declaration that is reported [standard deviations]: 3.4 to 16 on three measured
rigs with planted effects without their law, 0.8 to 2.5 with it."""


class Accuracy(NamedTuple):
    """Errors of the predictions of a reading along the training logs, root mean squares in its unit."""

    column: str
    unit: str
    seconds: tuple[float, ...]
    """Horizons, the shortest first [s]; none for free simulations."""
    error: tuple[float, ...]
    motion: tuple[float, ...]
    """Change of the reading over the horizon, or its standard deviation beside a simulation."""
    noise: float
    """Standard deviation, that of the fit or of the high frequencies of the logs, the larger."""
    pushed: float = 0.0
    """Random acceleration of the fit as a share of that of the motion; 0 where a reading is no joint's."""

    @property
    def useless(self) -> bool:
        """True where the motion is taken for random, or nothing of it is predicted."""
        share = np.divide(self.error, np.maximum(self.motion, 1e-300))
        return bool((self.pushed > PUSHED and share[-1] > UNPREDICTED) or share.min() >= UNMOVED)

    @property
    def noises(self) -> float:
        """Error over the shortest horizon in standard deviations of the noise."""
        return self.error[0] / max(self.noise, 1e-300)

    @property
    def sentence(self) -> str:
        """Errors, over the longest horizon beside the motion and over the shortest beside the noise."""
        ahead = [f"{s:.3g} s ahead" for s in self.seconds] or ["in free simulations"]
        last = f"{self.column} errs by {self.error[-1]:.3g} {self.unit}".strip()
        text = f"{last} {ahead[-1]}, {number(100 * self.error[-1] / max(self.motion[-1], 1e-300), 2)} % of its motion"
        text += f"; {ahead[0]} by {self.error[0]:.3g}" if self.seconds else ""
        text += f", {number(self.noises, 2)} times its noise"
        return text + (f"; random forces make {100 * self.pushed:.0f} % of its acceleration" if self.pushed else "")


class Misfit(NamedTuple):
    """The word on a fit."""

    text: str
    """Empty where predictions are as good as the noise lets them be."""
    useless: bool
    readings: tuple[Accuracy, ...] = ()


def misfit(rows: Sequence[tuple], *, settled: bool = True) -> Misfit:
    """The word on a fit with this accuracy, of the reading that is predicted worst."""
    every = tuple(Accuracy._make(row) if settled else Accuracy._make(row)._replace(pushed=0.0) for row in rows)
    if useless := [one.sentence for one in every if one.useless]:
        return Misfit(f"The fit does not describe the motion, do not use it: {'; '.join(useless)}.", True, every)
    worst = max(every, key=lambda one: one.noises, default=None)
    missing = worst is not None and worst.noises >= BEYOND_NOISE
    return Misfit(f"Something is missing in the model: {worst.sentence}." if missing else "", False, every)


def ahead(
    rig: Rig, model: StateSpaceModel, error: Float[np.ndarray, "seq start horizon obs"], data: Dataset
) -> tuple[Accuracy, ...]:
    """Accuracy of a model with the `errors` of its predictions, over the horizons at which it is judged."""
    dof, grid, places = len(model.system.coordinates), grid_along(model, data, JUDGED), channels(model)
    y = np.asarray(data.y)[..., places]
    rows = grid.starts(y.shape[1])
    change = np.stack([y[:, rows + age] - y[:, rows] for age in grid.ages], axis=2)
    kick = np.exp(0.5 * np.asarray(model.log_q)[dof : 2 * dof]) / rig.dt
    pushed = 2 * (kick / measure_scales(rig, model.system, data).acceleration).tolist()  # by coordinate, then by rate
    return _rows(rig, model, data, places, tuple(age * rig.dt for age in grid.ages), error, change, pushed)


def simulating(rig: Rig, model: StateSpaceModel, error: Errors, data: Dataset) -> tuple[Accuracy, ...]:
    """Accuracy of free simulations of equations."""
    y = np.asarray(data.y)
    spread = (y - np.nanmean(y, axis=(0, 1)))[..., None, :]
    return _rows(rig, model, data, range(len(rig.measured)), (), error[..., None, :], spread, [])


def _rows(rig: Rig, model, data: Dataset, places, seconds, error, change, pushed) -> tuple[Accuracy, ...]:
    """Root mean squares of errors and motion by reading; a reading without any is left out."""
    out = []
    for i, (name, place) in enumerate((rig.measured[place], place) for place in places):
        wide, moved = (tuple(map(_size, part[..., i].reshape(-1, part.shape[-2]).T)) for part in (error, change))
        noise = max(math.exp(0.5 * float(model.log_r[place])), reading_noise(np.asarray(data.y)[..., place]))
        push = dict(enumerate(pushed)).get(model.measured[place], 0.0)
        out += [Accuracy(name, rig.unit(name), seconds, wide, moved, noise, push)]
    return tuple(row for row in out if math.isfinite(sum(row.error + row.motion)))


def _size(values: Float[np.ndarray, " value"]) -> float:
    known = values[~np.isnan(values)]
    return math.sqrt(np.mean(np.clip(known, -RUNAWAY, RUNAWAY) ** 2)) if known.size else math.nan


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
        text = f"{self.name} = {self.value:.4g} {self.unit}".strip() + f" is {abs(self.distance):.1f} std from what is "
        return f"{text}declared ({self.declared:.4g}): something is missing in the model, or rig.toml is wrong."


def moved(rig: Rig, prior: ParameterPrior, model: StateSpaceModel) -> list[Moved]:
    """Numbers of the rig that the fit has moved by more than `LEFT` of their declared std, the farthest first."""
    z = np.asarray(prior.read(model))[: len(prior.declared)] if prior.declared else ()
    numbers = zip(prior.declared, z, np.asarray(prior.mean), np.asarray(prior.std), strict=False)
    far = [Moved(n, float(m + s * d), float(m), float(d), rig.unit(n)) for n, d, m, s in numbers if abs(d) > LEFT]
    return sorted(far, key=lambda one: -abs(one.distance))
