"""Smoothing and prediction in plain NumPy: the part of an exported predictor that is the same for every model."""

import argparse
import csv
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

Affine = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Matrix, offset, and covariance of the remainder."""


class Model(NamedTuple):
    """A fitted model; states are positions, rates and memory in SI units, or those of equations."""

    states: tuple[str, ...]
    measured: tuple[str, ...]
    inputs: tuple[str, ...]
    sensors: tuple[str, ...]
    """Sensors reported beside positions and rates."""
    dt: float
    substeps: int
    dressed: bool
    """True where the functions want the clock and the inputs of the row before beside the inputs."""
    log_q: np.ndarray
    log_r: np.ndarray
    mean: np.ndarray
    cov: np.ndarray
    offsets: np.ndarray
    """Hypotheses of the start, in standard deviations."""
    shrink: np.ndarray
    nodes: np.ndarray
    """Velocities of each joint at which friction is uncertain."""
    spread: np.ndarray
    """Factor of the covariance of the torques at the nodes and of the parameters."""
    parameters: np.ndarray
    rate: Callable[..., Any]
    reading: Callable[..., Any]
    shown: Callable[..., Any]
    nominal: bool = False
    """True where the mean is the path of the model itself: of equations."""
    window: int = 60
    inflations: tuple[float, ...] = (1.0, 10.0, 100.0)


class Prediction(NamedTuple):
    """Mean and standard deviation of every state, for every row; measurement noise is not in them."""

    mean: np.ndarray
    std: np.ndarray
    ahead: np.ndarray
    """Rows later than the given time; the others are smoothed."""


def rows_of(model: Model, time: np.ndarray, u: np.ndarray) -> np.ndarray:
    """External inputs of every row."""
    if not model.dressed:
        return u
    before = np.concatenate([np.zeros_like(u[:1]), u[:-1]])
    return np.column_stack([u, time + 0.5 * model.dt, before, time - time[0]])


def transition(
    model: Model, x: np.ndarray, u: np.ndarray, force: np.ndarray | None = None, z: np.ndarray | None = None
) -> np.ndarray:
    """The state one sample later, by Runge-Kutta steps; leading axes of x are batches."""
    u = np.broadcast_to(u, (*x.shape[:-1], u.shape[-1]))
    force = np.zeros(len(model.nodes)) if force is None else force
    z = model.parameters if z is None else z

    def rate(x: np.ndarray) -> np.ndarray:
        return _joined(model.rate(_parts(x), _parts(u), _parts(force), _parts(z)), x.shape[:-1])

    h = model.dt / model.substeps
    for _ in range(model.substeps):
        k1 = rate(x)
        k2 = rate(x + 0.5 * h * k1)
        k3 = rate(x + 0.5 * h * k2)
        k4 = rate(x + h * k3)
        x = x + h * (k1 + 2 * k2 + 2 * k3 + k4) / 6
    return x


def smooth(model: Model, time: np.ndarray, u: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance of the state in every row, given all readings and this model; NaN in y is no reading.

    The model counts as sure: where a joint is not read, the state is less certain than this.
    """
    with np.errstate(all="ignore"):
        return _smooth(model, rows_of(model, time, u), y)


def predict(
    model: Model,
    time: np.ndarray,
    u: np.ndarray,
    y: np.ndarray,
    given: float,
    *,
    seed: int = 0,
    samples: int = 100,
    draws: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None,
) -> Prediction:
    """Every state, from the readings up to `given` [s] after the first row and all inputs.

    `draws` in place of a seed: deviations of torques and parameters, and standard normals of start and noise.
    """
    last = int(np.sum(time <= time[0] + given + 1e-6)) - 1
    n, dof, nodes = len(model.mean), *model.nodes.shape
    if draws is None:
        rng = np.random.default_rng(seed)
        deviations = rng.standard_normal((samples, model.spread.shape[1])) @ model.spread.T
        draws = deviations, rng.standard_normal((samples, n)), rng.standard_normal((len(time), samples, n))
    deviations, start, noise = draws
    tables, z = (
        deviations[:, : dof * nodes].reshape(len(deviations), dof, nodes),
        model.parameters + deviations[:, dof * nodes :],
    )
    past, cov = smooth(model, time[: last + 1], u[: last + 1], y[: last + 1])
    if model.nominal:  # the first path is that of the model itself
        start, noise = np.array(start), np.array(noise)
        z[0], start[0], noise[:, 0] = model.parameters, 0.0, 0.0
    inputs = rows_of(model, time, u)
    with np.errstate(all="ignore"):
        first, rows = _shown(model, past, inputs[: last + 1], np.zeros(dof), model.parameters)
        mean, std = np.empty((2, len(time), first.shape[1]))
        mean[: last + 1], std[: last + 1] = first, np.sqrt(np.einsum("tij,tjk,tik->ti", rows, cov, rows))
        x = past[last] + start @ _cholesky(cov[last] + 1e-16 * np.eye(n)).T
        for k in range(last, len(time)):
            force = _between(model.nodes, tables, x[:, dof : 2 * dof])
            if k > last:
                shown = _shown(model, x, inputs[k], force, z)[0]
                mean[k] = shown[0] if model.nominal else shown.mean(0)
                std[k] = np.sqrt(np.mean((shown - mean[k]) ** 2, axis=0))
            x = transition(model, x, inputs[k], force, z) + noise[k] * np.exp(0.5 * model.log_q)
    return Prediction(mean, std, np.arange(len(time)) > last)


