"""A small JAX function as plain NumPy source: every array unrolled to scalars, which may then be batches of any shape.

What only moves numbers about (slices, reshapes, gathers) leaves no line: JAX does it on the numbers' places.
"""

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core

_ELEMENTWISE = {  # primitive to NumPy
    "add": "{} + {}", "add_any": "{} + {}", "sub": "{} - {}", "mul": "{} * {}", "div": "{} / {}", "neg": "-{}",
    "max": "np.maximum({}, {})", "min": "np.minimum({}, {})", "pow": "{} ** {}", "atan2": "np.arctan2({}, {})",
    "rem": "np.fmod({}, {})", "square": "{0} * {0}", "rsqrt": "1.0 / np.sqrt({})", "abs": "np.abs({})",
    "logistic": "1.0 / (1.0 + np.exp(-{}))", "clamp": "np.minimum(np.maximum({1}, {0}), {2})", "sign": "np.sign({})",
    "select_n": "np.where({0}, {2}, {1})", "is_finite": "np.isfinite({})", "not": "np.logical_not({})",
    "and": "{} & {}", "or": "{} | {}", "xor": "{} ^ {}",
    "eq": "{} == {}", "ne": "{} != {}", "lt": "{} < {}", "le": "{} <= {}", "gt": "{} > {}", "ge": "{} >= {}",
    "asinh": "np.arcsinh({})", "acosh": "np.arccosh({})", "atanh": "np.arctanh({})", "asin": "np.arcsin({})",
    "acos": "np.arccos({})", "atan": "np.arctan({})", "round": "np.round({})",
} | {name: f"np.{name}({{}})" for name in (
    "sin", "cos", "tan", "sinh", "cosh", "tanh", "exp", "exp2", "expm1", "log", "log1p", "sqrt", "cbrt", "floor", "ceil"
)}  # fmt: skip
_STEERED = {"gather": (0,), "dynamic_slice": (0,), "dynamic_update_slice": (0, 1), "scatter": (0, 2)}
"""Operands that are moved, where others give the destination."""
_MOVERS = (
    *_STEERED, "broadcast_in_dim", "concatenate", "pad", "reshape", "rev", "slice", "split", "squeeze", "stack",
    "transpose", "unstack",
)  # fmt: skip
_SCATTERED = {"scatter-add": ("{} + {}", 0.0), "scatter-mul": ("{} * {}", 1.0)}
"""Their form, and the number that changes nothing."""


class UnrollError(ValueError):
    """An operation that cannot be written in plain NumPy, by the name of JAX's primitive."""


_named = core.Primitive("named")
_named.def_abstract_eval(lambda x, function, value: x)
_named.def_impl(lambda x, function, value: jnp.asarray(value(np.asarray(x)), x.dtype))


def named(function: str, value: Callable[[np.ndarray], np.ndarray], x: jax.Array) -> jax.Array:
    """A function of a scalar that is written by its name; `value` has its numbers."""
    return _named.bind(x, function=function, value=value)


class Source(NamedTuple):
    """A Python function of NumPy scalars or equal batches."""

    name: str
    sizes: dict[str, int]
    """The number of scalars in each argument."""
    lines: tuple[str, ...]
    results: tuple[tuple[str, ...], ...]
    """The expressions of each result, flat."""

    def __str__(self) -> str:
        results = ", ".join("(" + "".join(f"{x}, " for x in result) + ")" for result in self.results)
        unpack = [f"{''.join(f'{name}{i}, ' for i in range(n))}= {name}" for name, n in self.sizes.items() if n]
        body = "\n".join(f"    {line}" for line in [*unpack, *self.lines, f"return {results}"])
        return f"def {self.name}({', '.join(self.sizes)}):\n{body}\n"


