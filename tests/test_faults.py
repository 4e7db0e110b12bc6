"""kill -9, Ctrl-C and disks that are full: the last good state is kept and told, and the numbers are those of no fault.

Every kind of fault hits a command whose steps cost nothing, in this process.  One run of `diagnose` is killed in a
process of its own and goes on to its end.
"""

import errno
import functools
import json
import math
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import plant
import pytest
from helpers import begun
from shell import ENVIRONMENT

from nnap_em.base import files, journal
from nnap_em.base.digest import digest
from nnap_em.base.journal import HERE, Journal, keeping, step
from nnap_em.cli import identify as identify_command
from nnap_em.cli import main as cli
from nnap_em.cli.identify import MISFIT_STATUS
from nnap_em.logs.read import read_logs
from nnap_em.machines.rig import read_rig
from nnap_em.machines.systems import specs
from nnap_em.model.effects import catalogue

SPRING = {"name": "torsional_spring", "joint": 1, "k": 20.0, "theta0": 0.05}
SLIDE = plant.Case(system="slide", sequences=8, tests=1, steps=95, seed=2, noise=(5e-4, 5e-3), effects=(SPRING,))


def numbers(out: Path) -> dict:
    """Everything that a run leaves behind but the seconds that it took."""
    contents: dict = {}
    for path in sorted(out.glob("*.npz")):
        with np.load(path) as stored:
            arrays = {n: stored[n].tobytes() for n in stored.files if n not in ("header", "sha256")}
            header = json.loads(stored["header"].tobytes())
            header.pop("notes")
            contents[path.name] = arrays, header
    for path in sorted(out.glob("*.csv")):
        contents[path.name] = path.read_bytes()
    report = json.loads((out / "report.json").read_text())
    report.pop("seconds")
    for epoch in report.get("epochs", []):
        epoch.pop("seconds")
    return contents | {"report": report}


