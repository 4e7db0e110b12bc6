"""The laws that are planted on real logs, and the list of cases: no law shares code with the library's catalogue.

A case is `rig-laws-strength`, its laws a tag and its place each, joined by `+`: `dfki_c1-spring2-strong`,
`dfki_a0-bias_theta2+shake-medium`, `dfki_c0-recorded` for a rig as it is, `dfki_c0-wrong2` for a rig as it is whose
declared numbers are two of their standard deviations off.
"""

import hashlib
import math
import re
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

Columns = dict[str, np.ndarray]
Body = Mapping[str, float]
"""The declared means of `[model]`, and the friction level of each joint as `friction1`, `friction2` [N m]."""
Values = Mapping[str, float]
STRENGTHS = {"strong": 0.30, "medium": 0.15, "weak": 0.07}
"""Root mean square of the torque that an effect adds, as a share of the typical torque at its joint."""
WRONG = {"wrong1": 1.0, "wrong2": 2.0}
"""Standard deviations by which declared numbers are off; the signs are drawn by the name."""
REST = 0.3
"""Velocity at which planted friction turns over [rad/s]: some times the noise of the velocities."""


class Motion(NamedTuple):
    """Moments of one recording."""

    q: np.ndarray
    """(time, 2) [rad]."""
    v: np.ndarray
    t: np.ndarray
    """[s]"""


class Ranges(NamedTuple):
    """What the training recordings visit at the joint of an effect; parameters are drawn inside."""

    low: float
    """A tenth of the rows lie below [rad]."""
    high: float


class Law(NamedTuple):
    """A law: one of `force`, `undo` and `reading`, and how its parameters are chosen."""

    name: str
    """Key of the vocabulary."""
    draw: Callable[[np.random.Generator, Ranges], dict[str, float]]
    """All parameters but the strength."""
    amount: Callable[[float], dict[str, float]]
    """The strength as a parameter; 0 changes nothing."""
    force: Callable[[Motion, int, Values, Body], np.ndarray] | None = None
    """Generalised force (time, 2) that the machine then has in addition [N m]."""
    undo: Callable[[np.ndarray, np.ndarray, Values, float], np.ndarray] | None = None
    """The input of which the law makes a given torque [N m], at the mean rates of the joint, rows of some seconds."""
    reading: Callable[[np.ndarray, Values], np.ndarray] | None = None
    """What the sensor says of a value."""
    delay: bool = False
    """The reading comes late."""
    whole: bool = False
    """The force is on the whole machine, not at a joint."""
    of: tuple[str, ...] = ()
    """Inputs of an unknown function; `j` stands for the joint."""
    direct: float | None = None
    """The strength is that many times the share; None: the strength that gives the share is sought."""
    scored: tuple[str, ...] = ()
    """Parameters under the vocabulary's names."""


def at(joint: int, value: np.ndarray) -> np.ndarray:
    """A generalised force at one joint."""
    out = np.zeros((*value.shape, 2))
    out[..., joint - 1] = value
    return out


def _angle(motion: Motion, joint: int) -> np.ndarray:
    return motion.q[:, joint - 1]


def _rate(motion: Motion, joint: int) -> np.ndarray:
    return motion.v[:, joint - 1]


def _spring(m: Motion, j: int, p: Values, body: Body) -> np.ndarray:
    return at(j, -p["k"] * (_angle(m, j) - p["theta0"]))


def _cogging(m: Motion, j: int, p: Values, body: Body) -> np.ndarray:
    turn = p["k"] * _angle(m, j)
    overtone = p.get("overtone", 0.0) * np.sin(2 * turn + p.get("phase2", 0.0))
    return at(j, p["amplitude"] * (np.sin(turn + p["phase"]) + overtone))


