"""Rigs with known truth, in plain NumPy: friction, effects that nobody declared, logs, and the best possible forecast.

A simulator for tests and benchmarks of a diagnosis.  It shares no code with the library, so agreement means something:

    plant.write(plant.Case(effects=({"name": "base_tilt", "angle": 0.1},)), Path("my_rig"))

Signs, units and names of the effects are those of `vocabulary.json`; states are arrays [batch, state] in SI units:
positions, velocities, what effects remember (lag, motor side, bristle), and values on their way to a late sensor.
"""

import itertools
import json
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

Array = np.ndarray
Effect = dict[str, Any]

DT = 0.01
"""Between two samples [s]."""
GAP = 2.0
"""Between two files of a session [s]."""
THETA2_STD = 0.5
RATE_STD = 0.02
"""Of the first row [rad], [rad/s]."""
MOTOR_INERTIA = 3e-4
"""On the motor's side of a backlash or of a flexible joint [kg m^2]."""
BRISTLE_RATE = 2000.0
"""Fastest relaxation of a bristle [1/s]: above it the pre-sliding displacement is in equilibrium anyway."""


class Case(NamedTuple):
    """One rig, its hidden effects and the experiment made on it."""

    system: str = "acrobot"
    effects: tuple[Effect, ...] = ()
    hidden: bool = True
    """Acrobot: only joint 1 is measured; one joint: only the position is."""
    noise: tuple[float, float] = (0.005, 0.05)
    """Of the readings of positions and velocities."""
    process: float = 0.002
    """Kick of each velocity per sample."""
    sequences: int = 20
    tests: int = 5
    steps: int = 500
    """Intervals: a file has one row more."""
    declare_noise: bool = True
    missing: float = 0.0
    """Fraction of the readings that are empty."""
    clock: str = "sequence"
    seed: int = 0
    friction_shape: str = "stribeck"
    torque: str = "drawn"
    """"sine", "sum" (of four sines), "chirp", or "drawn": sine or sum, by the seed."""
    start: str = "upper"
    """Of the acrobot's theta1: "upper" half plane or "anywhere"."""


class System(NamedTuple):
    """What the owner knows of a rig, the size of its friction, and how it is excited."""

    states: tuple[str, ...]
    parameters: dict[str, float]
    friction: tuple[dict[str, float], ...]
    """Per joint."""
    driven: int
    amplitude: tuple[float, float]
    first: tuple[float, float]
    """Size of the first coordinate in the first row."""


SYSTEMS = {
    "acrobot": System(
        ("theta1", "theta2", "dtheta1", "dtheta2"),
        {
            "m1": 0.235,
            "m2": 0.25,
            "l1": 0.275,
            "l2": 0.285,
            "lc1": 0.1375,
            "lc2": 0.1425,
            "I1": 0.0014809896,
            "I2": 0.0016921875,
            "g": 9.81,
        },
        (
            {"Fc": 0.0296, "Fs": 0.0414, "vs": 0.321, "b": 0.00715, "eps": 0.1},
            {"Fc": 0.0166, "Fs": 0.0277, "vs": 0.407, "b": 0.00326, "eps": 0.1},
        ),
        2,
        (0.06, 0.3),
        (math.pi / 2, math.pi),
    ),
    "pendulum": System(
        ("theta1", "dtheta1"),
        {"m": 0.5, "lc": 0.2, "I": 0.002, "g": 9.81},
        ({"Fc": 0.03, "Fs": 0.05, "vs": 0.4, "b": 0.01, "eps": 0.1},),
        1,
        (0.1, 0.8),
        (0.3, 2.0),
    ),
    "slide": System(
        ("x", "dx"),
        {"m": 1.0},
        ({"Fc": 1.0, "Fs": 1.5, "vs": 0.05, "b": 2.0, "eps": 0.02},),
        1,
        (2.0, 8.0),
        (0.0, 0.1),
    ),
}


# Friction: the level g(w) at steady sliding, and its smoothed sign.


def _stribeck_level(f: dict[str, float], w: Array) -> Array:
    return f["Fc"] + (f["Fs"] - f["Fc"]) * np.exp(-((w / f["vs"]) ** 2))


def _other_level(f: dict[str, float], w: Array) -> Array:
    return f["Fc"] + (f["Fs"] - f["Fc"]) / (1 + (w / f["vs"]) ** 2)


SHAPES: dict[str, tuple[Callable, Callable]] = {
    "stribeck": (_stribeck_level, lambda f, w: np.tanh(w / f["eps"])),
    "other": (_other_level, lambda f, w: w / np.sqrt(w**2 + (0.6 * f["eps"]) ** 2)),
}


def friction_torque(shape: str, f: dict[str, float], w: Array) -> Array:
    """Static friction torque of one joint, -[g(w) sign(w) + b w]."""
    level, sign = SHAPES[shape]
    return -(level(f, w) * sign(f, w) + f["b"] * w)


# Effects that are a torque on joint j, of its position and velocity.


def _spring(p: Effect, q: Array, w: Array) -> Array:
    d = q - p.get("theta0", 0.0)
    return -p["k"] * (d + p.get("k3", 0.0) * d**3)


def _drag(p: Effect, q: Array, w: Array) -> Array:
    return -p["c"] * np.abs(w) ** p.get("exponent", 2.0) * np.sign(w)


def _cogging(p: Effect, q: Array, w: Array) -> Array:
    first = p["amplitude"] * np.sin(p["k"] * q + p.get("phase", 0.0))
    return first + p.get("amplitude2", 0.0) * np.sin(2 * p["k"] * q + p.get("phase2", 0.0))


