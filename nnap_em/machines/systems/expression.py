"""Formulas of rig.toml: text in, function of named numbers out; parsed, never evaluated as Python."""

import ast
from collections.abc import Callable, Collection, Mapping
from typing import Any, NamedTuple, NoReturn

import jax.numpy as jnp

from ...errors import FormulaError
from ..rig import nearest
from .plant import Scalar

Values = Mapping[str, Any]
TINY = 1e-12
"""Smallest argument of a root or logarithm: below, its value is that here, and its slope 0."""


def root(x: Any) -> Any:
    """Square root, with value and slope 0 below 0: a level that a filter takes below its floor stays finite."""
    return jnp.where(x > TINY, jnp.sqrt(jnp.maximum(x, TINY)), 0.0)


FUNCTIONS: dict[str, tuple[int, Callable[..., Any]]] = {
    "sqrt": (1, root),
    "exp": (1, jnp.exp),
    "log": (1, lambda x: jnp.log(jnp.maximum(x, TINY))),
    "abs": (1, jnp.abs),
    "sign": (1, jnp.sign),
    "min": (2, jnp.minimum),
    "max": (2, jnp.maximum),
    "sin": (1, jnp.sin),
    "cos": (1, jnp.cos),
    "tanh": (1, jnp.tanh),
    "where": (3, jnp.where),
}
"""Functions of formulas with the number of their arguments."""
_OPERATORS: dict[type, Callable[..., Any]] = {
    ast.Add: lambda a, b: a + b, ast.Sub: lambda a, b: a - b, ast.Mult: lambda a, b: a * b,
    ast.Div: lambda a, b: a / b, ast.Pow: lambda a, b: a**b, ast.USub: lambda a: -a, ast.UAdd: lambda a: a,
    ast.Lt: lambda a, b: a < b, ast.LtE: lambda a, b: a <= b, ast.Gt: lambda a, b: a > b, ast.GtE: lambda a, b: a >= b,
}  # fmt: skip


class Formula(NamedTuple):
    """A formula of named numbers."""

    text: str
    names: tuple[str, ...]
    """Names in it, in their order."""
    of: Callable[[Values], Scalar]
    """Its value."""


def parse(text: str, known: Collection[str]) -> Formula:
    """The formula of a text in `known` names: + - * / ^, comparisons in `where`, and `FUNCTIONS`."""
    try:
        tree = ast.parse(text.replace("^", "**"), mode="eval").body
    except SyntaxError as error:
        place = _mark(text, (error.offset or 1) - 1)
        raise FormulaError(f"{place}: not a formula; write such as k * sqrt(h)") from None
    names: dict[str, None] = {}

    def refuse(node: ast.AST, problem: str, hint: str) -> NoReturn:
        raise FormulaError(f"{_mark(text, getattr(node, 'col_offset', 0))}: {problem}; {hint}")

    def built(node: ast.AST) -> Callable[[Values], Any]:
        function, parts = None, []
        match node:
            case ast.Constant(value=int() | float() as value) if not isinstance(value, bool):
                number = float(value)
                return lambda values: number
            case ast.Name(id=name) if name in known:
                names[name] = None
                return lambda values: values[name]
            case ast.Name(id=name):
                refuse(node, f"unknown name {name!r}", nearest(name, known))
            case ast.UnaryOp(op=op, operand=a):
                function, parts = _OPERATORS.get(type(op)), [a]
            case ast.BinOp(op=op, left=a, right=b) | ast.Compare(left=a, ops=[op], comparators=[b]):
                function, parts = _OPERATORS.get(type(op)), [a, b]
            case ast.Call(func=ast.Name(id=name), args=parts, keywords=[]):
                count, function = FUNCTIONS.get(name, (len(parts), None))
                if function is None:
                    refuse(node, f"unknown function {name!r}", nearest(name, FUNCTIONS))
                if len(parts) != count:
                    refuse(node, f"{name} takes {count} arguments, found {len(parts)}", "correct it")
        if function is None:
            refuse(node, f"{type(node).__name__} is not part of formulas", f"use + - * / ^ and {', '.join(FUNCTIONS)}")
        inner = [built(one) for one in parts]
        return lambda values: function(*(part(values) for part in inner))

    of = built(tree)
    return Formula(text, tuple(names), of)


def _mark(text: str, column: int) -> str:
    """Place in a text, of which Python has seen every ^ as two characters."""
    seen = 0
    for place, letter in enumerate(text):
        if seen >= column:
            return f"at character {place + 1} of {text!r}"
        seen += 2 if letter == "^" else 1
    return f"at the end of {text!r}"