def _drag(m: Motion, j: int, p: Values, body: Body) -> np.ndarray:
    """A point at the tip of link 2: -c |w| w with w its velocity [m/s]."""
    outer = m.q.sum(axis=1)
    x1, z1 = body["l1"] * np.cos(m.q[:, 0]), body["l1"] * np.sin(m.q[:, 0])
    x2, z2 = body["l2"] * np.cos(outer), body["l2"] * np.sin(outer)
    both = m.v.sum(axis=1)
    x, z = x1 * m.v[:, 0] + x2 * both, z1 * m.v[:, 0] + z2 * both
    pull = -p["c"] * np.hypot(x, z)
    return pull[:, None] * np.stack([(x1 + x2) * x + (z1 + z2) * z, x2 * x + z2 * z], axis=-1)


def _shake(m: Motion, j: int, p: Values, body: Body) -> np.ndarray:
    """The base is accelerated sideways."""
    acceleration = p["amplitude"] * np.sin(2 * np.pi * p["frequency"] * m.t + p["phase"])
    outer = body["m2"] * body["lc2"] * np.cos(m.q.sum(axis=1))
    inner = (body["m1"] * body["lc1"] + body["m2"] * body["l1"]) * np.cos(m.q[:, 0])
    return -acceleration[:, None] * np.stack([inner + outer, outer], axis=-1)


def _friction(m: Motion, j: int, p: Values, body: Body) -> np.ndarray:
    """Of the published Coulomb friction, the part that changes with the angle."""
    level = p["depth"] * body[f"friction{j}"] * np.cos(p["n"] * _angle(m, j) + p["phase"])
    return at(j, -level * np.tanh(_rate(m, j) / REST))


def _brake(m: Motion, j: int, p: Values, body: Body) -> np.ndarray:
    return at(j, -p["c"] * np.cos(_angle(m, j) - p["center"]) ** 2 * _rate(m, j))


def _near(m: Motion, j: int, p: Values) -> np.ndarray:
    return np.exp(-0.5 * ((_angle(m, j) - p["center"]) / p["width"]) ** 2)


def _bump(m: Motion, j: int, p: Values, body: Body) -> np.ndarray:
    return at(j, p["amplitude"] * _near(m, j, p))


def _patch(m: Motion, j: int, p: Values, body: Body) -> np.ndarray:
    """It rubs near one angle."""
    return at(j, -p["amplitude"] * _near(m, j, p) * np.tanh(_rate(m, j) / REST))


def _square(m: Motion, j: int, p: Values, body: Body) -> np.ndarray:
    return at(j, p["amplitude"] * np.sign(np.sin(2 * np.pi * p["frequency"] * m.t + p["phase"])))


def _ungain(torque: np.ndarray, rate: np.ndarray, p: Values, dt: float) -> np.ndarray:
    return torque / p["gain"]


def _undead(torque: np.ndarray, rate: np.ndarray, p: Values, dt: float) -> np.ndarray:
    return torque + p["width"] * np.sign(torque)


def _unloss(torque: np.ndarray, rate: np.ndarray, p: Values, dt: float) -> np.ndarray:
    """Of a negative input the share `loss` does not arrive."""
    return np.where(torque < 0, torque / (1 - p["loss"]), torque)


def _unload(torque: np.ndarray, rate: np.ndarray, p: Values, dt: float) -> np.ndarray:
    """Of an input u, the friction mu |u| is lost against the motion."""
    return torque / (1 - p["mu"] * np.sign(torque) * np.tanh(rate / REST))


def earlier(torque: np.ndarray, rate: np.ndarray, p: Values, dt: float) -> np.ndarray:
    """Row k is what acts `delay` later; the last torque is held at the end."""
    rows = np.arange(len(torque))
    return np.interp(rows + p["delay"] / dt, rows, torque)


def _phase(rng: np.random.Generator) -> float:
    return round(rng.uniform(-math.pi, math.pi), 2)


def _place(rng: np.random.Generator, ranges: Ranges) -> dict[str, float]:
    """A place that is passed often."""
    span = ranges.high - ranges.low
    return {
        "center": round(rng.uniform(ranges.low + 0.25 * span, ranges.high - 0.25 * span), 3),
        "width": round(float(np.clip(0.12 * span, 0.08, 0.4)), 3),
    }


def _number(name: str) -> Callable[[float], dict[str, float]]:
    return lambda s: {name: float(f"{s:.3g}")}


