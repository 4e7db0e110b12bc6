"""A small JAX function as operations on scalars, one a line: every array is unrolled.

What only moves numbers about (slices, reshapes, gathers) leaves no line: JAX does it on the numbers' places.
"""

import functools
import itertools
import math
import operator
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core

from ...errors import ExportError


class Op(NamedTuple):
    """An operation: its form in C, where ~ ends the name of a function of the mathematics library, and its numbers."""

    c: str
    value: Callable[..., Any]
    own: bool = False
    """True for a function that is written beside the lines."""


_OPS = {name: Op(*pair) for name, pair in {
    "add": ("{} + {}", np.add), "sub": ("{} - {}", np.subtract), "mul": ("{} * {}", np.multiply),
    "div": ("{} / {}", np.divide), "neg": ("-{}", np.negative), "pow": ("pow~({}, {})", np.power),
    "max": ("{0} > {1} ? {0} : {1}", np.maximum), "min": ("{0} < {1} ? {0} : {1}", np.minimum),
    "atan2": ("atan2~({}, {})", np.arctan2), "rem": ("fmod~({}, {})", np.fmod), "square": ("{0} * {0}", np.square),
    "rsqrt": ("1 / sqrt~({})", lambda x: 1 / np.sqrt(x)), "abs": ("fabs~({})", np.abs),
    "logistic": ("1 / (1 + exp~(-{}))", lambda x: 1 / (1 + np.exp(-x))), "round": ("rint~({})", np.round),
    "sign": ("({0} > 0) - ({0} < 0)", np.sign), "is_finite": ("isfinite({}) != 0", np.isfinite),
    "select_n": ("{0} ? {2} : {1}", lambda which, other, one: np.where(which, one, other)),
    "not": ("!{}", np.logical_not), "and": ("{} & {}", np.bitwise_and), "or": ("{} | {}", np.bitwise_or),
    "xor": ("{} ^ {}", np.bitwise_xor), "eq": ("{} == {}", np.equal), "ne": ("{} != {}", np.not_equal),
    "lt": ("{} < {}", np.less), "le": ("{} <= {}", np.less_equal), "gt": ("{} > {}", np.greater),
    "ge": ("{} >= {}", np.greater_equal), "real": ("{}", lambda x: x * 1.0),
    "whole": ("whole({})", lambda x: np.trunc(x).astype(int)),
}.items()} | {name: Op(f"{name}~({{}})", getattr(np, name)) for name in (
    "sin", "cos", "tan", "sinh", "cosh", "tanh", "exp", "exp2", "expm1", "log", "log1p", "sqrt", "cbrt", "floor",
    "ceil", "asinh", "acosh", "atanh", "asin", "acos", "atan",
)}  # fmt: skip
_REDUCTIONS = {"reduce_sum": "add", "reduce_max": "max", "reduce_min": "min", "reduce_prod": "mul"}
_STEERED = {"gather": (0,), "dynamic_slice": (0,), "dynamic_update_slice": (0, 1), "scatter": (0, 2)}
"""Operands that are moved, where others give the destination."""
_MOVERS = (*_STEERED, "pad", "rev", "split", "transpose", "unstack")
_NAMED = core.Primitive("named")
_NAMED.def_abstract_eval(lambda x, function: x)


def named(function: str, x: jax.Array) -> jax.Array:
    """A function of a scalar that is written by its name."""
    return _NAMED.bind(x, function=function)


class Line(NamedTuple):
    """A scalar and the operation that gives it."""

    name: str
    op: Op
    values: tuple[Any, ...]
    """Names of scalars, and numbers."""
    whole: bool
    """True for a whole number or a truth value."""


class Source(NamedTuple):
    """A function of scalars, line by line."""

    name: str
    sizes: dict[str, int]
    """The number of scalars in each argument: those of q are q0, q1."""
    lines: tuple[Line, ...]
    results: tuple[Any, ...]
    """Names and numbers, flat."""


def unroll(name: str, function: Callable[..., tuple[jax.Array, ...]], **arguments: jax.Array) -> Source:
    """`function` of arrays of the shapes of `arguments`, as a function of their flat scalars.

    Raises ExportError for what has no plain form.
    """
    writer, sizes = _Writer(), {key: np.size(value) for key, value in arguments.items()}
    names = [
        np.array([f"{key}{i}" for i in range(np.size(value))], object).reshape(np.shape(value))
        for key, value in arguments.items()
    ]
    outputs = writer.run(jax.make_jaxpr(function)(*arguments.values()), names)
    results = tuple(itertools.chain(*(output.ravel().tolist() for output in outputs)))
    return Source(name, sizes, writer.needed(results), results)