class _Writer:
    """Lines so far; the same expression is written once, and constants are computed at once."""

    def __init__(self) -> None:
        self.lines: dict[str, tuple[str, tuple[Any, ...]]] = {}
        self.known: dict[Any, str] = {}

    def write(self, form: str, *values: Any) -> Any:
        """A scalar of that form: a name, or a number where all `values` are numbers."""
        if not any(isinstance(value, str) for value in values):
            with np.errstate(all="ignore"):
                # the forms are the constants above
                number = eval(form.format(*map(_text, values)), {"np": np, "inf": np.inf, "nan": np.nan})
            return number.item() if isinstance(number, np.ndarray) else number
        if (plain := _simpler(form, values)) is not None:
            return plain
        key = (form, *((type(value), repr(value)) for value in values))  # NaN is not itself, its text is
        if key not in self.known:
            self.known[key] = name = f"t{len(self.lines)}"
            self.lines[name] = (form.format(*map(_text, values)), values)
        return self.known[key]

    def needed(self, results: Sequence[Any]) -> tuple[str, ...]:
        """The lines that the results hang on."""
        alive = {value for value in results if isinstance(value, str)}
        for name in reversed(self.lines):
            if name in alive:
                alive |= {value for value in self.lines[name][1] if isinstance(value, str)}
        return tuple(f"{name} = {text}" for name, (text, _) in self.lines.items() if name in alive)


def unroll(name: str, function: Callable[..., tuple[jax.Array, ...]], **arguments: jax.Array) -> Source:
    """`function` of arrays of the shapes of `arguments`, as source of a function of their flat scalars.

    Raises UnrollError for what NumPy has no plain form of.
    """
    closed = jax.make_jaxpr(function)(*arguments.values())
    writer = _Writer()
    names = [
        np.array([f"{key}{i}" for i in range(np.size(value))], object).reshape(np.shape(value))
        for key, value in arguments.items()
    ]
    results = [np.ravel(result) for result in _run(writer, *_opened(closed), names)]
    lines = writer.needed(list(itertools.chain(*results)))
    sizes = {key: np.size(value) for key, value in arguments.items()}
    return Source(name, sizes, lines, tuple(tuple(map(_text, result)) for result in results))


def _text(value: Any) -> str:
    if isinstance(value, str):
        return value
    value = value.item() if isinstance(value, np.generic) else value
    text = {math.inf: "np.inf", -math.inf: "(-np.inf)"}.get(value) if isinstance(value, float) else None
    text = text or ("np.nan" if value != value else repr(value))
    return f"({text})" if text.startswith("-") else text


def _simpler(form: str, values: tuple[Any, ...]) -> Any:
    """x + 0, x * 1, x * 0 and their like; derivatives are full of them."""
    if len(values) != 2:
        return None
    a, b = values
    zero, one = [not isinstance(x, str) and x == 0 for x in values], [not isinstance(x, str) and x == 1 for x in values]
    if form == "{} + {}" and any(zero):
        return b if zero[0] else a
    if form == "{} - {}" and zero[1]:
        return a
    if form == "{} * {}" and any(zero):
        return 0.0
    if form == "{} * {}" and any(one):
        return b if one[0] else a
    if form == "{} / {}" and (one[1] or zero[0]):
        return a if one[1] else 0.0
    return None


def _opened(jaxpr: Any) -> tuple[core.Jaxpr, Sequence[Any]]:
    """A jaxpr and its constants."""
    return (jaxpr.jaxpr, jaxpr.consts) if isinstance(jaxpr, core.ClosedJaxpr) else (jaxpr, ())


def _run(
    writer: _Writer, jaxpr: core.Jaxpr, consts: Sequence[Any], arguments: Sequence[np.ndarray]
) -> list[np.ndarray]:
    """The results of a jaxpr on arrays of names and numbers."""
    values = dict(zip(jaxpr.constvars, map(_array, consts), strict=True))
    values |= dict(zip(jaxpr.invars, arguments, strict=True))

    def read(atom: Any) -> np.ndarray:
        return _array(atom.val) if isinstance(atom, core.Literal) else values[atom]

    for equation in jaxpr.eqns:
        outputs = _equation(writer, equation, [read(atom) for atom in equation.invars])
        values |= dict(zip(equation.outvars, outputs, strict=True))
    return [read(atom) for atom in jaxpr.outvars]


def _array(value: Any) -> np.ndarray:
    return np.asarray(value).astype(object)


def _dtype(atom: Any) -> np.dtype:
    return atom.aval.dtype


def _symbolic(value: np.ndarray) -> bool:
    return any(isinstance(x, str) for x in value.ravel())


