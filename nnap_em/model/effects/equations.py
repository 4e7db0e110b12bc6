"""Laws that equations may lack: flows into and between states, by states and inputs.

Each is a `Flow`: one formula for all of them, so that a search compiles one program for all.
"""

import dataclasses
import itertools
import math
from abc import abstractmethod
from collections.abc import Sequence
from functools import partial
from typing import Any, ClassVar, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .actuator import ActuatorLag, DeadZone, InputDelay, InputEffect, MotorGain, Saturation
from .base import AbstractEffect, Candidate, Scalar, SearchScales, SensorEffect, a, fields, known, one
from .sensor import SensorBias, SensorScale

STRONG = 5.0
"""Prior standard deviation of a strength: multiple of that which moves a state by its typical rate over the range of
the signal."""
FORMS = (
    "", " in proportion to {0}", " in proportion to {0} - {1}", " in proportion to {0} {1}", " with the square of {0}",
    "", "", " with a power of {0}", " with the cube of {0}",
)  # fmt: skip
"""Words of the forms of a flow, with the names of its signals."""

POWERS = 0.2, 5.0
"""Ends of the exponents of a power."""


class PlantLaw(AbstractEffect):
    """Any law of equations that takes no time, by zeros and ones: strength g(signals), which enters `source`, and times
    share `target`; for inputs, `strength` as excess of a gain, bias, dead zone or limit; for readings, as excess of a
    scale, bias or bend.

    g is one of 1, p, p - q, p q, p |p|, p above a level (p - level), the rate of the source where p is above a level
    and rises, p |p|^(level - 1) and p^3, by `kind`, of the signals p and q that `first` and `second` pick of states and
    inputs.
    """

    meaning: ClassVar[str] = "A law of equations."
    confirm: ClassVar[str] = "Change one signal of it at a time."
    strength: Scalar
    level: Scalar
    share: Scalar
    inputs: Float[Array, "4 *input"] = known()
    sensors: Float[Array, "3 *readable"] = known()
    kind: Float[Array, " kind"] = known()
    first: Float[Array, " signal"] = known()
    second: Float[Array, " signal"] = known()
    source: Float[Array, " port"] = known()
    target: Float[Array, " port"] = known()
    edge: Any = known()

    @classmethod
    def nothing(cls, system: Any) -> "PlantLaw":
        """None of the laws."""
        inputs, sensors = _zeros(4, len(system.inputs)), _zeros(3, len(system.readable))
        signals, ports = _zeros(len(system.states) + len(system.inputs)), _zeros(len(system.ports))
        none, kind = a(1e-12), _zeros(len(FORMS))
        return cls(none, none, none, inputs, sensors, kind, signals, signals, ports, ports, a(0.0))

    def force(self, scene, memory):
        values = jnp.concatenate([scene.q, cast(Array, scene.u)])
        p, q = self.first @ values, self.second @ values
        over, edge = jnp.maximum(p - self.level, 0.0), jnp.maximum(self.edge, 1e-12)
        step = jax.nn.sigmoid((p - self.level) / edge)
        rates = jnp.stack(scene.system.slopes(scene.q, scene.v, scene.u, jnp.zeros_like(scene.drive)))
        rising = jnp.maximum(jnp.abs(self.source[: len(rates)]) @ rates, 0.0)
        power = jnp.sign(p) * jnp.maximum(jnp.abs(p), 1e-12) ** jnp.clip(self.level, *POWERS)
        forms = jnp.stack([jnp.ones_like(p), p, p - q, p * q, p * jnp.abs(p), over, step * rising, power, p**3])
        return self.strength * (self.kind @ forms) * (self.source + self.share * self.target)

    def at_drive(self, place, index):
        return dataclasses.replace(self, inputs=self.inputs[:, index])

    def drive(self, torque):
        gain, bias, zone, limit = self.inputs
        width, end = zone * self.strength, limit * self.strength + (1 - limit) * 1e30
        value = (1 + gain * self.strength) * torque + bias * self.strength
        return jnp.clip(value - jnp.clip(value, -width, width), -end, end)

    def at_reading(self, name, index):
        return dataclasses.replace(self, sensors=self.sensors[:, index])

    def reading(self, value, past):
        scale, bias, bend = self.strength * self.sensors
        return (1 + scale) * value + bias + bend * (value - self.level) ** 2 / jnp.where(self.edge > 0, self.edge, 1.0)