def _none(rng: np.random.Generator, ranges: Ranges) -> dict[str, float]:
    return {}


PERIODS = (4, 5, 7, 8, 9)
"""Not 6, nor 12: some drives are geared 6:1 and may ripple so by themselves."""

LAWS: dict[str, Law] = {
    "spring": Law(
        "torsional_spring",
        lambda rng, r: {"theta0": round(rng.uniform(-0.5, 0.5), 2)},
        _number("k"),
        force=_spring,
        scored=("k", "theta0"),
    ),
    "cogging": Law(
        "cogging",
        lambda rng, r: {"k": float(rng.choice(PERIODS)), "phase": _phase(rng)},
        _number("amplitude"),
        force=_cogging,
        scored=("amplitude", "k", "phase"),
    ),
    "ripple": Law(  # two harmonics
        "cogging",
        lambda rng, r: {
            "k": float(rng.choice(PERIODS)),
            "phase": _phase(rng),
            "overtone": 0.5,
            "phase2": _phase(rng),
        },
        _number("amplitude"),
        force=_cogging,
        scored=("amplitude", "k", "phase"),
    ),
    "drag": Law("air_drag", _none, _number("c"), force=_drag, whole=True, scored=("c",)),
    "gain": Law("motor_gain", _none, lambda s: {"gain": round(1 / (1 + s), 4)}, undo=_ungain, scored=("gain",)),
    "deadzone": Law("dead_zone", _none, _number("width"), undo=_undead, scored=("width",)),
    "delay": Law("input_delay", _none, _number("delay"), undo=earlier, scored=("delay",)),
    "friction": Law(
        "position_dependent_friction",
        lambda rng, r: {"n": float(rng.choice((1, 2, 3, 4, 5))), "phase": _phase(rng)},
        _number("depth"),
        force=_friction,
        direct=3.0,
        scored=("n", "phase"),
    ),
    "brake": Law(
        "eddy_brake",
        lambda rng, r: {"center": round(rng.uniform(-1.2, 1.2), 2)},
        _number("c"),
        force=_brake,
        scored=("c", "center"),
    ),
    "shake": Law(
        "base_vibration",
        lambda rng, r: {"frequency": round(rng.uniform(0.6, 3.0), 2), "phase": _phase(rng)},
        _number("amplitude"),
        force=_shake,
        whole=True,
        scored=("amplitude", "frequency", "phase"),
    ),
    "bias": Law("sensor_bias", _none, _number("bias"), reading=lambda value, p: value + p["bias"], scored=("bias",)),
    "scale": Law(
        "sensor_scale",
        _none,
        lambda s: {"scale": round(1 + s, 4)},
        reading=lambda value, p: value * p["scale"],
        scored=("scale",),
    ),
    "late": Law("sensor_delay", _none, _number("delay"), delay=True, scored=("delay",)),
    # off the catalogue
    "bump": Law("unknown_function", _place, _number("amplitude"), force=_bump, of=("thetaj",)),
    "patch": Law("unknown_function", _place, _number("amplitude"), force=_patch, of=("thetaj", "dthetaj")),
    "square": Law(
        "unknown_function",
        lambda rng, r: {"frequency": round(rng.uniform(0.4, 1.5), 2), "phase": _phase(rng)},
        _number("amplitude"),
        force=_square,
        of=("time",),
    ),
    "onesided": Law(
        "unknown_function",
        _none,
        lambda s: {"loss": round(s / (1 + s), 4)},
        undo=_unloss,
        of=("tauj",),
        scored=("loss",),
    ),
    "load": Law(
        "unknown_function",
        _none,
        lambda s: {"mu": round(s / (1 + s), 4)},
        undo=_unload,
        of=("tauj", "dthetaj"),
        scored=("mu",),
    ),
}
"""By tag."""
WHOLE = " and ".join(tag for tag, law in LAWS.items() if law.whole)


class Plant(NamedTuple):
    """A law at its place."""

    tag: str
    joint: int | None
    channel: str | None

    @property
    def law(self) -> Law:
        """What it does."""
        return LAWS[self.tag]


