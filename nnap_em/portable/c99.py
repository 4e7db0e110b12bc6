"""Friction and feed-forward torque of a fitted model as C99, without dependencies but the mathematics library."""

import ast
import re
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp

from .. import __version__
from ..effects import AbstractEffect
from ..effects.base import Scene
from ..fit.identify import Identified
from ..model import hooks
from ..storage.files import replace_text
from .export import ExportError, unrolled
from .placement import of_command
from .unroll import Source

CALLS: dict[str, str] = {
    "maximum": "fmax({}, {})", "minimum": "fmin({}, {})", "where": "({} ? {} : {})", "arctan2": "atan2({}, {})",
    "fmod": "fmod({}, {})", "abs": "fabs({})", "sign": "(double)(({0} > 0) - ({0} < 0))", "isfinite": "isfinite({})",
    "logical_not": "!({})", "arcsinh": "asinh({})", "arccosh": "acosh({})", "arctanh": "atanh({})",
    "arcsin": "asin({})", "arccos": "acos({})", "arctan": "atan({})", "round": "rint({})",
} | {name: f"{name}({{}})" for name in (
    "sin", "cos", "tan", "sinh", "cosh", "tanh", "exp", "exp2", "expm1", "log", "log1p", "sqrt", "cbrt", "floor",
    "ceil", "trunc",
)}  # fmt: skip
"""C of NumPy's functions."""
OPERATORS: dict[type, str] = {
    ast.Add: "({} + {})", ast.Sub: "({} - {})", ast.Mult: "({} * {})", ast.Div: "({} / {})", ast.Pow: "pow({}, {})",
    ast.BitAnd: "({} & {})", ast.BitOr: "({} | {})", ast.BitXor: "({} ^ {})", ast.USub: "(-{})",
    ast.Eq: "({} == {})", ast.NotEq: "({} != {})", ast.Lt: "({} < {})", ast.LtE: "({} <= {})",
    ast.Gt: "({} > {})", ast.GtE: "({} >= {})",
}  # fmt: skip
"""C of Python's operators."""


class Torques(NamedTuple):
    """Torques of a model as JAX functions, and the laws that they leave out."""

    friction: Callable
    """Friction torque at velocities."""
    feedforward: Callable
    """Torque of the drives that gives an acceleration at q, v, a and a time on the clock of the fit."""
    without: tuple[AbstractEffect, ...]


def torques(fitted: Identified) -> Torques:
    """Friction and inverse dynamics of a fitted model.

    A law with states of its own counts as settled, and what lies between a command and its torque is left out.
    A law of the drive's torque acts on that of the machine without laws.
    """
    model = fitted.model
    without = tuple(effect for effect in model.effects if effect.memory or of_command(effect))
    laws = tuple(effect for effect in model.effects if effect not in without and effect.channel is None)

    def friction(v):
        return (model.unknown(v),)

    def feedforward(q, v, a, time):
        system = model.system
        needed = system.mass(q) @ a + system.bias(q, v) - model.unknown(v)
        scene = Scene(system, q, v, needed, time[0], model.unknown(v), model.unknown)
        return (needed - hooks.added(laws, scene, jnp.zeros(0, q.dtype), a),)

    return Torques(friction, feedforward, without)


def write_c(fitted: Identified, out: Path) -> list[str]:
    """Write friction and feed-forward torque per joint to a C99 file, and return the laws that are not in it.

    Functions are named after the file: `arm_friction(v, tau)` and `arm_feedforward(q, v, a, time, tau)` for `arm.c`.
    Raises ExportError, before anything is written, where a law has no plain C form.
    """
    system, functions = fitted.model.system, torques(fitted)
    name = re.sub(r"\W", "_", out.stem)
    name = f"model_{name}" if name[:1].isdigit() else name
    dof = len(system.coordinates)
    still = jnp.zeros(dof)
    sources = [
        unrolled(f"{name}_friction", functions.friction, v=still),
        unrolled(f"{name}_feedforward", functions.feedforward, q=still, v=still, a=still, time=jnp.zeros(1)),
    ]
    units = ", ".join(
        f"{q} [{system.unit(q)}], torque [{system.force_unit(j)}]" for j, q in enumerate(system.coordinates, 1)
    )
    left = [f"{effect.name}{f' at joint {effect.joint}' if effect.joint else ''}" for effect in functions.without]
    head = f"""/* {fitted.rig.name}: written by nnap_em {__version__}.  SI units.  Link with -lm.
   Joints: {units}.
   {name}_friction: friction torque at joint rates v.
   {name}_feedforward: torque of the drives that gives acceleration a at q, v; time is that of the fit's clock.
   Not in here: {", ".join(left) or "nothing"}. */
#include <math.h>

enum {{ {name.upper()}_JOINTS = {dof} }};
""".replace("*/\n   ", "* /\n   ")
    replace_text(out, head + "\n" + "\n".join(map(function, sources)))
    return left