class OtherLaw(AbstractEffect):
    """A delay of an input, a lag of an input, or parameters k of the plant, times 1 + number (p - middle), by zeros and
    ones; p is the signal that `pick` picks.
    """

    meaning: ClassVar[str] = "A law of equations that takes time, or a parameter that is none."
    confirm: ClassVar[str] = "Make a step."
    number: Scalar
    inputs: Float[Array, "2 *input"] = known()
    which: Float[Array, " parameter"] = known()
    pick: Float[Array, " signal"] = known()
    middle: Any = known()

    @classmethod
    def nothing(cls, system: Any) -> "OtherLaw":
        """None of the laws."""
        inputs, which = _zeros(2, len(system.inputs)), _zeros(len(system.of.parameters))
        return cls(a(1e-12), inputs, which, _zeros(len(system.states) + len(system.inputs)), a(0.0))

    def at_drive(self, place, index):
        return dataclasses.replace(self, inputs=self.inputs[:, index])

    def input(self, u, dt):
        delay, lag = self.inputs
        late = InputDelay(self.number * delay, channel="").input(u, dt)
        return jnp.where(lag > 0, ActuatorLag(self.number * lag, channel="").input(u, dt), late)

    def force(self, scene, memory):
        system, still = scene.system, jnp.zeros_like(scene.drive)
        moved = self.number * self.which * (self.pick @ jnp.concatenate([scene.q, cast(Array, scene.u)]) - self.middle)
        numbers = zip(system.of.parameters, moved, strict=True)
        changed = system.with_parameters({name: system.values[name] * (1 + more) for name, more in numbers})
        rates = (jnp.stack(one.slopes(scene.q, scene.v, scene.u, still)) for one in (changed, system))
        return still.at[: len(system.states)].set(next(rates) - next(rates))


def lean(effect: AbstractEffect, system: Any) -> AbstractEffect:
    """A law in the form that it has in common with others, so that one program serves all; itself without one."""
    if isinstance(effect, SignalEffect):
        return effect.lean(system)
    if type(effect) not in PLACES:
        return effect
    kind, at, place = PLACES[type(effect)]
    form = kind.nothing(system)
    here = np.array(getattr(form, at))
    names = {"inputs": system.inputs, "sensors": system.readable}[at]
    here[place] = _one_of(names, effect.channel)
    more: dict[str, Any] = {at: jnp.asarray(here)} | ({"edge": effect.range} if isinstance(effect, Bend) else {})
    more |= {to: getattr(effect, of) for to, of in zip(fields(form), fields(effect), strict=False)}
    return dataclasses.replace(form, **more)


def numbered(effect: AbstractEffect, form: AbstractEffect) -> AbstractEffect:
    """A law with the numbers of the form that it has in common with others, which may have more."""
    names, others = fields(effect), [getattr(form, name) for name in fields(form)]
    pairs = zip((getattr(effect, name) for name in names), others, strict=False)
    values = [other[: own.shape[0]] if own.ndim else other for own, other in pairs]
    return eqx.tree_at(lambda e: [getattr(e, name) for name in names], effect, values)


def _one_of(names: Sequence[str], name: str | None) -> Float[Array, " name"]:
    """1 at the place of a name, else 0."""
    return jnp.asarray(np.array([float(other == name) for other in names]))


def _zeros(*shape: int) -> Array:
    """Zeros by way of NumPy: a search makes thousands, and those of JAX are programs."""
    return jnp.asarray(np.zeros(shape))