def _stop(p: Effect, q: Array, w: Array) -> Array:
    stiffness, damping = p.get("stiffness", 40.0), p.get("damping", 0.3)
    above = np.where(q > p["upper"], np.maximum(stiffness * (q - p["upper"]) + damping * w, 0), 0)
    below = np.where(q < p["lower"], np.maximum(stiffness * (p["lower"] - q) - damping * w, 0), 0)
    return below - above


def _magnet(p: Effect, q: Array, w: Array) -> Array:
    d = q - p["center"]
    return p["amplitude"] * d / (1 + (d / p["width"]) ** 2) ** 2


JOINT: dict[str, Callable[[Effect, Array, Array], Array]] = {
    "torsional_spring": _spring,
    "air_drag": _drag,
    "cogging": _cogging,
    "torque_offset": lambda p, q, w: p["value"] + 0 * q,
    "hard_stop": _stop,
    "eddy_brake": lambda p, q, w: -p["c"] * np.cos(q - p.get("center", 0.0)) ** 2 * w,
    "motor_back_emf": lambda p, q, w: -p["b"] * w,
    "bump": lambda p, q, w: p["amplitude"] * np.exp(-(((q - p["center"]) / p["width"]) ** 2)),
    "magnet": _magnet,
}

# Effects between the column u and the motor's torque; they act in the order in which a case lists them.
INPUT: dict[str, Callable[[Effect, Array], Array]] = {
    "motor_gain": lambda p, u: p["gain"] * u,
    "dead_zone": lambda p, u: np.sign(u) * np.maximum(np.abs(u) - p["width"], 0),
    "saturation": lambda p, u: np.clip(u, -p["limit"], p["limit"]),
    "one_sided_loss": lambda p, u: np.where(np.sign(u) == p["side"], (1 - p["loss"]) * u, u),
}

# Factors on the friction of a joint.
LEVEL: dict[str, Callable[[Effect, Array, Array], Array]] = {
    "position_dependent_friction": lambda p, q, t: 1 + p["depth"] * np.cos(p["n"] * q + p.get("phase", 0.0)),
    "friction_drift": lambda p, q, t: 1 + p["change"] * (1 - np.exp(-t / p["tau"])),
}

# Torque between the motor (angle ahead of the joint, its rate) and the joint.


def _flexible(p: Effect, ahead: Array, rate: Array) -> Array:
    return p["k"] * ahead + 0.2 * math.sqrt(p["k"] * MOTOR_INERTIA) * rate


def _play(p: Effect, ahead: Array, rate: Array) -> Array:
    pressed = ahead - np.clip(ahead, -p["gap"] / 2, p["gap"] / 2)
    contact = 20.0 * pressed + 0.08 * rate
    return np.where(pressed > 0, np.maximum(contact, 0), np.where(pressed < 0, np.minimum(contact, 0), 0))


TRANSMISSION: dict[str, Callable[[Effect, Array, Array], Array]] = {"joint_flexibility": _flexible, "backlash": _play}

SUBSTEPS = {"backlash": 20, "joint_flexibility": 20, "presliding_friction": 20, "hard_stop": 20}
"""Runge-Kutta steps per sample where ten are too few."""
OTHERS = {
    *("base_tilt", "base_vibration", "payload", "payload_step", "link_inertia", "link_length", "center_of_mass"),
    *("input_delay", "actuator_lag", "presliding_friction", "coupling"),
    *("load_friction", "pulses", "sensor_bias", "sensor_scale", "sensor_delay", "sensor_quantization"),
}
KNOWN = {*JOINT, *INPUT, *LEVEL, *TRANSMISSION, *OTHERS}


def kind(effect: Effect) -> str:
    """Name of the law: that of the effect, or the form of an unknown function."""
    return effect["form"] if effect["name"] == "unknown_function" else effect["name"]


class Queue(NamedTuple):
    """Values of one state on their way to a late sensor; the oldest is read."""

    state: int
    first: int
    length: int
    fraction: float
    """Of the interval, at which a value enters."""


class Plant(NamedTuple):
    """The truth, ready to be integrated."""

    case: Case
    parameters: dict[str, float]
    friction: tuple[dict[str, float], ...]
    lumps: tuple[float, ...]
    """Constants of mass matrix and gravity, without what changes in time."""
    memory: dict[str, int]
    """First state of each effect that remembers."""
    queues: tuple[Queue, ...]
    dof: int
    dynamic: int
    """States that follow a differential equation; the queues stand behind them."""
    size: int
    driven: int
    late: float
    """Samples until an input acts."""
    substeps: int

    def named(self, *names: str) -> Iterator[Effect]:
        return (e for e in self.case.effects if kind(e) in names)

    def joint(self, effect: Effect) -> int:
        """Index of the joint that an effect acts on: the driven one if it names none."""
        return (effect.get("joint") or self.driven) - 1


def measured(case: Case) -> tuple[str, ...]:
    states = SYSTEMS[case.system].states
    hidden = {"acrobot": ("theta1", "dtheta1")}.get(case.system, states[:1])
    return hidden if case.hidden else states


def drawn_friction(case: Case) -> tuple[dict[str, float], ...]:
    """Friction of the case's rig: every parameter but the smoothing within 25 % of the system's."""
    rng = np.random.default_rng([case.seed, 0])
    draw = lambda f: {k: v if k == "eps" else round(v * rng.uniform(0.75, 1.25), 6) for k, v in f.items()}  # noqa: E731
    return tuple(map(draw, SYSTEMS[case.system].friction))


