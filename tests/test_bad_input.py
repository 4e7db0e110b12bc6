"""Bad input, from end to end: each ends in one line that names file, row, column and the hint, and writes nothing."""

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from helpers import csv_text, rig_text, swing, with_field

from nnap_em.cli import identify as identify_command
from nnap_em.cli import main as cli
from nnap_em.errors import FitError

MODEL = 'type = "pendulum"\nm = 0.5\nlc = 0.4\nI = 0.002\ng = 9.81\nfriction = "unknown"\nactuated_joint = 1\n'
NOISE = "\n[measurement.noise_std]\ntheta1 = 0.005\ndtheta1 = 0.05\n"
RIG = rig_text(MODEL, ("theta1", "dtheta1")) + NOISE
COLUMNS = RIG[RIG.index("columns = ") :]


@pytest.fixture(scope="module")
def good(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("good")
    (folder / "rig.toml").write_text(RIG)
    for name, phase in (("train/00", 0.5), ("train/01", 0.0), ("test/00", 1.0)):
        path = folder / f"{name}.csv"
        path.parent.mkdir(exist_ok=True)
        path.write_text(csv_text(swing(phase=phase)))
    return folder


def _with(change: Callable) -> Callable[..., Callable[[Path], None]]:
    """A change of the folder, of the arguments that follow the folder."""
    return lambda *arguments: lambda folder: change(folder, *arguments)


@_with
def _log_file(folder: Path, change: Callable[[str], str | bytes]) -> None:
    """A change of train/01.csv."""
    path = folder / "train/01.csv"
    content = change(path.read_text())
    path.write_bytes(content if isinstance(content, bytes) else content.encode())


def _columns(change: Callable[[dict[str, np.ndarray]], dict[str, np.ndarray]]) -> Callable[[str], str]:
    """A change of the columns of train/01.csv before they are written."""
    return lambda _: csv_text(swing() | change(swing()))


def _column(name: str, change) -> Callable[[str], str]:
    return _columns(lambda log: {name: change(log[name])})


@_with
def _rig(folder: Path, old: str, new: str) -> None:
    """A change of rig.toml."""
    assert old in RIG
    (folder / "rig.toml").write_text(RIG.replace(old, new, 1))


def _both(*changes: Callable[[Path], object]) -> Callable[[Path], object]:
    return lambda folder: [change(folder) for change in changes]


@_with
def _everywhere(folder: Path, name: str, change) -> None:
    """A change of one column of all files."""
    for path in folder.glob("t*/*.csv"):
        log = np.genfromtxt(path, delimiter=",", names=True)
        columns = {other: log[other] for other in log.dtype.names}
        path.write_text(csv_text(columns | {name: change(columns[name])}))


@_with
def _cut(folder: Path, first: int, last: int) -> None:
    """test/01.csv: some rows of train/01.csv, their clock set back."""
    rows = {name: values[first:last] for name, values in swing().items()}
    (folder / "test/01.csv").write_text(csv_text(rows | {"time": rows["time"] - rows["time"][0]}))


LOGS = {  # name: (the change of train/01.csv, the words of the message: place | finding | hint)
    "blank file": (lambda _: "\n \n", "line 1 | empty | write a header"),
    "one row": (lambda s: "\n".join(s.splitlines()[:2]), "line 2 | found 1 row; | 2 rows or more"),
    "no header": (lambda s: s.split("\n", 1)[1],
        "line 1, column 'time' | missing | line 1 holds numbers: write a header"),
    "units": (lambda s: s.replace("\n", "\ns,N m,rad,rad/s\n", 1), "line 2 | 's,N m,rad | remove the row of units"),
    "column missing": (lambda s: s.replace("dtheta1", "speed"), "column 'dtheta1' | missing | possible here: speed"),
    "column misspelt": (lambda s: s.replace("dtheta1", "dteta1"), "'dtheta1' | missing | did you mean 'dteta1'?"),
    "column twice": (lambda s: s.replace("dtheta1", "theta1"), "column 'theta1' | 2 times | keep one"),
    "semicolons": (lambda s: s.replace(",", ";").replace(".", ","), "line 1 | missing | not ';'"),
    "decimal commas": (lambda s: s.replace(".", ","), "line 3 | found 8 fields under 4 names | decimals with '.'"),
    "text in a reading": (with_field(9, "theta1", "0.1 rad"),
        "line 9, column 'theta1' | '0.1 rad' | leave the field empty"),
    "blank line": (lambda s: s.replace("\n0.03,", "\n\n0.03,"), "line 5 | 1 field under 4 | every column a field"),
    "gap of half a row": (_column("time", lambda t: t + 0.004 * (np.arange(t.size) > 4)),
        "line 7, column 'time' | jitter: 0.04 | empty field"),
    "row twice": (lambda s: s.replace("\n0.04,", "\n0.03,"),
        "line 6, column 'time' | does not run on | resample to uniform rows with `nnap-em import` | (dt = 0.01 s)"),
    "jitter": (_column("time", lambda t: t + 0.0002 * (np.arange(t.size) == 7)),
        "line 9, column 'time' | jitter: 0.06 s, then 0.0702 s (2 places | resample"),
    "another dt": (_column("time", lambda t: 2 * t), "column 'time' | 0.02 s apart | correct [sampling] dt"),
    "late start": (_column("time", lambda t: t + 5), "line 2, column 'time' | starts at 5 s | clock = \"session\""),
    "never measured": (_column("theta1", lambda x: x * np.nan), "column 'theta1' | no sample | [measurement]"),
    "wrapped": (_column("theta1", lambda x: (x + 1.0) % (2.0 * np.pi)),
        "line 125, column 'theta1' | jumps by 6.283, in 2 places | --unwrap theta1"),
    "angle in degrees": (_column("theta1", np.degrees), "column 'theta1' | 57.3 times | write rad"),
    "rate in rpm": (_column("dtheta1", lambda x: x * 30 / np.pi), "column 'dtheta1' | 0.105 times | rpm: write rad/s"),
    "sign": (_column("dtheta1", np.negative), "column 'dtheta1' | minus column 'dtheta1' | turn the sign"),
    "angle and rate swapped": (_columns(lambda log: {"theta1": log["dtheta1"], "dtheta1": log["theta1"]}),
        "column 'theta1' | is the rate of 'dtheta1'; swap the names 'theta1'"),
}  # fmt: skip
FOLDERS = {  # name: (the change of the folder, the words of the message, the file first); more in test_rig.py
    "no rig": (lambda f: (f / "rig.toml").unlink(), "rig.toml | cannot be read | a folder with a rig.toml"),
    "rig no TOML": (_rig("m = 0.5", "m = 0,5"), "rig.toml | line 5 | not TOML | key = value"),
    "parameters missing": (_rig("lc = 0.4\nI = 0.002\n", ""), "rig.toml | [model] lc, I: missing (found only: type, m, "
        "g, friction, actuated_joint); write lc = 0.2 | , and so on"),
    "a folder for a file": (lambda f: [(f / "train/01.csv").unlink(), (f / "train/01.csv").mkdir()],
        "train/01.csv | cannot be read | check the path"),
    "bad test file": (lambda f: (f / "test/00.csv").write_text(csv_text(swing(phase=1.0)).replace("time", "tme")),
        "test/00.csv | line 1, column 'time' | did you mean 'tme'?"),
    "time and dt in ms": (_both(_rig("dt = 0.01", "dt = 10"), _everywhere("time", lambda t: 1000 * t)),
        "train/00.csv | column 'dtheta1' | times column | time and dt are in ms"),
    "test in train": (_cut(0, 201), "test file 01.csv | same content as train file 01.csv | remove one"),
    "a part of train in test": (_cut(100, 150),
        "test file 01.csv | row 1 and those after it are also in train file 01.csv, from row 101 | remove one"),
}  # fmt: skip
ERRORS = FOLDERS | {name: (_log_file(change), f"train/01.csv | {words}") for name, (change, words) in LOGS.items()}


WARNINGS = {  # what may be meant: name: (the change of the folder, the words of the warning)
    "gap": (_log_file(lambda s: s.replace(s.splitlines()[6] + "\n", "")),
        "line 7, column 'time' | a gap: 0.04 s, then 0.06 s (1 row missing in all) | inputs there are interpolated"),
    "gap in noisy inputs": (
        _log_file(lambda _: csv_text({name: np.delete(x, range(100, 110)) for name, x in swing().items()}
            | {"u": np.random.default_rng(0).normal(0.0, 0.1, 191)})),
        "line 102, column 'time' | a gap: 0.99 s, then 1.1 s (91 rows after it in all) | cannot be interpolated"),
    "spike": (_log_file(with_field(50, "theta1", "0.5")),
        "line 50, column 'theta1' | reading far from what the readings before and after say (spike) | first at 0.48"),
    "stuck": (_log_file(_column("theta1", lambda x: np.where(np.arange(x.size) // 40 == 2, x[80], x))),
        "line 83, column 'theta1' | 39 readings one value over again while the machine moves (stuck)"),
    "constant": (_log_file(_column("theta1", lambda x: 0 * x + 0.25)),
        "train/01.csv | column 'theta1' | constant at 0.25 | is the sensor alive?"),
    "degrees without a rate": (_both(
        _rig(COLUMNS, 'columns = ["theta1"]\n[measurement.noise_std]\ntheta1 = 0.005\n'),
        _log_file(_column("theta1", np.degrees))),
        "train/01.csv | column 'theta1' | turns at | is it in degrees?"),
    "another motion": (_log_file(_column("dtheta1", lambda x: np.sin(np.arange(x.size) / 11))),
        "train/01.csv | column 'dtheta1' | not the rate of 'theta1' | check units"),
    "overlapping sequences": (lambda f: (f / "train/02.csv").write_text(csv_text(swing(150))),
        "train file 02.csv | row 1 and those after it are also in train file 01.csv | cut sequences without overlap"),
    "input in N mm": (_everywhere("u", lambda x: 1e4 * x),
        "train: column u | gravity and inertia of joint 1 | look at its unit (N m)"),
    "length in mm": (_rig("lc = 0.4", "lc = 400"), "rig.toml | [model] lc | 400 | write it in m"),
}  # fmt: skip


def _identify(good: Path, change: Callable[[Path], object], place: Path) -> Path:
    """`nnap-em identify` on a broken copy; it must be refused and write nothing."""
    folder = place / "bench"
    shutil.copytree(good, folder)
    change(folder)
    before = sorted(place.rglob("*"))
    assert cli.main(["identify", str(folder), "--out", str(place / "out")]) == 2
    assert sorted(place.rglob("*")) == before
    return folder


@pytest.mark.parametrize("change, words", ERRORS.values(), ids=ERRORS)
def test_bad_input_is_refused_in_one_line(good, tmp_path, capsys, change, words):
    _identify(good, change, tmp_path)
    said = capsys.readouterr()
    assert said.out == ""
    (line,) = (line for line in said.err.splitlines() if "warning: " not in line)
    assert line.startswith("nnap-em: error: ")
    for word in words.split(" | "):
        assert word in line


@pytest.mark.parametrize("change, words", [(lambda _: None, ""), *WARNINGS.values()], ids=["good", *WARNINGS])
def test_what_is_doubtful_is_said_before_the_fit(good, tmp_path, capsys, monkeypatch, change, words):
    def stop(*_, **__):
        raise FitError("the fit would begin here")

    monkeypatch.setattr(identify_command, "resumable", stop)
    _identify(good, change, tmp_path)
    *warnings, last = capsys.readouterr().err.splitlines()
    assert last == "nnap-em: error: the fit would begin here"
    said = [line for line in warnings if line.startswith("nnap-em: warning: ")]
    assert any(all(word in line for word in words.split(" | ")) for line in said) if words else not warnings
