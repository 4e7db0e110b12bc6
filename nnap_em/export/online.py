"""The observer of a fit as C99: the filter of `fit/observer.py` by square roots, and the model in scalars."""

import dataclasses
import re
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Float

from .. import __version__
from ..em.prior import ParameterPrior
from ..fit import observer as observing
from ..fit.identify import Identified
from ..model import hooks
from ..model.friction import FrictionNetwork
from ..model.state_space import Inputs, StateSpaceModel
from ..smoother.mixture import WIDE_STD
from ..storage.files import replace_text
from .c99 import WHOLE, Dialect, function
from .model import ExportError, unrolled
from .unroll import named

BRANCHES = 16
"""Gaussians at most, where an angle is not read."""
DEGREE, SEGMENTS, BEYOND = 5, 1024, 1.5
"""Polynomials of a friction table: their degree, their number at most, and the end of the table over the largest rate
of interest."""
EXACT = {False: 1e-11, True: 1e-6}
"""Largest error of a friction table over the size of the torque, in 64 and 32 bits; else the network is kept."""


class Table(NamedTuple):
    """A friction curve as polynomials on equal parts of asinh(v / knee).

    A step of the acrobot takes 6.5 us with it and 34 us with the network.
    """

    name: str
    knee: float
    end: float
    """asinh(v / knee) at the ends."""
    coefficients: Float[np.ndarray, "segment power"]

    def __call__(self, v: np.ndarray) -> np.ndarray:
        """Torque at velocities."""
        w = (np.arcsinh(v / self.knee) / self.end + 1) * (len(self.coefficients) / 2)
        segment = np.clip(np.floor(w).astype(int), 0, len(self.coefficients) - 1)
        powers = np.stack([(w - segment) ** k for k in range(DEGREE + 1)], axis=-1)
        return np.sum(self.coefficients[segment] * powers, axis=-1)

    def text(self, dialect: Dialect) -> str:
        """The table and its function in C; beyond its ends is the network."""
        count = len(self.coefficients)
        rows = ",\n".join("    {" + ", ".join(dialect.number(float(x)) for x in row) + "}" for row in self.coefficients)
        horner = f"c[{DEGREE}]"
        for k in reversed(range(DEGREE)):
            horner = f"c[{k}] + t * ({horner})"
        number = dialect.number
        return f"""static const {dialect.real} {self.name}_rows[{count}][{DEGREE + 1}] = {{
{rows}}};

static {dialect.real} {self.name}({dialect.real} v)
{{
    const {dialect.real} size = FABS(v) * {number(1 / self.knee)};
    const {dialect.real} w = LOG(size + SQRT(1 + size * size)) * {number(count / 2 / self.end)};
    const {dialect.real} at = {count // 2} + (v < 0 ? -w : w);
    if (!(at > 0 && at < {count})) {{
        {dialect.real} torque;
        {self.name}_network(&v, &torque);
        return torque;
    }}
    const int i = (int)at;
    const {dialect.real} t = at - i, *c = {self.name}_rows[i];
    return {horner};
}}
"""


def table(curve: Any, name: str, speed: float, knee: float, share: float) -> Table | None:
    """A curve as a table that errs by `share` of its size at most, if one does."""
    end = float(np.arcsinh(BEYOND * speed / knee))
    unit = 0.5 - 0.5 * np.cos(np.pi * (np.arange(DEGREE + 1) + 0.5) / (DEGREE + 1))  # Chebyshev's nodes
    checks = np.linspace(0.0, 1.0, 13)

    def values(at: np.ndarray, count: int) -> np.ndarray:
        w = (np.arange(count)[:, None] + at[None]) * (2 / count) - 1
        return np.asarray(curve(jnp.asarray(knee * np.sinh(end * w)).ravel())).reshape(w.shape)

    count = 32
    while count <= SEGMENTS:
        coefficients = np.linalg.solve(np.vander(unit, increasing=True), values(unit, count).T).T
        truth = values(checks, count)
        error = np.max(np.abs(coefficients @ np.vander(checks, DEGREE + 1, increasing=True).T - truth))
        if error <= share * np.max(np.abs(truth)):
            return Table(name, knee, end, coefficients)
        count *= 2
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
    replace_text(out.with_suffix(".h"), header)
    replace_text(out, source)