def build(case: Case) -> Plant:
    """The plant of a case."""
    if unknown := {kind(e) for e in case.effects} - KNOWN:
        raise ValueError(f"no such effect: {', '.join(sorted(unknown))}")
    system = SYSTEMS[case.system]
    dof, effects = len(system.states) // 2, case.effects
    memory, size = {}, 2 * dof
    for e in effects:
        if e["name"] in ("presliding_friction", *TRANSMISSION) or (e["name"] == "actuator_lag" and e["tau"] > 0):
            memory[e["name"]] = size
            size += 2 if e["name"] in TRANSMISSION else 1
    dynamic, queues = size, []
    for e in effects:
        if e["name"] == "sensor_delay" and e["delay"] > 0:
            late = round(e["delay"] / DT, 9)
            for column in measured(case) if e["channel"] == "all" else (e["channel"],):
                queues.append(Queue(system.states.index(column), size, math.ceil(late), math.ceil(late) - late))
                size += math.ceil(late)
    parameters = true_parameters(case)
    return Plant(
        case,
        parameters,
        drawn_friction(case),
        lumped(case.system, parameters),
        memory,
        tuple(queues),
        dof,
        dynamic,
        size,
        system.driven,
        round(sum(e["delay"] for e in effects if e["name"] == "input_delay") / DT, 9),
        max((SUBSTEPS.get(e["name"], 10) for e in effects), default=10),
    )


# Rigid bodies.


def true_parameters(case: Case) -> dict[str, float]:
    """The declared parameters, put right by the effects that change one; the `payload` stands beside them."""
    p = {**SYSTEMS[case.system].parameters, "payload": 0.0}
    for e in case.effects:
        end = str(e.get("joint") or 2) if case.system == "acrobot" else ""
        for name, key, change in (
            ("link_inertia", "I" + end, "dI"),
            ("link_length", "l" + end, "dl"),
            ("center_of_mass", "lc" + end, "dlc"),
            ("payload", "payload", "mass"),
        ):
            if e["name"] == name:
                p[key] += e[change]
    return p


def _arm_lumps(p: dict[str, float]) -> tuple[float, ...]:
    l1, l2, m = p["l1"], p["l2"], p["payload"]
    return (
        p["I1"] + p["m1"] * p["lc1"] ** 2 + (p["m2"] + m) * l1**2,
        p["I2"] + p["m2"] * p["lc2"] ** 2 + m * l2**2,
        (p["m2"] * p["lc2"] + m * l2) * l1,
        p["m1"] * p["lc1"] + (p["m2"] + m) * l1,
        p["m2"] * p["lc2"] + m * l2,
    )


def lumped(system: str, p: dict[str, float]) -> tuple[float, ...]:
    """Inertias [kg m^2], then first moments of mass [kg m]; of a slide its mass.  A pendulum's tip is at 2 lc."""
    if system == "acrobot":
        return _arm_lumps(p)
    if system == "pendulum":
        tip = 2 * p["lc"]
        return (p["I"] + p["m"] * p["lc"] ** 2 + p["payload"] * tip**2, p["m"] * p["lc"] + p["payload"] * tip)
    return (p["m"] + p["payload"],)


def _lumps(plant: Plant, t: Array) -> tuple:
    """The constants at time t: a payload may have changed."""
    lumps = plant.lumps
    for e in plant.named("payload_step"):
        loaded = {**plant.parameters, "payload": plant.parameters["payload"] + e["mass"]}
        more = lumped(plant.case.system, loaded)
        lumps = tuple(a + np.where(t >= e["time"], b - c, 0) for a, b, c in zip(lumps, more, plant.lumps, strict=True))
    return lumps


def acceleration(plant: Plant, q: Array, v: Array, force: Array, t: Array) -> Array:
    """Second derivative of the coordinates under generalised forces, weight and the base's shaking."""
    lumps = _lumps(plant, t)
    shaking = sum(
        e["amplitude"] * np.sin(2 * math.pi * e["frequency"] * t + e.get("phase", 0.0))
        for e in plant.named("base_vibration")
    )
    if plant.case.system == "slide":
        return force / np.reshape(lumps[0], (-1, 1)) - np.reshape(shaking, (-1, 1))
    tilt = sum(e["angle"] for e in plant.named("base_tilt"))
    g = plant.parameters["g"]
    pull = lambda moment, angle: -moment * (g * np.sin(angle + tilt) + shaking * np.cos(angle + tilt))  # noqa: E731
    if plant.case.system == "pendulum":
        inertia, moment = lumps
        return ((force[:, 0] + pull(moment, q[:, 0])) / inertia)[:, None]
    a1, a2, a3, k1, k2 = lumps
    coupling, h = a3 * np.cos(q[:, 1]), a3 * np.sin(q[:, 1])
    m11, m12 = a1 + a2 + 2 * coupling, a2 + coupling
    outer = pull(k2, q[:, 0] + q[:, 1])
    f1 = force[:, 0] + h * v[:, 1] * (2 * v[:, 0] + v[:, 1]) + pull(k1, q[:, 0]) + outer
    f2 = force[:, 1] - h * v[:, 0] ** 2 + outer
    return np.stack([a2 * f1 - m12 * f2, m11 * f2 - m12 * f1], axis=1) / (m11 * a2 - m12**2)[:, None]


