"""Rough logs: what is put in is found, what is right is left alone, and a fit survives it."""

import warnings

import numpy as np
import pytest
from helpers import swing, swing_rig
from hypothesis import given, settings
from hypothesis import strategies as st

from nnap_em import read_logs
from nnap_em.errors import DataError, DataWarning
from nnap_em.logs.formats import write_csv
from nnap_em.logs.missing import interpolated
from nnap_em.logs.plausible import Columns
from nnap_em.logs.read import Logs
from nnap_em.logs.rough import rough

DT, ROWS = 0.01, 501
NOISE = {"theta1": 0.005, "dtheta1": 0.05}
LEVELS = (1.0, 1e-2, 0.0)
"""Of the noise: that of `NOISE`, hardly any, none."""


def _motion(seed: int, level: float = 1.0) -> dict[str, np.ndarray]:
    """An angle of three slow sines, its exact rate, and noise."""
    rng, t = np.random.default_rng(seed), DT * np.arange(ROWS)
    size, speed, phase = rng.uniform(0.2, 1.0, (3, 1)), rng.uniform(1.0, 9.0, (3, 1)), rng.uniform(0, 6.3, (3, 1))
    clean = {"theta1": size * np.sin(speed * t + phase), "dtheta1": size * speed * np.cos(speed * t + phase)}
    return {n: y.sum(axis=0) + level * NOISE[n] * rng.standard_normal(ROWS) for n, y in clean.items()}


def _faults(readings: Columns) -> dict[tuple[str, str], set[int]]:
    return {(entry.kind, entry.column): set(entry.rows.tolist()) for entry in rough(readings, DT)}


@settings(deadline=None, max_examples=40)
@given(seed=st.integers(0, 10**6), level=st.sampled_from(LEVELS), step=st.sampled_from([0.0, 1e-3, 0.05]))
def test_smooth_motion_is_left_alone(seed, level, step):
    """No alarm among 40 x 1002 readings with Gaussian noise, none, or steps; each costs 1e-8 by the threshold."""
    readings = _motion(seed, level)
    if step:
        readings["theta1"] = step * np.round(readings["theta1"] / step)
    assert _faults(readings) == {}


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("name", NOISE)
def test_spikes_are_found_row_by_row(name, level):
    """Far ones all, none beside them."""
    for seed in range(5):
        readings, rng = _motion(seed, level), np.random.default_rng(seed)
        rows = rng.choice(np.arange(5, ROWS - 5, 7), 5, replace=False)
        readings[name][rows] += 40 * NOISE[name] * rng.choice([-1, 1], 5)
        assert _faults(readings) == {("spike", name): set(rows.tolist())}