def _equation(writer: _Writer, equation: core.JaxprEqn, operands: list[np.ndarray]) -> list[np.ndarray]:
    name, params = equation.primitive.name, equation.params
    calls = ("jaxpr", "call_jaxpr", "fun_jaxpr")
    inner = next((params[key] for key in calls if key in params), None)
    if name == "scan":
        return _scan(writer, params, operands)
    if name == "cond":
        return _cond(writer, params["branches"], operands)
    if inner is not None:
        return _run(writer, *_opened(inner), operands)
    if not any(map(_symbolic, operands)):
        return _constant(equation, operands)
    if refused := _refused(equation):
        raise UnrollError(f"JAX's {name!r} {refused} has no plain NumPy form here")
    identities = ("copy", "copy_p", "stop_gradient", "optimization_barrier", "reduce_precision")
    if name in identities:
        return operands
    if name == "convert_element_type":
        return [_each(writer, _converted(_dtype(equation.invars[0]).kind, params["new_dtype"].kind), operands)]
    if name == "integer_pow":
        return [_each(writer, f"{{}} ** {params['y']}", operands)]
    if name == "named":
        return [_each(writer, f"{params['function']}({{}})", operands)]
    if name in _ELEMENTWISE:
        return [_each(writer, _ELEMENTWISE[name], operands)]
    reductions = {"reduce_sum": "add", "reduce_max": "max", "reduce_min": "min", "reduce_prod": "mul"}
    if name in reductions:
        return [_reduce(writer, _ELEMENTWISE[reductions[name]], operands[0], params["axes"])]
    if name == "dot_general":
        return [_dot(writer, operands[0], operands[1], params["dimension_numbers"])]
    return [_scatter(writer, equation, operands)] if name in _SCATTERED else _move(equation, operands)


def _refused(equation: core.JaxprEqn) -> str | None:
    """Property of an operation that NumPy does not share."""
    name, kinds = equation.primitive.name, {_dtype(atom).kind for atom in equation.invars}
    if name in ("div", "rem", "not") and kinds & {"i", "u"}:
        return "of whole numbers"
    if name == "select_n" and len(equation.invars) > 3:
        return "of more than two cases"
    if name == "round" and equation.params["rounding_method"] != jax.lax.RoundingMethod.TO_NEAREST_EVEN:
        return "away from zero"
    return None


def _converted(old: str, new: str) -> str:
    """The form of a conversion between kinds of numbers."""
    if new == "f":
        return "{} * 1.0"
    if new == "i":
        return "np.trunc({}).astype(int)" if old == "f" else "{} * 1"
    return "{} != 0"


def _constant(equation: core.JaxprEqn, operands: list[np.ndarray]) -> list[np.ndarray]:
    """Numbers alone: JAX computes them."""
    typed = [
        jnp.asarray(x.tolist(), _dtype(atom)).reshape(x.shape)
        for x, atom in zip(operands, equation.invars, strict=True)
    ]
    outputs = equation.primitive.bind(*typed, **equation.params)
    return [_array(x) for x in (outputs if equation.primitive.multiple_results else [outputs])]


def _each(writer: _Writer, form: str, operands: list[np.ndarray]) -> np.ndarray:
    spread = np.broadcast_arrays(*operands)
    out = np.empty(spread[0].shape, object)
    for place in np.ndindex(out.shape):
        out[place] = writer.write(form, *(x[place] for x in spread))
    return out


def _reduce(writer: _Writer, form: str, operand: np.ndarray, axes: Sequence[int]) -> np.ndarray:
    for axis in sorted(axes, reverse=True):
        slices = list(np.moveaxis(operand, axis, 0))
        operand = slices[0]
        for part in slices[1:]:
            operand = _each(writer, form, [np.asarray(operand, object), np.asarray(part, object)])
    return np.asarray(operand, object)


def _dot(writer: _Writer, a: np.ndarray, b: np.ndarray, numbers: Any) -> np.ndarray:
    """Each element as one line: a sum of products."""
    (ca, cb), (ba, bb) = numbers
    fa = [i for i in range(a.ndim) if i not in (*ca, *ba)]
    fb = [i for i in range(b.ndim) if i not in (*cb, *bb)]
    batch, rows, columns = ([x.shape[i] for i in axes] for x, axes in ((a, ba), (a, fa), (b, fb)))
    left = np.transpose(a, (*ba, *fa, *ca)).reshape((*batch, math.prod(rows), -1))
    right = np.transpose(b, (*bb, *fb, *cb)).reshape((*batch, math.prod(columns), -1))
    out = np.empty((*batch, math.prod(rows), math.prod(columns)), object)
    for *at, i, j in np.ndindex(out.shape):
        pairs = list(zip(left[(*at, i)], right[(*at, j)], strict=True))
        terms = [(x, y) for x, y in pairs if not any(not isinstance(v, str) and v == 0 for v in (x, y))]
        out[(*at, i, j)] = (
            writer.write(" + ".join(["{} * {}"] * len(terms)), *itertools.chain(*terms)) if terms else 0.0
        )
    return out.reshape((*batch, *rows, *columns))