class Numbers(NamedTuple):
    """Numbers of an observer that a program may change: estimated ones, then both noises."""

    names: tuple[str, ...]
    values: tuple[float, ...]
    units: tuple[str, ...]


def numbers(fitted: Identified) -> Numbers:
    """Estimated numbers of the machine, standard deviations of the readings, and those of the kicks of a row."""
    model, system = fitted.model, fitted.model.system
    own = _estimated(fitted)
    states = system.coordinates + system.rates
    kicks = states + tuple(f"memory{i + 1}" for i in range(model.log_q.shape[0] - len(states)))
    values = [*(float(own.read(model)[i]) for i in range(own.size))]
    values += [float(x) for x in np.exp(0.5 * np.concatenate([model.log_r, model.log_q]))]
    names = (*own.names, *(f"noise.{name}" for name in fitted.rig.measured), *(f"kick.{name}" for name in kicks))
    units = [fitted.rig.unit(name) for name in own.names] + [system.unit(name) for name in fitted.rig.measured]
    return Numbers(names, tuple(values), (*units, *map(system.unit, states), *("" for _ in kicks[len(states) :])))


def _estimated(fitted: Identified) -> ParameterPrior:
    """Estimated numbers of the machine itself, in their own units."""
    servos = {servo.column for servo in fitted.model.servos or ()}
    names = tuple(n for n in fitted.m_step.prior.declared if n.rpartition(".")[0] not in servos)
    names = tuple(n for n in names if np.ndim(fitted.model.parameter(n)) == 0)
    return ParameterPrior(names, jnp.zeros(len(names)), jnp.ones(len(names)))


def observer_c(fitted: Identified, stem: str, *, single: bool = False) -> tuple[str, str]:
    """Source and header of the observer of a fit."""
    name = re.sub(r"\W", "_", stem)
    name = f"model_{name}" if name[:1].isdigit() else name
    dialect = Dialect("real", "static void", single)
    with jax.enable_x64(not single):
        model, prior = jax.tree.map(_cast, (fitted.model, _estimated(fitted)))
        functions, memory = _functions(model, prior, dialect)
    return _source(fitted, name, dialect, functions, memory), _header(fitted, name, dialect, memory)


def _cast(a: Any) -> Any:
    return a.astype(jnp.result_type(float)) if isinstance(a, jax.Array) and a.dtype.kind == "f" else a


