"""`examples/tanks.py`: the published recordings in both forms, its data set, and the whole of it on a simulated one."""

import re

import numpy as np
import pytest
import tanks
from helpers import optimised

from nnap_em import read_logs, read_rig

NOISE = 0.016
"""Standard deviation of a reading of the simulated level [V]."""


def _recordings(rows: int = 256):
    """Euler steps of a tenth of a second of both tanks; the reading ends at 10 V."""
    rng, out = np.random.default_rng(0), {}
    for part in ("est", "test"):
        u = np.repeat(rng.uniform(1.0, 2.8, rows // 16), 16)
        x, y = np.array([4.0, 5.0]), []
        for one in u:
            y.append(min(x[1] + NOISE * rng.standard_normal(), 10.0))
            for _ in range(40):
                flow = 0.055 * np.sqrt(x[0])
                x = x + 0.1 * np.array([0.05 * one - flow, flow - 0.05 * np.sqrt(x[1])])
        out[part] = np.column_stack([4.0 * np.arange(rows), u, y])
    return out


def _published(parts, folder):
    """The file of the benchmark: its sample interval stands in the first row alone, and a comma ends every row."""
    columns = zip(parts["est"][:, 1], parts["test"][:, 1], parts["est"][:, 2], parts["test"][:, 2], strict=True)
    rows = [",".join(f"{value:.10g}" for value in row) + (",," if i else ",4,") for i, row in enumerate(columns)]
    (folder / tanks.PUBLISHED).write_text("\n".join(['"uEst","uVal","yEst","yVal","Ts",', *rows]) + "\n")


def test_both_forms_of_the_recordings_are_the_same(tmp_path):
    parts = _recordings(32)
    for name in ("published", "two"):
        (tmp_path / name).mkdir()
    _published(parts, tmp_path / "published")
    for part, rows in parts.items():
        np.savetxt(tmp_path / "two" / f"{part}.csv", rows, delimiter=",", header="time,u,y", comments="")
    for name in ("published", "two"):
        read = tanks.recordings(tmp_path / name)
        for part, rows in parts.items():
            np.testing.assert_allclose(read[part], rows, rtol=1e-9)


def test_the_data_set_is_read_as_the_recordings_are(tmp_path):
    parts = _recordings(64)
    tanks.write(parts, tmp_path)
    rig = read_rig(tmp_path / "rig.toml")
    for part, folder in (("est", "train"), ("test", "test")):
        data = read_logs(tmp_path / folder, rig).as_read
        np.testing.assert_allclose(np.asarray(data.u)[0, :, 0], parts[part][:, 1], rtol=1e-9)
        np.testing.assert_allclose(np.asarray(data.y)[0, :, 0], parts[part][:, 2], rtol=1e-9)


def test_a_folder_without_the_recordings_is_refused_in_one_sentence(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["tanks.py", "--from", str(tmp_path), "--out", str(tmp_path / "out")])
    assert tanks.main() == 1
    error = capsys.readouterr().err
    assert error.startswith("error: ") and "est.csv: not there" in error and error.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_a_file_with_other_columns_is_refused(tmp_path):
    (tmp_path / tanks.PUBLISHED).write_text("u,y\n1,2\n")
    with pytest.raises(tanks.RecordingError, match="no columns uEst"):
        tanks.recordings(tmp_path)


def test_the_error_is_that_after_the_first_fifty_readings():
    t = 4.0 * np.arange(100)
    side = tanks.Simulation(t, np.where(t <= 196, 9.0, 1.0), np.full(100, 1.5))
    assert side.error == pytest.approx(0.5)


@pytest.mark.slow  # fast: test_equation_commands.py
def test_it_runs_from_the_recordings_to_the_figure(tmp_path, monkeypatch, capsys):
    """Nothing is missing in the simulated machine, and its levels are predicted to the noise of the readings."""
    _published(_recordings(), tmp_path)
    out = tmp_path / "out"
    monkeypatch.setattr("sys.argv", ["tanks.py", "--from", str(tmp_path), "--out", str(out)])
    with optimised():
        assert tanks.main() == 0
    printed = capsys.readouterr().out
    assert "\nNothing is missing that these data could show" in printed
    errors = [float(value) for value in re.findall(r": ([\d.]+) V", printed)]
    np.testing.assert_allclose(errors, [NOISE, NOISE], rtol=0.15)  # 100 rows
    assert (out / "tanks.png").stat().st_size > 10_000 and (out / "found" / "report.html").exists()
    file = out / "rig" / "test" / "test.csv"
    table = np.loadtxt(file, delimiter=",", skiprows=1)
    table[60, 2] = 10.0  # the end of the range, which no fit reads
    np.savetxt(file, table, delimiter=",", header="time,u,y", comments="")
    side = tanks.simulated(out / "fit" / "model.npz", out / "rig")
    assert side.reading[60] == 10.0 and 0.1 < side.error < 10.0
