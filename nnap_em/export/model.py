"""A fitted model for other programs: its numbers as JSON, a predictor in plain NumPy, one sample step as StableHLO."""

import json
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .. import __version__
from ..effects import AbstractEffect
from ..fit.identify import Identified, friction_table, parameter_table
from ..model.friction import FrictionNetwork
from ..model.state_space import Inputs, StateSpaceModel
from ..report.tables import write_json
from ..storage.files import replace_bytes, replace_text
from ..systems import AbstractPlant
from . import program as portable
from .placement import of_command
from .unroll import Source, UnrollError, unroll

PREDICTOR_FILE, STABLEHLO_FILE = "predictor.py", "model.stablehlo"


class ExportError(ValueError):
    """A model that has no plain NumPy form; the message names the reason."""


def write_model(fitted: Identified, out: Path | str) -> str:
    """Write parameters.json, predictor.py and model.stablehlo to a folder, each whole or not at all.

    Args:
        fitted: the model.
        out: the folder.

    Returns:
        The reason why there is no predictor.py, as for a law of the command; empty where there is one.

    Raises:
        ExportError: its inputs are commands of servos; nothing is written.

    Example:
        >>> nnap_em.export.write_model(fit, f"{folder}/plain")
        ''
    """
    out = Path(out)
    if fitted.model.servos:
        raise ExportError(
            "its inputs are commands of servos, which have no exported form yet; use nnap-em predict, --urdf or --c"
        )
    try:
        code, reason = predictor(fitted), ""
    except ExportError as error:
        code, reason = "", str(error)
    step = stablehlo(fitted.model)
    write_json(out / "parameters.json", parameters(fitted))
    replace_bytes(out / STABLEHLO_FILE, step)
    if code:
        replace_text(out / PREDICTOR_FILE, code)
    else:
        (out / PREDICTOR_FILE).unlink(missing_ok=True)  # of another fit
    return reason


def parameters(fitted: Identified) -> dict[str, Any]:
    """All numbers of the model, with units, as JSON has them."""
    rig, model = fitted.rig, fitted.model
    system, states = model.system, states_of(model)
    estimated = parameter_table(fitted)
    values = {name: (pair.mean, pair.std) for name, pair in rig.parameters.items()} | estimated
    return {
        "format": 1,
        "version": __version__,
        "rig": rig.name,
        "system": rig.system,
        "states": [{"name": n, "unit": system.unit(n)} for n in system.states],
        "inputs": [
            {"name": n, "joint": drive.get("joint"), "unit": unit}
            for (n, unit), drive in zip(inputs_of(fitted).items(), system.drives, strict=True)
        ],
        "sensors": [{"name": name, "unit": unit} for name, unit in system.sensors.items()],
        "measured": list(rig.measured),
        "dt": {"value": model.dt, "unit": "s"},
        "parameters": {
            n: {"value": v, "std": s, "unit": rig.unit(n), "estimated": n in estimated} for n, (v, s) in values.items()
        },
        "noise": {
            "measurement_std": _pairs(rig.measured, np.exp(0.5 * np.asarray(model.log_r))),
            "process_std_per_step": _pairs(states, np.exp(0.5 * np.asarray(model.log_q))),
        },
        "start": {
            "mean": _pairs(states, np.asarray(model.start.mean)),
            "std": _pairs(states, np.sqrt(np.diag(np.asarray(model.start.cov)))),
        },
        "friction": _friction(fitted) if rig.friction else None,
        "effects": [_effect(effect, system) for effect in model.effects],
    }


def stablehlo(model: StateSpaceModel) -> bytes:
    """(state, input) to (state one sample later, reading) for any number of rows, for `jax.export.deserialize`.

    With effects the input has the columns of `_row`.
    """

    def one(x: Float[Array, " state"], u: Float[Array, " input"]):
        return model.transition(x, _row(model, u)), model.emission(x, _row(model, u))

    step = jax.vmap(one)

    (rows,) = jax.export.symbolic_shape("rows")
    shapes = [jax.ShapeDtypeStruct((rows, n), model.log_q.dtype) for n in (len(states_of(model)), _width(model))]
    return bytes(jax.export.export(jax.jit(step), platforms=("cpu", "cuda"))(*shapes).serialize())