class SignalEffect(AbstractEffect):
    """A law of some signals of equations, which it has in a form in common with others."""

    reads: tuple[str, ...] = eqx.field(static=True, kw_only=True)
    """Names of its signals."""

    @abstractmethod
    def lean(self, system: Any) -> AbstractEffect:
        """The law in that form."""

    def force(self, scene, memory):
        return self.lean(scene.system).force(scene, memory)

    def inputs_named(self):
        return self.reads

    def signals(self, system):
        return self.reads


class PortEffect(SignalEffect):
    """A law of some signals at a port, or from one to another."""

    kind: ClassVar[int]
    """Its place among the forms of `PlantLaw`."""
    leaves: ClassVar[bool] = False
    """True where it leaves its port."""
    reports: ClassVar[tuple[str, ...]] = ("strength",)
    """Numbers that it has and reports; the others stay as they are."""
    count: ClassVar[int] = 1
    """Number of its signals, where they may be any."""

    to: str | None = eqx.field(static=True, default=None, kw_only=True)
    """Port that a share of it enters."""
    strength: Scalar = eqx.field(kw_only=True, converter=a)
    level: Scalar = eqx.field(kw_only=True, default=0.0, converter=a)
    share: Scalar = eqx.field(kw_only=True, default=1.0, converter=a)
    edge: Any = known(kw_only=True, default=0.0)

    def lean(self, system) -> PlantLaw:
        signals, ports, way = (*system.states, *system.inputs), system.ports, -1.0 if self.leaves else 1.0
        first, second = (_one_of(signals, (*self.reads, None, None)[i]) for i in (0, 1))
        source, target = way * _one_of(ports, self.channel), -way * _one_of(ports, self.to)
        kind, numbers = jnp.asarray(np.eye(len(FORMS))[self.kind]), {name: getattr(self, name) for name in fields(self)}
        places = {"first": first, "second": second, "source": source, "target": target}
        return dataclasses.replace(PlantLaw.nothing(system), kind=kind, edge=self.edge, **numbers, **places)

    def values(self):
        return {name: getattr(self, name) for name in self.reports}

    def units_on(self, system):
        signals = [system.unit(name) for name in self.reads]
        port = system.port_unit(system.ports.index(self.channel) + 1)
        one, of = signals[:1], signals[:1] and f"({signals[0]})^power"
        per = [[], one, one, signals[:2], one * 2, one, [], [of] if of else [], one * 3][self.kind]
        per = [unit for unit in per if unit]
        strength = f"{port}/({' '.join(per)})" if len(per) > 1 else f"{port}/{per[0]}" if per else port
        if len(per) == 1 and port.startswith(f"{per[0]}/"):
            strength = port.replace(per[0], "1", 1)
        return {"strength": strength, "level": signals[0] if signals else "", "share": "-", "power": "-"}

    def phrase(self, sizes):
        out = "out of" if self.leaves else "into"
        way = f"from {self.channel} to {self.to}" if self.to else f"{out} {self.channel}"
        form = FORMS[self.kind].format(*self.reads)
        level = f" above {self.reads[0]} = {sizes['level']}" if "level" in sizes else ""
        share = f" (share {sizes['share']})" if "share" in sizes else f" ({sizes['strength']})"
        power = f", power {sizes['power']}" if "power" in sizes else ""
        return f"a flow {way}{form}{level}{share}{power}"

    def inputs_named(self):
        return (*self.reads, *([self.to] if self.to else []))

    def is_physical(self) -> bool:
        """A flow that leaves a state has a positive strength, and no more of it arrives than leaves, but for errors."""
        shared = "share" not in self.reports or 0.0 < float(self.share) < 1.5
        return shared and (not self.leaves or float(self.strength) > 0)

    @classmethod
    def places(cls, around: SearchScales) -> Sequence[tuple[str, tuple[str, ...], str | None]]:
        """Ports where it may be, its signals there, and the port that a share enters."""
        signals = list(itertools.combinations(around.sizes, cls.count))
        return [(port, of, None) for port in around.system.open_ports for of in signals]

    @classmethod
    def candidates(cls, around):
        out = []
        places = (0.3, 0.6, 0.8)  # places in the range of a signal where the search for a level begins
        for port, of, to in cls.places(around):
            low, high = around.sizes[of[0]] if "level" in cls.reports else (0.0, 0.0)
            levels = [low + share * (high - low) for share in (places if "level" in cls.reports else (0.0,))]
            out += [cls.at(around, port, of, to, level) for level in levels]
        return out

    @classmethod
    def at(
        cls, around: SearchScales, port: str, of: tuple[str, ...], to: str | None = None, level: float = 0.0
    ) -> Candidate:
        """The law at a port, of signals, from a level on, with strengths of the size of what moves the port."""
        rate = float(around.torque[around.system.ports.index(port)])
        ends = [around.sizes[name] for name in of]
        width, reach = [high - low for low, high in ends], [max(abs(low), abs(high)) for low, high in ends]
        first, high = [*reach, 1.0][0], [*width, 1.0][0]
        typical = 1.0, first, high, math.prod(reach), first**2, high, 1.0, first**level, first**3
        spread = STRONG * rate / max(typical[cls.kind], 1e-12)

        def make(strength: float, level: float, share: float):
            edge = 0.02 * width[0] if of else 0.0  # width of a step at a level, as a share of the range of its signal
            return cls(strength=strength, level=level, share=share, edge=edge, channel=port, reads=of, to=to)

        has, none = cls.reports, 1e-12
        start = make(0.0, level, 0.7 if "share" in has else 1.0)
        probe = make(0.04 * spread, level, 0.7 if "share" in has else 1.0)
        far = 0.3 * width[0] if "level" in has else 1.0 if "power" in has else none
        wide = make(spread, far, 0.3 if "share" in has else none)
        return Candidate(start, (probe,), wide)


