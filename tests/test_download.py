"""The recordings of `examples/measured_loop.py`: from a server that breaks off, lies, or is not there."""

import hashlib
import threading
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import numpy as np
import pytest
import recordings

pytest.importorskip("pooch", reason="no pooch, which downloads the recordings")
FILES = {f"experiment{i:02d}.csv": np.random.default_rng(i).bytes(300_000 + i) for i in range(1, 9)}


@contextmanager
def _server(answer):
    """Address of a server on this machine, and the requests that it got as (path, first byte)."""
    asked = []

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self):
            first = int(self.headers.get("Range", "bytes=0-").removeprefix("bytes=").removesuffix("-"))
            name = f"{self.path.split('/')[-2]}.csv"
            asked.append((name, first))
            answer(self, FILES[name], name, first, len([n for n, _ in asked if n == name]))

        def log_message(self, *_):
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}/", asked
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
    monkeypatch.setattr(recordings, "HASHES", {n: hashlib.sha256(b).hexdigest() for n, b in FILES.items()})
    monkeypatch.setattr("pooch.core.time.sleep", lambda _: None)


def _same(paths):
    return [path.name for path in paths] == list(FILES) and all(p.read_bytes() == FILES[p.name] for p in paths)


def test_files_are_downloaded_once(published, tmp_path):
    with _server(lambda h, body, name, first, time: _send(h, body, first)) as (address, asked):
        assert _same(recordings.downloaded(address, tmp_path))
        assert asked == [(name, 0) for name in FILES]
        assert _same(recordings.downloaded(address, tmp_path)) and len(asked) == len(FILES)


@pytest.mark.parametrize("ranges", [True, False], ids=["with ranges", "without ranges"])
def test_a_server_that_breaks_off_is_asked_for_the_rest(ranges, published, tmp_path):
    def answer(handler, body, name, first, time):
        _send(handler, body, first, size=100_000 if time == 1 else None, ranges=ranges)

    with _server(answer) as (address, asked):
        assert _same(recordings.downloaded(address, tmp_path))
    again = [first for name, first in asked if first]
    assert len(asked) == 2 * len(FILES) and len(again) == len(FILES) and all(0 < first <= 100_000 for first in again)


def test_a_later_run_goes_on_where_the_last_one_stopped(published, tmp_path):
    """The first run makes one connection, and gives up; the second makes none for the bytes that are there."""
    with (
        _server(lambda h, body, name, first, time: _send(h, body, first, size=100_000)) as (address, _),
        pytest.raises(recordings.RecordingError, match=r"experiment01\.csv: no connection to 127"),
    ):
        recordings.downloaded(address, tmp_path, retries=0)
    with _server(lambda h, body, name, first, time: _send(h, body, first)) as (address, asked):
        assert _same(recordings.downloaded(address, tmp_path))
    assert asked[0][0] == "experiment01.csv" and asked[0][1] > 50_000


def test_a_part_that_holds_all_is_begun_again(published, tmp_path):
    (tmp_path / "experiment01.csv.part").write_bytes(FILES["experiment01.csv"])

    def answer(handler, body, name, first, time):
        if first < len(body):
            _send(handler, body, first)
        else:
            handler.send_error(416)

    with _server(answer) as (address, _):
        assert _same(recordings.downloaded(address, tmp_path))


def test_a_server_that_lies_is_refused_by_name(published, tmp_path):
    def answer(handler, body, name, first, time):
        _send(handler, body[:-1] + b"x" if name == "experiment03.csv" else body, first)

    with (
        _server(answer) as (address, _),
        pytest.raises(recordings.RecordingError, match=r"experiment03\.csv: what 127.* is not the published file"),
    ):
        recordings.downloaded(address, tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"experiment01.csv", "experiment02.csv"}


def test_a_file_that_the_server_has_not_is_told_with_its_address(published, tmp_path):
    with (
        _server(lambda h, *_: h.send_error(404)) as (address, _),
        pytest.raises(recordings.RecordingError, match=r"answers 404 for .*/experiment01/trajectory\.csv; .*--from"),
    ):
        recordings.downloaded(address, tmp_path)


def test_without_a_server_one_sentence_says_what_to_do(published, tmp_path):
    with _server(lambda *_: None) as (address, _):
        pass  # from here on nobody listens there
    with pytest.raises(recordings.RecordingError, match=r"no connection to 127.*--from FOLDER$") as refused:
        recordings.downloaded(address, tmp_path)
    assert "\n" not in str(refused.value)


def test_files_of_a_folder_are_checked(published, tmp_path):
    for name, body in FILES.items():
        (tmp_path / name).write_bytes(body)
    assert _same(recordings.recordings(tmp_path))
    (tmp_path / "experiment05.csv").write_bytes(b"something else")
    with pytest.raises(recordings.RecordingError, match=r"experiment05\.csv: not the published file"):
        recordings.recordings(tmp_path)
    (tmp_path / "experiment05.csv").unlink()
    with pytest.raises(recordings.RecordingError, match=r"experiment05\.csv: not there"):
        recordings.recordings(tmp_path)


def test_the_files_beside_the_checkout_are_the_published_ones(shared):
    assert len(recordings.recordings(shared / "data/raw/dfki_c1_pert")) == 8