def predictor(fitted: Identified) -> str:
    """Source of a program that smooths and predicts as `nnap_em.predict` does, with NumPy alone.

    It smooths by cubature, whatever the smoother of the fit.

    Raises ExportError where the model has an effect that NumPy cannot follow.
    """
    rig, model, prior = fitted.rig, fitted.model, fitted.m_step.prior
    for effect in model.effects:
        if of_command(effect):
            raise ExportError(
                f"{effect.name!r} acts on the command; use {STABLEHLO_FILE}, whose inputs are what reaches the joints"
            )
    x, u, z = jnp.zeros(len(states_of(model))), jnp.zeros(_width(model)), prior.read(model)
    force = jnp.zeros(len(model.system.coordinates))

    def rate(x, u, force, z):
        return (prior.write(model, z).rate(x, _row(model, u), model.system.at_ports(force)),)

    def reading(x, u, z):
        read = prior.write(model, z).emission
        return read(x, _row(model, u)), jax.jacfwd(read)(x, _row(model, u))

    def shown(x, u, force, z):
        show, push = prior.write(model, z).shown, model.system.at_ports(force)
        return show(x, _row(model, u), push), jax.jacfwd(show)(x, _row(model, u), push)

    functions = [
        unrolled("rate", rate, x=x, u=u, force=force, z=z),
        unrolled("reading", reading, x=x, u=u, z=z),
        unrolled("shown", shown, x=x, u=u, force=force, z=z),
    ]
    weights, bank = fitted.m_step.weights(model), fitted.bank.padded(len(states_of(model)))
    numbers = {
        "states": states_of(model),
        "measured": rig.measured,
        "inputs": rig.input_columns,
        "sensors": tuple(model.system.sensors),
        "dt": model.dt,
        "substeps": model.steps,
        "dressed": bool(model.effects),
        "log_q": model.log_q,
        "log_r": model.log_r,
        "mean": model.start.mean,
        "cov": model.start.cov,
        "offsets": bank.offsets,
        "shrink": bank.shrink,
        "nodes": weights.nodes,
        "spread": _spread(fitted),
        "parameters": z,
        "nominal": model.system.simulated,
    }
    fields = "\n".join(f"    {name}={literal(value)}," for name, value in numbers.items())
    body = Path(portable.__file__).read_text(encoding="utf-8").partition('"""\n')[2]
    title = f'"""Predictor of {json.dumps(rig.name)[1:-1]} ({rig.system}), written by nnap_em {__version__}.'.replace(
        "\\", "/"
    )
    usage = "\n\nIt needs NumPy only: python predictor.py LOG.csv --given 1.0 --out prediction.csv\n"
    states = described({n: model.system.unit(n) for n in model.system.states})
    inputs = described(inputs_of(fitted)) or "none"
    sensors = described(model.system.sensors)
    inputs += f".  Sensors: {sensors}" if sensors else ""
    units = f'States: {states}.  Inputs: {inputs}.\n"""\n'
    model_ = f"MODEL = Model(\n{fields}\n    rate=rate,\n    reading=reading,\n    shown=shown,\n)\n"
    tail = 'if __name__ == "__main__":\n    main(MODEL)\n'
    return "\n\n".join(
        [title + usage + units + body.rstrip(), *(f"\n{f}".rstrip() for f in functions), "", model_, tail]
    )


def unrolled(
    name: str,
    function: Callable[..., tuple[Array, ...]],
    truth: Callable[..., tuple[Array, ...]] | None = None,
    names: dict[str, Any] | None = None,
    **arguments: Array,
) -> Source:
    """`function` in NumPy, compared with JAX at four random places about `arguments`.

    The numbers of JAX are those of `truth`, where the function has others by their `names` in it.
    Raises ExportError where there is no such source, or where its numbers are others.
    """
    try:
        source = unroll(name, function, **arguments)
    except UnrollError as error:
        raise ExportError(f"{error}; use {STABLEHLO_FILE}") from None
    rng, space = np.random.default_rng(0), {"np": np, **(names or {})}
    centres = [np.asarray(a) for a in arguments.values()]
    places = [np.where(a == 0, 3.0, 0.1 * a) * rng.normal(size=(4, *a.shape)) + a for a in centres]
    expected = jax.jit(jax.vmap(truth or function))(*(jnp.asarray(a, jnp.result_type(float)) for a in places))
    exec(str(source), space)  # what the exported program does
    with np.errstate(all="ignore"):
        outputs = cast(Callable, space[name])(*(tuple(a.reshape(4, -1).T) for a in places))
    for mine, theirs in zip((outputs,) if len(expected) == 1 else outputs, expected, strict=True):
        flat = np.asarray(theirs, np.float64).reshape(4, -1)
        computed = np.stack([np.broadcast_to(a, 4) for a in mine], axis=1) if mine else flat
        bound = math.sqrt(jnp.finfo(theirs.dtype).eps)
        if not np.allclose(computed, flat, rtol=bound, atol=bound, equal_nan=True):
            raise ExportError(f"the NumPy form of {name!r} gives other numbers than JAX; use {STABLEHLO_FILE}")
    return source