class ConstantFlow(PortEffect):
    """strength."""

    meaning: ClassVar[str] = "A state gains or loses at a constant rate."
    confirm: ClassVar[str] = "Leave all inputs at zero and watch the state drift."
    kind: ClassVar[int] = 0
    count: ClassVar[int] = 0


class LinearFlow(PortEffect):
    """strength p: a leak where p is the state itself, else a coupling."""

    meaning: ClassVar[str] = "A state gains or loses in proportion to a signal: a leak where it is its own."
    confirm: ClassVar[str] = "Hold all else still, change this signal alone, and watch the rate of the state."
    kind: ClassVar[int] = 1


class SquareFlow(PortEffect):
    """strength p |p|."""

    meaning: ClassVar[str] = "A state gains or loses with the square of a signal."
    confirm: ClassVar[str] = "Hold all else still, double this signal, and compare the rates of the state."
    kind: ClassVar[int] = 4


class CubicFlow(PortEffect):
    """strength p^3."""

    meaning: ClassVar[str] = "A state gains or loses with the cube of a signal."
    confirm: ClassVar[str] = "Hold all else still, double this signal, and compare the rates of the state."
    kind: ClassVar[int] = 8


class PowerFlow(PortEffect):
    """strength p |p|^(power - 1)."""

    meaning: ClassVar[str] = "A state gains or loses with a power of a signal."
    confirm: ClassVar[str] = "Hold all else still, double this signal twice, and compare the rates of the state."
    kind: ClassVar[int] = 7
    reports: ClassVar[tuple[str, ...]] = ("strength", "power")

    @property
    def power(self) -> Scalar:
        """The exponent, in the place of a level."""
        return self.level

    def is_physical(self):
        return POWERS[0] < float(self.level) < POWERS[1]

    @classmethod
    def candidates(cls, around):
        powers = 0.5, 1.5, 3.0  # at which the search for one begins
        return [cls.at(around, *place, power) for place in cls.places(around) for power in powers]


