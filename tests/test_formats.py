"""Logs in other formats: the same numbers as in CSV, and the same refusals, by row and column."""

import sys
import warnings

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import scipy.io
from helpers import swing_rig
from hypothesis import given, settings
from hypothesis import strategies as st

from nnap_em.commands.common import write_states
from nnap_em.data.dataset import DataError
from nnap_em.data.formats import read_table, write_csv
from nnap_em.data.logs import read_logs
from nnap_em.storage.files import StoreError
from nnap_em.systems import specs

RIG = swing_rig()


def _log(rows: int = 50) -> dict[str, np.ndarray]:
    t = 0.01 * np.arange(rows)
    theta = np.sin(3 * t)
    theta[::7] = np.nan
    return {"time": t, "u": np.cos(t), "theta1": theta, "dtheta1": 3 * np.cos(3 * t)}


WRITERS = {
    "csv": (".csv", write_csv),
    "parquet": (".parquet", lambda path, columns: pq.write_table(pa.table(columns), path)),
    "mat": (".mat", lambda path, columns: scipy.io.savemat(path, columns, oned_as="row")),
    "struct": (".mat", lambda path, columns: scipy.io.savemat(path, {"run1": columns}, oned_as="column")),
}
OTHERS = dict([WRITERS["parquet"], WRITERS["mat"]])


@pytest.mark.parametrize("t0", (0.0, 12.3, 1.7e9))
def test_a_clock_keeps_its_samples(tmp_path, t0):
    """1 ms at the seconds since 1970, which float64 holds to 2.4e-7 s."""
    t = t0 + 1e-3 * np.arange(1001)
    write_csv(tmp_path / "01.csv", {"time": t, "u": np.ones_like(t)})
    back = read_table(tmp_path / "01.csv", ("time", "u"))[:, 0]
    np.testing.assert_allclose(back, t, rtol=0, atol=1e-9)
    assert t0 < 1e6 or np.array_equal(back, t)
    assert len((tmp_path / "01.csv").read_text().splitlines()[4].split(",")[0]) < 18  # no digits of rounding


@pytest.mark.parametrize("suffix, write", WRITERS.values(), ids=WRITERS)
def test_a_log_is_the_same_in_every_format(tmp_path, suffix, write):
    write(tmp_path / f"01{suffix}", _log())
    logs = read_logs(tmp_path, RIG)
    columns = _log()
    assert logs.files == (f"01{suffix}",)
    np.testing.assert_allclose(logs.data.t[0], columns["time"], rtol=1e-11)
    np.testing.assert_allclose(logs.data.u[0, :, 0], columns["u"], rtol=1e-11)
    np.testing.assert_allclose(logs.data.y[0].T, [columns["theta1"], columns["dtheta1"]], rtol=1e-11)


_values = st.floats(allow_infinity=False, allow_subnormal=False)


@pytest.mark.parametrize("suffix", OTHERS)
@settings(deadline=None, max_examples=40)  # it writes files
@given(rows=st.lists(st.tuples(_values, _values), min_size=2, max_size=30))
def test_any_finite_table_comes_back_to_the_bit(tmp_path_factory, suffix, rows):
    path = tmp_path_factory.getbasetemp() / f"written{suffix}"
    a, b = np.array(rows).T
    OTHERS[suffix](path, {"time": np.arange(len(rows), dtype=float), "a": a, "b": b})
    np.testing.assert_array_equal(read_table(path, ("time",), ("b", "a"))[:, 1:].T, [b, a])


@pytest.mark.parametrize("suffix", OTHERS)
@settings(deadline=None, max_examples=30)  # it writes files
@given(row=st.integers(0, 49), name=st.sampled_from(list(_log())), bad=st.sampled_from([np.inf, -np.inf, np.nan]))
def test_any_corrupted_field_is_named_with_its_row_and_column(tmp_path_factory, suffix, row, name, bad):
    path = tmp_path_factory.getbasetemp() / f"corrupted{suffix}"
    columns = _log()
    columns[name][row] = bad
    OTHERS[suffix](path, columns)
    if np.isnan(bad) and "theta" in name:
        assert np.isnan(read_table(path, ("time", "u"), ("theta1", "dtheta1"))[row]).any()
        return
    with pytest.raises(DataError) as refused:
        read_table(path, ("time", "u"), ("theta1", "dtheta1"))
    assert f"row {row + 1}, column {name!r}: found {bad:g}; write a number" in str(refused.value)