def inputs_of(fitted: Identified) -> dict[str, str]:
    """Inputs and their units."""
    rig, pairs = fitted.rig, zip(fitted.rig.input_columns, fitted.rig.input_joints, strict=True)
    return {name: rig.unit(name) if rig.equations else fitted.model.system.force_unit(joint) for name, joint in pairs}


def described(units: Mapping[str, str]) -> str:
    """Names with their units, as far as they have one."""
    return ", ".join(f"{name} [{unit}]" if unit else name for name, unit in units.items())


def states_of(model: StateSpaceModel) -> tuple[str, ...]:
    """States of the plant, and a name for each state of memory."""
    names = model.system.states
    return names + tuple(f"memory{i + 1}" for i in range(model.log_q.shape[0] - len(names)))


def _width(model: StateSpaceModel) -> int:
    """Columns of an exported row of inputs."""
    drives = len(model.system.drives)
    return 2 * drives + 2 if model.effects else drives


def _row(model: StateSpaceModel, columns: Float[Array, " input"]) -> Inputs:
    """An exported row: what reaches the joints; with effects the clock in the middle of the step [s], what reached
    the joints one row before, and the time since the first row [s].
    """
    if not model.effects:
        return Inputs.held(columns)
    drives = len(model.system.drives)
    return Inputs(columns[:drives], columns[drives + 1 : -1], columns[drives], columns[-1])


def _spread(fitted: Identified) -> Float[np.ndarray, "phi rank"]:
    """Factor of the covariance that `phi_samples` draws from, without directions that are rounding."""
    half = np.linalg.inv(np.linalg.cholesky(np.asarray(fitted.state.hessian))).T
    left, size, _ = np.linalg.svd(half, full_matrices=False)
    large = size > 1e-6 * np.max(size, initial=1e-300)
    return left[:, large] * size[large]


def literal(value: Any) -> str:
    """A number, text, tuple or array as Python source."""
    if isinstance(value, jax.Array | np.ndarray):
        return f"np.array({np.asarray(value).tolist()!r}).reshape({np.shape(value)!r})".replace("inf", "np.inf")
    return repr(value)


def _pairs(names: tuple[str, ...], values: np.ndarray) -> dict[str, float]:
    return dict(zip(names, values.tolist(), strict=True))


def _friction(fitted: Identified) -> dict[str, Any]:
    """The learned map as a table and as the weights of its network."""
    nodes = fitted.m_step.weights(fitted.model).nodes
    table = friction_table(fitted, nodes)
    unknown = cast(FrictionNetwork, fitted.model.unknown)
    columns = {"velocity": table.velocity, "torque": table.torque, "torque_std": table.std}
    return {
        "joints": [
            {"joint": j + 1, "velocity_unit": rate, "torque_unit": force}
            | {name: np.asarray(values[j]).tolist() for name, values in columns.items()}
            for j, (rate, force) in enumerate(table.units)
        ],
        "network": {
            "form": "scale * mlp(v / speed, asinh(v / knee) / asinh(speed / knee)), tanh layers, one network per joint",
            **{name: np.asarray(getattr(unknown, name)).tolist() for name in ("speed", "knee", "scale")},
            **({} if unknown.rest is None else {"straight_below": np.asarray(unknown.rest).tolist()}),
            "layers": [
                {"weight": np.asarray(layer.weight).tolist(), "bias": np.asarray(layer.bias).tolist()}
                for layer in unknown.mlp.layers
            ],
        },
    }


def _effect(effect: AbstractEffect, system: AbstractPlant) -> dict[str, Any]:
    units = effect.units_on(system)
    values = {name: float(value) for name, value in effect.values().items()}
    return {
        "name": effect.name,
        "joint": effect.joint,
        "channel": effect.channel,
        "parameters": {n: {"value": v if math.isfinite(v) else None, "unit": units[n]} for n, v in values.items()},
    }
