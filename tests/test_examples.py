"""Examples: recordings from a server that breaks off or lies, laws taken out of measured torques, tanks, the tour."""

import hashlib
import re
import threading
from contextlib import contextmanager
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import matplotlib
import measured_loop
import numpy as np
import pytest
import recordings
import tanks
from helpers import nnap, optimised

import nnap_em
from nnap_em import read_logs, read_rig
from nnap_em.experiment.search import Effort
from nnap_em.storage.journal import Journal, keeping

TOUR = Path(__file__).resolve().parents[1] / "examples" / "tour.py"
FILES = {f"experiment{i:02d}.csv": np.random.default_rng(i).bytes(300_000 + i) for i in range(1, 9)}


@contextmanager
def _server(answer):
    """Address of a server on this machine, and the requests that it got as (file, first byte).

    `answer(handler, bytes of the file, its name, first byte, count of the requests for it)`.
    """
    requests = []

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self):
            first = int(self.headers.get("Range", "bytes=0-").removeprefix("bytes=").removesuffix("-"))
            name = f"{self.path.split('/')[-2]}.csv"
            requests.append((name, first))
            answer(self, FILES[name], name, first, len([n for n, _ in requests if n == name]))

        def log_message(self, *_):
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}/", requests
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


def _send(handler, body, first, size=None, ranges=True):
    """Answer with what follows the first byte, or as much of it as `size` bytes."""
    first = first if ranges else 0
    handler.send_response(206 if first else 200)
    handler.send_header("Content-Length", str(len(body) - first))
    handler.end_headers()
    handler.wfile.write(body[first:][:size])


@pytest.fixture
def published(monkeypatch):
    """Files of this test, as if they were those of the lab."""
    pytest.importorskip("pooch", reason="no pooch, which downloads the recordings")
    monkeypatch.setattr(recordings, "HASHES", {n: hashlib.sha256(b).hexdigest() for n, b in FILES.items()})
    monkeypatch.setattr("pooch.core.time.sleep", lambda _: None)


def _same(paths):
    return [path.name for path in paths] == list(FILES) and all(p.read_bytes() == FILES[p.name] for p in paths)


@pytest.mark.parametrize("ranges", [True, False], ids=["with ranges", "without ranges"])
def test_files_are_downloaded_once_from_a_server_that_breaks_off(ranges, published, tmp_path):
    def answer(handler, body, name, first, count):
        _send(handler, body, first, size=100_000 if count == 1 else None, ranges=ranges)

    with _server(answer) as (address, requests):
        assert _same(recordings.downloaded(address, tmp_path))
        rest = [first for _, first in requests if first]
        assert len(requests) == 2 * len(FILES) and len(rest) == len(FILES) and all(0 < n <= 100_000 for n in rest)
        assert _same(recordings.downloaded(address, tmp_path)) and len(requests) == 2 * len(FILES)


LIE = FILES["experiment03.csv"][:-9] + b"elsewhere"
REFUSALS = {
    "other bytes": (
        lambda h, body, name, first, count: _send(h, LIE if name == "experiment03.csv" else body, first),
        r"experiment03\.csv: what 127.* is not the published file",
    ),
    "no such file": (lambda h, *_: h.send_error(404), r"answers 404 for .*/experiment01/trajectory\.csv; .*--from"),
    "no server": (None, r"^[^\n]*no connection to 127[^\n]*--from FOLDER$"),
}


@pytest.mark.parametrize("answer, message", REFUSALS.values(), ids=REFUSALS)
def test_a_download_is_refused_by_name(answer, message, published, tmp_path):
    with _server(answer) as (address, _):
        if answer:
            with pytest.raises(recordings.RecordingError, match=message):
                recordings.downloaded(address, tmp_path)
    if not answer:  # nobody listens there any more
        with pytest.raises(recordings.RecordingError, match=message):
            recordings.downloaded(address, tmp_path)
    assert "experiment03.csv" not in {path.name for path in tmp_path.iterdir()}


def test_files_of_a_folder_are_checked(published, tmp_path):
    for name, body in FILES.items():
        (tmp_path / name).write_bytes(body)
    assert _same(recordings.recordings(tmp_path))
    (tmp_path / "experiment05.csv").write_bytes(b"something else")
    with pytest.raises(recordings.RecordingError, match=r"experiment05\.csv: not the published file"):
        recordings.recordings(tmp_path)


LAWS = {
    "torsional_spring": lambda q, v: -0.6 * (q - 0.2),
    "cogging": lambda q, v: 0.4 * np.sin(3 * q + 0.5),
    "eddy_brake": lambda q, v: -0.05 * np.cos(q - 0.5) ** 2 * v,
}
"""The laws of the page, written once more."""


def _columns(path):
    return np.genfromtxt(path, delimiter=",", names=True)


@pytest.fixture(scope="module")
def source(shared):
    """Two of the published files: `recordings` compares the hashes of all."""
    return recordings.recordings(shared / "data/raw/dfki_c1_pert")[:2]


@pytest.mark.parametrize("law", measured_loop.LAWS)
def test_a_law_is_taken_out_of_the_torque_of_its_joint_alone(law, source, tmp_path):
    (written,) = measured_loop.write_logs(source[:1], tmp_path / "logs", law)
    log, real = _columns(written), _columns(source[0])[: len(_columns(written))]
    assert 4.99 < log["time"][-1] <= 5.0
    q, v = real["pos_meas2"], real["vel_meas2"]
    np.testing.assert_allclose(log["tau_meas2"], real["tau_meas2"] - LAWS[law](q, v), atol=1e-7)
    for name in set(log.dtype.names) - {"tau_meas2"}:
        np.testing.assert_allclose(log[name], real[name], rtol=1e-8, atol=1e-8)


