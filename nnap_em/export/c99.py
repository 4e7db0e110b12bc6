"""Friction and feed-forward torque, or equations, of a fitted model as C99, with the mathematics library alone."""

import ast
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp

from .. import __version__
from ..effects import AbstractEffect
from ..effects.base import OperatingPoint
from ..fit.identify import Identified
from ..model import hooks
from ..model.state_space import Inputs
from ..storage.files import replace_own
from .model import ExportError, described, inputs_of, states_of, unrolled
from .placement import of_command
from .unroll import Source

CALLS: dict[str, str] = {
    "maximum": "({0} > {1} ? {0} : {1})", "minimum": "({0} < {1} ? {0} : {1})", "where": "({} ? {} : {})",
    "arctan2": "atan2({}, {})", "fmod": "fmod({}, {})", "abs": "fabs({})", "sign": "(({0} > 0) - ({0} < 0))",
    "isfinite": "isfinite({})", "logical_not": "!({})", "arcsinh": "asinh({})", "arccosh": "acosh({})",
    "arctanh": "atanh({})", "arcsin": "asin({})", "arccos": "acos({})", "arctan": "atan({})", "round": "rint({})",
} | {name: f"{name}({{}})" for name in (
    "sin", "cos", "tan", "sinh", "cosh", "tanh", "exp", "exp2", "expm1", "log", "log1p", "sqrt", "cbrt", "floor",
    "ceil", "trunc",
)}  # fmt: skip
"""C of NumPy's functions."""
WHOLE = """/* The whole number that a floating one is; 0 where none is. */
static inline int whole(double x) { return (int)(x > -2000000000 && x < 2000000000 ? x : 0); }
"""
OPERATORS: dict[type, str] = {
    ast.Add: "({} + {})", ast.Sub: "({} - {})", ast.Mult: "({} * {})", ast.Div: "({} / {})", ast.Pow: "pow({}, {})",
    ast.BitAnd: "({} & {})", ast.BitOr: "({} | {})", ast.BitXor: "({} ^ {})", ast.USub: "(-{})",
    ast.Eq: "({} == {})", ast.NotEq: "({} != {})", ast.Lt: "({} < {})", ast.LtE: "({} <= {})",
    ast.Gt: "({} > {})", ast.GtE: "({} >= {})",
}  # fmt: skip
"""C of Python's operators."""


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
    """Write friction and feed-forward torque per joint to a C99 file, or rates and readings of equations.

    Functions are named after the file: `arm_friction(v, tau)` and `arm_feedforward(q, v, a, time, tau)` for `arm.c`;
    of equations `tanks_rates(x, u, rate)` and `tanks_readings(x, u, y)` for `tanks.c`.

    Args:
        fitted: the model.
        out: the file.

    Returns:
        Laws that are not in it.

    Raises:
        ExportError: a law has no plain C form; nothing is written.
    """
    out = Path(out)
    name = identifier(out.stem)
    functions, sizes, left, lines = (_equations if fitted.rig.equations else _joints)(fitted, name)
    absent = [f"{effect.name}{f' at joint {effect.joint}' if effect.joint else ''}" for effect in left]
    first, last = (
        f"{fitted.rig.name}: written by nnap_em {__version__}.",
        f"Not in here: {', '.join(absent) or 'nothing'}.",
    )
    text = "\n   ".join([f"{first}  Link with -lm.", *lines, last]).replace("*/", "* /")
    sizes = ", ".join(f"{name.upper()}_{what} = {size}" for what, size in sizes.items())
    head = f"""/* {text} */
#include <math.h>

{WHOLE}
enum {{ {sizes} }};
"""
    replace_own({out: head + "\n" + "\n".join(functions)})
    return absent


def identifier(stem: str) -> str:
    """The name of a file as one in C."""
    name = re.sub(r"\W", "_", stem)
    return f"model_{name}" if name[:1].isdigit() else name


def _joints(fitted: Identified, name: str) -> tuple[list[str], dict[str, int], Sequence[AbstractEffect], list[str]]:
    """Functions of friction and feed-forward torque, their sizes, laws that are not in them, and lines about them."""
    system, (friction, feedforward, without) = fitted.model.system, torques(fitted)
    still = jnp.zeros(len(system.coordinates))
    sources = [
        unrolled(f"{name}_friction", friction, v=still),
        unrolled(f"{name}_feedforward", feedforward, q=still, v=still, a=still, time=jnp.zeros(1)),
    ]
    units = ", ".join(
        f"{q} [{system.unit(q)}], torque [{system.force_unit(j)}]" for j, q in enumerate(system.coordinates, 1)
    )
    lines = [
        f"SI units.  Joints: {units}.",
        f"{name}_friction: friction torque at joint rates v.",
        f"{name}_feedforward: torque of the drives that gives acceleration a at q, v; time is that of the fit's clock.",
    ]
    return list(map(function, sources)), {"JOINTS": len(still)}, without, lines