def _functions(model: StateSpaceModel, prior: ParameterPrior, dialect: Dialect) -> tuple[list[str], int]:
    """Friction tables, rate, reading and commands in C, and the size of the memory of the commands."""
    system, share = model.system, EXACT[dialect.single]
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
                texts += [function(unrolled(f"{found.name}_network", one, v=jnp.ones(1)), dialect), found.text(dialect)]

    def unknown(v):
        torque = network(v)
        return jnp.stack(
            [named(tables[j].name, lambda x, j=j: tables[j](x), v[j]) if j in tables else torque[j] for j in range(dof)]
        )

    def inputs(row) -> Inputs:
        u, before, time, age = row[:drives], row[drives : 2 * drives], row[2 * drives], row[2 * drives + 1]
        return Inputs(u, before, time, age, row[2 * drives + 2 :] if scales else None)

    def rate(x, row, p, friction=unknown):
        written = dataclasses.replace(prior.write(model, p[: prior.size]), unknown=friction)
        return (written.rate(x, inputs(row), jnp.zeros(dof, x.dtype)),)

    def reading(x, row, p):
        read = prior.write(model, p[: prior.size]).emission
        return read(x, inputs(row)), jax.jacfwd(read)(x, inputs(row))

    try:
        stream = hooks.command_stream(model.effects, model.servos, system, model.dt)
    except ValueError as error:
        raise ExportError(str(error)) from None
    flat, unravel = ravel_pytree(stream.memory)

    def commands(memory, u, first, p):
        after, fed = stream.step(unravel(memory), u, first[0] > 0.5)
        return ravel_pytree(after)[0], fed

    size = prior.size + len(model.measured) + model.log_q.shape[0]
    row, p = jnp.zeros(2 * drives + 2 + scales), jnp.concatenate([prior.read(model), jnp.ones(size - prior.size)])
    spaces = {found.name: found for found in tables.values()}
    x = jnp.asarray(model.start.mean)
    true = lambda x, row, p: rate(x, row, p, network)  # noqa: E731
    sources = [
        unrolled("rate", rate, true, spaces, x=x, row=row, p=p),
        unrolled("reading", reading, x=x, row=row, p=p),
        unrolled("commands", commands, memory=flat, u=jnp.zeros(drives + scales), first=jnp.ones(1), p=p),
    ]
    return [*texts, *(function(source, dialect) for source in sources)], flat.size


def _source(fitted: Identified, name: str, dialect: Dialect, functions: list[str], memory: int) -> str:
    """The C file: numbers, the functions of the model, the filter."""
    model, drives, angles = fitted.model, len(fitted.model.system.joints), fitted.bank.angles
    own, again, dof = numbers(fitted), observing.restart_prior(model), len(model.system.coordinates)
    n, m, scales = model.log_q.shape[0], len(fitted.rig.measured), len(fitted.rig.scale_columns)
    sizes = {
        "N": n, "M": m, "D": drives, "SCALES": scales, "COLUMNS": drives + scales, "MEMORY": memory,
        "PARAMETERS": len(own.names), "NOISE": len(own.names) - n - m, "PROCESS": len(own.names) - n,
        "SUBSTEPS": model.steps, "SETTLING": observing.SETTLING, "ANGLES": len(angles),
        "LONGEST_GAP": max(10, round(1 / model.dt)),
    }  # fmt: skip
    reals = {
        "GATE": observing.GATE, "FORGET": observing.FORGET, "DIVERGED": observing.DIVERGED, "TWIN": observing.TWIN,
        "FAR_AWAY": observing.LARGEST_STATE, "LOG_LEAST": np.log(observing.BRANCH_END), "WIDE": WIDE_STD,
    }  # fmt: skip
    root = lambda cov: np.linalg.cholesky(np.asarray(cov, float))  # noqa: E731
    arrays = {
        "start_mean[N]": model.start.mean, "start_root[N][N]": root(model.start.cov), "again_mean[N]": again.mean,
        "again_root[N][N]": root(again.cov), "fitted[PARAMETERS]": own.values,
    }  # fmt: skip
    calls = ("sqrt", "fabs", "exp", "log", "fmax")
    lines = [
        f"/* Observer of {_comment(fitted.rig.name)}: written by nnap_em {__version__}.  Link with -lm. */",
        f'#include "{name}.h"\n\n#include <math.h>\n',
        f"typedef {name}_real real;",
        f"enum {{ {', '.join(f'{key} = {value}' for key, value in sizes.items())} }};",
        f"#define DT {model.dt!r}",
        *(f"#define {key} ({dialect.number(float(value))})" for key, value in reals.items()),
        *(f"#define {call.upper()} {call}{'f' if dialect.single else ''}" for call in calls),
        *(f"static const real {key} = {_braces(np.asarray(value), dialect)};" for key, value in arrays.items()),
        f"static const int waits[M] = {{{', '.join(str(int(place >= 2 * dof)) for place in model.measured)}}};",
        f"#define BRANCHES {_branches(fitted)}",
        *([f"static const int angles[ANGLES] = {{{', '.join(map(str, angles))}}};"] if angles else []),
    ]
    template = Path(__file__).with_name("observer.c").read_text(encoding="utf-8").replace("nnap_", f"{name}_")
    return "\n".join([*lines, "", WHOLE, *functions, template])


