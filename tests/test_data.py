"""Logs: what is written is read back in every format, padding is marked, mistakes are refused by row and column."""

import dataclasses
import re
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import scipy.io
from helpers import csv_text, data_sets, read_table, swing, swing_rig, with_field

from nnap_em.errors import DataError
from nnap_em.logs.dataset import Dataset, fill_missing, horizon, pad
from nnap_em.logs.formats import write_csv
from nnap_em.logs.read import check_split, logs_of_arrays, read_logs, sequences_of
from nnap_em.machines.rig import read_rig
from nnap_em.machines.systems import specs

ROWS, RIG = 201, swing_rig()


def _log(rows: int = 50) -> dict[str, np.ndarray]:
    log = swing(rows)
    return log | {"theta1": np.where(np.arange(rows) % 7, log["theta1"], np.nan)}


WRITERS = {
    "csv": (".csv", write_csv),
    "parquet": (".parquet", lambda path, columns: pq.write_table(pa.table(columns), path)),
    "mat": (".mat", lambda path, columns: scipy.io.savemat(path, columns, oned_as="row")),
    "struct": (".mat", lambda path, columns: scipy.io.savemat(path, {"run1": columns}, oned_as="column")),
}
OTHERS = dict([WRITERS["parquet"], WRITERS["mat"]])


def test_a_folder_without_logs_is_refused(tmp_path):
    with pytest.raises(DataError, match=r"nowhere: is no folder; put one CSV file per sequence there"):
        read_logs(tmp_path / "nowhere", swing_rig())
    (tmp_path / ".01.csv.7.part").touch()
    (tmp_path / "._01.csv").touch()  # what a Mac leaves on a memory stick
    with pytest.raises(DataError, match=r"holds no \*.csv"):
        read_logs(tmp_path, swing_rig())


READABLE = {
    "byte order mark": lambda s: "\ufeff" + s,
    "windows lines": lambda s: s.replace("\n", "\r\n"),
    "UTF-16": lambda s: s.encode("utf-16"),
    "western European": lambda s: s.replace("\n", ",\n").replace(",\n", ",Wert °\n", 1).encode("cp1252"),
    "other order": lambda s: "\n".join(",".join(reversed(row.split(","))) for row in s.splitlines()),
}


@pytest.mark.parametrize("change", READABLE.values(), ids=READABLE.keys())
def test_harmless_differences_are_read_alike(tmp_path, change):
    content = change(csv_text(swing()))
    (tmp_path / "01.csv").write_bytes(content if isinstance(content, bytes) else content.encode("utf-8"))
    logs = read_logs(tmp_path, swing_rig())
    columns = swing()
    assert (logs.files, logs.columns) == (("01.csv",), ("u", "theta1", "dtheta1"))
    np.testing.assert_allclose(logs.data.t[0], columns["time"], rtol=1e-8)
    np.testing.assert_allclose(logs.data.u[0, :, 0], columns["u"], rtol=1e-8)
    np.testing.assert_allclose(logs.data.y[0].T, [columns["theta1"], columns["dtheta1"]], rtol=1e-8)


@pytest.mark.parametrize("text", ["", "nan", "NaN", " "])
def test_an_empty_field_is_a_missing_sample(tmp_path, text):
    (tmp_path / "01.csv").write_text(with_field(4, "theta1", text)(csv_text(swing())))
    y = read_logs(tmp_path, swing_rig()).data.y[0]
    assert np.argwhere(np.isnan(y)).tolist() == [[2, 0]]


@pytest.mark.parametrize("suffix, write", WRITERS.values(), ids=WRITERS)
def test_a_log_is_the_same_in_every_format(tmp_path, suffix, write):
    write(tmp_path / f"01{suffix}", _log())
    logs = read_logs(tmp_path, RIG)
    columns = _log()
    assert logs.files == (f"01{suffix}",)
    np.testing.assert_allclose(logs.data.t[0], columns["time"], rtol=1e-11)
    np.testing.assert_allclose(logs.data.u[0, :, 0], columns["u"], rtol=1e-11)
    np.testing.assert_allclose(logs.data.y[0].T, [columns["theta1"], columns["dtheta1"]], rtol=1e-11)


