"""Forms of a learned curve: columns for a fit, numbers with units, and a sentence of them."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import ndtr

from ...model.effects.base import Curve

Columns = Float[np.ndarray, "place node column"]
Places = Float[np.ndarray, "place number"]
Place = Float[np.ndarray, " number"]
Size = Float[np.ndarray, " column"]


class Quantity(NamedTuple):
    """A number with its unit; a format of its own shows the number alone."""

    value: float
    unit: str

    def __format__(self, form: str) -> str:
        return format(self.value, form) if form else f"{self.value:.3g} {self.unit}".rstrip()


class View(NamedTuple):
    """The known part of a curve."""

    curve: Curve
    known: Bool[np.ndarray, " node"]
    clear: bool
    """False for a curve that is nowhere better known than it is large."""
    x: Float[np.ndarray, " known"]
    """The signal there; of an angle in one piece, which may pass the end of the turn."""
    whole: bool
    """True for an angle that goes round and is known all around."""
    fine: float
    """Distance of the basis functions."""

    @property
    def low(self) -> float:
        """Low end of the axis."""
        return float(self.curve.x[0])

    @property
    def length(self) -> float:
        """Length of the axis; of an angle that goes round a turn."""
        return float(np.ptp(self.curve.x))

    def at(self, x: float) -> Quantity:
        """A place; an angle that goes round within its turn."""
        return self.along(self.low + (x - self.low) % self.length if self.curve.turns else x)

    def along(self, width: float) -> Quantity:
        """A number in the unit of the signal."""
        return Quantity(float(width), self.curve.signal_unit)

    def force(self, value: float) -> Quantity:
        """A force."""
        return Quantity(float(value), self.curve.unit)

    def slope(self, size: float) -> Quantity:
        """Force per signal."""
        force, signal = self.curve.unit, self.curve.signal_unit
        return Quantity(float(size), "" if force == signal else f"{force}/{signal}")


class Description(NamedTuple):
    """A shape with its numbers and in words."""

    kind: str
    numbers: dict[str, Quantity]
    words: str


class Form(NamedTuple):
    """Shapes of one form: sums of columns whose sizes are free, at places of a grid."""

    columns: Callable[[View, Places], Columns]
    describe: Callable[[View, Place, Size], Description]
    grid: Places
    price: int
    """Number of its free numbers, beside the mean."""
    fixed: int = 0
    """Numbers of a place, the first ones, that stay on the grid."""


def forms(view: View) -> list[Form]:
    """All forms; of an angle that goes round those that close, and a wave repeats at least once in the known part."""
    start, span, fine, whole = view.x.min(), np.ptp(view.x), view.fine, view.whole
    within = start + span * np.linspace(0.0, 1.0, 41)
    around = np.linspace(view.low, view.low + view.length, 41) if whole else within  # both ends: polished inside
    widths = np.log(np.geomspace(0.3 * fine, max(0.25 * span, fine), 8))

    finest = 0.5 / fine
    closing, part = np.arange(1.0, view.length * finest + 0.5), np.arange(1.4 / span, 0.96 * finest, 0.3 / span)
    rates = closing / view.length if whole else part
    rotary = view.curve.signal_unit == "rad" and not whole and span > 0.6 * np.pi  # as gravity
    once = np.full((int(rotary), 1), 0.5 / np.pi)
    cycles = product(rates[rates <= 0.8 * finest], np.linspace(0, 1, 17), [0.2, 0.35, 0.5, 0.65, 0.8])

    waves = [
        Form(_ripples, _ripple, once, 3, fixed=1),
        Form(_ripples, _ripple, rates[:, None], 3, fixed=int(whole)),
        Form(_cycles, _square_wave, cycles, 4, fixed=int(whole)),
    ]
    bump = Form(_bells, _bump, product(around, widths), 3)
    local = [
        Form(_lines, _line, np.zeros((1, 1)), 1, fixed=1),
        Form(_steps, _step, product(within[2:-2], widths), 3),
        bump,
        Form(_bends, _bend, within[4:-4, None], 3),
    ]
    return [form for form in waves + ([bump] if whole else local) if len(form.grid)]


def product(*axes: np.ndarray | list[float]) -> Places:
    """All combinations of the numbers of a place."""
    return np.stack([part.ravel() for part in np.meshgrid(*axes, indexing="ij")], axis=1)


def _lines(view: View, place: Places) -> Columns:
    return np.tile(view.x[:, None], (len(place), 1, 1))


def _line(view: View, place: Place, size: Size) -> Description:
    slope = view.slope(size[0])
    return Description("line", {"slope": slope}, f"nearly a straight line in {view.curve.signal}, slope {slope}")


def _bends(view: View, place: Places) -> Columns:
    away = view.x - place
    return np.stack([np.minimum(0.0, away), np.maximum(0.0, away)], axis=2)


def _bend(view: View, place: Place, size: Size) -> Description:
    below, above, at = view.slope(size[0]), view.slope(size[1]), view.at(place[0])
    words = f"a bend in {view.curve.signal} at {at}: slope {below} below, {above} above"
    return Description("bend", {"place": at, "slope_below": below, "slope_above": above}, words)


def _steps(view: View, place: Places) -> Columns:
    return ndtr((view.x - place[:, :1]) / np.exp(place[:, 1:]))[..., None]


def _step(view: View, place: Place, size: Size) -> Description:
    wide, least = 2.563 * np.exp(place[1]), 1.5 * view.fine  # from 10 to 90 % of a cumulative normal distribution
    at, over, height = view.at(place[0]), view.along(max(wide, least)), view.force(size[0])
    blur = f" (or a transition no wider than {over})" if wide < least else f", over {over}"
    way = "up" if size[0] > 0 else "down"
    words = f"a step {way} at {view.curve.signal} = {at}, {view.force(abs(size[0]))} high{blur}"
    return Description("step", {"place": at, "height": height, "transition": over}, words)


def _bells(view: View, place: Places) -> Columns:
    away = view.x - place[:, :1]
    away -= view.length * np.round(away / view.length) * view.whole  # the short way round where the curve goes round
    return np.exp(-0.5 * (away / np.exp(place[:, 1:])) ** 2)[..., None]


def _bump(view: View, place: Place, size: Size) -> Description:
    wide, least = 2.355 * np.exp(place[1]), 1.5 * view.fine  # at half height
    at, width, height = view.at(place[0]), view.along(max(wide, least)), view.force(size[0])
    bound, (kind, tall) = "about" if wide > least else "at most", ("bump", "high") if size[0] > 0 else ("dip", "deep")
    words = f"a {kind} at {view.curve.signal} = {at}, {bound} {width} wide, {view.force(abs(size[0]))} {tall}"
    return Description(kind, {"place": at, "height": height, "width": width}, words)


def _rate(view: View, wave: float) -> tuple[dict[str, Quantity], str]:
    """Rate of repetition, and in words: periods a turn of an angle, Hz in time, else the period."""
    unit = view.curve.signal_unit
    if unit == "rad":
        often = Quantity(2 * np.pi * wave, "")
        return {"periods_per_turn": often}, f"{often} period{'' if f'{often}' == '1' else 's'} a turn"
    if unit == "s":
        return {"frequency": Quantity(wave, "Hz")}, f"{wave:.2f} Hz"
    period = view.along(1 / wave)
    return {"period": period}, f"period {period}"


def _ripples(view: View, place: Places) -> Columns:
    phase, both = 2 * np.pi * place * view.x, place < 0.49 / view.fine  # two nodes a period: one phase is seen
    return np.stack([np.cos(phase), both * np.sin(phase)], axis=2)


def _ripple(view: View, place: Place, size: Size) -> Description:
    """Amplitude and phase of amplitude sin(k x + phase); "at least", where basis and prior make it too small."""
    (wave,), (cos, sin) = place, size
    rate, text = _rate(view, wave)
    amplitude, least = view.force(np.hypot(cos, sin)), "at least " if wave > 0.4 / view.fine else ""
    words = f"a ripple in {view.curve.signal} of {text}, amplitude {least}{amplitude}"
    return Description(
        "ripple", {**rate, "amplitude": amplitude, "phase": Quantity(np.arctan2(cos, sin), "rad")}, words
    )


def _cycles(view: View, place: Places) -> Columns:
    wave, phase, duty = place[:, :1], place[:, 1:2], place[:, 2:]
    cycle = (wave * (view.x - view.low) - phase + 0.5) % 1.0 - 0.5  # from the middle of what is high
    edge = wave * view.fine / 3
    return np.clip((0.5 * duty - np.abs(cycle)) / edge + 0.5, 0.0, 1.0)[..., None]


def _square_wave(view: View, place: Place, size: Size) -> Description:
    wave, phase, duty = place
    phase, duty = (phase, duty) if size[0] > 0 else (phase + 0.5, 1 - duty)
    (rate, text), amplitude = _rate(view, wave), view.force(0.5 * abs(size[0]))
    rises = view.low + (phase - 0.5 * duty) / wave
    if not view.whole:
        rises += np.ceil((view.x.min() - rises) * wave) / wave
    up, down = view.at(rises), view.at(rises + duty / wave)
    high = f"{amplitude} to either side, high for {100 * duty:.0f} % of the period"
    words = f"a square wave in {view.curve.signal} of {text}, {high}"
    if view.whole and np.isclose(wave * view.length, 1.0):
        tall = view.force(abs(size[0]))
        words = f"a step up at {view.curve.signal} = {up:.3g} and down again at {down}, {tall} high"
    numbers = {**rate, "amplitude": amplitude, "duty": Quantity(duty, ""), "rises_at": up}
    return Description("square wave", numbers, words)