@pytest.fixture(scope="module")
def rig(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("faults") / "rig"
    plant.write(SLIDE, folder)
    shutil.rmtree(folder / "test")  # nothing to predict: it is the fits that are broken off
    return folder


def _order(command: str, rig: Path, out: Path, *more: str) -> list[str]:
    return [command, str(rig), "--out", str(out), *more]


def _last_line(said: str) -> str:
    """The last line, which is no traceback."""
    assert "Traceback" not in said, said
    return said.strip().splitlines()[-1]


DENIED = PermissionError(errno.EACCES, os.strerror(errno.EACCES))


class Killed(BaseException):
    """State of the disk after SIGKILL: no command catches it."""


def _faulty(kind: str, when: int | str):
    """`files.replace_bytes` with a fault at its n-th call, or at the file of a name."""
    whole, count = files.replace_bytes, 0

    def replace_bytes(path: Path, content: bytes) -> None:
        nonlocal count
        count += 1
        if when not in (count, path.name):
            return whole(path, content)
        if kind in ("in a write", "before the rename"):
            path.parent.mkdir(parents=True, exist_ok=True)
            part = path.with_name(f".{path.name}.{os.getpid()}.part")
            part.write_bytes(content[: len(content) // 2] if kind == "in a write" else content)
        elif kind in ERRORS:
            limits = resource.getrlimit(resource.RLIMIT_FSIZE)
            with pytest.MonkeyPatch.context() as patch:
                if kind == "full disk":
                    resource.setrlimit(resource.RLIMIT_FSIZE, (len(content) // 2, limits[1]))
                else:
                    patch.setattr(files.os, "replace", mock.Mock(side_effect=DENIED))
                try:
                    whole(path, content)
                finally:
                    resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        else:
            if kind != "Ctrl-C before a write":
                whole(path, content)
            if kind != "after a write":
                os.kill(os.getpid(), signal.SIGINT)
        raise Killed

    return replace_bytes


@step(lambda *_: HERE)
def _toy(x, i):
    return np.cos(x + i)


def _steps_of_a_toy() -> np.ndarray:
    x = np.arange(3.0)
    for i in range(12):
        x = _toy(x, i)
    return x


TOY = functools.reduce(lambda x, i: math.cos(x + i), range(12), 0.0)
"""The first number of the toy by hand."""
ERRORS = {"full disk": "File too large", "unwritable": "Permission denied"}
FAULTS: list[tuple[str, int | str]] = [
    ("in a write", 1),
    ("in a write", 3),
    ("before the rename", 2),
    ("after a write", 1),
    ("full disk", 2),
    ("Ctrl-C before a write", 2),
    ("Ctrl-C after a write", 1),
    ("unwritable", 2),
    ("in a write", "model.npz"),
    ("Ctrl-C after a write", "model.npz"),
    ("in a write", "friction.csv"),
    ("full disk", "friction.csv"),
    ("before the rename", "report.json"),
]


def test_a_chain_of_all_faults_is_survived(rig, tmp_path, monkeypatch, capsys):
    """One run that meets all the faults, one after the other, and then goes on to its end; numbers as of no fault."""
    declared = read_rig(rig / "rig.toml", specs)
    fitted = begun(declared, read_logs(rig / "train", declared).data)

    def identify(rig, data, *, watch, **_):  # twelve steps of NumPy, whose numbers stand for log-likelihoods
        state = fitted.state._replace(loglik=_steps_of_a_toy())
        watch(state, data.t.shape[1], np.ones(len(data.t), bool))
        return fitted._replace(state=state)

    monkeypatch.setattr(identify_command, "identify", identify)
    assert cli.main(_order("identify", rig, tmp_path / "whole")) == 0
    capsys.readouterr()
    out, kept = tmp_path / "broken", 0
    for kind, when in FAULTS:
        with monkeypatch.context() as patch:
            patch.setattr(files, "replace_bytes", _faulty(kind, when))
            try:
                code = cli.main(_order("identify", rig, out))
            except Killed:
                code = None
        said = capsys.readouterr().err
        if "Ctrl-C" in kind:
            assert code == 130
            assert re.search(r"stopped .*; the same command goes on", _last_line(said))
        elif kind in ERRORS:
            assert code == 2
            file = when if isinstance(when, str) else r"unfinished/_toy-\w+\.npz"
            assert re.search(
                rf"error: .*{file}: {ERRORS[kind]}; stopped .*; the same command goes on", _last_line(said)
            )
            assert not list(out.rglob(".*.part"))
        else:
            assert code is None
        steps = len(list(out.glob("unfinished/*.npz")))
        assert steps >= kept  # nothing is lost
        kept = steps
    assert kept == 12
    assert cli.main(_order("identify", rig, out)) == 0
    assert "12 finished steps in" in capsys.readouterr().err
    assert not list(out.rglob(".*.part")) and not (out / "unfinished").exists()
    left = numbers(out)
    assert left == numbers(tmp_path / "whole")
    assert left["report"]["log_likelihood"][0] == pytest.approx(TOY)


def _steps(out: Path) -> list[int]:
    """Tells one state of the finished steps from the next."""
    return sorted(path.stat().st_mtime_ns for path in out.glob("unfinished/*.npz"))


def _diagnosed(rig: Path, out: Path, *more: str, kind: signal.Signals | None = None, count: int = 0) -> tuple[int, str]:
    """Exit status and stderr of a search in its own process, which gets a signal after `count` new finished steps."""
    program = [sys.executable, "-m", "nnap_em.cli.main", *_order("diagnose", rig, out, *more)]
    run = subprocess.Popen(program, env=ENVIRONMENT, stderr=subprocess.PIPE, text=True)
    before = _steps(out)
    while kind and run.poll() is None and count:
        time.sleep(0.005)
        steps = _steps(out)
        count, before = count - (steps != before), steps
    if kind:
        assert run.poll() is None, "it was over too soon"
        run.send_signal(kind)
    _, said = run.communicate(timeout=600)  # it compiles, on a machine that may be busy
    return run.returncode, said


@pytest.mark.slow  # fast: test_a_chain_of_all_faults_is_survived
def test_a_search_that_is_killed_stopped_and_out_of_time_goes_on_to_the_same_numbers(rig, tmp_path):
    """By SIGKILL, then by Ctrl-C, then with an answer after the first fit, since no more time is left."""
    whole, out = tmp_path / "whole", tmp_path / "broken"
    code, said = _diagnosed(rig, whole, "--quiet")
    assert code == 0, said
    code, said = _diagnosed(rig, out, kind=signal.SIGKILL, count=4)
    assert code == -signal.SIGKILL, said
    code, said = _diagnosed(rig, out, kind=signal.SIGINT, count=2)
    assert code == 130, said
    assert re.search(r"stopped .*; the same command goes on", _last_line(said))
    steps = len(_steps(out))
    code, said = _diagnosed(rig, out, "--minutes", "0.001")
    assert code == MISFIT_STATUS and re.search(r"\[\d+:\d\d over\] ", said), said
    assert re.search(r"finished steps? kept; the same command goes on", _last_line(said))
    report = json.loads((out / "report.json").read_text())
    assert not report["complete"] and not report["effects"]
    assert "The search was not finished" in report["verdict"] and report["verdict"] in said
    assert "No effect of the catalogue" not in (out / "report.html").read_text()
    assert len(_steps(out)) >= steps
    code, said = _diagnosed(rig, out)
    assert code == 0 and "those of this run are not done again" in said, said
    assert not list(out.rglob(".*.part")) and not (out / "unfinished").exists()
    left = numbers(out)
    assert left == numbers(whole)
    assert all(len(left[name][0]) > 20 for name in left if name.endswith(".npz"))
    assert [effect["name"] for effect in left["report"]["effects"]] == ["torsional_spring"]


def _flipped(content: bytes) -> bytes:
    """One bit of the numbers, which stand before the directory of the zip."""
    place = content.rindex(b"PK\x01\x02", 0, content.rindex(b"PK\x01\x02")) - 8
    return content[:place] + bytes([content[place] ^ 1]) + content[place + 1 :]


DAMAGED = {
    "whole": lambda content: content,
    "empty": lambda content: b"",
    "truncated": lambda content: content[: len(content) // 2],
    "almost whole": lambda content: content[:-1],
    "text": lambda content: b"time,u\n0,1\n",
    "a bit": _flipped,
}
"""Damages of a finished step."""


def test_a_step_that_is_damaged_or_of_another_version_is_done_again(tmp_path, monkeypatch):
    written, keep = [], Journal.keep
    monkeypatch.setattr(Journal, "keep", lambda *of: (written.append(of[1]), keep(*of))[1])

    def done() -> int:
        written.clear()
        with keeping(Journal(tmp_path)):
            assert _steps_of_a_toy()[0] == pytest.approx(TOY)
        return len(written)

    assert done() == 12
    for name, change in DAMAGED.items():
        first = min(tmp_path.glob("*.npz"))
        first.write_bytes(change(first.read_bytes()))
        assert done() == (name != "whole"), name
    monkeypatch.setattr(journal, "surroundings", lambda: "after an edit")
    assert done() == 12


def test_clearing_leaves_what_is_not_ours(tmp_path):
    kept = Journal(tmp_path)
    kept.keep(f"work-{32 * '0'}", np.zeros(3))
    (tmp_path / "mine.npz").write_text("mine")
    kept.clear()
    assert [path.name for path in tmp_path.iterdir()] == ["mine.npz"]


def test_the_digest_tells_apart_what_is_not_the_same():
    def drag(c, joint):
        return catalogue["air_drag"](jnp.asarray(c), joint=joint)

    one = drag(1.0, 1)
    assert digest(one) == digest(drag(1.0, 1))
    others = [
        *(one, drag(1.0, 2), drag(np.nextafter(1.0, 2.0), 1)),
        *(catalogue[name](jnp.asarray(1.0), joint=1) for name in ("payload", "link_inertia", "motor_gain")),
        *((one, extra) for extra in (1, 1.0, "1", None, True, (1,), [1], {"1": 1}, jnp.tanh, jnp.sinh)),
        *(np.zeros(2, dtype) for dtype in (np.float32, np.float64, np.int64)),
        *(np.zeros(shape) for shape in ((2, 3), (3, 2), (6,))),
        *(jax.random.key(seed) for seed in (0, 1)),
        -0.0,
        0.0,
    ]
    assert len({digest(other) for other in others}) == len(others)
    with pytest.raises(TypeError, match="object cannot be distinguished"):
        digest(object())