def _equations(fitted: Identified, name: str) -> tuple[list[str], dict[str, int], Sequence[AbstractEffect], list[str]]:
    """The same of rates and readings of equations, at states, those of laws behind them, and inputs that reach them."""
    model, x, u = fitted.model, fitted.model.start.mean, jnp.zeros(len(fitted.rig.input_columns))
    push = jnp.zeros(len(model.system.ports))
    rates = unrolled(f"{name}_rates", lambda x, u: (model.rate(x, Inputs.held(u), push),), x=x, u=u)
    readings = unrolled(f"{name}_readings", lambda x, u: (model.emission(x, Inputs.held(u)),), x=x, u=u)
    units = {column: model.system.unit(column) for column in fitted.rig.measured}
    lines = [
        f"States x: {described({n: model.system.unit(n) for n in states_of(model)})}.",
        f"Inputs u: {described(inputs_of(fitted)) or 'none'}.  Readings y: {described(units)}.",
        f"{name}_rates: derivatives of the states by time [per second].",
        f"{name}_readings: what the sensors read, without noise.",
    ]
    code = [function(rates, out="rate"), function(readings, out="y")]
    sizes = {"STATES": len(x), "INPUTS": len(u), "READINGS": len(units)}
    return code, sizes, [effect for effect in model.effects if of_command(effect)], lines


class Dialect(NamedTuple):
    """Type of the numbers in a C function, and its words before the name."""

    real: str = "double"
    words: str = "void"
    single: bool = False
    """True for literals and functions of 32 bits."""

    def number(self, value: float) -> str:
        """A literal."""
        return repr(value) + ("f" if self.single else "")

    def call(self, form: str, arguments: list[str]) -> str:
        """A function of the mathematics library."""
        single = self.single and not form.startswith("isfinite")
        return (re.sub(r"^([a-z]+[0-9p]*)\(", r"\1f(", form) if single else form).format(*arguments)


PLAIN = Dialect()


def function(source: Source, dialect: Dialect = PLAIN, out: str = "tau", points: str = "") -> str:
    """A C function of arrays, whose last argument `out` is the result.

    With `points` of them the first argument and the result have an axis more; curves are read before the loop over it.
    """
    results, real = [text for result in source.results for text in result], dialect.real
    along, at, own = (f"[{points}]", "[l]", "restrict ") if points else ("", "", "")
    loop, inside, first = f"for (int l = 0; l < {points}; l++)", [], next(iter(source.sizes), "")
    axes = {name: f"[{size or 1}]{along if name == first else ''}" for name, size in source.sizes.items()}
    arrays = ", ".join(f"const {real} {name}{axis}" for name, axis in axes.items())
    lines = [f"{dialect.words} {source.name}({arrays}, {real} {out}[{own}{len(results) or 1}]{along})", "{"]
    code = "\n".join((*source.lines, *results))
    for name, size in source.sizes.items():
        lines += [f"    (void){name};"]
        used = (i for i in range(size) if re.search(rf"\b{name}{i}\b", code))
        inside += [f"    const {real} {name}{i} = {name}[{i}]{at if name == first else ''};" for i in used]
    whole_numbers: set[str] = set()
    for line in source.lines:
        name, _, text = line.partition(" = ")
        if points and (call := re.fullmatch(rf"(\w+)\({first}(\d+)\)", text)):
            lines += [f"    {real} {name}s{along};", f"    {loop} {name}s{at} = {call[1]}({first}[{call[2]}]{at});"]
            inside.append(f"    const {real} {name} = {name}s{at};")
            continue
        node = ast.parse(text, mode="eval").body
        if _whole(node, whole_numbers):
            whole_numbers.add(name)
        inside.append(f"    const {'int' if name in whole_numbers else real} {name} = {_c(node, dialect)};")
    final = (_c(ast.parse(text, mode="eval").body, dialect) for text in results)
    inside += [f"    {out}[{i}]{at} = {text};" for i, text in enumerate(final)]
    if points:
        inside = [f"    {loop} {{", *(f"    {line}" for line in inside), "    }"]
    return "\n".join([*lines, *inside, "}", ""])


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


def _c(node: ast.AST, dialect: Dialect) -> str:
    """A Python expression of scalars in C.

    Raises ExportError for what has no plain C form.
    """
    match node:
        case ast.Constant(value=bool() | int() as value):
            return str(int(value))
        case ast.Constant(value=float() as value):
            return dialect.number(value)
        case ast.Name(id=name):
            return name
        case ast.Attribute(value=ast.Name(id="np"), attr="inf" | "nan" as name):
            return {"inf": "INFINITY", "nan": "NAN"}[name]
        case ast.BinOp(left=ast.Name(id=name), op=ast.Pow(), right=ast.Constant(value=int(power))) if 1 < power < 5:
            return f"({' * '.join([name] * power)})"
        case ast.BinOp(left=left, op=op, right=right) if type(op) in OPERATORS:
            return OPERATORS[type(op)].format(_c(left, dialect), _c(right, dialect))
        case ast.UnaryOp(op=op, operand=operand) if type(op) in OPERATORS:
            return OPERATORS[type(op)].format(_c(operand, dialect))
        case ast.Compare(left=left, ops=[op], comparators=[right]) if type(op) in OPERATORS:
            return OPERATORS[type(op)].format(_c(left, dialect), _c(right, dialect))
        case ast.Call(func=ast.Attribute(value=ast.Name(id="np"), attr=name), args=args) if name in CALLS:
            return dialect.call(CALLS[name], [_c(a, dialect) for a in args])
        case ast.Call(func=ast.Name(id=name), args=args):
            return f"{name}({', '.join(_c(a, dialect) for a in args)})"
        case ast.Call(func=ast.Attribute(value=inner, attr="astype")):
            return f"whole({_c(inner, dialect)})".replace("(trunc(", "((").replace("(truncf(", "((")
    raise ExportError(f"{ast.unparse(node)!r} has no plain C form")