def _smooth(model: Model, u: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The likeliest of the hypotheses of the start, filtered with three sizes of process noise, smoothed twice."""
    sd = np.sqrt(np.diag(model.cov))
    means = model.mean + model.offsets * sd
    covs = np.broadcast_to(model.cov * np.outer(model.shrink, model.shrink), (len(means), *model.cov.shape))
    head = slice(model.window)
    score = _filter(model, means, covs, u[head], y[head], model.log_q)[-1] - 0.5 * np.sum(model.offsets**2, axis=1)
    best = np.argmax(np.where(np.isfinite(score), score, -np.inf))
    count = len(model.inflations)
    mean, cov = np.repeat(means[best][None], count, 0), np.repeat(covs[best][None], count, 0)
    loose = model.log_q + np.log(model.inflations)[:, None]
    path = _backwards(*_filter(model, mean, cov, u, y, loose)[:-1])
    affine = _affine(model, *path, u)
    reading = (*_linear(model.reading, path[0], u, model.parameters), path[0])
    mean, cov = np.repeat(model.mean[None], count, 0), np.repeat(model.cov[None], count, 0)
    *filtered, loglik = _filter(model, mean, cov, u, y, model.log_q, affine, reading)
    best = np.argmax(np.where(np.isfinite(loglik), loglik, -np.inf))
    mean, cov = _backwards(*filtered)
    return mean[best], cov[best]


def _filter(model: Model, mean, cov, u, y, log_q, affine: Affine | None = None, reading=None):
    """Kalman filter of a batch: states, predictions, matrices and log-likelihoods.

    Linearised about its own states, or by `affine` and `reading`.
    """
    q, r = np.zeros((len(mean), *cov.shape[1:])), np.exp(model.log_r)
    q[:] = np.eye(mean.shape[1]) * np.exp(log_q)[..., None, :]
    loglik, out = np.zeros(len(mean)), []
    for k, values in enumerate(y):
        predicted = mean, cov
        if reading is None:
            value, rows, about = *_linear(model.reading, mean, u[k], model.parameters), mean
        else:
            value, rows, about = (part[:, k] for part in reading)
        offset = value - np.einsum("boi,bi->bo", rows, about)
        for i, seen in enumerate(values):
            if np.isnan(seen):
                continue
            pc = np.einsum("bij,bj->bi", cov, rows[:, i])
            s = np.einsum("bi,bi->b", rows[:, i], pc) + r[i]
            gain = pc / s[:, None]
            e = seen - offset[:, i] - np.einsum("bi,bi->b", rows[:, i], mean)
            mean = mean + gain * e[:, None]
            cov = cov - gain[:, :, None] * pc[:, None, :]
            loglik = loglik - 0.5 * (e**2 / s + np.log(2 * np.pi * s))
        cov = 0.5 * (cov + np.swapaxes(cov, 1, 2))
        step = _affine(model, mean, cov, u[k]) if affine is None else tuple(part[:, k] for part in affine)
        out.append((mean, cov, *predicted, step[0]))
        mean = np.einsum("bij,bj->bi", step[0], mean) + step[1]
        cov = step[0] @ cov @ np.swapaxes(step[0], 1, 2)
        cov = 0.5 * (cov + np.swapaxes(cov, 1, 2)) + step[2] + q
    return *(np.stack(part, 1) for part in zip(*out, strict=True)), loglik


def _backwards(mean, cov, mean_before, cov_before, matrix) -> tuple[np.ndarray, np.ndarray]:
    """Rauch-Tung-Striebel smoother of a batch."""
    mean, cov = mean.copy(), cov.copy()
    for k in reversed(range(mean.shape[1] - 1)):
        gain = np.swapaxes(np.linalg.solve(cov_before[:, k + 1], matrix[:, k] @ cov[:, k]), 1, 2)
        mean[:, k] += np.einsum("bij,bj->bi", gain, mean[:, k + 1] - mean_before[:, k + 1])
        change = gain @ (cov[:, k + 1] - cov_before[:, k + 1]) @ np.swapaxes(gain, 1, 2)
        cov[:, k] += 0.5 * (change + np.swapaxes(change, 1, 2))
    return mean, cov


def _affine(model: Model, mean: np.ndarray, cov: np.ndarray, u: np.ndarray) -> Affine:
    """The transition linearised over Gaussians, by cubature."""
    n = mean.shape[-1]
    unit = np.sqrt(n) * np.concatenate([np.eye(n), -np.eye(n)])
    factor = _cholesky(cov)
    y = transition(model, mean[..., None, :] + unit @ np.swapaxes(factor, -1, -2), u[..., None, :])
    middle = y.mean(axis=-2)
    d = y - middle[..., None, :]
    slope = np.swapaxes(d, -1, -2) @ unit / (2 * n)
    matrix = np.swapaxes(np.linalg.solve(np.swapaxes(factor, -1, -2), np.swapaxes(slope, -1, -2)), -1, -2)
    residual = np.swapaxes(d, -1, -2) @ d / (2 * n) - slope @ np.swapaxes(slope, -1, -2)
    offset = middle - np.einsum("...ij,...j->...i", matrix, mean)
    return matrix, offset, 0.5 * (residual + np.swapaxes(residual, -1, -2))


def _linear(function: Callable[..., Any], x: np.ndarray, u: np.ndarray, z: np.ndarray):
    """Value and Jacobian of a reading."""
    u = np.broadcast_to(u, (*x.shape[:-1], u.shape[-1]))
    value, rows = function(_parts(x), _parts(u), _parts(z))
    shape = x.shape[:-1]
    return _joined(value, shape), _joined(rows, shape).reshape(*shape, len(value), x.shape[-1])


def _shown(model: Model, x: np.ndarray, u: np.ndarray, force: np.ndarray, z: np.ndarray):
    """All that is shown, under an extra force, and its Jacobian."""
    return _linear(lambda x, u, z: model.shown(x, u, _parts(force), z), x, u, z)


def _between(nodes: np.ndarray, tables: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Tabulated torques at the velocities of each sample, constant beyond the ends."""
    out = np.empty_like(v)
    for j, line in enumerate(nodes):
        at = np.clip(v[:, j], line[0], line[-1])
        i = np.clip(np.searchsorted(line, at, side="right") - 1, 0, len(line) - 2)
        share = (at - line[i]) / (line[i + 1] - line[i])
        low, high = (tables[np.arange(len(v)), j, place] for place in (i, i + 1))
        out[:, j] = low + share * (high - low)
    return out


def _cholesky(a: np.ndarray) -> np.ndarray:
    """Lower factors; NaN where a matrix is not positive definite."""
    out = np.zeros(a.shape)
    for i in range(a.shape[-1]):
        for j in range(i + 1):
            s = a[..., i, j] - np.sum(out[..., i, :j] * out[..., j, :j], axis=-1)
            out[..., i, j] = np.sqrt(s) if i == j else s / out[..., j, j]
    return out


def _parts(a: np.ndarray) -> tuple[np.ndarray, ...]:
    return tuple(np.moveaxis(a, -1, 0))


def _joined(parts: Sequence[Any], shape: tuple[int, ...]) -> np.ndarray:
    return np.stack([np.broadcast_to(part, shape) for part in parts], -1)


def main(model: Model) -> None:
    """Predict a CSV log."""
    parser = argparse.ArgumentParser(description="Predict all states of a log, with their standard deviations.")
    parser.add_argument("log", help=f"a CSV file with time, {', '.join((*model.inputs, *model.measured))}")
    parser.add_argument("--given", type=float, required=True, help="readings up to here are used [s]")
    parser.add_argument("--out", required=True, help="the CSV file to write")
    parser.add_argument("--seed", type=int, default=0, help="of the sample paths (0)")
    args = parser.parse_args()
    with open(args.log, newline="", encoding="utf-8-sig") as file:
        rows = list(csv.DictReader(file))

    def column(name: str) -> list[float]:
        return [float(row[name] or "nan") for row in rows]

    time = np.array(column("time"))
    u, y = (
        np.array([column(name) for name in names]).T.reshape(len(time), -1) for names in (model.inputs, model.measured)
    )
    prediction = predict(model, time, u, y, args.given, seed=args.seed)
    names = model.states[: prediction.mean.shape[1] - len(model.sensors)] + model.sensors
    with open(args.out, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["time", *names, *(f"{name}_std" for name in names)])
        writer.writerows(np.column_stack([time, prediction.mean, prediction.std]).tolist())
