"""Effects: an effect is a named law that changes force, drive, body, friction or reading, with parameters and units.

A new effect is one new file in this folder; the catalogue finds it.
"""

import dataclasses
import itertools
import re
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

Scalar = Float[Array, ""]
CHANNEL_UNIT = "unit of the channel"


class OperatingPoint(NamedTuple):
    """State of the machine at one moment, as effects get it."""

    system: Any
    q: Float[Array, " dof"]
    v: Float[Array, " rate"]
    """Coordinates and rates; of equations all states, and none."""
    drive: Float[Array, " port"]
    """Generalised force of the inputs [N m]."""
    time: Scalar
    friction: Float[Array, " port"]
    """Torque of the learned map at v [N m]."""
    map: Callable[[Float[Array, " dof"]], Float[Array, " dof"]]
    """The learned map itself."""
    u: Float[Array, " input"] | None = None
    """Inputs that reach the plant."""


KNEE = 0.02
"""Share of the largest velocity of a joint within which it turns round: the sign of dry friction is smoothed over it,
and below it a joint rests."""


class SearchScales(NamedTuple):
    """Sizes that candidates are built from, all read off the logs and the declared physics."""

    system: Any
    torque: Float[np.ndarray, " dof"]
    """Typical torque of gravity and drive [N m]."""
    speed: Float[np.ndarray, " dof"]
    """Largest velocity [rad/s]."""
    viscous: Float[np.ndarray, " dof"]
    """Slope of the learned friction map at speed [N m s/rad]."""
    low: Float[np.ndarray, " dof"]
    high: Float[np.ndarray, " dof"]
    """Smallest and largest coordinate on the smoothed paths [rad]."""
    drive: Float[np.ndarray, " input"]
    """Largest torque of every input [N m]."""
    measured: tuple[str, ...]
    reading: Float[np.ndarray, " obs"]
    """Typical size of each reading."""
    dt: float
    """Sample interval, or what counts as one where sizes are grown from it [s]."""
    duration: tuple[float, float]
    ending: float
    """First and last time on the clock, and last one of the whole recording, of which a part is looked at [s]."""
    session: bool
    """True where the clock runs on over all sequences."""
    learned: bool
    """True where a friction map is learned."""
    inputs: tuple[str, ...]
    """Column of every input."""
    sizes: Mapping[str, tuple[float, float]] = {}
    ends: Mapping[str, tuple[float, float]] = {}
    """Ranges of states and inputs, and of the readings, of equations."""
    moved: tuple[tuple[str, str, float], ...] | None = None
    """Estimated numbers of the machine with unit and size, where the question is what changed since a fit."""
    width: Float[np.ndarray, " dof"] = np.zeros(0)
    """Range in which every coordinate is for nine tenths of the time in which it moves [rad]: what a rare swing alone
    sees is no repetition. In all of its range a bump of a real arm is a cogging of 4.3 periods a turn.
    """
    dry: Float[np.ndarray, " dof"] = np.zeros(0)
    """Dry friction of the learned map: its odd part at 0.4 of the largest velocity, less the viscous one [N m]."""

    @property
    def ordered(self) -> list[tuple[str, str]]:
        """Pairs of different states that are open ports, in either order."""
        return list(itertools.permutations([name for name in self.system.open_ports if name in self.system.states], 2))

    @property
    def joints(self) -> range:
        """All joints, counted from 1."""
        return range(1, len(self.system.coordinates) + 1)

    @property
    def turning(self) -> list[int]:
        """Those whose coordinate is an angle."""
        return [j for j in self.joints if self.system.angles[j - 1]]

    @property
    def driven(self) -> list[tuple[int, float]]:
        """Joints whose input ever moves, with its largest value [N m]."""
        return [(place["joint"], size) for place, size in self.drives if "joint" in place]

    @property
    def drives(self) -> list[tuple[dict[str, Any], float]]:
        """Places of laws of inputs that ever move, with the largest value [N m]."""
        return [(place, float(size)) for place, size in zip(self.system.drives, self.drive, strict=True) if size > 0]

    def column(self, joint: int) -> str:
        """Column of the input that drives a joint; "u" where there is one input."""
        return self.inputs[self.system.joints.index(joint)] if len(self.inputs) > 1 else "u"

    def inertia(self, joint: int) -> float:
        """Inertia of everything behind a joint, with all joints at zero [kg m^2]."""
        return float(np.asarray(_still(self.system))[joint - 1])