class ProductFlow(PortEffect):
    """strength p q."""

    meaning: ClassVar[str] = "A state gains or loses in proportion to the product of two signals."
    confirm: ClassVar[str] = "Change one of the two signals while the other is zero: the rate must stay."
    kind: ClassVar[int] = 3
    count: ClassVar[int] = 2


class ThresholdFlow(PortEffect):
    """strength (p - level) where p is above the level."""

    meaning: ClassVar[str] = "A state gains or loses once a signal is above a level."
    confirm: ClassVar[str] = "Raise this signal slowly and watch where the rate of the state begins to change."
    kind: ClassVar[int] = 5
    reports: ClassVar[tuple[str, ...]] = ("strength", "level")


class Exchange(PortEffect):
    """strength (p - q) leaves the state p and enters the state q, as heat and pressure do."""

    meaning: ClassVar[str] = "One state loses to another in proportion to their difference, as heat does."
    confirm: ClassVar[str] = "Bring one of the two states up with all inputs off, and watch the other follow."
    kind: ClassVar[int] = 2
    leaves: ClassVar[bool] = True

    @classmethod
    def places(cls, around):
        return [(one, (one, other), other) for one, other in around.ordered if one < other]


class Transfer(PortEffect):
    """strength (p - level) leaves the state p above a level, and a share of it enters another."""

    meaning: ClassVar[str] = "Above a level one state loses, and another gains a share of it."
    confirm: ClassVar[str] = "Fill the first state above the level and watch where the flow goes."
    kind: ClassVar[int] = 5
    leaves: ClassVar[bool] = True
    reports: ClassVar[tuple[str, ...]] = ("level", "share", "strength")

    @classmethod
    def places(cls, around):
        return [(one, (one,), other) for one, other in around.ordered]


class FullEffect(PortEffect):
    """A law of a state that does not rise above a level: its net inflow leaves it there."""

    kind: ClassVar[int] = 6
    leaves: ClassVar[bool] = True
    linear: ClassVar[bool] = False

    @classmethod
    def candidates(cls, around):
        out = []
        for port, of, to in cls.places(around):
            low, high = around.sizes[of[0]]
            width, shares = high - low, "share" in cls.reports
            make = partial(cls, channel=port, reads=of, to=to, edge=0.02 * width)
            start = make(strength=1.0, level=high + width, share=0.7)
            wide = make(strength=1e-12, level=0.3 * width, share=0.3 if shares else 1e-12)
            grid = (0.4, 0.6, 0.8, 0.95)  # places in the range of the state where the search for a level begins
            levels = [dataclasses.replace(start, level=a(low + place * width)) for place in grid]
            out += [Candidate(start, (probe,), wide) for probe in levels]
        return out


class Ceiling(FullEffect):
    """A state loses its net inflow above a level."""

    meaning: ClassVar[str] = "A state does not rise above a level: a vessel that is full, a stop, a clipped value."
    confirm: ClassVar[str] = "Drive this state up slowly and watch where it stays."
    reports: ClassVar[tuple[str, ...]] = ("level",)

    @classmethod
    def places(cls, around):
        ports = [name for name in around.system.open_ports if name in around.sizes]
        return [(name, (name,), None) for name in ports]

    def phrase(self, sizes):
        return f"a ceiling of {self.channel} at {sizes['level']}"


class Overflow(FullEffect):
    """A state loses its net inflow above a level, and a share of it enters another."""

    meaning: ClassVar[str] = "A state does not rise above a level: what flows over, or a share of it, enters another."
    confirm: ClassVar[str] = "Fill the first state above the level and watch where the inflow goes."
    reports: ClassVar[tuple[str, ...]] = ("level", "share")

    @classmethod
    def places(cls, around):
        return [(one, (one,), other) for one, other in around.ordered]

    def phrase(self, sizes):
        return f"an overflow of {self.channel} into {self.to} above {sizes['level']} (share {sizes['share']})"


