"""kill -9, Ctrl-C and disks that are full: the last good state is kept and told, and the numbers are those of no fault.

The commands run in processes of their own and are really killed: between writes, in the middle of one, and at moments
drawn from a seed.
"""

import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import plant
import pytest
from faults import numbers
from shell import ENVIRONMENT

from nnap_em.commands import check as check_command
from nnap_em.commands import cli
from nnap_em.effects import catalogue
from nnap_em.storage import files, journal
from nnap_em.storage.files import StoreError, sweep
from nnap_em.storage.journal import HERE, Journal, digest, keeping, step

SPRING = {"name": "torsional_spring", "joint": 1, "k": 20.0, "theta0": 0.05}
SLIDE = plant.Case(system="slide", sequences=6, tests=1, steps=80, seed=2, noise=(5e-4, 5e-3), effects=(SPRING,))
FOUND = {"identify": [], "diagnose": ["torsional_spring"]}
IDENTIFY, DIAGNOSE = ("identify", "--epochs", "14"), ("diagnose",)
FAULTY = """
import errno, os, resource, signal, sys, types
from nnap_em.commands import cli
from nnap_em.storage import files

fault, when = sys.argv[1:3]
whole, count = files.replace_bytes, 0


def denied(*_):
    raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))


def replace_bytes(path, content):
    global count
    if path.parent.name == "traced":  # programs for other runs: how many are missing is no part of this one
        return whole(path, content)
    count += 1
    if now := when in (str(count), path.name):
        if fault in ("in a write", "before the rename"):
            part = path.with_name(f".{path.name}.{os.getpid()}.part")
            path.parent.mkdir(parents=True, exist_ok=True)
            part.write_bytes(content[: len(content) // 2] if fault == "in a write" else content)
        if fault == "full disk":
            resource.setrlimit(resource.RLIMIT_FSIZE, (len(content) // 2, resource.RLIM_INFINITY))
        elif fault == "unwritable":
            files.os = types.SimpleNamespace(replace=denied, getpid=os.getpid, fsync=os.fsync)
        elif fault == "Ctrl-C before a write":
            os.kill(os.getpid(), signal.SIGINT)
        elif fault != "after a write":
            os.kill(os.getpid(), signal.SIGKILL)
    whole(path, content)
    if now:
        os.kill(os.getpid(), signal.SIGINT if fault == "Ctrl-C after a write" else signal.SIGKILL)


files.replace_bytes = replace_bytes
sys.exit(cli.main(sys.argv[3:]))
"""