MISTAKES = {  # name, which begins with the suffix: (the bytes or the columns, then the words of the message)
    "parquet: column missing": (lambda c: {n: c[n] for n in ("time", "theta1", "dtheta1")}, "'u': missing"),
    "parquet: text": (lambda c: c | {"u": ["0.1"] * 50}, "column 'u' | holds object | floating point"),
    "parquet: one row": (lambda c: {n: v[:1] for n, v in c.items()}, "found 1 row; | 2 rows or more"),
    "parquet: no such file": (b"PAR1 and nothing", "no Parquet file, or damaged | another copy"),
    "parquet: gap": (lambda c: {n: np.delete(v, slice(9, 39)) for n, v in c.items()}, "row 10, column 'time' | a gap"),
    "mat: column misspelt": (lambda c: {n.replace("dth", "d_th"): v for n, v in c.items()}, "did you mean"),
    "mat: another length": (lambda c: c | {"u": c["u"][:-1]}, "column 'u' | is 49, the first has 50 rows | one length"),
    "mat: a matrix": (lambda c: c | {"u": np.ones((50, 2))}, "column 'u' | missing | u[0], u[1]"),
    "mat: complex": (lambda c: c | {"u": c["u"] + 1j}, "column 'u' | holds complex128, no numbers"),
    "mat: text": (lambda c: c | {"u": "0.1"}, "column 'u' | no numbers | floating point"),
    "mat: cut short": (b"MATLAB 5.0 MAT-file, Platform" + 40 * b" ", "no MAT file, or damaged | another copy"),
    "mat: version 7.3": (b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM" + b"\x89HDF" * 99, "7.3 | '-v7'"),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_is_refused(tmp_path, name):
    content, words = MISTAKES[name]
    path = tmp_path / f"01.{name.partition(':')[0]}"
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        OTHERS[path.suffix](path, content(_log()))
    with pytest.raises(DataError) as refused, warnings.catch_warnings(action="ignore"):
        read_logs(tmp_path, RIG)
    for word in (str(path), *words.split(" | ")):
        assert word in str(refused.value)


def test_only_parquet_needs_an_extra(tmp_path, monkeypatch):
    """scipy, which reads MAT files, comes with JAX."""
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    OTHERS[".mat"](tmp_path / "01.mat", _log())
    assert read_logs(tmp_path, RIG).files == ("01.mat",)
    (tmp_path / "02.parquet").write_bytes(b"any")
    with pytest.raises(DataError, match=r"cannot be read without pyarrow; pip install 'nnap-em\[formats\]'"):
        read_logs(tmp_path, RIG)


def test_whole_numbers_single_precision_and_nulls_are_read(tmp_path):
    columns = _log() | {"u": np.arange(50, dtype=np.int32), "dtheta1": np.arange(50, dtype=np.float32)}
    table = pa.table(columns | {"theta1": pa.array([None, *range(49)], pa.float64()), "note": ["x"] * 50})
    pq.write_table(table, tmp_path / "01.parquet")
    rows = read_table(tmp_path / "01.parquet", ("u",), ("theta1", "dtheta1"))
    np.testing.assert_array_equal(rows.T, [np.arange(50), [np.nan, *range(49)], np.arange(50)])


def test_states_replace_their_own_files_and_never_a_log(tmp_path):
    """Those of such logs are CSV files; nothing is written beside a file that would be lost, either."""
    for name in ("01", "02"):
        OTHERS[".parquet"](tmp_path / f"{name}.parquet", _log())
    logs, values, out = read_logs(tmp_path, RIG), np.zeros((2, 50, 4)), tmp_path / "out"
    write_states(out, logs, specs["acrobot"].states, values, values)
    assert sorted(path.name for path in out.iterdir()) == ["01.csv", "02.csv"]
    write_states(out, logs, specs["acrobot"].states, values, values)
    (out / "01.csv").unlink()
    write_csv(out / "02.csv", _log())
    log = (out / "02.csv").read_text()
    with pytest.raises(StoreError, match=r"02\.csv: is there already, and nnap_em did not write it; move it away"):
        write_states(out, logs, specs["acrobot"].states, values, values)
    assert [path.read_text() for path in out.iterdir()] == [log]