class VaryingParameter(SignalEffect):
    """k (1 + slope (p - middle)) in the place of a parameter k, `middle` in the range of the signal p."""

    meaning: ClassVar[str] = "A parameter is none: it changes with a signal, as a heat transfer with the flow."
    confirm: ClassVar[str] = "Measure the parameter at two values of this signal."
    slope: Scalar = eqx.field(kw_only=True, converter=a)
    middle: Any = known(kw_only=True)

    def lean(self, system):
        signals = (*system.states, *system.inputs)
        which, pick = _one_of(system.of.parameters, self.channel), _one_of(signals, *self.reads)
        none = OtherLaw.nothing(system)
        return dataclasses.replace(none, number=self.slope, which=which, pick=pick, middle=self.middle)

    def values(self):
        return {"slope": self.slope}

    def units_on(self, system):
        unit = system.unit(self.reads[0])
        return {"slope": f"1/({unit})" if unit else "-"}

    def phrase(self, sizes):
        return f"a change of {self.channel} with {self.reads[0]} ({sizes['slope']} from {float(self.middle):.3g} on)"

    @classmethod
    def candidates(cls, around):
        out = []
        for signal, (low, high) in around.sizes.items():
            for name in around.system.of.parameters:
                make = partial(cls, middle=(low + high) / 2, channel=name, reads=(signal,))
                start, probe, wide = (make(slope=slope * 2 / (high - low)) for slope in (0.0, 0.04, 1.0))
                out.append(Candidate(start, (probe,), wide))
        return out


class InputBias(InputEffect):
    """u + bias."""

    meaning: ClassVar[str] = "The plant receives more or less of an input than is logged, by a constant."
    confirm: ClassVar[str] = "Set this input to zero, measure what arrives, and compare with the log."
    units: ClassVar[dict[str, str]] = {"bias": "N m"}
    bias: Scalar

    @classmethod
    def candidates(cls, around):
        places = [(place, size) for place, size in around.drives if "channel" in place]
        return [one(partial(cls, **place), 0.0, 0.03 * size, 0.5 * size) for place, size in places]

    def drive(self, torque):
        return torque + self.bias


class Bend(SensorEffect):
    """value + bend (value - true)^2 / range, the range that of the readings: it reads `true` as it is."""

    name: ClassVar[str] = "sensor_bend"
    meaning: ClassVar[str] = "A sensor bends: what it reads is a curve of the value."
    confirm: ClassVar[str] = "Compare the sensor with another one at three places of its range."
    units: ClassVar[dict[str, str]] = {"bend": "-", "true": "unit of the channel"}
    bend: Scalar
    true: Scalar
    range: Any = known()

    @classmethod
    def candidates(cls, around):
        ends = [(low, high - low, name) for name, (low, high) in around.ends.items()]
        return [one(partial(cls, range=n, channel=name), 0.0, 0.02, 0.5, (low, n)) for low, n, name in ends]

    def reading(self, value, past):
        return value + self.bend * (value - self.true) ** 2 / self.range


NODES = {1: 9, 2: 5, 3: 4}
"""Basis functions along each signal of an unknown term, by the number of its signals."""


def _grid(values: Float[Array, " axis"], low: Any, high: Any) -> Float[Array, " node"]:
    """Gaussian basis functions of a grid between `low` and `high`; beyond the ends those of the end."""
    count, out = NODES[values.shape[0]], jnp.ones(1, values.dtype)
    for i in range(values.shape[0]):
        away = jnp.clip(values[i], low[i], high[i]) - jnp.linspace(low[i], high[i], count)
        bells = jnp.exp(-0.5 * (away * (count - 1) / (high[i] - low[i])) ** 2)
        out = (out[:, None] * bells[None]).ravel()
    return out


@jax.custom_jvp
def _function(weights: Float[Array, " node"], values: Float[Array, " axis"], low: Any, high: Any) -> Scalar:
    return weights @ _grid(values, low, high)


