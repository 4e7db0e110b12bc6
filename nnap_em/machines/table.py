"""A table of rig.toml: its values are read by kind, every mistake refused with its remedy; and TOML as text."""

import dataclasses
import difflib
import json
import math
import re
import tomllib
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NoReturn

from ..errors import RigError

HOLD, SMOOTH = "zero-order", "first-order"
"""Holds of inputs: commands stay until the next row; measured signals go on from row to row."""
_LINES = {  # of keys, then of tables: how they should look
    "format": "format = 1",
    "name": 'name = "my_rig"',
    "type": 'type = "acrobot"',
    "friction": 'friction = "unknown" (to be learned) or friction = "none"',
    "actuated_joint": "actuated_joint = 2 (or a table [input] with columns and joints)",
    "columns": 'a list of different names, columns = ["theta1", "dtheta1"]',
    "joints": "a list of different joints, one per column, joints = [1, 2]",
    "kind": 'kind = "position" (a servo that is given a position), or kind = "torque"',
    "dt": "a number above 0, dt = 0.01 (s)",
    "input_hold": f'input_hold = "{HOLD}" (a command that is held) or "{SMOOTH}" (a measured signal)',
    "clock": 'clock = "sequence" (time starts at 0 in each file) or clock = "session" (it runs on over all files)',
    **dict.fromkeys(("mean", "std"), "both numbers, { mean = 0.2, std = 0.02 }"),
    **dict.fromkeys(("import", "uncertain", "locked"), "a table"),
    "model": 'a table [model] with type = "acrobot" and its parameters',
    "input": 'a table [input] with columns = ["u"] and joints = [2]',
    "sampling": "a table [sampling] with dt, input_hold and clock",
    "measurement": 'a table [measurement] with columns = ["theta1", "dtheta1"]',
    "noise_std": "a table [measurement.noise_std] with one number above 0 per column",
    "start": "a table [start] with lines such as theta2 = { mean = 0.0, std = 0.1 }",
    "limits": "a table [limits] with lines such as u = 0.3 or theta1 = [-2.0, 2.0]",
    "rate": "a table [limits.rate] with lines such as u = 5.0 (N m/s)",
}


@dataclass(frozen=True)
class Declared:
    """A declared number: mean and standard deviation, both in its SI unit; std = 0 is trusted."""

    mean: float
    std: float

    def __str__(self) -> str:
        return f"{self.mean:.6g}" + (f" +- {self.std:.2g}" if self.std else "")


@dataclass(frozen=True)
class Table:
    """One table of the file; its readers refuse a wrong value by file, table and key."""

    path: Path
    name: str
    items: Mapping[str, Any]

    def refuse(self, key: str, problem: str | None = None, hint: str | None = None) -> NoReturn:
        """Raise RigError: the place, what was found there, and the remedy."""
        place = f"[{self.name}] {key}" if self.name else key
        raise RigError(
            f"{self.path}: {place}: {problem or f'found {self.items[key]!r}'}; {hint or f'write {_LINES[key]}'}"
        )

    def check(self, required: Collection[str], optional: Collection[str] = ()) -> None:
        """Refuse unknown keys first: a misspelt key is also a missing one, and its name is the better hint."""
        known = (*required, *optional)
        left, unknown = [key for key in known if key not in self.items], [key for key in self.items if key not in known]
        every({key: partial(self.refuse, key, "unknown table or key", nearest(key, left)) for key in unknown})
        if missing := [key for key in required if key not in self.items]:
            self._missing(*missing)

    def _missing(self, key: str, *others: str) -> NoReturn:
        hint = _LINES.get(key, f"{key} = 0.2 (trusted) or {key} = {{ mean = 0.2, std = 0.02 }}")
        problem = f"missing (found only: {', '.join(self.items) or 'nothing'})"
        self.refuse(", ".join((key, *others)), problem, f"write {hint}" + ", and so on" * bool(others))

    def value(self, key: str) -> Any:
        """Any value."""
        return self.items[key] if key in self.items else self._missing(key)

    def table(self, key: str, absent: Mapping[str, object] | None = None) -> "Table":
        """A table inside."""
        value = self.value(key) if absent is None else self.items.get(key, absent)
        if not isinstance(value, dict):
            self.refuse(key, hint=None if key in _LINES else f"write {key} = {{ mean = 0.2, std = 0.02 }}")
        return Table(self.path, f"{self.name}.{key}" if self.name else key, value)

    def each(
        self, key: str, read: "Callable[[Table, str], Any]", known: Collection[str], apart: Collection[str] = ()
    ) -> dict[str, Any]:
        """Values of a table inside, by names that are `known`; keys of it that stand `apart` are not read."""
        table = self.table(key, absent={})
        table = Table(table.path, table.name, {k: v for k, v in table.items.items() if k not in apart}).flattened()
        return every(
            {"": partial(table.check, (), known)} | {k: partial(read, table, k) for k in known if k in table.items}
        )

    def flattened(self) -> "Table":
        """The table with dotted keys joined again."""
        return dataclasses.replace(self, items=dict(flat(self.items)))

    def text(self, key: str) -> str:
        """A text that is not empty."""
        value = self.value(key)
        return value if isinstance(value, str) and value else self.refuse(key)

    def choice(self, key: str, known: Collection[str]) -> str:
        """One of some texts."""
        value = self.text(key)
        return value if value in known else self.refuse(key, hint=nearest(value, known))

    def number(self, key: str) -> float:
        """A finite number."""
        value = self.value(key)
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            self.refuse(key, hint=f"write a finite number, {key} = 0.2")
        return float(value)

    def positive(self, key: str) -> float:
        """A number above 0."""
        value = self.number(key)
        return value if value > 0 else self.refuse(key, hint=f"write a number above 0, {key} = 0.01")

    def declared(self, key: str, optional: Collection[str] = (), mean: float | None = None) -> Declared:
        """{ mean, std }; `mean` is that of a machine file, which may be left out."""
        pair = self.table(key)
        pair.check(("mean", "std") if mean is None else ("std",), ("mean", *optional))
        if pair.number("std") < 0:
            pair.refuse("std", hint="write a standard deviation of 0 (trusted) or more")
        return Declared(pair.number("mean") if "mean" in pair.items else float(mean or 0.0), pair.number("std"))

    def quantity(self, key: str, optional: Collection[str] = (), mean: float | None = None) -> Declared:
        """A number (trusted) or { mean, std }, which may have `optional` keys, too."""
        if isinstance(self.value(key), dict):
            return self.declared(key, optional, mean)
        return Declared(self.number(key), 0.0)

    def distinct(self, key: str, kind: type) -> tuple:
        """A list of different values of one type."""
        value = self.value(key)
        if not isinstance(value, list) or not all(type(x) is kind for x in value) or len(set(value)) < len(value):
            self.refuse(key)
        return tuple(value)


