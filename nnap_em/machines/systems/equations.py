"""A plant that is written as equations: formulas of rig.toml, or a Python function of states, inputs and parameters."""

import functools
import json
from collections.abc import Callable, Mapping
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..units import quantities
from .expression import Formula, parse
from .plant import AbstractPlant, Scalar


class Text(NamedTuple):
    """Equations as they are declared; `packed` is the same in one line."""

    states: dict[str, str]  # States and their units
    inputs: dict[str, str]
    rates: dict[str, str]  # Formula of the derivative of every state; empty where a Python function has them
    readings: dict[str, str]  # Formula of every column that is no state
    parameters: tuple[str, ...]
    terms: Mapping[str, tuple[str, ...]] = {}  # Unknown terms that stand in formulas by their names, and their signals
    enters: Mapping[str, tuple[str, tuple[str, ...]]] = {}
    """Unknown terms that are added to the rate of a state: the state, and their signals."""
    units: Mapping[str, str] = {}  # Units of parameters and readings, as far as they are declared
    function: str = ""  # Name of the Python function
    exact: tuple[str, ...] = ()  # States whose rate lacks nothing: definitions, as of a velocity

    @property
    def packed(self) -> str:
        """All of it as JSON."""
        return json.dumps(self._asdict(), ensure_ascii=False)

    def unit(self, name: str) -> str:
        return {"time": "s", **self.states, **self.inputs, **self.units}.get(name, "")


@functools.cache
def unpacked(text: str) -> Text:
    """Equations as `Text.packed` writes them."""
    entries = json.loads(text)
    terms = {name: tuple(signals) for name, signals in entries["terms"].items()}
    enters = {name: (state, tuple(signals)) for name, (state, signals) in entries["enters"].items()}
    lists = {name: tuple(entries.get(name, ())) for name in ("parameters", "exact")}
    return Text(**(entries | lists | {"terms": terms, "enters": enters}))


@functools.cache
def _formulas(text: str) -> tuple[tuple[Formula, ...], tuple[Formula, ...]]:
    of = unpacked(text)
    known = (*of.states, *of.inputs, *of.parameters, *of.terms)
    rates = tuple(parse(of.rates[name], known) for name in of.states) if of.rates else ()
    return rates, tuple(parse(formula, known) for formula in of.readings.values())


Rate = Callable[[Any, Any, Any], Mapping[str, Any]]
functions: dict[str, Rate] = {}
"""Python functions `rate(x, u, p)` by the name of their plant."""


class Equations(AbstractPlant):
    """x' = f(x, u, p) + push, y = g(x, u, p); an unknown term is a port whose push stands where its name does."""

    simulated: ClassVar[bool] = True
    given: ClassVar[float] = 0.25  # Two slowest time constants determine a start
    joints: ClassVar[tuple[int, ...]] = ()

    values: dict[str, Float[Array, ""]]  # Parameters
    text: str = eqx.field(static=True)  # `Text.packed`

    @classmethod
    def declared(cls, parameters: Mapping[str, Array], joints: tuple[int, ...], text: str) -> "Equations":
        return cls(dict(parameters), text)

    @property
    def of(self) -> Text:
        """The declaration."""
        return unpacked(self.text)

    @property
    def states(self) -> tuple[str, ...]:
        return tuple(self.of.states)

    @property
    def inputs(self) -> tuple[str, ...]:
        return tuple(self.of.inputs)

    @property
    def ports(self) -> tuple[str, ...]:
        return (*self.of.states, *self.of.terms)

    @property
    def open_ports(self) -> tuple[str, ...]:
        return tuple(port for port in self.ports if port not in self.of.exact)

    @property
    def sensors(self) -> dict[str, str]:
        return {name: self.unit(name) for name in self.of.readings}

    @property
    def senses_push(self) -> bool:
        return any(set(formula.names) & set(self.of.terms) for formula in _formulas(self.text)[1])

    def parameter(self, name: str) -> Any:
        return self.values[name]

    def with_parameters(self, values: Mapping[str, Array]) -> "Equations":
        return replace(self, values={**self.values, **values})

    def __str__(self) -> str:
        numbers = {name: float(value) for name, value in self.values.items()}
        return f"Equations of {', '.join(self.states)}: {quantities(numbers, self.unit)}".rstrip(": ")

    def unit(self, name: str) -> str:
        return self.of.unit(name)

    def port_unit(self, port: int) -> str:
        name = self.ports[port - 1]
        unit = self.unit(name)
        return f"{unit or 1}/{self.unit('time')}" if name in self.of.states else unit

    @property
    def drives(self) -> list[dict[str, Any]]:
        return [{"channel": name} for name in self.of.inputs]

    def named(
        self, q: Float[Array, " dof"], u: Float[Array, " input"], push: Float[Array, " port"] | None = None
    ) -> dict[str, Scalar]:
        """All numbers of a formula by their names; unknown terms are 0 without a `push`."""
        of, count = self.of, len(self.of.states)
        terms = [jnp.zeros((), q.dtype)] * len(of.terms) if push is None else list(push[count:])
        states, inputs = ({n: a[i] for i, n in enumerate(names)} for names, a in ((of.states, q), (of.inputs, u)))
        return {**self.values, **states, **inputs, **dict(zip(of.terms, terms, strict=True))}

    def slopes(self, q, v, u, push):
        values, of = self.named(q, u, push), self.of
        if of.function:
            parts = (of.states, of.inputs, self.values)
            by_name = functions[of.function](*(SimpleNamespace(**{n: values[n] for n in part}) for part in parts))
            rates = [by_name[name] for name in of.states]
        else:
            rates = [formula.of(values) for formula in _formulas(self.text)[0]]
        return tuple(jnp.asarray(rate, q.dtype) + push[i] for i, rate in enumerate(rates))

    def sensed(self, q, v, u, push):
        values = self.named(q, u, push)
        return tuple(jnp.asarray(formula.of(values), q.dtype) for formula in _formulas(self.text)[1])

    def beside(self, parameter: str) -> set[str]:
        """States whose rates hold a parameter, and all names beside it there; none of a Python function."""
        rates = zip(self.of.states, _formulas(self.text)[0], strict=False)
        return {name for state, rate in rates if parameter in rate.names for name in (state, *rate.names)}

    def state_of(self, column: str) -> str | None:
        """The state that a column reads as it is; None where it reads something else."""
        formula = self.of.readings.get(column, column)
        return formula if formula in self.of.states else None