class _Writer:
    """Lines so far; the same expression is written once, and constants are computed at once."""

    def __init__(self) -> None:
        self.lines: dict[Any, Line] = {}

    def needed(self, results: Sequence[Any]) -> tuple[Line, ...]:
        alive, kept = set(filter(_is_name, results)), []
        for line in reversed(self.lines.values()):
            if line.name in alive:
                alive |= set(filter(_is_name, line.values))
                kept.append(line)
        return tuple(reversed(kept))

    def write(self, op: Op, whole: bool, *values: Any) -> Any:
        """The result of an operation: a name, or a number where all `values` are numbers."""
        if not op.own and not any(map(_is_name, values)):
            with np.errstate(all="ignore"):
                return np.asarray(op.value(*values)).item()
        if (plain := _simpler(op, values)) is not None:
            return plain
        key = (op.c, *((type(value), repr(value)) for value in values))  # NaN is not itself, its text is
        return self.lines.setdefault(key, Line(f"t{len(self.lines)}", op, values, whole)).name

    def each(self, op: Op, whole: bool, *operands: Any) -> np.ndarray:
        """An operation on arrays, entry by entry."""
        every = np.frompyfunc(lambda *values: self.write(op, whole, *values), len(operands), 1)
        return np.asarray(every(*operands), object)

    def run(self, jaxpr: Any, arguments: Sequence[np.ndarray]) -> list[np.ndarray]:
        """The results of a jaxpr on arrays of names and numbers."""
        closed = isinstance(jaxpr, core.ClosedJaxpr)
        jaxpr, consts = (jaxpr.jaxpr, jaxpr.consts) if closed else (jaxpr, ())
        values = dict(zip(jaxpr.constvars, map(_array, consts), strict=True))
        values |= dict(zip(jaxpr.invars, arguments, strict=True))
        read = lambda atom: _array(atom.val) if isinstance(atom, core.Literal) else values[atom]  # noqa: E731
        for equation in jaxpr.eqns:
            outputs = [np.asarray(x, object) for x in self.equation(equation, [read(a) for a in equation.invars])]
            values |= dict(zip(equation.outvars, outputs, strict=True))
        return [read(atom) for atom in jaxpr.outvars]

    def equation(self, equation: core.JaxprEqn, operands: list[np.ndarray]) -> Sequence[Any]:
        """The results of one operation of JAX."""
        name, params, whole = equation.primitive.name, equation.params, _kind(equation.outvars[0]) != "f"
        if name == "scan":
            return self.scan(params, operands)
        if name == "cond":
            return self.cond(equation, operands)
        for inner in ("jaxpr", "call_jaxpr", "fun_jaxpr"):
            if inner in params:
                return self.run(params[inner], operands)
        if name == "named":
            return [self.each(Op(f"{params['function']}({{}})", np.positive, own=True), whole, *operands)]
        if not any(map(_symbolic, operands)):
            return _by_jax(equation, operands)
        _refuse(equation)
        if name in ("copy", "copy_p", "stop_gradient", "optimization_barrier", "reduce_precision"):
            return operands
        if name == "convert_element_type":
            return [self.converted(_kind(equation.invars[0]), params["new_dtype"].kind, operands[0])]
        if name == "integer_pow":
            return [self.power(operands[0], params["y"], whole)]
        if name == "clamp":
            low, x, high = operands
            return [self.each(_OPS["min"], whole, self.each(_OPS["max"], whole, x, low), high)]
        if name == "dot_general":
            return [self.dot(operands[0], operands[1], params["dimension_numbers"], whole)]
        if name in ("scatter-add", "scatter-mul"):
            return [self.scatter(equation, whole, *operands)]
        if name in _REDUCTIONS:
            return [self.reduced(_OPS[_REDUCTIONS[name]], whole, operands[0], params["axes"])]
        op = _OPS.get(name.removesuffix("_any"))
        return [self.each(op, whole, *operands)] if op else _moved(equation, operands)

    def converted(self, old: str, new: str, operand: np.ndarray) -> np.ndarray:
        if new == "b":
            return self.each(_OPS["ne"], True, operand, 0)
        op = {("f", "i"): "whole", ("i", "f"): "real", ("b", "f"): "real"}.get((old, new))
        return self.each(_OPS[op], new != "f", operand) if op else operand

    def power(self, x: np.ndarray, y: int, whole: bool) -> np.ndarray:
        """A whole power, small ones by products."""
        if 1 < y < 5:
            return self.reduced(_OPS["mul"], whole, np.stack([x] * y), (0,))
        return self.each(_OPS["pow"], whole, x, y)

    def reduced(self, op: Op, whole: bool, operand: np.ndarray, axes: Sequence[int]) -> np.ndarray:
        for axis in sorted(axes, reverse=True):
            joined = functools.reduce(lambda a, b: self.each(op, whole, a, b), np.moveaxis(operand, axis, 0))
            operand = np.asarray(joined, object)
        return operand

    def dot(self, a: np.ndarray, b: np.ndarray, numbers: Any, whole: bool) -> np.ndarray:
        """Each element as one line: a sum of products."""
        (ca, cb), (ba, bb) = numbers
        fa = [i for i in range(a.ndim) if i not in (*ca, *ba)]
        fb = [i for i in range(b.ndim) if i not in (*cb, *bb)]
        batch, rows, columns = ([x.shape[i] for i in axes] for x, axes in ((a, ba), (a, fa), (b, fb)))
        left = np.transpose(a, (*ba, *fa, *ca)).reshape((*batch, math.prod(rows), -1))
        right = np.transpose(b, (*bb, *fb, *cb)).reshape((*batch, math.prod(columns), -1))
        out = np.zeros((*batch, math.prod(rows), math.prod(columns)), object)
        for *at, i, j in np.ndindex(out.shape):
            pairs = zip(left[(*at, i)], right[(*at, j)], strict=True)
            factors = [x for pair in pairs if not any(map(_is_zero, pair)) for x in pair]
            op = Op(" + ".join(["{} * {}"] * (len(factors) // 2)), lambda *x: sum(map(operator.mul, x[::2], x[1::2])))
            out[(*at, i, j)] = self.write(op, whole, *factors) if factors else 0.0
        return out.reshape((*batch, *rows, *columns))

    def scatter(
        self, equation: core.JaxprEqn, whole: bool, base: np.ndarray, where: np.ndarray, other: np.ndarray
    ) -> np.ndarray:
        """Numbers added or multiplied to an array, each at a place of its own."""
        name = equation.primitive.name
        neutral = float(name == "scatter-mul")
        if _symbolic(where):
            raise ExportError(f"JAX's {name!r} changes numbers where other numbers say")
        places = neutral + 1 + jnp.arange(float(other.size)).reshape(other.shape)
        scattered = equation.primitive.bind(
            jnp.full(base.shape, neutral), _typed(where, equation.invars[1]), places, **equation.params
        )
        places = np.asarray(scattered - neutral, int)
        if sorted(places[places > 0]) != list(range(1, other.size + 1)):
            raise ExportError(f"JAX's {name!r} changes one number several times")
        others = np.array([neutral, *other.ravel()], object)[places]
        return self.each(_OPS[name.removeprefix("scatter-")], whole, base, others)

    def cond(self, equation: core.JaxprEqn, operands: list[np.ndarray]) -> list[np.ndarray]:
        """Every branch, and the results of the one that holds."""
        branches, (which, *arguments) = equation.params["branches"], operands
        if not _symbolic(which):
            return self.run(branches[int(which.item())], arguments)
        first, *others = (self.run(branch, arguments) for branch in branches)
        for k, other in enumerate(others, 1):
            held = self.each(_OPS["eq"], True, which, k)
            results = zip(equation.outvars, first, other, strict=True)
            first = [self.each(_OPS["select_n"], _kind(atom) != "f", held, a, b) for atom, a, b in results]
        return first

    def scan(self, params: dict[str, Any], operands: list[np.ndarray]) -> list[np.ndarray]:
        """A loop of fixed length, pass by pass."""
        if params["length"] > 1000:  # passes of a loop
            raise ExportError(f"a loop of {params['length']} passes")
        consts, last = params["num_consts"], params["num_consts"] + params["num_carry"]
        fixed, carry, along = operands[:consts], operands[consts:last], operands[last:]
        rows: list[list[np.ndarray]] = []
        for k in range(params["length"])[:: -1 if params["reverse"] else 1]:
            outputs = self.run(params["jaxpr"], [*fixed, *carry, *(np.asarray(x[k], object) for x in along)])
            carry, row = outputs[: len(carry)], outputs[len(carry) :]
            rows.append(row)
        rows = rows[::-1] if params["reverse"] else rows
        return [*carry, *(np.stack(column) for column in zip(*rows, strict=True))]


def _is_name(value: Any) -> bool:
    return isinstance(value, str)


def _is_zero(value: Any) -> bool:
    return not _is_name(value) and value == 0


def _simpler(op: Op, values: tuple[Any, ...]) -> Any:
    """x + 0, x * 1, x * 0 and their like; derivatives are full of them."""
    if len(values) != 2:
        return None
    (a, b), zero, one = values, [*map(_is_zero, values)], [not _is_name(x) and x == 1 for x in values]
    plain = {
        "{} + {}": ((zero[0], b), (zero[1], a)),
        "{} - {}": ((zero[1], a),),
        "{} * {}": ((any(zero), 0.0), (one[0], b), (one[1], a)),
        "{} / {}": ((one[1], a), (zero[0], 0.0)),
    }
    return next((value for holds, value in plain.get(op.c, ()) if holds), None)


def _array(value: Any) -> np.ndarray:
    return np.asarray(value).astype(object)


def _kind(atom: Any) -> str:
    return atom.aval.dtype.kind


def _typed(value: np.ndarray, atom: Any) -> jax.Array:
    return jnp.asarray(value.tolist(), atom.aval.dtype).reshape(value.shape)


def _symbolic(value: np.ndarray) -> bool:
    return any(map(_is_name, value.ravel()))


def _refuse(equation: core.JaxprEqn) -> None:
    """Raise ExportError for an operation of which C has not the same one."""
    name, whole = equation.primitive.name, any(_kind(atom) in "iu" for atom in equation.invars)
    even = equation.params.get("rounding_method") == jax.lax.RoundingMethod.TO_NEAREST_EVEN
    for refused, reason in (
        (name in ("div", "rem", "not") and whole, "of whole numbers"),
        (name == "select_n" and len(equation.invars) > 3, "of more than two cases"),
        (name == "round" and not even, "away from zero"),
    ):
        if refused:
            raise ExportError(f"JAX's {name!r} {reason} has no plain C form here")


def _by_jax(equation: core.JaxprEqn, operands: list[np.ndarray]) -> list[np.ndarray]:
    outputs = equation.primitive.bind(*map(_typed, operands, equation.invars), **equation.params)
    return [_array(x) for x in (outputs if equation.primitive.multiple_results else [outputs])]


def _moved(equation: core.JaxprEqn, operands: list[np.ndarray]) -> list[np.ndarray]:
    """Operations that move numbers: the commonest by NumPy, others by JAX on their places."""
    name, params, first = equation.primitive.name, equation.params, operands[0]
    shape = np.shape(equation.outvars[0].aval)  # type: ignore[arg-type]
    if name in ("reshape", "squeeze"):
        return [first.reshape(shape)]
    if name == "broadcast_in_dim":
        axes = params["broadcast_dimensions"]
        return [np.broadcast_to(np.expand_dims(first, [i for i in range(len(shape)) if i not in axes]), shape)]
    if name == "concatenate":
        return [np.concatenate(operands, params["dimension"])]
    if name == "stack":
        return [np.stack(operands, params["axis"])]
    if name == "slice":
        strides = params["strides"] or [1] * first.ndim
        return [first[tuple(map(slice, params["start_indices"], params["limit_indices"], strides))]]
    if name not in _MOVERS:
        raise ExportError(f"JAX's {name!r} has no plain C form here")
    moved = _STEERED.get(name, range(len(operands)))
    pool: list[Any] = []
    places = []
    for i, (operand, atom) in enumerate(zip(operands, equation.invars, strict=True)):
        if i in moved:
            places.append(jnp.asarray(len(pool) + np.arange(float(operand.size)).reshape(operand.shape)))
            pool += operand.ravel().tolist()
        elif _symbolic(operand):
            raise ExportError(f"JAX's {name!r} moves numbers to where other numbers say")
        else:
            places.append(_typed(operand, atom))
    indices = equation.primitive.bind(*places, **equation.params)
    values = np.array(pool, object)
    return [values[np.asarray(x, int)] for x in (indices if equation.primitive.multiple_results else [indices])]
