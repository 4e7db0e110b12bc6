"""The observer of a fit as C99: the filter of `estimate/observer.py` by square roots, and the model in scalars."""

import dataclasses
import math
import re
from pathlib import Path
from string import Template
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Float

from ... import __version__
from ...base.files import replace_own
from ...errors import ExportError
from ...estimate import observer as observing
from ...estimate.identify import Identified
from ...estimate.smoother.mixture import WIDE_STD
from ...model import hooks
from ...model.friction import FrictionNetwork
from ...model.state_space import Inputs, StateSpaceModel
from .c99 import WHOLE, Dialect, function, identifier
from .unroll import named, unroll

DEGREE = 7
"""Degree of the polynomials of a friction table."""


class Table(NamedTuple):
    """A friction curve as polynomials in s = 1 + |v| / knee, on equal parts of every octave of s, for v >= 0 and v < 0.

    The leading bits of a floating number are those of its octave and part: no logarithm finds the polynomial.
    """

    name: str
    knee: float
    bits: int
    """Halvings of an octave."""
    rows: Float[np.ndarray, "segment entry"]
    """Coefficients, and the s that they are about."""

    def text(self, dialect: Dialect) -> str:
        """The table and its function in C; beyond its ends is the network."""
        half, number = len(self.rows) // 2, dialect.number
        rows = ",\n".join("    {" + ", ".join(number(float(x)) for x in row) + "}" for row in self.rows)
        ends = f"{number(1 / self.knee)}, {number(float(2 ** (half >> self.bits)))}, {self.bits}, {half}"
        return (
            f"static const real {self.name}_rows[{2 * half}][DEGREE + 2] = {{\n{rows}}};\nTABLE({self.name}, {ends})\n"
        )


def table(curve: Any, name: str, speed: float, knee: float, share: float) -> Table | None:
    """A curve as a table that errs by `share` of its size at most, if one does."""
    unit = 0.5 - 0.5 * np.cos(np.pi * (np.arange(DEGREE + 1) + 0.5) / (DEGREE + 1))  # Chebyshev's nodes
    beyond = 6.0  # end of the table over the largest rate of interest: the first estimates in motion are that wide
    checks, octaves = np.linspace(0.0, 1.0, 13), math.ceil(math.log2(1 + beyond * speed / knee))
    for bits in range(2, 6):  # halvings of an octave
        width = np.repeat(2.0 ** (np.arange(octaves) - bits), 2**bits)
        edge = 1 + np.cumsum(width) - width

        def values(at: np.ndarray, edge=edge, width=width) -> np.ndarray:
            size = knee * (edge[:, None] + width[:, None] * at - 1)
            return np.asarray(curve(jnp.asarray(np.concatenate([size, -size])).ravel())).reshape(-1, len(at))

        coefficients, truth = np.linalg.solve(np.vander(unit, increasing=True), values(unit).T).T, values(checks)
        error = np.max(np.abs(coefficients @ np.vander(checks, DEGREE + 1, increasing=True).T - truth))
        if error <= share * np.max(np.abs(truth)):
            scaled = coefficients / np.tile(width, 2)[:, None] ** np.arange(DEGREE + 1)
            return Table(name, knee, bits, np.column_stack([scaled, np.tile(edge, 2)]))
    return None


def write_observer(fitted: Identified, out: Path | str, *, single: bool = False) -> None:
    """Write the observer of a fit as a C99 file, and its declarations beside it: `arm.c` and `arm.h`.

    Functions have the name of the file: `arm_start`, `arm_step`, `arm_covariance`.

    Args:
        fitted: the model.
        out: the file, which ends in .c.
        single: numbers of 32 bits.

    Raises:
        ExportError: a law has no plain C form; nothing is written.
    """
    out = Path(out)
    if out.suffix != ".c":
        raise ExportError(f"{out}: name a file that ends in .c; its declarations go beside it")
    source, header = observer_c(fitted, out.stem, single=single)
    replace_own({out.with_suffix(".h"): header, out: source})


def observer_c(fitted: Identified, stem: str, *, single: bool = False) -> tuple[str, str]:
    """Source and header of the observer of a fit."""
    name = identifier(stem)
    dialect = Dialect("real", "static void", single)
    with jax.enable_x64(not single):
        functions, memory = _functions(jax.tree.map(_cast, fitted.model), dialect)
    return _source(fitted, stem, dialect, functions, memory), _header(fitted, name, dialect, memory)


