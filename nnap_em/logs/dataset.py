"""Sequences of one rig, padded to one length."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from ..base.digits import counted
from ..errors import DataError

Array = jax.Array | np.ndarray  # host or device


class Dataset(NamedTuple):
    """Sequences padded to one length; unequal length lives in `valid`, missing samples in NaN."""

    t: Float[Array, "*seq time"]  # s; repeats its last value in the padding
    u: Float[Array, "*seq time input"]  # N m; 0 in the padding
    y: Float[Array, "*seq time obs"]  # rad, rad/s; NaN = not measured, also in the padding
    valid: Bool[Array, "*seq time"]

    def __str__(self) -> str:
        y, valid = np.asarray(self.y), np.asarray(self.valid)
        count, gone = valid[..., 0].size, np.isnan(y[valid]).mean() if y[valid].size else 0.0
        t = np.asarray(self.t)
        longest, inputs = float(np.max(t[..., -1] - t[..., 0])), np.shape(self.u)[-1]
        size = f"{counted(count, 'sequence')}, {valid.sum()} rows, the longest {longest:.3g} s"
        return f"Dataset: {size}; {inputs} inputs, {y.shape[-1]} readings, {100 * gone:.2g} % missing"


def pad(sequences: Sequence[tuple[Array, Array, Array]]) -> Dataset:
    """Sequences of any length as one Dataset, for data that are not in a folder of logs.

    Args:
        sequences: (t, u, y) of each: time (row,) [s], uniform; inputs (row, input) [N m, or N] in the order of
            `rig.logged_inputs`; readings (row, column) [rad, rad/s, or m, m/s] in that of `rig.measured`, NaN where
            there is none. One column is `u[:, None]`.

    Returns:
        Arrays (sequence, row, ...), as long as the longest; `valid` marks the rows that are there.

    Raises:
        DataError: shapes of a sequence do not fit each other or the first sequence.

    Example:
        >>> t = np.arange(5) * 0.01
        >>> nnap_em.pad([(t, np.zeros((5, 1)), np.zeros((5, 1)))]).y.shape
        (1, 5, 1)
    """
    if not sequences:
        raise DataError("pad: no sequence; give at least one (t, u, y)")
    inputs, obs = (np.shape(x)[-1] for x in sequences[0][1:])
    for i, (t, u, y) in enumerate(sequences):
        expected = (len(t),), (len(t), inputs), (len(t), obs)
        if (shapes := (np.shape(t), np.shape(u), np.shape(y))) != expected or not len(t):
            hint = "give (row,), (row, input), (row, column), with a row at least; one column is u[:, None]"
            raise DataError(f"pad: sequence {i}: shapes of t, u, y are {shapes}, not {expected}: {hint}")
    lengths = [len(t) for t, _, _ in sequences]
    time = max(lengths)
    return Dataset(
        t=np.stack([np.pad(np.asarray(t, np.float64), (0, time - len(t)), mode="edge") for t, _, _ in sequences]),
        u=np.stack([_lengthen(u, time, 0.0) for _, u, _ in sequences]),
        y=np.stack([_lengthen(y, time, np.nan) for _, _, y in sequences]),
        valid=np.arange(time) < np.array(lengths)[:, None],
    )


def horizon(data: Dataset, samples: int, after: Int[np.ndarray, " seq"] | int = 0) -> Dataset:
    """The first `samples` samples of every sequence, and `after` more; the rest stays as padding: no shape changes."""
    seen = np.arange(data.t.shape[-1]) < samples + np.expand_dims(after, -1)
    return data._replace(valid=np.asarray(data.valid) & seen)


def whole_step(rows: int) -> int:
    """Next of 8, 9, ... 15 times a power of two: one program serves recordings of about one length, for 6 % more rows
    on average.
    """
    unit = 1 << max(0, rows.bit_length() - 4)
    return -(-rows // unit) * unit


def stepped(data: Dataset, rows: int = 0) -> Dataset:
    """`data` with rows of padding, up to `rows` and to a whole step."""
    length = data.t.shape[1]
    more = whole_step(max(rows, length)) - length
    longer = lambda a, **filler: np.pad(np.asarray(a), [(0, 0), (0, more), *[(0, 0)] * (a.ndim - 2)], **filler)  # noqa: E731
    if not more:
        return data
    t, u, y, valid = data
    return Dataset(longer(t, mode="edge"), longer(u), longer(y, constant_values=np.nan), longer(valid))


def fill_missing(y: Float[Array, "*batch obs"]) -> tuple[Float[jax.Array, "*batch obs"], Bool[jax.Array, "*batch obs"]]:
    """Readings with 0 in place of NaN, and the mask of what was measured."""
    observed = ~jnp.isnan(y)
    return jnp.where(observed, y, 0.0), observed


def active_steps(valid: Bool[jax.Array, " time"]) -> Bool[jax.Array, " time"]:
    """True at k where the step from k to k + 1 lies inside the data."""
    return jnp.concatenate([valid[1:], jnp.zeros(1, bool)])


def _lengthen(values: Array, time: int, filler: float) -> np.ndarray:
    return np.pad(np.asarray(values, np.float64), ((0, time - len(values)), (0, 0)), constant_values=filler)