@eqx.filter_jit
def _still(system: Any) -> Float[Array, " dof"]:
    return jnp.diagonal(system.mass(jnp.zeros(len(system.coordinates))))


class Candidate(NamedTuple):
    """An effect to be tried, without a value yet."""

    start: "AbstractEffect"
    """Strengths zero (linear), inner parameters at one place of their grid."""
    probes: tuple["AbstractEffect", ...]
    """The effect with one strength each at a typical size: the directions that the score test looks along."""
    prior_std: "AbstractEffect"
    """Prior standard deviation of every parameter."""


class Curve(NamedTuple):
    """A learned function along one signal, its mean taken away."""

    signal: str
    signal_unit: str
    joint: int
    """Joint at which it acts, counted from 1."""
    unit: str
    """Unit of the force."""
    turns: bool
    """True where the signal is an angle that goes round."""
    x: Float[np.ndarray, " node"]
    mean: Float[np.ndarray, " node"]
    std: Float[np.ndarray, " node"]
    basis: Float[np.ndarray, "node basis"] | None = None
    """Functions whose sum the curve is; None: the values as they stand."""
    of: str = "force"
    """Quantity that `mean` holds: a force, or the dry friction against the motion."""


class Stream(NamedTuple):
    """A law of the command over time as a filter: what it remembers of earlier rows, and its step."""

    memory: Float[Array, " memory"]
    """Memory before the first row."""
    step: Callable[[Float[Array, " memory"], Scalar], tuple[Float[Array, " memory"], Scalar]]
    """Function of the memory and the command of a row: the memory after it, and the command that arrives."""