def function(source: Source) -> str:
    """A C function of arrays, whose last argument is the result."""
    (results,) = source.results
    arrays = [f"const double {name}[{size}]" for name, size in source.sizes.items()]
    lines = [f"void {source.name}({', '.join(arrays)}, double tau[{len(results)}])", "{"]
    code = "\n".join((*source.lines, *results))
    for name, size in source.sizes.items():
        lines += [
            f"    const double {name}{i} = {name}[{i}];" for i in range(size) if re.search(rf"\b{name}{i}\b", code)
        ]
        lines += [f"    (void){name};"]
    whole_numbers: set[str] = set()
    for line in source.lines:
        name, _, text = line.partition(" = ")
        node = ast.parse(text, mode="eval").body
        if _whole(node, whole_numbers):
            whole_numbers.add(name)
        lines.append(f"    const {'long' if name in whole_numbers else 'double'} {name} = {_c(node)};")
    lines += [f"    tau[{i}] = {_c(ast.parse(text, mode='eval').body)};" for i, text in enumerate(results)]
    return "\n".join([*lines, "}", ""])


def _whole(node: ast.AST, names: set[str]) -> bool:
    """True for an expression of whole numbers or truth values; `names` are the variables that hold them."""
    match node:
        case ast.Constant(value=value):
            return isinstance(value, int)
        case ast.Name(id=name):
            return name in names
        case ast.Compare() | ast.Call(func=ast.Attribute(attr="astype" | "logical_not" | "isfinite")):
            return True
        case ast.BinOp(left=left, op=op, right=right):
            return not isinstance(op, ast.Div | ast.Pow) and _whole(left, names) and _whole(right, names)
        case ast.UnaryOp(operand=operand):
            return _whole(operand, names)
        case ast.Call(func=ast.Attribute(attr="where"), args=[_, first, second]):
            return _whole(first, names) and _whole(second, names)
    return False


def _c(node: ast.AST) -> str:
    """A Python expression of scalars in C.

    Raises ExportError for what has no plain C form.
    """
    match node:
        case ast.Constant(value=bool() | int() as value):
            return str(int(value))
        case ast.Constant(value=float() as value):
            return repr(value)
        case ast.Name(id=name):
            return name
        case ast.Attribute(value=ast.Name(id="np"), attr="inf" | "nan" as name):
            return {"inf": "INFINITY", "nan": "NAN"}[name]
        case ast.BinOp(left=left, op=op, right=right) if type(op) in OPERATORS:
            return OPERATORS[type(op)].format(_c(left), _c(right))
        case ast.UnaryOp(op=op, operand=operand) if type(op) in OPERATORS:
            return OPERATORS[type(op)].format(_c(operand))
        case ast.Compare(left=left, ops=[op], comparators=[right]) if type(op) in OPERATORS:
            return OPERATORS[type(op)].format(_c(left), _c(right))
        case ast.Call(func=ast.Attribute(value=ast.Name(id="np"), attr=name), args=args) if name in CALLS:
            return CALLS[name].format(*map(_c, args))
        case ast.Call(func=ast.Attribute(value=inner, attr="astype")):
            return f"(long){_c(inner)}"
    raise ExportError(f"{ast.unparse(node)!r} has no plain C form; use nnap-em export --out for NumPy")
