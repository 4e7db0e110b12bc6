"""Shapes at one place of a learned curve, as a step or a hinge: columns for a fit, numbers and words."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.special import ndtr

Columns = Float[np.ndarray, "place node column"]
Places = Float[np.ndarray, "place number"]
Place = Float[np.ndarray, " number"]
Size = Float[np.ndarray, " column"]


class View(NamedTuple):
    """The axis of a curve; z is the signal as a share of the axis, from its low end."""

    name: str
    across: str
    """Unit of the signal."""
    unit: str
    """Unit of the force."""
    low: float
    length: float
    turns: bool
    whole: bool
    """True for an angle that goes round and is known all around."""
    start: float
    """Start and length of the known part [z]."""
    span: float
    fine: float
    """Distance of the basis functions [z]."""
    z: Float[np.ndarray, " node"]

    @property
    def per(self) -> str:
        """Unit of a slope."""
        return "" if self.unit == self.across else f"{self.unit}/{self.across}"

    def at(self, z: float) -> float:
        """The signal at a place; an angle that goes round within its turn."""
        return self.low + self.length * (z % 1.0 if self.turns else z)


class Description(NamedTuple):
    """A shape with its numbers and in words."""

    kind: str
    numbers: dict[str, tuple[float, str]]
    words: str


class Family(NamedTuple):
    """Shapes of one form: sums of columns whose sizes are free, at places of a grid."""

    columns: Callable[[View, Places], Columns]
    describe: Callable[[View, Place, Size], Description]
    """Description from the view, a place and the sizes."""
    grid: Places
    free: tuple[int, ...]
    """Numbers of a place that may leave the grid."""
    price: int
    """Number of its free numbers, beside the mean."""


def quantity(value: float, unit: str) -> str:
    """A number in three digits, with its unit."""
    return f"{value:.3g} {unit}".rstrip()


def forms(view: View) -> list[Family]:
    """Shapes of one place, the simplest first; of an angle that goes round only those that close."""
    within = view.start + view.span * np.linspace(0.0, 1.0, 41)
    around = np.linspace(0, 1, 41) if view.whole else within  # with both ends: what is polished stays in its grid
    widths = np.geomspace(0.3 * view.fine, max(0.25 * view.span, view.fine), 8)
    bump = Family(_bump, _describe_bump, product(around, np.log(widths)), (0, 1), 3)
    if view.whole:
        return [bump]
    inner, coarse = within[4:-4], within[4:-4:2]
    zones = product(coarse, coarse)
    zones = zones[zones[:, 1] - zones[:, 0] > 0.09 * view.span]
    line, parabola, cubic = (
        Family(partial(_powers, k), partial(_describe_powers, k), np.zeros((1, 0)), (), k) for k in (1, 2, 3)
    )
    hinge = Family(_hinge, _describe_hinge, product(inner, [-1.0, 1.0]), (0,), 2)
    step = Family(_step, _describe_step, product(within[2:-2], np.log(widths)), (0, 1), 3)
    zone = Family(_zone, _describe_zone, zones, (0, 1), 3)
    bend = Family(_bend, _describe_bend, inner[:, None], (0,), 3)
    return [line, parabola, hinge, step, bump, cubic, zone, bend]


def product(*axes: np.ndarray | list[float]) -> Places:
    """All combinations of the numbers of a place."""
    return np.stack([part.ravel() for part in np.meshgrid(*axes, indexing="ij")], axis=1)


def _powers(order: int, view: View, place: Places) -> Columns:
    return np.stack([view.z**k for k in range(1, order + 1)], axis=1)[None]


def _describe_powers(order: int, view: View, place: Place, size: Size) -> Description:
    per, powers = view.per, np.arange(1, order + 1)
    first, middle, last = (
        float(size @ (powers * z ** (powers - 1))) / view.length for z in view.start + view.span * np.linspace(0, 1, 3)
    )
    if order == 1:
        words = f"nearly a straight line in {view.name}, slope {quantity(first, per)}"
        return Description("line", {"slope": (first, per)}, words)
    numbers = {"slope_first": (first, per), "slope_middle": (middle, per), "slope_last": (last, per)}
    kind = "parabola" if order == 2 else "cubic"
    words = f"a {kind} in {view.name}, slopes {first:.3g}, {middle:.3g} and {quantity(last, per)} from end to end"
    return Description(kind, numbers, words)


def _hinge(view: View, place: Places) -> Columns:
    return np.maximum(0.0, place[:, 1:] * (view.z - place[:, :1]))[..., None]


def _describe_hinge(view: View, place: Place, size: Size) -> Description:
    slope, per, at = place[1] * size[0] / view.length, view.per, view.at(place[0])
    side, other = ("above", "below") if place[1] > 0 else ("below", "above")
    words = f"a hinge in {view.name} at {quantity(at, view.across)}: flat {other}, slope {quantity(slope, per)} {side}"
    numbers = {"place": (at, view.across), f"slope_{side}": (slope, per), f"slope_{other}": (0.0, per)}
    return Description("hinge", numbers, words)


def _bend(view: View, place: Places) -> Columns:
    above = np.maximum(0.0, view.z - place)
    return np.stack([view.z - place - above, above], axis=2)


def _describe_bend(view: View, place: Place, size: Size) -> Description:
    (below, above), per, at = size / view.length, view.per, view.at(place[0])
    slopes = f"slope {quantity(below, per)} below, {quantity(above, per)} above"
    words = f"a bend in {view.name} at {quantity(at, view.across)}: {slopes}"
    numbers = {"place": (at, view.across), "slope_below": (below, per), "slope_above": (above, per)}
    return Description("bend", numbers, words)


def _zone(view: View, place: Places) -> Columns:
    below, above = view.z - place[:, :1], view.z - place[:, 1:]
    return (np.maximum(0.0, above) + np.minimum(0.0, below))[..., None]


def _describe_zone(view: View, place: Place, size: Size) -> Description:
    slope, per = size[0] / view.length, view.per
    low, high = view.at(place[0]), view.at(place[1])
    words = f"flat in {view.name} from {low:.3g} to {quantity(high, view.across)}, slope {quantity(slope, per)} outside"
    numbers = {"from": (low, view.across), "to": (high, view.across), "slope": (slope, per)}
    return Description("dead zone", numbers, words)


def _step(view: View, place: Places) -> Columns:
    return ndtr((view.z - place[:, :1]) / np.exp(place[:, 1:]))[..., None]


def _describe_step(view: View, place: Place, size: Size) -> Description:
    wide = 2.563 * np.exp(place[1])  # from 10 to 90 % of a cumulative normal distribution
    at, over = view.at(place[0]), view.length * max(wide, view.fine)
    numbers = {"place": (at, view.across), "height": (size[0], view.unit), "transition": (over, view.across)}
    way, tall = "up" if size[0] > 0 else "down", quantity(abs(size[0]), view.unit)
    words = f"a step {way} at {view.name} = {quantity(at, view.across)}, {tall} high"
    if wide < 1.5 * view.fine:
        over = numbers["transition"] = 1.5 * view.fine * view.length, view.across
        return Description("step", numbers, f"{words} (or a transition no wider than {quantity(*over)})")
    if wide < view.span / 3:
        return Description("step", numbers, f"{words}, over {quantity(over, view.across)}")
    words = f"a slope in {view.name} about {quantity(at, view.across)} that levels off on both sides, {tall} {way}"
    return Description("saturation", numbers, f"{words} over {quantity(over, view.across)}")


def _bump(view: View, place: Places) -> Columns:
    away = view.z - place[:, :1]
    away = away - np.round(away) if view.whole else away  # the short way round where the curve goes round
    return np.exp(-0.5 * (away / np.exp(place[:, 1:])) ** 2)[..., None]


def _describe_bump(view: View, place: Place, size: Size) -> Description:
    wide = view.length * max(2.355 * np.exp(place[1]), 1.5 * view.fine)
    bound = "at most " if wide <= 1.5 * view.fine * view.length else "about "
    kind, tall = ("bump", "high") if size[0] > 0 else ("dip", "deep")
    at, height, width = view.at(place[0]), quantity(abs(size[0]), view.unit), quantity(wide, view.across)
    words = f"a {kind} at {view.name} = {quantity(at, view.across)}, {bound}{width} wide, {height} {tall}"
    numbers = {"place": (at, view.across), "height": (size[0], view.unit), "width": (wide, view.across)}
    return Description(kind, numbers, words)