class AbstractEffect(eqx.Module):
    """A law that the declared physics may lack.  Its hooks change the model.

    Array fields are its parameters, but for `known` ones.
    """

    name: ClassVar[str] = ""
    """Key of the catalogue: the name of the class in words, unless it is given."""
    reported_as: ClassVar[str] = ""
    """Key of the vocabulary where that is another: for a law that it has no name for."""
    named: ClassVar[bool] = True
    """False for a law without a form of its own."""
    meaning: ClassVar[str] = ""
    """The law in a sentence for a reader."""
    confirm: ClassVar[str] = ""
    """Measurement on the machine that confirms it."""
    units: ClassVar[dict[str, str]] = {}
    """Reported parameters and their units on a rotary joint."""
    words: ClassVar[dict[str, str]] = {}
    """Reported parameters in words."""
    units_free: ClassVar[dict[str, str]] = {}
    """Those that are others where it acts on no single joint."""
    above_zero: ClassVar[str] = ""
    """The parameter that makes no physical sense at zero or below."""
    memory: ClassVar[int] = 0
    """States of its own."""
    substeps: ClassVar[int] = 1
    """Integration steps per sample that it needs."""
    linear: ClassVar[bool] = True
    """False where a probe itself, not its multiple, is the place to start a fit from."""
    held: ClassVar[bool] = False
    """True for a force with many parameters: their sensitivity is that of a force held over the step."""
    dry: ClassVar[bool] = False
    """True for friction that the place and the direction of the motion decide, as far as the learned map does not."""
    read_off: ClassVar[bool] = False
    """True for what is seen in the numbers themselves, before any fit."""

    joint: int | None = eqx.field(static=True, default=None, kw_only=True)
    """The joint that it acts on, counted from 1; None: all, or no joint."""
    channel: str | None = eqx.field(static=True, default=None, kw_only=True)
    """The reading that it acts on ("all": every one); of equations also the port, or the input."""

    def __init_subclass__(cls):
        cls.name = vars(cls).get("name", re.sub(r"\B(?=[A-Z])", "_", cls.__name__).lower())

    @classmethod
    def key(cls) -> str:
        """Key of the vocabulary."""
        return cls.reported_as or cls.name

    @classmethod
    def of(cls, *numbers: float, **where):
        """One of these numbers, in the order of its fields."""
        return cls(*map(a, numbers), **where)

    @classmethod
    def candidates(cls, around: SearchScales) -> list[Candidate]:
        """Candidates of this kind for a machine; none where the machine cannot have it."""
        return []

    def values(self) -> dict[str, Scalar]:
        """The reported parameters under the vocabulary's names."""
        return {name: getattr(self, name) for name in self.units}

    def phrase(self, sizes: dict[str, str]) -> str:
        """Noun of a sentence with its numbers, as texts by their names; empty where the name of the law serves."""
        return ""

    def units_on(self, system: Any) -> dict[str, str]:
        """Units of the reported parameters on this machine and channel."""
        own = {name: system.unit("time") if unit == "s" else unit for name, unit in self.units.items()}
        if self.channel in system.readable:
            return {name: unit.replace(CHANNEL_UNIT, system.unit(self.channel)) for name, unit in own.items()}
        if self.joint is None:
            return own | self.units_free
        force, angle = system.force_unit(self.joint), system.unit(system.coordinates[self.joint - 1])
        return {name: unit.replace("N m", force).replace("rad", angle) for name, unit in own.items()}

    def is_physical(self) -> bool:
        """True if the fitted values are physical."""
        return not self.above_zero or float(getattr(self, self.above_zero)) > 0

    def visible(self, around: SearchScales) -> bool:
        """True if the visited range distinguishes it from simpler laws."""
        return True

    def inputs_named(self) -> tuple[str, ...]:
        """Arguments of the function, for laws without a name in the vocabulary."""
        return ()

    def inputs_free(self) -> tuple[str, ...]:
        """Those of them in which its form is free."""
        return self.inputs_named()

    def signals(self, system: Any) -> tuple[str, ...]:
        """Arguments of its force at its joint: coordinates, rates, "time", `input_of` a joint."""
        return ()

    def richer(self, around: SearchScales) -> list[Candidate]:
        """The same law with more of a form, to be tried once it is found."""
        return []

    def same_as(self, system: Any, measured: tuple[str, ...]) -> tuple[tuple, ...]:
        """Laws that are the same model on this machine, by name, joint, channel and inputs."""
        return ()

    def responds_to_feedback(self) -> bool:
        """True for a free function of an input, which under feedback correlates with any disturbance."""
        return False

    def at_drive(self, place: Mapping[str, Any], index: int) -> "AbstractEffect | None":
        """The law as it is at one drive; None where it does nothing."""
        return self if all(getattr(self, key) == value for key, value in place.items()) else None

    def at_reading(self, name: str, index: int) -> "AbstractEffect | None":
        """The law as it is for one reading; None where it does nothing."""
        return self if self.channel in (name, "all") else None

    def curve(self, cov: Float[np.ndarray, "param param"], system: Any) -> Curve | None:
        """A learned function of one signal, its parameters of covariance `cov`; None for a law given by numbers."""
        return None

    def memory_scale(self) -> Float[Array, " memory"]:
        """Typical size of its own states."""
        return jnp.ones(self.memory)

    def input(self, u: Float[Array, " time"], dt: float) -> Float[Array, " time"]:
        """Input that reaches the drive, mean over each sample: for laws with memory of the input, as delays."""
        return u

    def stream(self, dt: float) -> Stream | None:
        """`input` row by row, for use while the machine runs; None for a law that takes no time."""
        return None

    def drive(self, torque: Float[Array, "*time"]) -> Float[Array, "*time"]:
        """Torque of the drive that reaches the joint, at one moment [N m, or N]."""
        return torque

    def physics(self, system: Any, time: Scalar) -> Any:
        """The machine as it truly is."""
        return system

    def friction(self, torque: Float[Array, " port"], scene: OperatingPoint) -> Float[Array, " port"]:
        """The friction torque as it truly is."""
        return torque

    def force(self, scene: OperatingPoint, memory: Float[Array, " memory"]) -> Float[Array, " port"]:
        """Generalised force that comes on top [N m], or push at every port."""
        return jnp.zeros_like(scene.drive)

    def drift(self, scene: OperatingPoint, memory: Float[Array, " memory"]) -> Float[Array, " memory"]:
        """Time derivative of its own states."""
        return memory

    def reading(self, value: Scalar, past: Callable[[Scalar], Scalar]) -> Scalar:
        """Reading of the sensor of its channel; `past(delay)` is the value some seconds ago."""
        return value