MISTAKES = {  # name, which begins with the suffix: (the bytes or the columns, then the words of the message)
    "parquet: column missing": (lambda c: {n: c[n] for n in ("time", "theta1", "dtheta1")}, "'u': missing"),
    "parquet: text": (lambda c: c | {"u": ["0.1"] * 50}, "column 'u' | holds object | floating point"),
    "parquet: no such file": (b"PAR1 and nothing", "no Parquet file, or damaged | another copy"),
    "parquet: gap": (lambda c: {n: np.delete(v, slice(9, 39)) for n, v in c.items()}, "row 10, column 'time' | a gap"),
    "mat: column misspelt": (lambda c: {n.replace("dth", "d_th"): v for n, v in c.items()}, "did you mean"),
    "mat: another length": (lambda c: c | {"u": c["u"][:-1]}, "column 'u' | is 49, the first has 50 rows | one length"),
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


def test_padding_is_marked_and_neutral():
    short, long = ((np.arange(n) * 0.1, np.ones((n, 2)), np.full((n, 1), float(n))) for n in (3, 5))
    data = pad([short, long])
    assert [x.shape for x in data] == [(2, 5), (2, 5, 2), (2, 5, 1), (2, 5)]
    assert data.valid.tolist() == [[True] * 3 + [False] * 2, [True] * 5]
    np.testing.assert_array_equal(np.diff(data.t[0])[2:], 0.0)
    np.testing.assert_array_equal(data.u[0, 3:], 0.0)
    assert np.isnan(data.y[0, 3:]).all()
    for i, sequence in enumerate((short, long)):
        for field, values in zip(data[:3], sequence, strict=True):
            np.testing.assert_array_equal(field[i][data.valid[i]], values)


def test_sequences_that_do_not_fit_are_refused_by_number():
    t, u, y = np.arange(3.0), np.zeros((3, 1)), np.zeros((3, 2))
    with pytest.raises(DataError, match=r"pad: no sequence"):
        pad([])
    with pytest.raises(DataError, match=r"pad: sequence 1: shapes of t, u, y are \(\(3,\), \(3, 2\), \(3, 2\)\)"):
        pad([(t, u, y), (t, y, y)])
    with pytest.raises(DataError, match=r"pad: sequence 0: .* one column is u"):
        pad([(t, u[:2], y)])


@pytest.mark.parametrize("kind", [np.asarray, jnp.asarray], ids=["numpy", "jax"])
def test_the_horizon_keeps_the_first_steps(kind):
    data = Dataset(*map(kind, pad([(np.arange(n) * 0.1, np.ones((n, 1)), np.ones((n, 1))) for n in (3, 6)])))
    short = horizon(data, 4)
    assert short.valid.sum(axis=1).tolist() == [3, 4]
    np.testing.assert_array_equal(short.t, data.t)
    assert jax.tree.all(jax.tree.map(lambda a, b: np.array_equal(a, b, equal_nan=True), horizon(data, 99), data))


@pytest.mark.parametrize("kind", [np.asarray, jnp.asarray], ids=["numpy", "jax"])
def test_missing_readings_become_zero_and_a_mask(kind):
    """Which the gradient passes."""
    y, observed = fill_missing(kind([[1.0, np.nan], [np.nan, -2.0]]))
    assert y.tolist() == [[1.0, 0.0], [0.0, -2.0]] and observed.tolist() == [[True, False], [False, True]]
    grad = jax.grad(lambda y: jnp.sum(fill_missing(y)[0] ** 2))(jnp.array([3.0, jnp.nan]))
    assert grad.tolist() == [6.0, 0.0]


def test_written_files_are_plain(tmp_path):
    write_csv(tmp_path / "out" / "a.csv", {"time": [0.0, 0.1, 0.3], "joint": np.arange(3), "y": [np.nan, 1 / 3, 2.5]})
    assert (tmp_path / "out" / "a.csv").read_text() == "time,joint,y\n0,0,\n0.1,1,0.333333333333\n0.3,2,2.5\n"
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["a.csv"]
    late = 1.7e9 + 1e-3 * np.arange(3)  # a clock that 12 digits would stop
    write_csv(tmp_path / "b.csv", {"time": late})
    np.testing.assert_array_equal(read_table(tmp_path / "b.csv", ("time",))[:, 0], late)


@pytest.mark.parametrize("columns", [{}, {"a": [1.0], "b": [1.0, 2.0]}, {"a": [np.inf]}])
def test_what_cannot_be_read_back_is_not_written(tmp_path, columns):
    with pytest.raises(DataError, match=r"a.csv: columns .*; write finite columns \(NaN = missing\) of one length"):
        write_csv(tmp_path / "a.csv", columns)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow  # fast: tests of one log each, here
def test_every_shared_log_is_read_without_a_word(shared):
    paths = [path for path in data_sets(shared) if path.parents[1].name != "ode"]  # plants as strangers logged them
    assert len(paths) > 10
    for path in paths:
        rig = read_rig(path, specs)
        train, test = (read_logs(path.parent / name, rig) for name in ("train", "test"))
        check_split(train, test)
        rows = [len(file.read_text().splitlines()) - 1 for file in sorted((path.parent / "train").glob("*.csv"))]
        assert train.data.y.shape == (len(rows), max(rows), len(rig.measured))
        np.testing.assert_array_equal(np.sum(train.data.valid, axis=1), rows)
        assert np.isfinite(test.data.y[test.data.valid]).all()


WRONG = {  # the change of arrays, and the place and finding
    "readings": (lambda d: d._replace(y=d.y[..., :0]),
        "y has 0 columns; give those of the rig in its order: theta1, dtheta1"),
    "dt": (lambda d: d._replace(t=2 * d.t), "sequence 0, row 1: t goes from 0 to 0.02 s, the rig has dt = 0.01 s"),
    "a late row": (lambda d: d._replace(t=d.t + 0.004 * (np.arange(5) == 3)),
        "sequence 0, row 3: t goes from 0.02 to 0.034 s"),
    "NaN": (lambda d: d._replace(u=np.where(np.arange(5)[:, None] == 2, np.nan, d.u)),
        "sequence 0, row 2: u is no number"),
}  # fmt: skip


@pytest.mark.parametrize("change, problem", WRONG.values(), ids=WRONG)
def test_arrays_that_are_not_of_the_rig_are_refused(change, problem):
    """Each mistake is refused by its place; padding does not count, a lost row and a missing reading are no mistake."""
    rig, t = dataclasses.replace(swing_rig(), dt=0.01), 0.01 * np.arange(5)
    good = pad([(t, np.zeros((5, 1)), np.full((5, 2), np.nan)), (t[[0, 1, 3]], np.zeros((3, 1)), np.zeros((3, 2)))])
    assert sequences_of(good, rig) is good
    assert logs_of_arrays(good, rig).files == ("sequence 0", "sequence 1")
    with pytest.raises(DataError, match=re.escape(problem)):
        sequences_of(change(good), rig)
