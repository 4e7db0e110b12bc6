"""Sample and hold: each reading once, however long it stands; an encoder that moves slowly or rests holds nothing."""

import numpy as np
import pytest
from helpers import swing, swing_rig

from nnap_em.errors import DataWarning
from nnap_em.logs.formats import write_csv
from nnap_em.logs.held import HELD_ROWS, hold, repeats
from nnap_em.logs.read import read_logs
from nnap_em.logs.rough import rough

T = 0.01 * np.arange(601)
ANGLE = np.sin(2.2 * T) + 0.3 * np.sin(9.1 * T + 0.4)
NOISE = np.random.default_rng(0).normal(size=T.size)
STOP = np.where(T < 2, ANGLE, np.where(T < 4, ANGLE[200], ANGLE - ANGLE[400] + ANGLE[200]))


def _held(y: np.ndarray, lengths: np.ndarray | list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Readings that each stand in so many rows, in turn, and the rows in which they are new."""
    new = np.cumsum([0, *np.resize(lengths, y.size)])
    new = new[new < y.size]
    return y[new[np.searchsorted(new, np.arange(y.size), side="right") - 1]], new


def _encoder(y: np.ndarray, step: float = 1e-3) -> np.ndarray:
    return step * np.round(y / step)


HOLDS = {"every other row": [2], "4": [4], "10": [10], "jitter": [4, 5, 6, 4, 6, 5, 5], "30 Hz": [3, 3, 4]}


@pytest.mark.parametrize("lengths", HOLDS.values(), ids=HOLDS)
@pytest.mark.parametrize("signal", (ANGLE + 1e-3 * NOISE, _encoder(ANGLE + 1e-3 * NOISE), 5 * np.cos(3 * T)))
def test_a_hold_is_found_whatever_its_length(signal, lengths):
    y, new = _held(signal, lengths)
    assert hold([y]) == pytest.approx(np.mean(lengths), rel=0.05)
    left = np.setdiff1d(np.arange(y.size), repeats(y, hold([y])))
    assert np.isin(left, new).mean() > 0.97  # at a turn two readings may be equal: a row beside is as good
    assert abs(left.size - new.size) <= 3


def test_one_hold_in_a_few_rows_is_left_alone():
    """The threshold of `HELD` rows, from both sides."""
    assert hold([_held(ANGLE, [1, 2, 2])[0]]) == pytest.approx(5 / 3, rel=0.05) and HELD_ROWS < 5 / 3
    assert hold([_held(ANGLE, [1, 1, 2])[0]]) == 1.0 and HELD_ROWS > 4 / 3


@pytest.mark.parametrize("step", (1e-4, 1e-2, 0.1, 0.5))
@pytest.mark.parametrize("signal", (ANGLE, 0.05 * ANGLE, STOP, ANGLE + 0.05 * NOISE, 3 * T, np.round(30 * T)))
def test_an_encoder_holds_nothing(signal, step):
    assert hold([_encoder(signal, step)]) == 1.0


def test_missing_samples_are_no_hold():
    assert hold([np.where(np.random.default_rng(1).random(T.size) < 0.6, np.nan, ANGLE)]) == 1.0
    assert hold([np.where(np.arange(T.size) % 4, np.nan, ANGLE)]) == 1.0


def test_a_rest_of_a_held_sensor_keeps_its_share_of_readings():
    y, _ = _held(_encoder(STOP), [5])
    left = np.setdiff1d(np.arange(y.size), repeats(y, hold([y])))
    assert hold([y]) == pytest.approx(5.0, abs=0.05)
    assert np.max(np.diff(left)) <= 6
    y[repeats(y, 5.0)] = np.nan
    assert rough({"theta1": y}, 0.01) == []  # nor is the sensor stuck in a rest of which every fifth row is read


def test_repeats_are_missing_samples(tmp_path):
    """In the column that is held alone, also among the readings as read, and not where they are trusted."""
    columns = swing(401)
    columns["theta1"], new = _held(columns["theta1"], [5])
    write_csv(tmp_path / "01.csv", columns)
    with pytest.warns(DataWarning, match=r"line 3, column 'theta1': 320 readings equal to the one before"):
        logs = read_logs(tmp_path, swing_rig())
    assert [(m.kind, m.column, m.row, m.amount) for m in logs.masked] == [("held", "theta1", 2, 320)]
    for data in (logs.data, logs.as_read):
        assert np.flatnonzero(np.isfinite(data.y[0, :, 0])).tolist() == new.tolist()
        assert np.isfinite(data.y[0, :, 1]).all()
    assert np.isfinite(read_logs(tmp_path, swing_rig(), trust=True).data.y).all()
