"""Friction and feed-forward torque of a fitted model as C99, with the mathematics library alone."""

import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp

from ... import __version__
from ...base.files import replace_own
from ...estimate.identify import Identified
from ...model import hooks
from ...model.effects import AbstractEffect
from ...model.effects.base import OperatingPoint
from .placement import of_command
from .unroll import Line, Source, unroll

WHOLE = """/* The whole number that a floating one is; 0 where none is. */
static inline int whole(double x) { return (int)(x > -2000000000 && x < 2000000000 ? x : 0); }
"""


def torques(fitted: Identified) -> tuple[Callable, Callable, tuple[AbstractEffect, ...]]:
    """Friction at velocities, torque of the drives that gives an acceleration at q, v, a and a time of the fit's clock,
    and the laws that these leave out.

    A law with states of its own counts as settled, and what lies between a command and its torque is left out.
    A law of the drive's torque acts on that of the machine without laws.
    """
    model = fitted.model
    without = tuple(effect for effect in model.effects if effect.memory or of_command(effect))
    laws = tuple(effect for effect in model.effects if effect not in without and effect.channel is None)

    def feedforward(q, v, a, time):
        system = model.system
        needed = system.mass(q) @ a + system.bias(q, v) - model.unknown(v)
        scene = OperatingPoint(system, q, v, needed, time[0], model.unknown(v), model.unknown)
        return (needed - hooks.added(laws, scene, jnp.zeros(0, q.dtype), a),)

    return lambda v: (model.unknown(v),), feedforward, without


def write_c(fitted: Identified, out: Path | str) -> list[str]:
    """Write friction and feed-forward torque per joint to a C99 file.

    Functions are named after the file: `arm_friction(v, tau)` and `arm_feedforward(q, v, a, time, tau)` for `arm.c`.

    Args:
        fitted: the model, of a machine with joints.
        out: the file.

    Returns:
        Laws that are not in it.

    Raises:
        ExportError: a law has no plain C form; nothing is written.
    """
    out, system = Path(out), fitted.model.system
    name, still = identifier(out.stem), jnp.zeros(len(system.coordinates))
    friction, feedforward, left = torques(fitted)
    sources = [
        unroll(f"{name}_friction", friction, v=still),
        unroll(f"{name}_feedforward", feedforward, q=still, v=still, a=still, time=jnp.zeros(1)),
    ]
    absent = [f"{effect.name}{f' at joint {effect.joint}' if effect.joint else ''}" for effect in left]
    units = [f"{q} [{system.unit(q)}], torque [{system.force_unit(j)}]" for j, q in enumerate(system.coordinates, 1)]
    lines = [
        f"{fitted.rig.name}: written by nnap_em {__version__}.  Link with -lm.",
        f"SI units.  Joints: {', '.join(units)}.",
        f"{name}_friction: friction torque at joint rates v.",
        f"{name}_feedforward: torque of the drives that gives acceleration a at q, v; time is that of the fit's clock.",
        f"Not in here: {', '.join(absent) or 'nothing'}.",
    ]
    text, size = "\n   ".join(lines).replace("*/", "* /"), f"enum {{ {name.upper()}_JOINTS = {still.size} }};"
    head = f"/* {text} */\n#include <math.h>\n\n{WHOLE}\n{size}\n\n"
    replace_own({out: head + "\n".join(map(function, sources))})
    return absent


def identifier(stem: str) -> str:
    """The name of a file as one in C."""
    name = re.sub(r"\W", "_", stem)
    return f"model_{name}" if name[:1].isdigit() else name


class Dialect(NamedTuple):
    """Type of the numbers in a C function, and its words before the name."""

    real: str = "double"
    words: str = "void"
    single: bool = False
    """True for literals and functions of 32 bits."""

    def number(self, value: float) -> str:
        """A literal."""
        text = repr(value) + ("f" if self.single else "")
        return "NAN" if value != value else text if math.isfinite(value) else text.partition("inf")[0] + "INFINITY"

    def scalar(self, value: Any) -> str:
        """A name, or a number between brackets where it has a sign."""
        text = value if isinstance(value, str) else self.number(value) if type(value) is float else f"{int(value)}"
        return f"({text})" if text.startswith("-") else text

    def of(self, line: Line) -> str:
        """The expression of a line."""
        return line.op.c.replace("~", "f" if self.single else "").format(*map(self.scalar, line.values))


PLAIN = Dialect()


def function(source: Source, dialect: Dialect = PLAIN, points: str = "") -> str:
    """A C function of arrays, whose last argument `out` is the result.

    With `points` of them the first argument and the result have an axis more; curves are read before the loop over it.
    """
    real, first = dialect.real, next(iter(source.sizes), "")
    along, at, own = (f"[{points}]", "[l]", "restrict ") if points else ("", "", "")
    axes = {name: along if name == first else "" for name in source.sizes}
    places = {
        f"{name}{i}": f"{name}[{i}]{at if axes[name] else ''}" for name, n in source.sizes.items() for i in range(n)
    }
    arrays = ", ".join(f"const {real} {name}[{size or 1}]{axes[name]}" for name, size in source.sizes.items())
    lines = [f"{dialect.words} {source.name}({arrays}, {real} out[{own}{len(source.results) or 1}]{along})", "{"]
    lines += [f"    (void){name};" for name in source.sizes]
    used = {value for line in source.lines for value in line.values} | {*source.results}
    inside = [f"const {real} {name} = {place};" for name, place in places.items() if name in used]
    loop = f"    for (int l = 0; l < {points}; l++)"
    for line in source.lines:
        text = dialect.of(line)
        if points and line.op.own and line.values[0] in places:
            curve = line.op.c.format(places[line.values[0]])
            lines += [f"    {real} {line.name}s{along};", f"{loop} {line.name}s{at} = {curve};"]
            text = f"{line.name}s{at}"
        inside.append(f"const {'int' if line.whole else real} {line.name} = {text};")
    inside += [f"out[{i}]{at} = {dialect.scalar(value)};" for i, value in enumerate(source.results)]
    if points:
        inside = [f"{loop.strip()} {{", *(f"    {line}" for line in inside), "}"]
    return "\n".join([*lines, *(f"    {line}" for line in inside), "}", ""])