class Case(NamedTuple):
    """What a name says."""

    name: str
    rig: str
    plants: tuple[Plant, ...]
    strength: str


def _plant(word: str) -> Plant:
    match = re.fullmatch(r"([a-z]+)(?:([12])|_(d?theta[12]|all))?", word)
    if not match or match[1] not in LAWS:
        raise ValueError(f"{word!r} is no law; known: {', '.join(LAWS)}, with its joint or _channel behind")
    law, joint, channel = LAWS[match[1]], match[2], match[3]
    sensor = bool(law.reading or law.delay)
    if (bool(joint), bool(channel)) != (not (sensor or law.whole), sensor):
        raise ValueError(f"{word!r}: a force or drive stands with its joint, a sensor with its channel, {WHOLE} alone")
    return Plant(match[1], int(joint) if joint else None, channel)


def case_of(name: str) -> Case:
    """The case of a name."""
    rig, _, planted = name.partition("-")
    if planted == "recorded":
        return Case(name, rig, (), "none")
    if planted in WRONG:
        return Case(name, rig, (), planted)
    laws, _, strength = planted.rpartition("-")
    if strength not in STRENGTHS:
        raise ValueError(
            f"{name!r}: a case is RIG-LAWS-STRENGTH, RIG-recorded or RIG-wrong1, strengths are {', '.join(STRENGTHS)}"
        )
    return Case(name, rig, tuple(map(_plant, laws.split("+"))), strength)


def split(name: str) -> str:
    """`look`: may be looked at while something is built, as rigs as recorded may; `kept`: run at the end only."""
    if name.endswith(("-recorded", *WRONG)):
        return "look"
    return ("look", "kept")[hashlib.sha256(name.encode()).digest()[0] % 2]


_LISTED = {
    "dfki_c1": """
        spring2-strong spring2-weak cogging1-medium ripple2-strong drag-strong gain1-medium gain2-strong
        deadzone1-strong delay2-strong friction2-strong load2-strong brake2-medium shake-medium bias_theta2-strong
        late_dtheta2-strong bump2-strong bump1-medium onesided1-strong square1-medium patch2-strong
        spring2+gain1-strong shake+bias_theta2-medium""",
    "dfki_c1_pert": """
        spring2-medium cogging2-strong gain2-medium deadzone2-medium shake-strong scale_theta2-medium
        bump2-medium square2-strong onesided2-strong cogging2+delay2-strong""",
    "dfki_c0": """
        spring2-strong spring1-medium ripple1-medium drag-medium gain1-strong deadzone2-strong delay1-medium
        friction1-strong brake2-strong shake-weak bias_theta1-strong scale_dtheta1-medium
        bump2-strong bump2-weak onesided2-medium patch1-strong spring2+deadzone1-medium""",
    "dfki_a0": """
        spring2-medium cogging2-medium ripple2-weak drag-strong gain2-weak deadzone1-medium delay2-medium
        friction2-medium load1-medium brake1-strong shake-strong late_all-strong bump1-strong
        square2-medium onesided1-medium bias_theta2+cogging1-strong""",
    "cloudpendulum": """
        spring2-weak cogging1-strong drag-medium gain1-medium deadzone2-medium delay2-medium brake2-strong shake-medium
        scale_theta1-strong bump1-medium square1-strong patch2-medium spring2+shake-strong""",
    "dfki_c1_joint1": "spring2-strong cogging1-medium gain2-strong shake-medium bump1-strong",
    "dfki_c0_joint1": "spring2-medium deadzone2-strong onesided1-strong",
    "dfki_a0_joint1": "shake-strong delay2-strong cogging1-weak",
    "dfki_c1_pert_joint1": "gain2-medium bump1-strong",
}
PLANTED = tuple(f"{rig}-{words}" for rig, names in _LISTED.items() for words in names.split())
"""The list; parameters follow from the names."""
CONTROLS = tuple(f"{rig}-recorded" for rig in (*_LISTED, "dfki_c1_hidden_pert"))
"""Every rig as it is; in the log of the last, torques from outside are missing."""
CASES = PLANTED + CONTROLS