def _cast(a: Any) -> Any:
    return a.astype(jnp.result_type(float)) if isinstance(a, jax.Array) and a.dtype.kind == "f" else a


def _functions(model: StateSpaceModel, dialect: Dialect) -> tuple[list[str], int]:
    """Friction tables, rate, reading and commands in C, and the size of the memory of the commands."""
    # Largest error of a friction table over the size of the torque, in 64 and 32 bits; else the network is kept
    exact = {False: 1e-11, True: 1e-6}
    system, share = model.system, exact[dialect.single]
    dof, drives = len(system.coordinates), len(system.joints)
    scales = len({place for servo in model.servos or () for _, place, _ in servo.scales})
    network, tables, texts = model.unknown, {}, []
    if isinstance(network, FrictionNetwork):
        for j in range(dof):
            curve = jax.jit(jax.vmap(lambda v, j=j: network.torque(jnp.full(dof, v))[j]))
            found = table(curve, f"friction{j + 1}", float(network.speed[j]), float(network.knee[j]), share)
            if found is not None:
                tables[j] = found
                one = lambda v, j=j: (network.torque(jnp.full(dof, v[0]))[j],)  # noqa: E731
                texts += [function(unroll(f"{found.name}_network", one, v=jnp.ones(1)), dialect), found.text(dialect)]

    def unknown(v):
        torque = network(v)
        return jnp.stack([named(tables[j].name, v[j]) if j in tables else torque[j] for j in range(dof)])

    def inputs(row) -> Inputs:
        u, before, time, age = row[:drives], row[drives : 2 * drives], row[2 * drives], row[2 * drives + 1]
        change = jnp.zeros((2, drives), u.dtype) if model.smooth else None
        return Inputs(u, before, time, age, row[2 * drives + 2 :] if scales else None, change)

    def rate(x, row):
        return (dataclasses.replace(model, unknown=unknown).rate(x, inputs(row), jnp.zeros(dof, x.dtype)),)

    def reading(x, row):
        return model.emission(x, inputs(row)), jax.jacfwd(model.emission)(x, inputs(row))

    try:
        stream = hooks.command_stream(model.effects, model.servos, system, model.rows)
    except ValueError as error:
        raise ExportError(str(error)) from None
    flat, unravel = ravel_pytree(stream.memory)

    def commands(memory, u, first):
        after, fed = stream.step(unravel(memory), u, first[0] > 0.5)
        return ravel_pytree(after)[0], fed

    x, row = jnp.asarray(model.start.mean), jnp.zeros(2 * drives + 2 + scales)
    sources = [
        unroll("rate", rate, x=x, row=row),
        unroll("reading", reading, x=x, row=row),
        unroll("commands", commands, memory=flat, u=jnp.zeros(drives + scales), first=jnp.ones(1)),
    ]
    texts.append(function(sources[0], dialect, points="2 * N"))
    return [*texts, *(function(source, dialect) for source in sources[1:])], flat.size