def every(reads: Mapping[str, Callable[[], Any]]) -> dict[str, Any]:
    """Results by name, without None; RigError with the mistakes of all, a line each."""
    out, mistakes = {}, {}
    for name, read in reads.items():
        try:
            out[name] = read()
        except RigError as error:
            mistakes[str(error)] = error
    if mistakes:
        first, *others = mistakes.values()
        raise RigError("\n".join(mistakes)) from None if others else first
    return {name: value for name, value in out.items() if value is not None}


def nearest(word: str, known: Collection[str]) -> str:
    """The remedy for a misspelt name: the known name nearest to it, then all that are possible."""
    same = [name for name in known if name.casefold() == word.strip().casefold()]
    close = same or difflib.get_close_matches(word, known, n=1, cutoff=0.5)
    question = f"did you mean {close[0]!r}? " if close else ""
    return f"{question}possible here: {', '.join(known) or 'none'}"


def flat(items: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, object]]:
    """Every key with its value; dotted keys are tables inside tables, but for a number with its uncertainty."""
    for key, value in items.items():
        if isinstance(value, dict) and value and not set(value) & {"mean", "std"}:
            yield from flat(value, f"{before}{key}.")
        else:
            yield f"{before}{key}", value


def whole_table(path: Path) -> Table:
    """The whole of a rig.toml; RigError where it is no TOML."""
    try:
        return Table(path, "", tomllib.loads(path.read_bytes().decode("utf-8-sig")))
    except OSError as error:
        raise RigError(f"{path}: cannot be read ({error.strerror}); a data set is a folder with a rig.toml") from None
    except UnicodeDecodeError as error:
        line = error.object[: error.start].count(b"\n") + 1
        raise RigError(f"{path}: line {line}: not UTF-8; save the file as plain UTF-8 text") from None
    except tomllib.TOMLDecodeError as error:
        hint = "write key = value, texts in quotation marks, no key twice"
        raise RigError(f"{path}: not TOML: {error}; {hint}") from None


def written(tables: Mapping[str, Any], before: tuple[str, ...], units: Mapping[str, str]) -> Iterator[str]:
    """Lines of tables, each key with its unit; what is None or an empty table is left out."""
    for name, table in tables.items():
        place, there = (
            (*before, name),
            {key: value for key, value in table.items() if value is not None and value != {}},
        )
        inner = {key: x for key, x in there.items() if isinstance(x, Mapping) and "mean" not in x}
        if there:
            yield from ("", f"[{'.'.join(map(toml_key, place))}]")
        for key in (key for key in there if key not in inner):
            unit = units.get(f"{name}.{key}") or units.get(key)
            yield f"{toml_key(key)} = {toml_value(there[key])}" + (f"    # {unit}" if unit else "")
        yield from written(inner, place, units)


def toml_value(value: Any) -> str:
    """A value as TOML has it, a table in one line."""
    if isinstance(value, Mapping):
        return f"{{ {', '.join(f'{toml_key(key)} = {toml_value(x)}' for key, x in value.items())} }}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(toml_value, value))}]"
    return toml_text(value) if isinstance(value, str) else repr(value)


def toml_text(text: str) -> str:
    """A text as TOML writes it."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")  # TOML escapes as JSON does, save for DEL


def toml_key(name: str) -> str:
    """A name as a key of TOML, in quotes where it has to be."""
    return name if re.fullmatch(r"[\w-]+", name, re.ASCII) else toml_text(name)