def energy(plant: Plant, x: Array, t: Array) -> Array:
    """Kinetic and potential energy of a pendulum or an acrobot that does not shake [J]."""
    tilt, g = sum(e["angle"] for e in plant.named("base_tilt")), plant.parameters["g"]
    height = lambda moment, angle: -moment * g * np.cos(angle + tilt)  # noqa: E731
    if plant.case.system == "pendulum":
        inertia, moment = _lumps(plant, t)
        return inertia * x[:, 1] ** 2 / 2 + height(moment, x[:, 0])
    a1, a2, a3, k1, k2 = _lumps(plant, t)
    q1, q12, w1, w12 = x[:, 0], x[:, 0] + x[:, 1], x[:, 2], x[:, 2] + x[:, 3]
    kinetic = (a1 * w1**2 + a2 * w12**2) / 2 + a3 * w1 * w12 * np.cos(x[:, 1])
    return kinetic + height(k1, q1) + height(k2, q12)


# Forces and memory.


def _tip_drag(plant: Plant, e: Effect, q: Array, v: Array) -> Array:
    """Drag on the tip of link 2, by the Jacobian of its position."""
    l1, l2, outer = plant.parameters["l1"], plant.parameters["l2"], q[:, 0] + q[:, 1]
    jx2, jy2 = l2 * np.cos(outer), l2 * np.sin(outer)
    jx1, jy1 = l1 * np.cos(q[:, 0]) + jx2, l1 * np.sin(q[:, 0]) + jy2
    vx, vy = jx1 * v[:, 0] + jx2 * v[:, 1], jy1 * v[:, 0] + jy2 * v[:, 1]
    strength = -e["c"] * np.hypot(vx, vy) ** (e.get("exponent", 2.0) - 1)
    return np.stack([strength * (jx1 * vx + jy1 * vy), strength * (jx2 * vx + jy2 * vy)], axis=1)


def _passive(plant: Plant, q: Array, v: Array) -> Array:
    """Generalised force of the effects without memory."""
    force = np.zeros_like(q)
    for e in plant.case.effects:
        name, j = kind(e), plant.joint(e)
        if name == "air_drag" and e.get("joint") is None and plant.dof == 2:
            force += _tip_drag(plant, e, q, v)
        elif name in JOINT:
            force[:, j] += JOINT[name](e, q[:, j], v[:, j])
        elif name == "coupling":
            force[:, (e.get("joint") or 1) - 1] += e["amplitude"] * np.sin(2 * q[:, 0] + q[:, 1])
    return force


def _friction(plant: Plant, x: Array, t: Array, dx: Array) -> Array:
    """Friction of all joints; writes the rate of a bristle into dx."""
    torque = np.empty((len(x), plant.dof))
    bristle = {plant.joint(e): e for e in plant.named("presliding_friction")}
    for j, f in enumerate(plant.friction):
        q, w = x[:, j], x[:, plant.dof + j]
        if j in bristle:
            torque[:, j] = _bristle(plant, bristle[j], f, x, w, dx)
        else:
            torque[:, j] = friction_torque(plant.case.friction_shape, f, w)
        for e in plant.named(*LEVEL):
            if plant.joint(e) == j:
                torque[:, j] *= LEVEL[kind(e)](e, q, t)
    return torque


def _bristle(plant: Plant, e: Effect, f: dict[str, float], x: Array, w: Array, dx: Array) -> Array:
    """LuGre: z' = w - sigma0 |w| z / g(w), torque -(sigma0 z + sigma1 z' + b w)  [Canudas de Wit et al. 1995]."""
    i, sigma0 = plant.memory["presliding_friction"], e["sigma0"]
    relaxation = sigma0 * np.abs(w) / SHAPES[plant.case.friction_shape][0](f, w)
    slower = BRISTLE_RATE / np.maximum(relaxation, BRISTLE_RATE)
    dx[:, i] = slower * (w - relaxation * x[:, i])
    sigma1 = e.get("sigma1", 0.05 * math.sqrt(sigma0))
    return -(sigma0 * x[:, i] + sigma1 * dx[:, i] + f["b"] * w)


def _drive(plant: Plant, x: Array, u: Array, dx: Array) -> Array:
    """Torque on the driven joint; writes the rates of lag and motor into dx."""
    for e in plant.named(*INPUT):
        u = INPUT[kind(e)](e, u)
    for e in plant.named("actuator_lag"):
        if (i := plant.memory.get("actuator_lag")) is not None:
            dx[:, i] = (u - x[:, i]) / e["tau"]
            u = x[:, i]
    for e in plant.named(*TRANSMISSION):
        i, j = plant.memory[e["name"]], plant.driven - 1
        through = TRANSMISSION[e["name"]](e, x[:, i] - x[:, j], x[:, i + 1] - x[:, plant.dof + j])
        dx[:, i] = x[:, i + 1]
        dx[:, i + 1] = (u - 3e-4 * x[:, i + 1] - through) / MOTOR_INERTIA
        u = through
    for e in plant.named("load_friction"):
        rate = x[:, plant.dof + plant.driven - 1]
        u = u - e["mu"] * np.abs(u) * np.tanh(rate / e["knee"])
    return u