def _source(fitted: Identified, stem: str, dialect: Dialect, functions: list[str], memory: int) -> str:
    """The C file: numbers, the functions of the model, the filter."""
    name = identifier(stem)
    model, drives, angles = fitted.model, len(fitted.model.system.joints), fitted.bank.angles
    again, dof = observing.restart_prior(model), len(model.system.coordinates)
    n, m, scales = model.log_q.shape[0], len(fitted.rig.measured), len(fitted.rig.scale_columns)
    sizes = {
        "N": n, "M": m, "D": drives, "SCALES": scales, "COLUMNS": drives + scales, "MEMORY": memory,
        "COURSE": 2 * drives + 2 + scales, "ROW": 4 * drives + 2 + scales + 1,
        "SUBSTEPS": model.steps, "SETTLING": observing.SETTLING, "ANGLES": len(angles), "DEGREE": DEGREE,
        "DIGITS": 23 if dialect.single else 52, "BIAS": 127 if dialect.single else 1023,
    }  # fmt: skip
    reals = {
        "GATE": observing.GATE, "FORGET": observing.FORGET, "DIVERGED": observing.DIVERGED, "TWIN": observing.TWIN,
        "FAR_AWAY": observing.LARGEST_STATE, "LOG_LEAST": np.log(observing.BRANCH_END), "WIDE": WIDE_STD,
    }  # fmt: skip
    root = lambda cov: np.linalg.cholesky(np.asarray(cov, float))  # noqa: E731
    arrays = {
        "start_mean[N]": model.start.mean, "start_root[N][N]": root(model.start.cov), "again_mean[N]": again.mean,
        "again_root[N][N]": root(again.cov), "noise[M]": np.exp(0.5 * np.asarray(model.log_r)),
        "kick[N]": np.exp(0.5 * np.asarray(model.log_q)),
    }  # fmt: skip
    waits = [int(place >= 2 * dof and not model.smooth) for place in model.measured]
    calls = ("sqrt", "fabs", "exp", "log", "fmax")
    lines = [
        f"/* Observer of {_comment(fitted.rig.name)}: written by nnap_em {__version__}.  Link with -lm. */",
        f'#include "{stem}.h"\n\n#include <math.h>\n#include <stdint.h>\n#include <string.h>\n',
        f"typedef {name}_real real;\ntypedef uint{32 if dialect.single else 64}_t bits;",
        f"enum {{ {', '.join(f'{key} = {value}' for key, value in sizes.items())} }};",
        f"#define DT {model.dt!r}",
        f"#define SMOOTH {int(model.smooth)}",
        *(f"#define {key} ({dialect.number(float(value))})" for key, value in reals.items()),
        *(f"#define {call.upper()} {call}{'f' if dialect.single else ''}" for call in calls),
        *(f"static const real {key} = {_braces(np.asarray(value), dialect)};" for key, value in arrays.items()),
        f"static const int waits[M] = {{{', '.join(map(str, waits))}}};",
        f"#define BRANCHES {_branches(fitted)}",
        *([f"static const int angles[ANGLES] = {{{', '.join(map(str, angles))}}};"] if angles else []),
    ]
    return "\n".join(
        [
            *lines,
            "",
            WHOLE.replace("double", dialect.real),
            _template("table.c", name),
            *functions,
            _template("observer.c", name),
        ]
    )


def _header(fitted: Identified, name: str, dialect: Dialect, memory: int) -> str:
    """Declarations of the C file, with the meaning of every number."""
    rig, system = fitted.rig, fitted.model.system
    names, columns = system.coordinates + system.rates, (*rig.input_columns, *rig.scale_columns)
    states, extra = [f"{x} [{system.unit(x)}]" for x in names], fitted.model.log_q.shape[0] - len(names)
    sizes = {
        "STATES": len(names) + extra, "READINGS": len(rig.measured), "INPUTS": len(columns),
        "BRANCHES": _branches(fitted),
    }  # fmt: skip
    words = {
        "rig": rig.name, "version": __version__, "dt": f"{rig.dt:g}", "columns": ", ".join(columns) or "none",
        "held": "signals read in this row" if fitted.model.smooth else "held from the row before to this one",
        "states": ", ".join(states) + (f", {extra} of laws with memory" if extra else ""),
        "measured": ", ".join(rig.measured), "gate": f"{observing.GATE:g}",
        "sizes": ", ".join(f"{name.upper()}_{key} = {size}" for key, size in sizes.items()), "memory": max(memory, 1),
        "real": "float" if dialect.single else "double", "drives": max(len(system.joints), 1),
    }  # fmt: skip
    return Template(_template("observer.h", name)).substitute({key: _comment(f"{x}") for key, x in words.items()})


def _template(file: str, name: str) -> str:
    text = Path(__file__).with_name(file).read_text(encoding="utf-8")
    return re.sub("nnap_(?!em)", f"{name}_", text).replace("NNAP_", f"{name.upper()}_")


def _branches(fitted: Identified) -> int:
    return observing.BRANCHES if fitted.bank.angles else 1


def _comment(text: str) -> str:
    return text.replace("*/", "* /")


def _braces(values: Any, dialect: Dialect) -> str:
    if np.ndim(values) == 0:
        return dialect.number(float(values))
    return "{" + ", ".join(_braces(value, dialect) for value in values) + "}"