@pytest.fixture(scope="module")
def rig(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("faults") / "rig"
    plant.write(SLIDE, folder)
    shutil.rmtree(folder / "test")  # nothing to predict: it is the fits that are broken off
    return folder


def _order(command, rig: Path, out: Path, *more) -> list[str]:
    return [command[0], str(rig), "--out", str(out), *command[1:], *more]


def _start(order: list[str], fault: str = "", when: int | str = 0) -> subprocess.Popen:
    first = ["-c", FAULTY, fault, str(when)] if fault else ["-m", "nnap_em.commands.cli"]
    return subprocess.Popen([sys.executable, *first, *order], env=ENVIRONMENT, stderr=subprocess.PIPE, text=True)


def _written(out: Path) -> list[int]:
    """Tells one state of the finished steps from the next."""
    return sorted(path.stat().st_mtime_ns for path in out.glob("unfinished/*.npz"))


def _fault_at_some_time(order: list[str], out: Path, kind: signal.Signals, count: int, delay: float):
    """A signal from outside, some time after a number of new finished steps."""
    run, before = _start(order), _written(out)
    while run.poll() is None and count:
        time.sleep(0.005)
        now = _written(out)
        count, before = count - (now != before), now
    time.sleep(delay)
    assert run.poll() is None, "it was over too soon"
    run.send_signal(kind)
    _, said = run.communicate(timeout=120)
    return run.returncode, said


def _told(said: str) -> str:
    """The last line, which is no traceback."""
    assert "Traceback" not in said, said
    return said.strip().splitlines()[-1]


KILLS = ("in a write", "before the rename", "after a write")
ERRORS = {"full disk": "File too large", "unwritable": "Permission denied"}
LONG, SHORT = 4.0, 0.3
"""Seconds within which a moment is drawn: of the start of a command, of a step."""
Fault = tuple[str, int | str]
"""What happens, and at which write (or after how many, where it comes from outside)."""


def _meet(fault: Fault, order: list[str], out: Path, rng: random.Random) -> tuple[int, str]:
    kind, when = fault
    if kind in ("kill", "Ctrl-C"):
        assert isinstance(when, int)
        delay = rng.uniform(0.0, SHORT if when else LONG)
        return _fault_at_some_time(order, out, signal.SIGKILL if kind == "kill" else signal.SIGINT, when, delay)
    run = _start(order, kind, when)
    _, said = run.communicate(timeout=300)
    return run.returncode, said


def _survives(command, rig: Path, out: Path, faults: list[Fault]) -> None:
    """One run that meets all the faults, one after the other, and then goes on to its end."""
    rng = random.Random(1)
    more: list[str] = []
    for fault in faults:
        code, said = _meet(fault, _order(command, rig, out, *more), out, rng)
        if fault[0] in (*KILLS, "kill"):
            assert code == -signal.SIGKILL, said
        elif "Ctrl-C" in fault[0]:
            assert code == 130, said
            assert re.search(rf"stopped .*; to go on: nnap-em {command[0]} .*--resume", _told(said))
        else:
            assert code == 2, said
            reason = rf"error: .*unfinished/\w+-\w+\.npz: {ERRORS[fault[0]]}; stopped .*; to go on: .*--resume"
            assert re.search(reason, _told(said)), said
            assert not list(out.rglob(".*.part"))
        more = ["--resume"]
    run = _start(_order(command, rig, out, *more))
    _, said = run.communicate(timeout=300)
    assert run.returncode == 0, said
    assert "resumed" in said
    assert not list(out.rglob(".*.part"))
    assert not (out / "unfinished").exists()


CHAINS: dict[str, list[Fault]] = {
    "identify": [
        ("kill", 0),
        ("in a write", 2),
        ("before the rename", 2),
        ("after a write", 1),
        ("full disk", 2),
        ("Ctrl-C", 1),
        ("kill", 1),
        ("in a write", "friction.csv"),
    ],
    "diagnose": [
        ("kill", 0),
        ("in a write", 9),
        ("kill", 6),
        ("full disk", 4),
        ("before the rename", 5),
        ("Ctrl-C", 4),
        ("Ctrl-C before a write", 3),
        ("unwritable", 3),
        ("after a write", "before.npz"),
    ],
}


@pytest.mark.slow
@pytest.mark.parametrize("command", [IDENTIFY, DIAGNOSE], ids=lambda command: command[0])
def test_a_chain_of_faults_is_survived(rig, tmp_path, command):
    """The numbers are those of an unbroken run."""
    whole = _start(_order(command, rig, tmp_path / "whole"))
    _, said = whole.communicate(timeout=300)
    assert whole.returncode == 0, said
    _survives(command, rig, tmp_path / "broken", CHAINS[command[0]])
    left = numbers(tmp_path / "broken")
    assert left == numbers(tmp_path / "whole")
    assert all(len(left[name][0]) > 20 for name in left if name.endswith(".npz"))
    assert [effect["name"] for effect in left["report"].get("effects", [])] == FOUND[command[0]]


# --- files that are not what they should be


@pytest.fixture(scope="module")
def stopped(rig) -> dict[str, Path]:
    """What each command has kept when it was killed, by the name of the command."""
    outs = {}
    for command, count in ((IDENTIFY, 1), (DIAGNOSE, 2)):
        out = outs[command[0]] = rig.parent / f"stopped {command[0]}"
        run = _start(_order(command, rig, out), "after a write", count)
        run.communicate(timeout=300)
        assert run.returncode == -signal.SIGKILL
    return outs


def _first(out: Path) -> Path:
    return min(out.glob("unfinished/*.npz"))


def _cut(share: float):
    def change(out: Path, rig: Path) -> None:
        content = _first(out).read_bytes()
        _first(out).write_bytes(content[: int(share * len(content))])

    return change


def _wrong_number(out: Path, rig: Path) -> None:
    with np.load(_first(out)) as stored:
        arrays = {name: stored[name] for name in stored.files}
    name = next(n for n, a in arrays.items() if a.dtype == np.float64 and a.size)
    np.savez(_first(out), **arrays | {name: arrays[name] + 1e-9})


def _edit(name: str, old: str, new: str):
    def change(out: Path, rig: Path) -> None:
        assert old in (rig / name).read_text()
        (rig / name).write_text((rig / name).read_text().replace(old, new, 1))

    return change


def _other_data(out: Path, rig: Path) -> None:
    path = min((rig / "train").glob("*.csv"))
    lines = path.read_text().splitlines()
    path.write_text("\n".join(lines[:-1]) + "\n")


REFUSED = {
    "empty": (_cut(0.0), (), r"damaged or cut short \(0 bytes\)"),
    "truncated": (_cut(0.4), (), "damaged or cut short"),
    "almost whole": (_cut(0.999), (), "damaged or cut short"),
    "text": (lambda out, rig: _first(out).write_text("time,u\n0,1\n"), (), "damaged or cut short"),
    "npz": (lambda out, rig: np.savez(_first(out), x=np.zeros(3)), (), "damaged or cut short"),
    "number": (_wrong_number, (), "checksum does not hold"),
    "rig": (_edit("rig.toml", "m = 1.0", "m = 1.1"), (), r"made from another rig\.toml; leave --resume out"),
    "data": (_other_data, (), "made from another training data; leave --resume out"),
    "seed": (lambda out, rig: None, ("--seed", "3"), "made with --seed 0, not 3; resume with --seed 0"),
}


@pytest.mark.parametrize("command", [IDENTIFY, DIAGNOSE], ids=["identify", "diagnose"])
@pytest.mark.parametrize("change, options, reason", REFUSED.values(), ids=REFUSED)
def test_what_is_no_state_of_this_run_is_refused(rig, stopped, tmp_path, capsys, command, change, options, reason):
    out, copy = tmp_path / "out", tmp_path / "rig"
    shutil.copytree(stopped[command[0]], out)
    shutil.copytree(rig, copy)
    change(out, copy)
    before = {path: path.read_bytes() for path in out.rglob("*.npz")}
    assert cli.main(_order(command, copy, out, "--resume", *options)) == 2
    assert re.search(rf"error: {_first(out)}: .*{reason}", _told(capsys.readouterr().err))
    assert {path: path.read_bytes() for path in out.rglob("*.npz")} == before


def test_steps_of_another_version_are_refused(rig, stopped, tmp_path, capsys, monkeypatch):
    out = tmp_path / "out"
    shutil.copytree(stopped["diagnose"], out)
    with monkeypatch.context() as patch:
        patch.setattr(journal, "__version__", "9.9")
        assert cli.main(_order(DIAGNOSE, rig, out, "--resume")) == 2
    reason = rf"{_first(out)}: made by nnap_em 0\S* and jax {jax.__version__}, this is nnap_em 9\.9 .*; leave --resume"
    assert re.search(reason, _told(capsys.readouterr().err))
    monkeypatch.setattr(journal, "KIND", journal.KIND._replace(format=2))
    assert cli.main(_order(DIAGNOSE, rig, out, "--resume")) == 2
    assert re.search(rf"{_first(out)}: format 1 .*, this version reads format 2", _told(capsys.readouterr().err))


@pytest.mark.parametrize("command", [IDENTIFY, DIAGNOSE], ids=["identify", "diagnose"])
def test_a_folder_that_cannot_be_is_refused_before_the_work(rig, tmp_path, capsys, command):
    (tmp_path / "file").write_text("")
    assert cli.main(_order(command, rig, tmp_path / "file" / "out")) == 2
    assert _told(capsys.readouterr().err) == f"nnap-em: error: {tmp_path}/file/out: Not a directory"


def test_ctrl_c_leaves_no_half_data_set(tmp_path, monkeypatch, capsys):
    def stop(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("nnap_em.commands.simulate.write_csv", stop)
    order = ["simulate", str(tmp_path / "new"), "--system", "slide", "--sequences", "1", "--test", "0", "--steps", "9"]
    assert cli.main(order) == 130
    assert _told(capsys.readouterr().err) == "nnap-em: stopped; the files that were written are whole"
    assert not list(tmp_path.iterdir())


def test_ctrl_c_that_a_garbage_collection_swallows_stops_at_the_next_line(tmp_path, monkeypatch, capsys):
    class Litter:
        def __del__(self):
            os.kill(os.getpid(), signal.SIGINT)

    def lost(args, say):
        litter = Litter()
        del litter
        say("one line")
        raise AssertionError

    monkeypatch.setattr(check_command, "run", lost)
    assert cli.main(["check", str(tmp_path)]) == 130
    assert _told(capsys.readouterr().err) == "nnap-em: stopped; the files that were written are whole"
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


# --- the journal itself


def _twice(counts: dict):
    @step(lambda x, *_, **__: {"x": x, "all": (HERE, HERE, HERE), "f": jnp.tanh})
    def work(x, options, *, factor=1.0):
        counts["calls"] = counts.get("calls", 0) + 1
        key = jax.random.split(options["key"])[1]
        return {"x": jax.tree.map(lambda a: factor * a, x), "all": (key, 0.1 * factor, np.arange(3)), "f": jnp.tanh}

    return work


def _same(a, b) -> None:
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for one, other in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert type(one) is type(other)
        if isinstance(one, jax.Array) and jnp.issubdtype(one.dtype, jax.dtypes.prng_key):
            one, other = jax.random.key_data(one), jax.random.key_data(other)
        np.testing.assert_array_equal(one, other)


def test_a_step_is_done_once_for_the_same_arguments(tmp_path):
    counts: dict = {}
    work = _twice(counts)
    effect = catalogue["air_drag"](jnp.asarray(0.8), joint=1)
    options = {"key": jax.random.key(3)}
    plainly = work(effect, options, factor=1 / 3)
    for _ in range(2):
        with keeping(Journal(tmp_path / "steps", {"seed": 0})):
            _same(work(effect, options, factor=1 / 3), plainly)
    assert counts["calls"] == 2  # once without a journal
    with keeping(Journal(tmp_path / "steps", {"seed": 0})) as _:
        work(effect, options, factor=float(np.nextafter(1 / 3, 1)))
        work(effect, {"key": jax.random.key(4)}, factor=1 / 3)
    assert counts["calls"] == 4
    assert len(Journal(tmp_path / "steps", {})) == 3
    with pytest.raises(StoreError, match=r"work-\w+\.npz: made with seed 0, not 1; resume with seed 0"):
        Journal(tmp_path / "steps", {"seed": 1}).check()


def test_clearing_leaves_what_is_not_ours(tmp_path):
    kept = Journal(tmp_path, {})
    kept.keep(f"work-{32 * '0'}", np.zeros(3))
    (tmp_path / "mine.npz").write_text("mine")
    kept.clear()
    assert [path.name for path in tmp_path.iterdir()] == ["mine.npz"]
    with pytest.raises(StoreError, match=r"mine\.npz: no finished step"):
        kept.check()


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
    with pytest.raises(TypeError, match="object cannot be told"):
        digest(object())


def test_sweeping_leaves_what_others_are_writing(tmp_path):
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    names = {pid: f".model.npz.{pid}.part" for pid in (dead.pid, os.getpid(), os.getppid())}
    for name in (*names.values(), ".other.part", "model.npz"):
        (tmp_path / name).write_text("")
    sweep(tmp_path)
    assert {p.name for p in tmp_path.iterdir()} == {names[os.getppid()], ".other.part", "model.npz"}


def test_a_file_whose_disk_is_full_is_named(tmp_path, monkeypatch):
    path = tmp_path / "a.txt"
    files.replace_text(path, "old")

    def full(_):
        raise OSError("no room")

    monkeypatch.setattr(files.os, "fsync", full)
    with pytest.raises(OSError, match=r"no room.*a\.txt"):
        files.replace_text(path, "new")
    assert path.read_text() == "old"
    assert len(list(tmp_path.iterdir())) == 1