@pytest.mark.parametrize("level", LEVELS)
def test_an_impact_is_no_spike(level):
    """A rate that jumps and its angle that kinks, there and back within some rows; also a ramp that begins and ends."""
    t, rng = DT * np.arange(ROWS), np.random.default_rng(0)
    for length in (4, 8, 30):
        rate = 3.0 * np.sign(((np.arange(ROWS) // length) % 2) - 0.5) + 0.2 * np.sin(5 * t)
        angle = DT * np.cumsum(rate)
        noise = {n: level * s * rng.standard_normal(ROWS) for n, s in NOISE.items()}
        assert _faults({"theta1": angle + noise["theta1"], "dtheta1": rate + noise["dtheta1"]}) == {}
    held = np.clip(np.arange(ROWS) - 200.0, 0.0, 60.0)
    assert _faults({"x": held}) == {}


def _resampled(way: np.ndarray, step: float, part: float = 0.37) -> np.ndarray:
    """An encoder of coarse steps on the clock of a log that lies between two of its own samples, with eight digits."""
    held = step * np.round(way / step)
    return np.array([float(f"{value:.8g}") for value in part * held[:-1] + (1 - part) * held[1:]])


def _ease(x: np.ndarray) -> np.ndarray:
    """From 0 to 1 at constant acceleration, then at constant deceleration."""
    x = np.clip(x, 0.0, 1.0)
    return np.where(x < 0.5, 2 * x**2, 1 - 2 * (1 - x) ** 2)


def test_an_encoder_that_turns_round_pauses_or_rests_is_left_alone():
    """In a log that was resampled; while it rests it sways by a step of its own."""
    t, slow = DT * np.arange(ROWS), 0.008 * np.arange(626)
    starts = np.clip([slow / 1.5, (slow - 2.2) / 1.5, slow - 4], 0.0, 1.0)
    for seed in range(10):
        rng = np.random.default_rng(seed)
        for step in (1.5e-3, 0.01):
            assert _faults({"theta1": _resampled(_motion(seed, 0.0)["theta1"], step)}) == {}
        length, pause = rng.uniform((0.5, 0.05), (1.5, 0.3))
        assert _faults({"x": _ease((t - 0.5) / length) - _ease((t - 0.5 - length - pause) / length)}) == {}
        way = [0.3, 0.3, -0.4] @ (starts**3 * (10 - 15 * starts + 6 * starts**2))
        way += 3.6e-6 * np.sin(2 * np.pi * rng.uniform(2, 6) * slow + rng.uniform(0, 6))
        assert _faults({"q": _resampled(way, 4e-6, rng.uniform(0.05, 0.95))}) == {}


@pytest.mark.parametrize("name", NOISE)
@pytest.mark.parametrize("level", LEVELS)
def test_a_sensor_that_is_stuck_or_dies_is_found_by_what_the_other_says(name, level):
    """A sequence that is longer dead than alive, too: the run is not its own measure."""
    for seed, first, end in ((4, 151, 201), (4, 401, ROWS), (4, 200, ROWS)):
        readings = _motion(seed, level)
        readings[name][first:end] = readings[name][first - 1]
        ((kind, column), rows), *more = _faults(readings).items()
        assert (column, more) == (name, [])
        assert kind in ("stuck", "saturated")
        assert set(range(first, end)) <= rows <= set(range(first - 1, end))


def test_a_column_alone_is_stuck_where_it_wakes_up_elsewhere_or_its_noise_is_gone():
    """About the top of a sine it wakes up where it stood; without noise it is a joint that rests."""
    alone = _motion(5)["theta1"]
    alone[151:201] = alone[150]
    assert _faults({"theta1": alone}) == {("stuck", "theta1"): set(range(151, 201))}
    for noise, found in ((0.005, {("stuck", "theta1"): set(range(101, 210))}), (0.0, {})):
        alone = np.sin(np.pi * np.arange(311) / 310) + noise * np.random.default_rng(0).standard_normal(311)
        alone[101:210] = alone[100]
        assert _faults({"theta1": alone}) == found


def test_one_count_of_an_encoder_is_no_spike_of_its_rate():
    """A rate that is filtered from steps; one of twice the size is masked."""
    counts = np.where(np.arange(ROWS) > 250, 1e-3, 0.0)
    for size, found in ((1.0, {}), (3.0, {("spike", "dq"): {250}})):
        rate = 1e-4 * np.sin(np.arange(ROWS) / 30) + size * 1e-3 / DT * (np.arange(ROWS) == 250)
        assert _faults({"q": counts, "dq": rate}) == found


def test_axes_of_a_measured_arm_that_rest_are_left_alone(shared):
    """Its rates, filtered from coarse steps, are 0 for up to 41 rows; they came as sensors that start late."""
    table = np.genfromtxt(shared / "data/measured/kr300/train/02.csv", delimiter=",", names=True)
    readings = {name: table[name] for name in table.dtype.names if name[0] in "qds"}
    assert [entry for entry in rough(readings, 0.008) if entry.kind != "spike"] == []


def test_a_late_and_a_saturated_sensor_are_found():
    readings = _motion(6)
    readings["theta1"][:30] = 0.0
    assert _faults(readings) == {("late start", "theta1"): set(range(30))}
    readings = _motion(7)
    limit = float(np.percentile(readings["dtheta1"], 90))
    beyond = set(np.flatnonzero(readings["dtheta1"] > limit).tolist())
    readings["dtheta1"] = np.minimum(readings["dtheta1"], limit)
    ((what, rows),) = _faults(readings).items()
    assert what == ("saturated", "dtheta1") and beyond <= rows
    assert len(rows - beyond) <= 1  # the reading at the limit


@pytest.mark.parametrize("length", [1, 8, 25])
def test_an_input_of_sines_is_told_over_a_gap(length):
    t = DT * np.arange(ROWS)
    u = 0.2 * np.sin(7 * t) + 0.1 * np.sin(23 * t + 1)
    lost = (np.arange(ROWS) >= 200) & (np.arange(ROWS) < 200 + length)
    filled = interpolated(np.where(lost, np.nan, u), lost)
    np.testing.assert_allclose(filled.u, u, atol=1e-3)
    assert (filled.error[lost] < 0.01).all()
    assert (filled.error[~lost] == 0).all()


def test_an_input_of_noise_is_not_trusted_over_a_gap():
    u, lost = np.random.default_rng(0).standard_normal(ROWS), np.arange(ROWS) // 8 == 25
    assert (interpolated(np.where(lost, np.nan, u), lost).error[lost] > 1).all()
    assert interpolated(np.where(lost, np.nan, 0.0), lost).u.tolist() == [0.0] * ROWS


# --- through the reader


def _write(folder, columns, kept=None):
    kept = np.ones(len(columns["time"]), bool) if kept is None else kept
    write_csv(folder / "01.csv", {name: values[kept] for name, values in columns.items()})


def _read(folder, **options) -> tuple[Logs, list[str]]:
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        logs = read_logs(folder, swing_rig(), **options)
    return logs, [str(w.message) for w in said]


def test_what_is_masked_is_said_and_kept_aside(tmp_path):
    columns = swing() | {"theta1": swing()["theta1"].copy()}
    columns["theta1"][[40, 90]] += 0.5
    _write(tmp_path, columns)
    logs, (said,) = _read(tmp_path)
    assert "01.csv: line 42, column 'theta1': 2 readings far from" in said
    assert "--trust-readings" in said
    (entry,) = logs.masked
    assert entry[:4] == ("01.csv", "spike", "theta1", 41)
    assert (entry.time, entry.amount) == (0.4, 2)
    assert np.argwhere(np.isnan(logs.data.y[0])).tolist() == [[40, 0], [90, 0]]
    np.testing.assert_allclose(logs.as_read.y[0, :, 0], columns["theta1"], rtol=1e-9)
    trusted, silence = _read(tmp_path, trust=True)
    assert (silence, trusted.masked) == ([], ())
    np.testing.assert_array_equal(trusted.data.y, logs.as_read.y)
    rest = zip((logs.data.t, logs.data.u, logs.data.valid), trusted.data[:2] + trusted.data[3:], strict=True)
    assert all(np.array_equal(one, other) for one, other in rest)


def test_a_prediction_knows_nothing_of_later_readings(tmp_path):
    """Not even through a mask: whatever comes after the given time, what a filter sees is the same."""
    seen = []
    for later in ("as it is", "restless"):
        columns = {name: values.copy() for name, values in swing().items()}
        columns["theta1"][[40, 100, 150]] += 0.5  # at 0.4 s, 1 s and 1.5 s
        if later == "restless":  # beside this the first spike is none
            columns["theta1"][101:] += np.random.default_rng(0).normal(0.0, 0.5, len(columns["time"]) - 101)
        _write(tmp_path, columns)
        logs, _ = _read(tmp_path, until=1.0)
        seen.append((logs.masked, logs.data.y[:, :101]))
        np.testing.assert_allclose(logs.data.y[0, 101:, 0], columns["theta1"][101:], rtol=1e-9)
    assert [entry.row for entry in seen[0][0]] == [41]
    assert seen[0][0] == seen[1][0]
    np.testing.assert_array_equal(seen[0][1], seen[1][1])


def test_lost_rows_come_back_without_readings_and_a_log_ends_where_inputs_cannot_be_told(tmp_path):
    columns, kept = swing(), np.ones(201, bool)
    kept[50:60] = kept[100] = False
    _write(tmp_path, columns, kept)
    logs, (said,) = _read(tmp_path)
    assert "line 52, column 'time': a gap: 0.49 s, then 0.6 s (11 rows missing in all)" in said
    np.testing.assert_allclose(logs.data.t[0], columns["time"], atol=1e-9)
    np.testing.assert_allclose(logs.data.u[0, :, 0], columns["u"], atol=1e-4)
    np.testing.assert_array_equal(np.isnan(logs.data.y[0]).all(axis=1), ~kept)
    assert [(m.kind, m.row, m.amount) for m in logs.masked] == [("gap", 51, 11)]
    _write(tmp_path, columns | {"u": np.random.default_rng(0).standard_normal(201)}, np.arange(201) // 5 != 24)
    logs, (said,) = _read(tmp_path)
    assert "inputs before these rows cannot be interpolated" in said
    assert logs.data.valid.sum() == 120
    assert [(m.kind, m.row, m.amount) for m in logs.masked] == [("cut", 121, 76)]
    for kept in (np.arange(201) % 3 > 0, (np.arange(201) < 60) | (np.arange(201) > 140)):
        _write(tmp_path, swing(), kept)
        with pytest.raises(DataError, match=r"a gap|rows are"):
            read_logs(tmp_path, swing_rig(clock="session"))


def test_a_limit_seen_in_one_file_holds_for_all(tmp_path):
    """The second file touches it twice only."""
    t = DT * np.arange(301)
    for i, size in enumerate((4.0, 3.006)):
        rate = np.minimum(size * np.cos(2 * t + 1), 3.0)
        columns = {"time": t, "u": 0 * t, "theta1": size / 2 * np.sin(2 * t + 1), "dtheta1": rate}
        write_csv(tmp_path / f"{i}.csv", columns)
    with pytest.warns(DataWarning):
        logs = read_logs(tmp_path, swing_rig())
    assert {(m.file, m.kind, m.column) for m in logs.masked} == {(f"{i}.csv", "saturated", "dtheta1") for i in range(2)}
    assert not (np.asarray(logs.data.y)[..., 1] == 3.0).any()
