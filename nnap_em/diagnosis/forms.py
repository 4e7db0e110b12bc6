"""Forms of a learned curve, each a row of a table: columns for a fit, numbers with units, and a sentence of them."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.special import ndtr

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
    """The axis of a curve; z is the signal as a share of the axis, from its low end."""

    name: str
    across: str
    unit: str
    """Units of the signal and of the force."""
    low: float
    length: float
    turns: bool
    whole: bool
    """True for an angle that goes round and is known all around."""
    start: float
    span: float
    """Start and length of the known part [z]."""
    fine: float
    """Distance of the basis functions [z]."""
    z: Float[np.ndarray, " node"]

    def at(self, z: float) -> Quantity:
        """The signal at a place; an angle that goes round within its turn."""
        return Quantity(self.low + self.length * (z % 1.0 if self.turns else z), self.across)

    def wide(self, share: float) -> Quantity:
        """A part of the axis."""
        return Quantity(self.length * share, self.across)

    def force(self, value: float) -> Quantity:
        """A force."""
        return Quantity(float(value), self.unit)

    def slope(self, size: float) -> Quantity:
        """Force per signal, of a force per axis."""
        return Quantity(float(size) / self.length, "" if self.unit == self.across else f"{self.unit}/{self.across}")


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
    free: tuple[int, ...]
    """Numbers of a place that may leave the grid."""
    price: int
    """Number of its free numbers, beside the mean."""


def forms(view: View) -> list[Form]:
    """All forms; of an angle that goes round those that close, and a wave repeats at least once in the known part."""
    within = view.start + view.span * np.linspace(0.0, 1.0, 41)
    around = np.linspace(0, 1, 41) if view.whole else within  # with both ends: what is polished stays in its grid
    widths = np.log(np.geomspace(0.3 * view.fine, max(0.25 * view.span, view.fine), 8))

    finest = 0.5 / view.fine
    part = np.arange(1.4 / view.span, 0.96 * finest, 0.3 / view.span)
    rates = np.arange(1.0, finest + 0.5) if view.whole else part
    rotary = view.across == "rad" and not view.whole and view.span * view.length > 0.6 * np.pi  # as gravity
    once = np.full((int(rotary), 1), view.length / (2 * np.pi))
    cycles = product(rates[rates <= 0.8 * finest], np.linspace(0, 1, 17), [0.2, 0.35, 0.5, 0.65, 0.8])

    waves = [
        Form(_ripples, _ripple, once, (), 3),
        Form(_ripples, _ripple, rates[:, None], () if view.whole else (0,), 3),
        Form(_cycles, _square_wave, cycles, (1, 2) if view.whole else (0, 1, 2), 4),
    ]
    bump = Form(_bells, _bump, product(around, widths), (0, 1), 3)
    local = [
        Form(lambda view, place: view.z[None, :, None], _line, np.zeros((1, 0)), (), 1),
        Form(_steps, _step, product(within[2:-2], widths), (0, 1), 3),
        bump,
        Form(_bends, _bend, within[4:-4, None], (0,), 3),
    ]
    return [form for form in waves + ([bump] if view.whole else local) if len(form.grid)]


def product(*axes: np.ndarray | list[float]) -> Places:
    """All combinations of the numbers of a place."""
    return np.stack([part.ravel() for part in np.meshgrid(*axes, indexing="ij")], axis=1)


def _line(view: View, place: Place, size: Size) -> Description:
    slope = view.slope(size[0])
    return Description("line", {"slope": slope}, f"nearly a straight line in {view.name}, slope {slope}")


def _bends(view: View, place: Places) -> Columns:
    above = np.maximum(0.0, view.z - place)
    return np.stack([view.z - place - above, above], axis=2)


def _bend(view: View, place: Place, size: Size) -> Description:
    below, above, at = view.slope(size[0]), view.slope(size[1]), view.at(place[0])
    words = f"a bend in {view.name} at {at}: slope {below} below, {above} above"
    return Description("bend", {"place": at, "slope_below": below, "slope_above": above}, words)


def _steps(view: View, place: Places) -> Columns:
    return ndtr((view.z - place[:, :1]) / np.exp(place[:, 1:]))[..., None]


def _step(view: View, place: Place, size: Size) -> Description:
    wide = 2.563 * np.exp(place[1])  # from 10 to 90 % of a cumulative normal distribution
    sharp = wide < 1.5 * view.fine
    at, over = view.at(place[0]), view.wide(1.5 * view.fine if sharp else wide)
    way, tall = "up" if size[0] > 0 else "down", view.force(abs(size[0]))
    numbers = {"place": at, "height": view.force(size[0]), "transition": over}
    blur = f" (or a transition no wider than {over})" if sharp else f", over {over}"
    return Description("step", numbers, f"a step {way} at {view.name} = {at}, {tall} high{blur}")


def _bells(view: View, place: Places) -> Columns:
    away = view.z - place[:, :1]
    away = away - np.round(away) if view.whole else away  # the short way round where the curve goes round
    return np.exp(-0.5 * (away / np.exp(place[:, 1:])) ** 2)[..., None]


def _bump(view: View, place: Place, size: Size) -> Description:
    share, least = 2.355 * np.exp(place[1]), 1.5 * view.fine
    bound, width = "about" if share > least else "at most", view.wide(max(share, least))
    kind, tall = ("bump", "high") if size[0] > 0 else ("dip", "deep")
    at = view.at(place[0])
    words = f"a {kind} at {view.name} = {at}, {bound} {width} wide, {view.force(abs(size[0]))} {tall}"
    return Description(kind, {"place": at, "height": view.force(size[0]), "width": width}, words)


def _ripples(view: View, place: Places) -> Columns:
    phase, both = 2 * np.pi * place * view.z, place < 0.49 / view.fine  # two nodes a period: one phase is seen
    return np.stack([np.cos(phase), both * np.sin(phase)], axis=2)


def _rate(view: View, wave: float) -> tuple[str, Quantity, str]:
    """Rate of repetition: periods a turn of an angle, Hz in time, else the period."""
    if view.across == "rad":
        often = Quantity(2 * np.pi * wave / view.length, "")
        return "periods_per_turn", often, f"{often}"
    if view.across == "s":
        return "frequency", (often := Quantity(wave / view.length, "Hz")), f"{often:.2f}"
    return "period", (period := Quantity(view.length / wave, view.across)), f"{period:.3g}"


def _of(view: View, text: str) -> str:
    if view.across == "rad":
        return f"{text} period{'' if text == '1' else 's'} a turn"
    return f"{text} Hz" if view.across == "s" else f"period {text} {view.across}"


def _ripple(view: View, place: Place, size: Size) -> Description:
    """Amplitude and phase of amplitude sin(k x + phase); "at least", where basis and prior make it too small."""
    (wave,), (cos, sin) = place, size
    key, rate, text = _rate(view, wave)
    phase = np.arctan2(cos, sin) - 2 * np.pi * wave * view.low / view.length
    turned = Quantity(float((phase + np.pi) % (2 * np.pi) - np.pi), "rad")
    amplitude, least = view.force(np.hypot(cos, sin)), "at least " if wave > 0.4 / view.fine else ""
    words = f"a ripple in {view.name} of {_of(view, text)}, amplitude {least}{amplitude}"
    return Description("ripple", {key: rate, "amplitude": amplitude, "phase": turned}, words)


def _cycles(view: View, place: Places) -> Columns:
    wave, phase, duty = place[:, :1], place[:, 1:2], place[:, 2:]
    cycle = (wave * view.z - phase + 0.5) % 1.0 - 0.5  # from the middle of what is high
    edge = wave * view.fine / 3
    return np.clip((0.5 * duty - np.abs(cycle)) / edge + 0.5, 0.0, 1.0)[..., None]


def _square_wave(view: View, place: Place, size: Size) -> Description:
    wave, phase, duty = place
    phase, duty = (phase, duty) if size[0] > 0 else (phase + 0.5, 1 - duty)
    key, rate, text = _rate(view, wave)
    amplitude, rises = view.force(0.5 * abs(size[0])), (phase - 0.5 * duty) / wave
    if not view.whole:
        rises += np.ceil((view.start - rises) * wave) / wave
    up, down = view.at(rises), view.at(rises + duty / wave)
    high = f"{amplitude} to either side, high for {100 * duty:.0f} % of the period"
    words = f"a square wave in {view.name} of {_of(view, text)}, {high}"
    if view.whole and wave == 1.0:
        words = f"a step up at {view.name} = {up:.3g} and down again at {down}, {view.force(abs(size[0]))} high"
    numbers = {key: rate, "amplitude": amplitude, "duty": Quantity(duty, ""), "rises_at": up}
    return Description("square wave", numbers, words)