class JointEffect(AbstractEffect):
    """A law that acts on one joint."""

    joint: int = eqx.field(static=True, kw_only=True)
    """Counted from 1."""
    arguments: ClassVar[tuple[str, ...]] = ()
    """Signals of its force: "position" and "rate" are those of its joint."""

    def signals(self, system):
        own = {"position": system.coordinates, "rate": system.rates}
        return tuple(own[name][self.joint - 1] if name in own else name for name in self.arguments)

    def repeats(self, periods: Scalar, around: SearchScales) -> bool:
        """True where most of the motion sees one and a half of so many periods a turn: what rises and falls once is a
        bump, and less a spring or a weight.
        """
        return float(periods) * float(around.width[self.joint - 1]) >= 3 * np.pi

    def own(self, values: Float[Array, " dof"]) -> Scalar:
        """Entry of an array at its joint."""
        return values[self.joint - 1]

    def at(self, scene: OperatingPoint, value: Scalar) -> Float[Array, " dof"]:
        """A generalised force at its joint alone."""
        return jnp.zeros_like(scene.v).at[self.joint - 1].set(value)


class SensorEffect(AbstractEffect):
    """A law of one reading."""

    channel: str = eqx.field(static=True, kw_only=True)
    """The reading; "all": every one."""


def input_of(joint: int | None) -> str:
    """The input of a joint, as `signals` call it."""
    return f"input {joint}"


def known(**options):
    """A field with a number that no fit moves; an array all the same, so that another number is no other program."""
    return eqx.field(converter=a, metadata={"known": True}, **options)


def fields(effect: AbstractEffect) -> tuple[str, ...]:
    """Names of the parameters, in the order of a fit."""
    free = (f.name for f in dataclasses.fields(effect) if "known" not in f.metadata)
    return tuple(name for name in free if eqx.is_array(getattr(effect, name)))


def flat(effect: AbstractEffect) -> Float[Array, " param"]:
    """All parameters as one vector, in the order of a fit."""
    return jnp.concatenate([jnp.ravel(getattr(effect, name)) for name in fields(effect)])


def one(
    make: Callable[..., AbstractEffect], none: float, probe: float, spread: float, *inner: tuple[float, float]
) -> Candidate:
    """A candidate of one strength: no effect, a small one, its prior standard deviation; `inner` as in `pair`."""
    start, small, wide = ([a(n), *(a(number[i]) for number in inner)] for i, n in ((0, none), (0, probe), (1, spread)))
    return Candidate(make(*start), (make(*small),), make(*wide))


def pair(make: Callable[..., AbstractEffect], probe: float, spread: float, *inner: tuple[float, float]) -> Candidate:
    """A candidate of two strengths, as sine and cosine, and of inner parameters: each a value and its spread."""
    at, wide = [value for value, _ in inner], [std for _, std in inner]
    probes = make(probe, 0.0, *at), make(0.0, probe, *at)
    return Candidate(make(0.0, 0.0, *at), probes, make(spread, spread, *wide))


def a(value: Any) -> Any:
    """Numbers of any shape as an array of the default precision."""
    return jnp.asarray(value, float)