def rates(plant: Plant, x: Array, u: Array, t: Array) -> Array:
    """Time derivative of the dynamic states at the motor's command u."""
    n = plant.dof
    q, v = x[:, :n], x[:, n : 2 * n]
    dx = np.zeros_like(x)
    force = _passive(plant, q, v) + _friction(plant, x, t, dx)
    force[:, plant.driven - 1] += _drive(plant, x, u, dx)
    for e in plant.named("pulses"):  # a square wave, as far as its seventh harmonic
        turn = 2 * math.pi * e["frequency"] * t
        force[:, plant.joint(e)] += e["amplitude"] * sum(4 / (math.pi * h) * np.sin(h * turn) for h in (1, 3, 5, 7))
    dx[:, :n] = v
    dx[:, n : 2 * n] = acceleration(plant, q, v, force, t)
    return dx


def _runge_kutta(plant: Plant, x: Array, u: Array, t: Array, span: float) -> Array:
    """The states after `span`, at one held command."""
    steps = max(math.ceil(span / DT * plant.substeps - 1e-9), 1)
    h = span / steps
    for i in range(steps):
        s = t + i * h
        a = rates(plant, x, u, s)
        b = rates(plant, x + h / 2 * a, u, s + h / 2)
        c = rates(plant, x + h / 2 * b, u, s + h / 2)
        d = rates(plant, x + h * c, u, s + h)
        x = x + h / 6 * (a + 2 * b + 2 * c + d)
    return x


def step(plant: Plant, x: Array, u: Array, k: int, t: Array) -> Array:
    """The states one sample later, without noise; u [batch, time] from the first row, of which k is now, at time t."""
    cuts = {0.0, 1.0, plant.late - math.floor(plant.late), *(queue.fraction for queue in plant.queues)}
    cuts = sorted(cuts)
    state, past = x[:, : plant.dynamic], {0.0: x}
    for begin, end in itertools.pairwise(cuts):
        row = k + math.floor((begin + end) / 2 - plant.late)
        command = u[:, row] if row >= 0 else np.zeros(len(u))
        state = _runge_kutta(plant, state, command, t + begin * DT, (end - begin) * DT)
        past[end] = state
    shifted = x.copy()
    shifted[:, : plant.dynamic] = state
    for queue in plant.queues:
        shifted[:, queue.first + 1 : queue.first + queue.length] = x[:, queue.first : queue.first + queue.length - 1]
        shifted[:, queue.first] = past[queue.fraction][:, queue.state]
    return shifted


def lift(plant: Plant) -> Array:
    """Matrix [state, positions and velocities] from a rig at its start to all states: motors in line, queues full."""
    matrix = np.eye(plant.size, 2 * plant.dof)
    for name in TRANSMISSION:
        if name in plant.memory:
            matrix[plant.memory[name], plant.driven - 1] = 1
            matrix[plant.memory[name] + 1, plant.dof + plant.driven - 1] = 1
    for queue in plant.queues:
        matrix[queue.first : queue.first + queue.length, queue.state] = 1
    return matrix


class Sensor(NamedTuple):
    """reading = scale * state + bias, then noise, then steps."""

    index: int
    scale: float
    bias: float
    noise: float
    step: float


def sensors(plant: Plant) -> tuple[Sensor, ...]:
    """One per measured column; a late one reads the end of its queue."""
    case, states = plant.case, SYSTEMS[plant.case.system].states

    def one(column: str) -> Sensor:
        state, scale, bias, width = states.index(column), 1.0, 0.0, 0.0
        last = {queue.state: queue.first + queue.length - 1 for queue in plant.queues}
        for e in case.effects:
            if e.get("channel") in (column, "all"):
                scale *= e["scale"] if e["name"] == "sensor_scale" else 1.0
                bias += e["bias"] if e["name"] == "sensor_bias" else 0.0
                width = e["step"] if e["name"] == "sensor_quantization" else width
        return Sensor(last.get(state, state), scale, bias, case.noise[state >= plant.dof], width)

    return tuple(map(one, measured(case)))


# The experiment.


def torques(case: Case) -> Array:
    """Column u of every sequence, [sequence, time]."""
    rng, low, high = np.random.default_rng([case.seed, 1]), *SYSTEMS[case.system].amplitude
    form = rng.choice(["sine", "sum"]) if case.torque == "drawn" else case.torque
    number, t = case.sequences + case.tests, DT * np.arange(case.steps + 1)
    draw = lambda a, b, *more: rng.uniform(a, b, (number, *more, 1))  # noqa: E731
    size, frequency, phase = draw(low, high), np.exp(draw(math.log(0.4), math.log(2.0))), draw(0, 2 * math.pi)
    if form == "sine":
        return size * np.sin(2 * math.pi * frequency * t + phase)
    if form == "chirp":
        return size * np.sin(2 * math.pi * (0.3 + 0.5 * frequency * t) * t + phase)
    if form == "sum":
        parts = np.exp(draw(math.log(0.4), math.log(5.0), 4)) * t
        return (draw(low / 2, 0.6 * high, 4) * np.sin(2 * math.pi * parts + draw(0, 2 * math.pi, 4))).sum(axis=1)
    raise ValueError(f"no such torque: {case.torque}")


def starts(case: Case) -> Array:
    """Positions and velocities in the first row of every sequence."""
    rng, dof = np.random.default_rng([case.seed, 2]), len(SYSTEMS[case.system].states) // 2
    number, (low, high) = case.sequences + case.tests, SYSTEMS[case.system].first
    spread = [0.0, THETA2_STD][:dof] + [RATE_STD] * dof
    x = rng.standard_normal((number, 2 * dof)) * spread
    low = 0.0 if case.start == "anywhere" else low
    x[:, 0] = rng.choice([-1.0, 1.0], number) * rng.uniform(low, high, number)
    return x


