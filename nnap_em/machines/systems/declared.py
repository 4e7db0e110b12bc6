"""Declaration in rig.toml of a plant as equations: [model], [model.unknown] and the columns of [measurement]."""

from collections.abc import Collection, Mapping
from functools import partial

from ...errors import FormulaError
from ..rig import Declaration, SystemSpec, every, nearest
from ..servo import Inputs
from ..table import Declared, Table
from .equations import Text
from .expression import FUNCTIONS, Formula, parse


def declare(root: Table, of: Text | None = None) -> Declaration:
    """The equations of the table [model], or those `of` a Python function; `root` is the whole of rig.toml."""
    model, own = root.table("model"), of or Text({}, {}, {}, {}, ())
    for key in ("states", "rates"):
        if of is None and key not in model.items:
            model.refuse(key, "missing", 'write states = { h1 = "V" } and rates = { h1 = "k * u - h1" }')
    units = model.table("units", absent={})
    units = {name: _unit(units, name) for name in units.items}
    states, inputs = _named(model, "states", own.states), _named(model, "inputs", own.inputs)
    bare = {} if any((units | states | inputs).values()) else {"time": "time units"}
    reserved = ("type", "inputs", "states", "rates", "unknown", "units", "exact", "open")
    parameters = {key: model.quantity(key) for key in model.items if key not in reserved}
    unknown = model.table("unknown", absent={})
    _distinct(model, states, inputs, parameters, unknown.items)
    terms = every({name: partial(_term, unknown, name, states, inputs) for name in unknown.items})
    named = {name: signals for name, (port, signals) in terms.items() if not port}
    known = (*states, *inputs, *parameters, *named)
    rates = {} if of is not None else _rates(model, states, known)
    readings = _readings(root.table("measurement"), states, known)
    if of is not None:
        model.check(("type", *of.parameters), ("units", "unknown", "exact", "open"))
    else:
        formulas = (*rates.values(), *readings.values())
        _used(model, formulas, {**parameters, **inputs})
        _used(unknown, formulas, named)
    inherited = {name: states[formula.text] for name, formula in readings.items() if states.get(formula.text)}
    text = Text(
        states,
        inputs,
        {name: formula.text for name, formula in rates.items()},
        {name: formula.text for name, formula in readings.items()},
        tuple(parameters),
        named,
        {name: (port, signals) for name, (port, signals) in terms.items() if port},
        {**bare, **own.units, **inherited, **units},
        own.function,
        _exact(model, states, rates, parameters, (*named, *(port for port, _ in terms.values()))),
    )
    spec = SystemSpec(tuple(states), tuple(parameters), {}, 0, sensors=tuple(readings))
    return Declaration(spec, parameters, Inputs(tuple(inputs), tuple(range(1, len(inputs) + 1))), equations=text.packed)


def _exact(
    model: Table,
    states: Collection[str],
    rates: Mapping[str, Formula],
    parameters: Mapping[str, Declared],
    unknown: Collection[str],
) -> tuple[str, ...]:
    """States in whose rate nothing can be missing: those of `exact`, and where a formula holds no estimated number, as
    y' = v and x' = v cos(psi) do; but for those of `open`, and where it is a constant. Where all numbers are trusted, a
    trusted one counts as estimated.
    """
    exact, open_ = (model.distinct(key, str) if key in model.items else () for key in ("exact", "open"))
    for key, name in [("exact", name) for name in exact] + [("open", name) for name in open_]:
        if name not in states:
            model.refuse(key, f"{name!r} is no state", nearest(name, states))
    estimated = {name for name, number in parameters.items() if number.std}
    held = [set(parameters) & set(rate.names) for rate in rates.values()]
    known = estimated if any(estimated & names for names in held) else set(parameters)
    shut = [name for name, rate in rates.items() if rate.names and not {*known, *unknown} & {name, *rate.names}]
    return tuple(name for name in dict.fromkeys((*exact, *shut)) if name not in open_)