def _header(fitted: Identified, name: str, dialect: Dialect, memory: int) -> str:
    """Declarations of the C file, with the meaning of every number."""
    rig, system, own = fitted.rig, fitted.model.system, numbers(fitted)
    names = system.coordinates + system.rates
    states = ", ".join(f"{x} [{system.unit(x)}]" for x in names)
    extra = fitted.model.log_q.shape[0] - len(names)
    columns = (*rig.input_columns, *rig.scale_columns)
    real, upper = "float" if dialect.single else "double", name.upper()
    sizes = {
        "STATES": len(names) + extra, "READINGS": len(rig.measured), "INPUTS": len(columns),
        "PARAMETERS": len(own.names), "BRANCHES": _branches(fitted),
    }  # fmt: skip
    flags = ("MISSING", "OUTLIER", "NO_INPUT", "RESTARTED", "AMBIGUOUS", "JUMP")
    members = {
        "mean": "STATES", "std": "STATES", "innovation": "READINGS", "parameter": "PARAMETERS", "u": "INPUTS",
        "late": "READINGS",
    }  # fmt: skip
    arrays = "\n".join(f"    {name}_real {key}[{upper}_{size} + !{upper}_{size}];" for key, size in members.items())
    return f"""/* Observer of {_comment(rig.name)}: written by nnap_em {__version__}.
   SI units, a row every {rig.dt:g} s.  States: {states}{f", {extra} of laws with memory" if extra else ""}.
   Inputs u, held from the row before to this one: {_comment(", ".join(columns) or "none")}.
   Readings y; NaN is none: {_comment(", ".join(rig.measured))}.
   Parameters: {_comment(", ".join(own.names))}.

   {name}_start(&s, time), then in every row flags = {name}_step(&s, time, u, y); a time that is NaN is the next row's.
   s.mean and s.std are the estimate, s.innovation the readings minus their prediction over the standard deviation,
   s.misfit the mean of their squares (1 where the model is right), s.weight the probability of this branch. */
#ifndef {upper}_H
#define {upper}_H

enum {{ {", ".join(f"{upper}_{key} = {size}" for key, size in sizes.items())} }};
/* A reading is no number; one is beyond {observing.GATE:g} standard deviations and not read; an input is no number and
   the one before holds; the estimate diverged and starts anew; several branches are left; stamps are not in a row. */
enum {{ {", ".join(f"{name}_{flag} = {1 << i}" for i, flag in enumerate(flags))} }};

typedef {real} {name}_real;
typedef struct {{
    {name}_real mean[{upper}_STATES], root[{upper}_STATES][{upper}_STATES], log_weight;
    {name}_real innovation[{upper}_READINGS];
}} {name}_branch;
typedef struct {{
{arrays}
    {name}_real misfit, weight, memory[{max(memory, 1)}], fed[{max(len(system.joints), 1)}];
    double stamp, odd, time, age;
    int rows, live;
    {name}_branch branch[{upper}_BRANCHES + 2];
}} {name}_state;

void {name}_start({name}_state *s, double time);
int {name}_step({name}_state *s, double time, const {name}_real *u, const {name}_real *y);
void {name}_covariance(const {name}_state *s, {name}_real *covariance);

#endif
"""


def _branches(fitted: Identified) -> int:
    return BRANCHES if fitted.bank.angles else 1


def _comment(text: str) -> str:
    return text.replace("*/", "* /")


def _braces(values: Any, dialect: Dialect) -> str:
    if np.ndim(values) == 0:
        return dialect.number(float(values))
    return "{" + ", ".join(_braces(value, dialect) for value in values) + "}"