def clocks(case: Case) -> Array:
    """Time of the first row of every sequence [s]."""
    return np.arange(case.sequences + case.tests) * (case.steps * DT + GAP) * (case.clock == "session")


def simulate(plant: Plant, start: Array, u: Array, t: Array, kicks: Array | float = 0.0) -> Array:
    """All states, [batch, time, state], from positions and velocities; `kicks` [batch, time, dof] per sample."""
    n, x = plant.dof, start @ lift(plant).T
    kicks = np.broadcast_to(kicks, (*u.shape, n))
    states = [x]
    for k in range(u.shape[1] - 1):
        x = step(plant, x, u, k, t + k * DT)
        x[:, n : 2 * n] += kicks[:, k]
        states.append(x)
    return np.stack(states, axis=1)


def noise_free(plant: Plant, x: Array) -> Array:
    """What the sensors would read without noise and steps."""
    return np.stack([s.scale * x[..., s.index] + s.bias for s in sensors(plant)], axis=-1)


def readings(plant: Plant, x: Array) -> Array:
    """What the sensors read; NaN where a reading is missing."""
    rng = np.random.default_rng([plant.case.seed, 4])
    y = noise_free(plant, x)
    y = y + rng.standard_normal(y.shape) * [s.noise for s in sensors(plant)]
    for i, s in enumerate(sensors(plant)):
        if s.step:
            y[..., i] = s.step * np.round(y[..., i] / s.step)
    return np.where(rng.uniform(size=y.shape) < plant.case.missing, np.nan, y)


# The folder.


def write(case: Case, folder: Path) -> None:
    """Write rig.toml, train/ and test/ as a diagnosis gets them, and truth/ as it must not."""
    plant, u, t = build(case), torques(case), clocks(case)
    kicks = case.process * np.random.default_rng([case.seed, 3]).standard_normal((*u.shape, plant.dof))
    x = simulate(plant, starts(case), u, t, kicks)
    y = readings(plant, x)
    folder = Path(folder)
    for i in range(len(u)):
        test = i >= case.sequences
        name = f"{i - case.sequences * test + 1:0{2 if case.sequences < 100 else 3}d}.csv"
        time = t[i] + DT * np.arange(u.shape[1])
        header = ("u", *measured(case))
        _write_csv(folder / ("test" if test else "train") / name, header, time, np.c_[u[i], y[i]])
        if test:
            states = SYSTEMS[case.system].states
            _write_csv(folder / "truth" / "test" / name, states, time, x[i, :, : len(states)])
    (folder / "rig.toml").write_text(rig_toml(case), encoding="utf-8", newline="\n")
    truth = {
        "effects": case.effects,
        "friction": plant.friction,
        "friction_shape": case.friction_shape,
        "noise_std": case.noise,
        "process_noise_std_per_sample": case.process,
        "seed": case.seed,
    }
    (folder / "truth" / "truth.json").write_text(json.dumps(truth, indent=1) + "\n", encoding="utf-8", newline="\n")


def rig_toml(case: Case) -> str:
    """What the owner declares: everything but the effects, the friction and the process noise."""
    system, columns = SYSTEMS[case.system], measured(case)
    dof = len(system.states) // 2
    lines = ["format = 1", f'name = "{case.system}_{case.seed}"', "", "[model]", f'type = "{case.system}"']
    lines += [f"{name} = {value!r}" for name, value in system.parameters.items()]
    lines += [f"actuated_joint = {system.driven}", 'friction = "unknown"']
    lines += ["", "[sampling]", f"dt = {DT}", 'input_hold = "zero-order"', f'clock = "{case.clock}"']
    lines += ["", "[measurement]", f"columns = {json.dumps(columns)}"]
    if case.declare_noise:
        lines += ["", "[measurement.noise_std]"]
        lines += [f"{c} = {float(case.noise[system.states.index(c) >= dof])!r}" for c in columns]
    lines += ["", "[start]"]
    if "theta2" in system.states and "theta2" not in columns:
        lines += [f"theta2 = {{ mean = 0.0, std = {THETA2_STD} }}"]
    lines += [f"{rate} = {{ mean = 0.0, std = {RATE_STD} }}" for rate in system.states[dof:]]
    return "\n".join(lines) + "\n"


def _write_csv(path: Path, header: tuple[str, ...], time: Array, values: Array) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    cell = lambda v: "" if math.isnan(v) else f"{v:.6f}"  # noqa: E731
    rows = [",".join([f"{t:.2f}", *map(cell, row)]) for t, row in zip(time, values.tolist(), strict=True)]
    path.write_text("\n".join([",".join(("time", *header)), *rows]) + "\n", encoding="utf-8", newline="\n")


def read(folder: Path) -> tuple[Array, Array, Array]:
    """Time [sequence, time], u and readings [sequence, time, column] of all files of a folder."""
    tables = [np.genfromtxt(path, delimiter=",", skip_header=1) for path in sorted(Path(folder).glob("*.csv"))]
    table = np.stack(tables)
    return table[..., 0], table[..., 1], table[..., 2:]


# The best possible forecast.