def _named(model: Table, key: str, had: Mapping[str, str]) -> dict[str, str]:
    """Names with their units, empty where none is declared."""
    items = model.items.get(key, dict(had) or ([] if key == "inputs" else None))
    if isinstance(items, list):
        return dict.fromkeys(map(str, model.distinct(key, str)), "") if items else {}
    hint = 'write names with units, { h1 = "V" }, or names alone, ["h1"]'
    if not isinstance(items, Mapping):
        model.refuse(key, None if key in model.items else "missing", hint)
    if had:
        return dict(items)
    table = model.table(key)
    return {name: _unit(table, name) for name in table.items}


def _unit(table: Table, name: str) -> str:
    unit = table.items[name]
    if not isinstance(unit, str) or not unit:
        hint = f'write its unit, {name} = "V", or for all names alone, ["{name}"]'
        table.refuse(name, f"missing unit (found {unit!r})", hint)
    return unit


def _distinct(model: Table, *parts: Collection[str]) -> None:
    seen: set[str] = set()
    for name in (name for part in parts for name in part):
        if not name.isidentifier() or name in (*FUNCTIONS, "time"):
            model.refuse(name, f"{name!r} cannot be a name in a formula", "use letters, digits and _, but no function")
        if name in seen:
            model.refuse(name, "this name stands twice", "give states, inputs, parameters and terms names of their own")
        seen.add(name)


def _rates(model: Table, states: Collection[str], known: Collection[str]) -> dict[str, Formula]:
    rates = model.table("rates")
    for name in states:
        if name not in rates.items:
            rates.refuse(name, "a state without rate", f'write {name} = "..." , its derivative by time [1/s]')
    rates.check((), states)
    return every({name: partial(_formula, rates, name, known) for name in states})


def _formula(table: Table, key: str, known: Collection[str]) -> Formula:
    text = table.items[key]
    text = str(text) if type(text) in (int, float) else text
    if not isinstance(text, str):
        table.refuse(key, hint="write a formula in quotation marks")
    try:
        return parse(text, known)
    except FormulaError as error:
        problem, _, hint = str(error).rpartition("; ")
        return table.refuse(key, problem, hint)


def _readings(measurement: Table, states: Collection[str], known: Collection[str]) -> dict[str, Formula]:
    columns = measurement.value("columns")
    if not isinstance(columns, Mapping):
        for name in columns if isinstance(columns, list) else ():
            if name not in states:
                hint = f'{nearest(str(name), states)}; or write what it reads, columns = {{ {name} = "2 * h" }}'
                measurement.refuse("columns", f"{name!r} is no state", hint)
        return {}
    table = measurement.table("columns")
    formulas = every({name: partial(_formula, table, name, known) for name in table.items})
    for name, formula in formulas.items():
        if name in states and formula.text != name:
            table.refuse(name, "called as a state, but of another formula", "name the state or the column otherwise")
    return {name: formula for name, formula in formulas.items() if name not in states}


def _term(unknown: Table, name: str, states: Collection[str], inputs: Collection[str]) -> tuple[str, tuple[str, ...]]:
    """State that an unknown term enters, or nothing where it stands in a formula, and its signals."""
    table = unknown.table(name)
    table.check(("signals",), ("enters",))
    signals = table.distinct("signals", str)
    most = 3  # signals of an unknown term at most
    if not 1 <= len(signals) <= most:
        table.refuse("signals", hint=f"write one to {most} states or inputs")
    for signal in signals:
        if signal not in (*states, *inputs):
            table.refuse("signals", f"{signal!r} is no state or input", nearest(signal, (*states, *inputs)))
    return (table.choice("enters", states) if "enters" in table.items else ""), signals


def _used(table: Table, formulas: Collection[Formula], names: Collection[str]) -> None:
    used = {name for formula in formulas for name in formula.names}
    for name in names:
        if name not in used:
            table.refuse(name, "no equation and no reading uses it", "use it, or take it out")