@_function.defjvp
def _function_jvp(at, moved):
    """Its slopes by the signals serve all directions, of which a free function has one for each weight."""
    (weights, *place), nodes = at, _grid(*at[1:])
    return weights @ nodes, moved[0] @ nodes + weights @ jax.jacfwd(_grid)(*place) @ moved[1]


class FreeFlow(AbstractEffect):
    """A free function of the signals that `pick` takes of states and inputs, at the port `at`; one program for all."""

    meaning: ClassVar[str] = "A flow as a function of some signals."
    named: ClassVar[bool] = False
    confirm: ClassVar[str] = "Change one signal of it at a time."
    weights: Float[Array, " node"]
    basis: Any = known()
    low: Any = known()
    high: Any = known()
    pick: Any = known()
    at: Any = known()

    def force(self, scene, memory):
        values = self.pick @ jnp.concatenate([scene.q, cast(Array, scene.u)])
        return _function(self.weights @ self.basis, values, self.low, self.high) * self.at


class UnknownTerm(SignalEffect):
    """sum_i w_i phi_i(signals) at a port, of Gaussian basis functions on a grid, free of the span of the parameters.

    phi = T psi, psi on the grid: T takes out of it what a change of the parameters does to the rate of the port along
    the logs, so that the two do not compete.
    """

    meaning: ClassVar[str] = "A rate as a function of these signals, outside the vocabulary of effects."
    named: ClassVar[bool] = False
    confirm: ClassVar[str] = "Hold all signals but one still, and move that one through its range."
    weights: Float[Array, " basis"]
    basis: Any = known()
    """T."""
    low: Any = known()
    high: Any = known()
    label: str = eqx.field(static=True, default="", kw_only=True)
    """Name in rig.toml; empty for one that a search proposes."""

    def grid(self, values: Float[Array, " axis"]) -> Float[Array, " node"]:
        """Basis functions of the grid at values of the signals; beyond the ends those of the end."""
        return _grid(values, self.low, self.high)

    def table(self, cov: Float[np.ndarray, "basis basis"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Places over the ranges of its signals (place, signal), the function there, and its standard deviation."""
        count = 2 * NODES[len(self.reads)] - 1
        axes = np.meshgrid(*np.linspace(self.low, self.high, count).T, indexing="ij")
        places = np.stack([axis.ravel() for axis in axes], axis=1)
        rows = np.asarray(jax.vmap(self.grid)(jnp.asarray(places))) @ np.asarray(self.basis).T
        return places, rows @ np.asarray(self.weights), np.sqrt(np.einsum("pi,ij,pj->p", rows, cov, rows))

    def lean(self, system):
        nodes, numbers = self.basis.shape[1], self.weights.shape[0]
        signals, fill = (*system.states, *system.inputs), [(0, nodes - numbers)]
        pick, at = np.asarray([_one_of(signals, name) for name in self.reads]), _one_of(system.ports, self.channel)
        basis = jnp.pad(jnp.asarray(self.basis), [*fill, (0, 0)])
        return FreeFlow(jnp.pad(self.weights, fill, constant_values=1.0), basis, self.low, self.high, pick, at)

    def phrase(self, sizes):
        return f"a flow into {self.channel} that depends on {' and '.join(self.reads)}"


PLACES: dict[type[AbstractEffect], tuple[type[PlantLaw | OtherLaw], str, int]] = {
    MotorGain: (PlantLaw, "inputs", 0), InputBias: (PlantLaw, "inputs", 1), DeadZone: (PlantLaw, "inputs", 2),
    Saturation: (PlantLaw, "inputs", 3), SensorScale: (PlantLaw, "sensors", 0), SensorBias: (PlantLaw, "sensors", 1),
    Bend: (PlantLaw, "sensors", 2), InputDelay: (OtherLaw, "inputs", 0), ActuatorLag: (OtherLaw, "inputs", 1),
}  # fmt: skip
"""Laws of inputs and readings: the form that each has in common with others, and its place there; a late reading has
none, as a state of some time ago costs more than all other laws."""