def forecast(plant: Plant, t: Array, u: Array, y: Array, given: float) -> Array:
    """Readings without noise [sequence, time, column] that the true model foretells from those up to `given`.

    A cubature Kalman filter from each of a bank of starts of the hidden angle; the likeliest rolls on without noise.
    """
    rows = int(np.sum(t[0] - t[0, 0] <= given + 1e-9))
    mean, cov, log_weight = _bank(plant, y)
    bank = mean.shape[1]
    flat = lambda a: a.reshape(-1, *a.shape[2:])  # noqa: E731
    fan = lambda a: np.repeat(a, bank, axis=0)  # noqa: E731
    mean, log_likelihood = filtered(plant, flat(mean), flat(cov), fan(u[:, :rows]), fan(y[:, :rows]), fan(t[:, 0]))
    best = np.argmax(log_likelihood.reshape(-1, bank) + log_weight, axis=1)
    x = mean.reshape(-1, bank, plant.size)[np.arange(len(u)), best]
    states = np.full((*u.shape, plant.size), np.nan)
    for k in range(rows - 1, u.shape[1]):
        states[:, k] = x
        x = step(plant, x, u, k, t[:, 0] + k * DT)
    return noise_free(plant, states)


def _bank(plant: Plant, y: Array) -> tuple[Array, Array, Array]:
    """Starts [sequence, bank, ...] and their log weights: measured angles near their first reading, rates near 0."""
    n, case = plant.dof, plant.case
    mean, std = np.zeros((len(y), 2 * n)), np.tile([0.0] * n + [RATE_STD] * n, (len(y), 1))
    for i, s in enumerate(sensors(plant)):
        state = SYSTEMS[case.system].states.index(measured(case)[i])
        if state < n:
            first = np.argmax(np.isfinite(y[..., i]), axis=1)
            mean[:, state] = (y[np.arange(len(y)), first, i] - s.bias) / s.scale
            std[:, state] = 10 * (s.noise + s.step) + 0.05 * first
    offsets, width = np.zeros(1), 0.0
    if n == 2 and case.hidden:
        offsets, width = np.linspace(-3, 3, 13) * THETA2_STD, 0.3 * THETA2_STD
        std[:, 1] = width
    mean = np.repeat(mean[:, None], len(offsets), axis=1)
    if width:
        mean[..., 1] += offsets
    matrix = lift(plant)
    cov = (matrix * std[:, None, None] ** 2) @ matrix.T + 1e-10 * np.eye(plant.size)
    return mean @ matrix.T, np.repeat(cov, len(offsets), axis=1), -((offsets / THETA2_STD) ** 2) / 2


def filtered(plant: Plant, mean: Array, cov: Array, u: Array, y: Array, t: Array) -> tuple[Array, Array]:
    """Mean state after the last reading, and the log-likelihood of all; one row of the batch per hypothesis."""
    n, size = plant.dof, plant.size
    noise = np.full(size, 1e-10)
    noise[n : 2 * n] += plant.case.process**2
    points = 2 * size
    fan_u, fan_t = np.repeat(u, points, axis=0), np.repeat(t, points, axis=0)
    log_likelihood = np.zeros(len(mean))
    for k in range(u.shape[1]):
        if k:
            value, vector = np.linalg.eigh(cov)
            root = vector * np.sqrt(size * np.maximum(value, 0))[:, None, :]
            cloud = mean[:, None] + np.concatenate([root, -root], axis=2).swapaxes(1, 2)
            cloud = step(plant, cloud.reshape(-1, size), fan_u, k - 1, fan_t + (k - 1) * DT)
            cloud = cloud.reshape(-1, points, size)
            mean = cloud.mean(axis=1)
            spread = cloud - mean[:, None]
            cov = spread.swapaxes(1, 2) @ spread / points + np.diag(noise)
        for i, s in enumerate(sensors(plant)):
            mean, cov, gain = _condition(mean, cov, s, y[:, k, i])
            log_likelihood += gain
    return mean, log_likelihood


def _condition(mean: Array, cov: Array, s: Sensor, y: Array) -> tuple[Array, Array, Array]:
    """Kalman's update by one reading of each row, none where it is NaN; and its log-likelihood."""
    seen = np.isfinite(y)
    variance = s.scale**2 * cov[:, s.index, s.index] + s.noise**2 + s.step**2 / 12
    innovation = np.where(seen, y, 0) - (s.scale * mean[:, s.index] + s.bias)
    gain = seen[:, None] * s.scale * cov[:, :, s.index] / variance[:, None]
    mean = mean + gain * innovation[:, None]
    cov = cov - gain[:, :, None] * gain[:, None, :] * variance[:, None, None]
    return mean, cov, -0.5 * seen * (innovation**2 / variance + np.log(2 * math.pi * variance))


def oracle_errors(
    case: Case, folder: Path, given: float = 1.0, horizons: tuple[float, ...] = (0.1, 0.25, 0.5, 1.0, 2.0, 4.0)
) -> dict[str, list[float]]:
    """Error on test/ of one who knows the model of `case` exactly: the floor of INTERFACE.md's `error`.

    With the `effects` of another case it is the error of one who knows all but these.
    """
    t, u, y = read(Path(folder) / "test")
    plant = build(case)
    error = forecast(plant, t, u, y, given) - y
    elapsed = t - t[:, :1]
    result = {}
    for i, column in enumerate(measured(case)):
        e = error[..., i]
        if column.startswith("theta"):
            e = (e + math.pi) % (2 * math.pi) - math.pi
        within = [(elapsed > given + 1e-9) & (elapsed <= given + h + 1e-9) for h in horizons]
        result[column] = [float(np.sqrt(np.nanmean(e[rows] ** 2))) for rows in within]
    return result


# One case of every name in the vocabulary, for the acrobot.

