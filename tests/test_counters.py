"""Counters that start over: jumps of one size are found and unwrapped exactly, and nothing that machines do is one."""

import numpy as np
import pytest
from helpers import pendulum_rig, read_table, swing_rig

from nnap_em.cli import main as cli
from nnap_em.errors import DataError
from nnap_em.logs.counters import counter
from nnap_em.logs.formats import write_csv
from nnap_em.logs.read import read_logs

T = 0.01 * np.arange(601)
ANGLE = 1.5 * np.sin(1.1 * T) + 0.4 * np.sin(4.7 * T + 0.4)  # at most 3.2 rad/s
NOISE = np.random.default_rng(0).normal(size=T.size)
COUNTS = np.round(ANGLE * 4096 / (2 * np.pi) * 10)  # 12 bits of a motor before a gear of 10


COUNTERS = {  # name: (readings, what they are of, size, options)
    "12 bits": (COUNTS % 4096, COUNTS, 4096, {}),
    "16 bits with a sign": ((9 * COUNTS + 32768) % 65536 - 32768, 9 * COUNTS, 65536, {}),
    "a motor before a gear of 19.2": (ANGLE % (2 * np.pi / 19.2), ANGLE, 2 * np.pi / 19.2, {}),
    "a motor before a gear of 60": (ANGLE % (np.pi / 30), ANGLE, np.pi / 30, {}),
    "noise": ((ANGLE + 1e-3 * NOISE) % (np.pi / 5), ANGLE + 1e-3 * NOISE, np.pi / 5, {}),
    "degrees": ((5e2 * ANGLE + 180) % 360 - 180, 5e2 * ANGLE, 360, {}),
    "one jump of an axis": ((T**2 + T) % 30.0, T**2 + T, 30.0, {}),
    "slow encoder": (np.round(50 * T) % 256, np.round(50 * T), 256, {}),
    "a lost turn": (ANGLE + 2 * np.pi * (T > 3), ANGLE, 2 * np.pi, {"angle": True}),
}  # fmt: skip


@pytest.mark.parametrize("y, true, size, options", COUNTERS.values(), ids=COUNTERS)
def test_jumps_are_found_and_unwrapped(y, true, size, options):
    """Exactly, as sizes are counts or parts of a turn."""
    found = counter(y, **options)
    assert found is not None
    assert found.size == pytest.approx(size, rel=1e-5)
    assert np.ptp(y + found.size * found.turns - true) < 1e-4 * size


def test_a_jump_in_a_gap_is_found():
    for lost in (1, 2, 4):
        y = (ANGLE % (2 * np.pi / 9)).copy()
        for row in np.flatnonzero(np.abs(np.diff(y)) > 0.35):
            y[row + 1 : row + 1 + lost] = np.nan
        found = counter(y)
        assert found is not None and np.ptp((y + found.size * found.turns - ANGLE)[np.isfinite(y)]) < 1e-3


BOUNCES = np.sign(np.sin(4 * T)) * (1 - 0.1 * (4 * T / np.pi % 1))
MACHINES = {
    "smooth": (ANGLE, {"angle": True}),
    "noise": (NOISE, {"angle": True}),
    "encoder between two steps": (np.round(0.3 + 0.4 * np.sin(5 * T)), {"angle": True}),
    "spike": (ANGLE + 50 * (T[200] == T), {"angle": True}),
    "dropouts": (np.where(np.abs(NOISE) > 2.2, 0.0, ANGLE + 20), {}),
    "table of four stations": (90 * np.floor(T) % 360 + 0.1 * NOISE, {}),
    "a jump inside the range": (np.where(T < 3, T, T - 2.6), {}),
    "bounces of an axis": (BOUNCES, {}),
    "too fast for its rows": (np.sin(250 * T), {"angle": True}),
}


@pytest.mark.parametrize("y, options", MACHINES.values(), ids=MACHINES)
def test_what_machines_do_is_no_counter(y, options):
    assert counter(y, **options) is None


COUNTS_OF = '[import.columns]\ntheta1 = { from = "counts", scale = 0.00015339807878856412 }\n'
RIG = pendulum_rig(("theta1",)) + COUNTS_OF


@pytest.fixture
def motor(tmp_path):
    """12 bits of a motor before a gear of 10, at times between those of the rows, and a folder."""
    t = 0.007 * np.arange(900)
    angle = np.interp(t, T, ANGLE, right=ANGLE[-1])
    write_csv(tmp_path / "log.csv", {"time": t, "u": np.cos(t), "counts": np.round(angle * 40960 / (2 * np.pi)) % 4096})
    (tmp_path / "rig.toml").write_text(RIG)
    return tmp_path


def _import(folder, *words: str) -> int:
    argv = ["import", str(folder / "log.csv"), "--rig", str(folder / "rig.toml"), "--out", str(folder / "out")]
    return cli.main([*argv, "--test", "0", *words])


def _written(folder) -> np.ndarray:
    """Time and angle of what `import` writes."""
    return read_table(folder / "out/train/000.csv", ("time", "u"), ("theta1",))[:, [0, 2]].T


def test_nothing_is_interpolated_across_a_jump(motor, capsys):
    """Rows beside a jump are empty, and all others as near to the turning angle as its counts and 7 ms allow."""
    assert _import(motor) == 0
    t, theta = _written(motor)
    assert "--unwrap theta1 takes the jumps out" in capsys.readouterr().err
    turn = 2 * np.pi / 10
    off = (theta - np.interp(t, T, ANGLE) + turn / 2) % turn - turn / 2
    assert 5 < np.isnan(off).sum() < 100
    assert np.nanmax(np.abs(off)) < 5e-4
    said = r"column 'theta1': jumps by 0.6283, in \d+ places, .* import LOG ... .* --unwrap theta1"
    with pytest.raises(DataError, match=said):
        read_logs(motor / "out/train", swing_rig(measured=("theta1",)))


def test_a_counter_is_unwrapped_as_asked(motor, capsys):
    assert _import(motor, "--unwrap", "theta") == 2
    assert "--unwrap theta: no column of this rig; did you mean 'theta1'?" in capsys.readouterr().err
    assert _import(motor, "--unwrap", "theta1") == 0
    t, theta = _written(motor)
    assert np.isfinite(theta).all()
    np.testing.assert_allclose(theta, np.interp(t, T, ANGLE) - ANGLE[0] + theta[0], rtol=0, atol=5e-4)