def _move(equation: core.JaxprEqn, operands: list[np.ndarray]) -> list[np.ndarray]:
    """Operations that move numbers, done by JAX on their places."""
    name = equation.primitive.name
    if name not in _MOVERS:
        raise UnrollError(f"JAX's {name!r} has no plain NumPy form here")
    moved = _STEERED.get(name, range(len(operands)))
    pool: list[Any] = []
    places = []
    for i, (operand, atom) in enumerate(zip(operands, equation.invars, strict=True)):
        if i in moved:
            places.append(jnp.asarray(len(pool) + np.arange(float(operand.size)).reshape(operand.shape)))
            pool += operand.ravel().tolist()
        elif _symbolic(operand):
            raise UnrollError(f"JAX's {name!r} moves numbers to where other numbers say")
        else:
            places.append(jnp.asarray(operand.tolist(), _dtype(atom)).reshape(operand.shape))
    indices = equation.primitive.bind(*places, **equation.params)
    values = np.array(pool, object)
    return [
        np.asarray(values[np.asarray(x, int)], object)
        for x in (indices if equation.primitive.multiple_results else [indices])
    ]


def _scatter(writer: _Writer, equation: core.JaxprEqn, operands: list[np.ndarray]) -> np.ndarray:
    """Numbers added or multiplied to an array, each at a place of its own."""
    base, where, other = operands
    form, neutral = _SCATTERED[equation.primitive.name]
    if _symbolic(where):
        raise UnrollError(f"JAX's {equation.primitive.name!r} changes numbers where other numbers say")
    first = neutral + 1
    count = jnp.arange(first, first + other.size).reshape(other.shape)
    index = jnp.asarray(where.tolist(), _dtype(equation.invars[1]))
    scattered = equation.primitive.bind(jnp.full(base.shape, neutral), index, count, **equation.params)
    places = np.asarray(scattered - neutral, int)
    if sorted(places[places > 0]) != list(range(1, other.size + 1)):
        raise UnrollError(f"JAX's {equation.primitive.name!r} changes one number several times")
    return _each(writer, form, [base, np.array([neutral, *other.ravel()], object)[places]])


def _cond(writer: _Writer, branches: Sequence[core.ClosedJaxpr], operands: list[np.ndarray]) -> list[np.ndarray]:
    """Every branch, and the results of the one that holds."""
    which, *arguments = operands
    if not _symbolic(which):
        return _run(writer, *_opened(branches[int(which.item())]), arguments)
    first, *others = (_run(writer, *_opened(branch), arguments) for branch in branches)
    for k, other in enumerate(others, 1):
        held = _each(writer, "{} == {}", [which, np.asarray(k, object)])
        first = [
            _each(writer, _ELEMENTWISE["select_n"], [np.broadcast_to(held, b.shape), a, b])
            for a, b in zip(first, other, strict=True)
        ]
    return first


def _scan(writer: _Writer, params: dict[str, Any], operands: list[np.ndarray]) -> list[np.ndarray]:
    """A loop of fixed length, pass by pass."""
    if params["length"] > 1000:  # passes of a loop
        raise UnrollError(f"a loop of {params['length']} passes")
    if "ft_in" in params:  # jax 0.11 and newer
        fixed, carry, along = map(list, params["ft_in"].update(operands).unpack())
    else:
        consts, last = params["num_consts"], params["num_consts"] + params["num_carry"]
        fixed, carry, along = operands[:consts], operands[consts:last], operands[last:]
    carried = len(carry)
    rows: list[list[np.ndarray]] = []
    order = range(params["length"])
    for k in reversed(order) if params["reverse"] else order:
        outputs = _run(writer, *_opened(params["jaxpr"]), [*fixed, *carry, *(np.asarray(x[k], object) for x in along)])
        carry = outputs[:carried]
        rows.append(outputs[carried:])
    rows = rows[::-1] if params["reverse"] else rows
    return [*carry, *(np.stack(column) for column in zip(*rows, strict=True))]
