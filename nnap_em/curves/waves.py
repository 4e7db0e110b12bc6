"""Periodic shapes of a learned curve, ripples and square waves: columns for a fit, numbers and words."""

import numpy as np

from .forms import Columns, Description, Family, Place, Places, Size, View, product, quantity


def waves(view: View) -> list[Family]:
    """Periodic shapes, the simplest first; a shape repeats at least once within the known part."""
    finest = 0.5 / view.fine
    part = np.arange(1.4 / view.span, 0.96 * finest, 0.3 / view.span)
    rates = np.arange(1.0, finest + 0.5) if view.whole else part
    rotary = view.across == "rad" and not view.whole and view.span * view.length > 0.6 * np.pi  # as gravity
    once = np.full((int(rotary), 1), view.length / (2 * np.pi))
    low, high = product(rates, rates).T
    enough = (low * view.span > 1.8) | (view.whole & (high > 2.9))  # once and twice a turn: any smooth curve
    pairs = np.stack([low, high - low], axis=1)[enough & ((high - low) * view.span > 0.89)]
    cycles = product(rates[rates <= 0.8 * finest], np.linspace(0, 1, 17), [0.2, 0.35, 0.5, 0.65, 0.8])
    families = [
        Family(_ripples, _describe_ripple, once, (), 3),
        Family(_ripples, _describe_ripple, rates[:, None], () if view.whole else (0,), 3),
        Family(_square, _describe_square, cycles, (1, 2) if view.whole else (0, 1, 2), 4),
        Family(_ripples, _describe_two, pairs, () if view.whole else (0, 1), 6),
    ]
    return [family for family in families if len(family.grid)]


def _ripples(view: View, place: Places) -> Columns:
    waves = np.cumsum(place, axis=1)[:, None, :]
    phase, both = 2 * np.pi * waves * view.z[:, None], waves < 0.49 / view.fine  # two nodes a period: one phase is seen
    return np.concatenate([np.cos(phase), both * np.sin(phase)], axis=2)


def _rate(view: View, wave: float) -> tuple[str, tuple[float, str], str]:
    """Rate of repetition: periods a turn of an angle, Hz in time, else the period."""
    if view.across == "rad":
        often = 2 * np.pi * wave / view.length
        return "periods_per_turn", (often, ""), f"{often:.3g}"
    if view.across == "s":
        return "frequency", (wave / view.length, "Hz"), f"{wave / view.length:.2f}"
    return "period", (view.length / wave, view.across), f"{view.length / wave:.3g}"


def _of(view: View, text: str) -> str:
    """Rates in words."""
    if view.across == "rad":
        return f"{text} period{'' if text == '1' else 's'} a turn"
    return f"{text} Hz" if view.across == "s" else f"period {text} {view.across}"


def _wave(view: View, wave: float, cos: float, sin: float) -> tuple[float, float]:
    """Amplitude and phase of amplitude sin(k x + phase)."""
    phase = np.arctan2(cos, sin) - 2 * np.pi * wave * view.low / view.length
    return float(np.hypot(cos, sin)), float((phase + np.pi) % (2 * np.pi) - np.pi)


def _least(view: View, wave: float) -> str:
    """Words for an amplitude that the basis, and the prior of its weights, make too small."""
    return "at least " if wave > 0.4 / view.fine else ""


def _describe_ripple(view: View, place: Place, size: Size) -> Description:
    key, rate, text = _rate(view, place[0])
    amplitude, phase = _wave(view, place[0], *size)
    tall = _least(view, place[0]) + quantity(amplitude, view.unit)
    words = f"a ripple in {view.name} of {_of(view, text)}, amplitude {tall}"
    if 3 * place[0] > 0.48 / view.fine:
        words += ", overtones not seen"
    return Description("ripple", {key: rate, "amplitude": (amplitude, view.unit), "phase": (phase, "rad")}, words)


def _describe_two(view: View, place: Place, size: Size) -> Description:
    numbers, texts, tall = {}, [], []
    for i, wave in enumerate(np.cumsum(place)):
        key, rate, text = _rate(view, wave)
        amplitude, phase = _wave(view, wave, size[i], size[i + 2])
        numbers |= {f"{key}_{i + 1}": rate, f"amplitude_{i + 1}": (amplitude, view.unit)}
        numbers |= {f"phase_{i + 1}": (phase, "rad")}
        texts, tall = [*texts, text], [*tall, f"{_least(view, wave)}{amplitude:.3g}"]
    often = _of(view, " and ".join(texts))
    words = f"two ripples in {view.name} of {often}, amplitudes {tall[0]} and {tall[1]} {view.unit}"
    return Description("two ripples", numbers, words)


def _square(view: View, place: Places) -> Columns:
    wave, phase, duty = place[:, :1], place[:, 1:2], place[:, 2:]
    cycle = (wave * view.z - phase + 0.5) % 1.0 - 0.5  # from the middle of what is high
    edge = wave * view.fine / 3
    return np.clip((0.5 * duty - np.abs(cycle)) / edge + 0.5, 0.0, 1.0)[..., None]


def _describe_square(view: View, place: Place, size: Size) -> Description:
    wave, phase, duty = place
    phase, duty = (phase, duty) if size[0] > 0 else (phase + 0.5, 1 - duty)
    key, rate, text = _rate(view, wave)
    amplitude, rises = 0.5 * abs(size[0]), (phase - 0.5 * duty) / wave
    if not view.whole:
        rises += np.ceil((view.start - rises) * wave) / wave
    up, down = view.at(rises), view.at(rises + duty / wave)
    numbers = {key: rate, "amplitude": (amplitude, view.unit), "duty": (duty, ""), "rises_at": (up, view.across)}
    if view.whole and wave == 1.0:
        high = quantity(2 * amplitude, view.unit)
        words = f"a step up at {view.name} = {up:.3g} and down again at {quantity(down, view.across)}, {high} high"
        return Description("square wave", numbers, words)
    words = f"a square wave in {view.name} of {_of(view, text)}, {quantity(amplitude, view.unit)} to either side"
    return Description("square wave", numbers, words + f", high for {100 * duty:.0f} % of the period")