def test_the_import_keeps_the_law_as_its_mean_over_each_step(source, tmp_path):
    """Against the exact mean of the spring at the raw rows, each held until the next."""
    data = {}
    for name, law in (("recorded", None), ("planted", "torsional_spring")):
        logs = measured_loop.write_logs(source, tmp_path / name / "logs", law)
        out = tmp_path / name / "data"
        assert nnap("import", *logs, "--rig", measured_loop.RIG, "--out", out, "--test", 1) == 0
        data[name] = read_logs(out / "train", read_rig(out / "rig.toml")).data
    np.testing.assert_array_equal(data["planted"].y, data["recorded"].y)
    change = np.asarray(data["planted"].u - data["recorded"].u)[0]
    raw = _columns(source[0])
    whole = np.concatenate([[0.0], np.cumsum(0.6 * (raw["pos_meas2"][:-1] - 0.2) * np.diff(raw["time"]))])
    expected = np.diff(np.interp(0.01 * np.arange(len(change)), raw["time"], whole)) / 0.01
    np.testing.assert_allclose(change[:-1, 1], expected, atol=1e-6)
    np.testing.assert_array_equal(change[:, 0], 0.0)
    assert data["recorded"].y.shape == (1, 500, 2)


NOISE = 0.016
"""Standard deviation of a reading of the simulated level [V]."""


def _tanks(rows: int = 256):
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


def _published_tanks(parts, folder):
    """The file of the benchmark: its sample interval stands in the first row alone, and a comma ends every row."""
    columns = zip(parts["est"][:, 1], parts["test"][:, 1], parts["est"][:, 2], parts["test"][:, 2], strict=True)
    rows = [",".join(f"{value:.10g}" for value in row) + (",," if i else ",4,") for i, row in enumerate(columns)]
    (folder / tanks.PUBLISHED).write_text("\n".join(['"uEst","uVal","yEst","yVal","Ts",', *rows]) + "\n")


def test_both_forms_of_the_tanks_and_their_data_set_are_the_same(tmp_path):
    parts = _tanks(64)
    for name in ("published", "two"):
        (tmp_path / name).mkdir()
    _published_tanks(parts, tmp_path / "published")
    for part, rows in parts.items():
        np.savetxt(tmp_path / "two" / f"{part}.csv", rows, delimiter=",", header="time,u,y", comments="")
    for name in ("published", "two"):
        read = tanks.recordings(tmp_path / name)
        for part, rows in parts.items():
            np.testing.assert_allclose(read[part], rows, rtol=1e-9)
    tanks.write(parts, tmp_path)
    rig = read_rig(tmp_path / "rig.toml")
    for part, folder in (("est", "train"), ("test", "test")):
        data = read_logs(tmp_path / folder, rig).as_read
        np.testing.assert_allclose(np.concatenate([data.u[0], data.y[0]], axis=1), parts[part][:, 1:], rtol=1e-9)


@pytest.mark.parametrize(
    "example, file", [(tanks, "est.csv"), (measured_loop, "experiment01.csv")], ids=["tanks", "measured loop"]
)
def test_a_folder_without_the_recordings_is_refused_in_one_sentence(example, file, tmp_path, monkeypatch, capsys):
    out = tmp_path / "out"
    monkeypatch.setattr("sys.argv", ["example.py", "--from", str(tmp_path), "--out", str(out)])
    assert example.main() == 1
    error = capsys.readouterr().err
    assert error.startswith("error: ") and f"{file}: not there" in error and error.count("\n") == 1
    assert not out.exists()


@pytest.mark.slow  # fast: test_equation_commands.py
def test_the_tanks_run_from_the_recordings_to_the_figure(tmp_path, monkeypatch, capsys):
    """Nothing is missing in the simulated machine, and its levels are predicted to the noise of the readings."""
    _published_tanks(_tanks(), tmp_path)
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


@pytest.mark.slow  # fast: test_docs.py, README.md
def test_the_tour_runs_and_finds_the_cable(tmp_path, monkeypatch, capsys):
    """The truth is 30 N/m; the stated standard deviation holds it."""
    monkeypatch.chdir(tmp_path)
    small = Effort(pool=16, batch=16, rounds=2, tries=4)  # test_design.py tests the quality of a design
    monkeypatch.setattr(nnap_em, "design", partial(nnap_em.design, effort=small))
    matplotlib.use("agg")
    names = {"__name__": "tour"}
    with keeping(Journal(tmp_path / "steps")):  # the search begins with the fit of the cell before
        for cell in re.split(r"(?m)^# %%", TOUR.read_text())[1:]:
            if not cell.startswith(" [markdown]\n"):
                exec(compile(cell.partition("\n")[2], str(TOUR), "exec"), names)
    (finding,) = names["found"]
    number = finding.parameters["k"]
    assert finding.effect.name == "torsional_spring"
    assert abs(number.value - 30.0) < max(3 * number.std, 1.0)
    before, after = (names["error"][side]["x"] for side in ("before", "after"))
    assert after[-1] < 0.5 * before[-1]
    assert names["design"].u.shape[0] == 2
    assert "torsional spring" in capsys.readouterr().out