STRONG: dict[str, tuple[Effect, ...]] = {
    "torsional_spring": ({"name": "torsional_spring", "joint": 2, "k": 0.06, "theta0": -0.2},),
    "base_tilt": ({"name": "base_tilt", "joint": None, "angle": 0.12},),
    "payload": ({"name": "payload", "joint": 2, "mass": 0.04},),
    "link_inertia": ({"name": "link_inertia", "joint": 2, "dI": 0.0015},),
    "link_length": ({"name": "link_length", "joint": 1, "dl": 0.03},),
    "center_of_mass": ({"name": "center_of_mass", "joint": 2, "dlc": 0.02},),
    "air_drag": ({"name": "air_drag", "joint": None, "c": 0.006},),
    "motor_gain": ({"name": "motor_gain", "joint": 2, "gain": 0.7},),
    "dead_zone": ({"name": "dead_zone", "joint": 2, "width": 0.04},),
    "saturation": ({"name": "saturation", "joint": 2, "limit": 0.12},),
    "input_delay": ({"name": "input_delay", "joint": 2, "delay": 0.03},),
    "actuator_lag": ({"name": "actuator_lag", "joint": 2, "tau": 0.05},),
    "cogging": ({"name": "cogging", "joint": 2, "amplitude": 0.03, "k": 5.0, "phase": 0.5},),
    "torque_offset": ({"name": "torque_offset", "joint": 2, "value": 0.03},),
    "backlash": ({"name": "backlash", "joint": 2, "gap": 0.15},),
    "presliding_friction": ({"name": "presliding_friction", "joint": 2, "sigma0": 0.4},),
    "position_dependent_friction": (
        {"name": "position_dependent_friction", "joint": 1, "depth": 0.6, "n": 1.0, "phase": 0.4},
    ),
    "friction_drift": ({"name": "friction_drift", "joint": 1, "change": -0.5, "tau": 20.0},),
    "sensor_bias": ({"name": "sensor_bias", "channel": "theta1", "bias": 0.1},),
    "sensor_scale": ({"name": "sensor_scale", "channel": "dtheta1", "scale": 1.15},),
    "sensor_delay": ({"name": "sensor_delay", "channel": "dtheta1", "delay": 0.03},),
    "sensor_quantization": ({"name": "sensor_quantization", "channel": "theta1", "step": 0.05},),
    "base_vibration": ({"name": "base_vibration", "joint": None, "amplitude": 1.5, "frequency": 1.7, "phase": 0.6},),
    "payload_step": ({"name": "payload_step", "joint": 2, "mass": 0.05, "time": 70.0},),
    "hard_stop": ({"name": "hard_stop", "joint": 2, "upper": 2.2, "lower": -2.2},),
    "eddy_brake": ({"name": "eddy_brake", "joint": 2, "c": 0.02, "center": 0.3},),
    "joint_flexibility": ({"name": "joint_flexibility", "joint": 2, "k": 1.5},),
    "motor_back_emf": ({"name": "motor_back_emf", "joint": 2, "b": 0.012},),
}
"""Plain to see in a forecast (or, where a friction map holds the effect, in that map)."""

_THIRDS: dict[str, dict[str, float]] = {
    "torsional_spring": {"k": 0.02},
    "base_tilt": {"angle": 0.04},
    "payload": {"mass": 0.013},
    "link_inertia": {"dI": 0.0005},
    "link_length": {"dl": 0.01},
    "center_of_mass": {"dlc": 0.007},
    "air_drag": {"c": 0.002},
    "motor_gain": {"gain": 0.9},
    "dead_zone": {"width": 0.013},
    "saturation": {"limit": 0.18},
    "input_delay": {"delay": 0.01},
    "actuator_lag": {"tau": 0.017},
    "cogging": {"amplitude": 0.01},
    "torque_offset": {"value": 0.01},
    "backlash": {"gap": 0.05},
    "presliding_friction": {"sigma0": 1.2},
    "position_dependent_friction": {"depth": 0.2},
    "friction_drift": {"change": -0.17},
    "sensor_bias": {"bias": 0.033},
    "sensor_scale": {"scale": 1.05},
    "sensor_delay": {"delay": 0.01},
    "sensor_quantization": {"step": 0.017},
    "base_vibration": {"amplitude": 0.5},
    "payload_step": {"mass": 0.017},
    "hard_stop": {"upper": 2.8, "lower": -2.8},
    "eddy_brake": {"c": 0.007},
    "joint_flexibility": {"k": 4.5},
    "motor_back_emf": {"b": 0.004},
}
WEAK: dict[str, tuple[Effect, ...]] = {name: ({**STRONG[name][0], **less},) for name, less in _THIRDS.items()}
"""About a third as strong."""
UNNAMED: dict[str, tuple[Effect, ...]] = {
    "one_sided_loss": ({"name": "unknown_function", "form": "one_sided_loss", "joint": 2, "side": -1, "loss": 0.5},),
    "load_friction": ({"name": "unknown_function", "form": "load_friction", "joint": 2, "mu": 0.3, "knee": 0.2},),
    "periodic_force": (
        {"name": "unknown_function", "form": "pulses", "joint": 2, "amplitude": 0.05, "frequency": 0.9},
    ),
}
"""Laws that the vocabulary has no name for: unknown functions of u, of u and dtheta2, of time."""
SESSION = frozenset({"friction_drift", "payload_step"})
"""Names whose cases in STRONG and WEAK are meant for clock="session"."""
