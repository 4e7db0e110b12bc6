"""Every command line that the documentation and the help show is parsed, and every option runs, in its cheapest form.

The engines that need minutes are replaced by what a fit already gave; their own tests run them.
"""

import argparse
import dataclasses
import functools
import inspect
import re
import shlex
import shutil
import subprocess
from collections.abc import Iterator

import h5py
import jax
import numpy as np
import pytest
import rod
from helpers import begun, file_rig, nnap
from shell import ROOT

import nnap_em
from nnap_em import load
from nnap_em.commands import cli, compare, design, diagnose, identify
from nnap_em.data.logs import read_logs
from nnap_em.data.rig import read_rig
from nnap_em.diagnosis.outcome import Diagnosis
from nnap_em.experiment import experiment
from nnap_em.experiment.search import Effort
from nnap_em.fit.identify import begin
from nnap_em.fit.store import save
from nnap_em.systems import specs

PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
LAUNCH = "python -m nnap_em.launch"

EVERY = "--seed 1 --quiet --profile --trust-readings"
RUNS: dict[str, tuple[str, ...]] = {
    "simulate DIR/new --system slide --sequences 2 --test 1 --steps 60 --seed 1 --measured x"
    " --process-noise 0.001 0.01 --measurement-noise 0.001 0.01": (),
    "init log.csv --system slide --out DIR": (),
    "init log.csv --model equations --out DIR": (),
    "import one.h5 two.h5 --rig bench/rig.toml --out DIR/new --test 1 --shift /drive=0.0 --unwrap x": (),
    "check bench --trust-readings": (),
    "identify bench --out DIR": ("model.npz", "report.json", "friction.csv", "friction.png"),
    f"identify bench --out DIR --more february --smoother particle --particles 9 --epochs 3 {EVERY}": (),
    "identify bench --out DIR --from january": (),
    "diagnose bench --out DIR": ("after.npz", "friction_before.csv"),
    f"diagnose bench --out DIR --from january --logs bench --more february --minutes 1 {EVERY}": (),
    f"design fit --out DIR --seconds 1.2 --sequences 2 --logs bench {EVERY}": (),
    "design fit --out DIR": ("design.json", "inputs/1.csv", "motion/6.csv"),
    "compare fit other --out DIR": ("compare.html",),
    "predict fit bench/test --given 0.1 --out DIR --seed 1 --trust-readings": ("000.csv",),
    "smooth fit bench/test --out DIR --trust-readings": ("000.csv",),
    "export fit --out DIR": ("parameters.json",),
    "export fit --c DIR/arm.c": ("arm.c",),
    "export fit --observer DIR/arm.c --float": ("arm.c", "arm.h"),
    "export rod --mjcf DIR/rod.xml": ("rod.xml",),
    "export rod --urdf DIR/rod.urdf": ("rod.urdf",),
}
"""Lines in the folder of the fits, and files in DIR that they write."""
PARSER = cli.parser()
COMMANDS = next(a for a in PARSER._actions if isinstance(a, argparse._SubParsersAction)).choices


def _shown() -> Iterator[tuple[str, list[str]]]:
    """Whole command lines in fenced blocks of pages and under the examples of a help text: where, and the words."""
    for page in PAGES:
        for number, line in enumerate(page.read_text().splitlines(), 1):
            if line.startswith(("nnap-em ", LAUNCH)):
                yield f"{page.name}:{number}", shlex.split(line, comments=True)
    for name, parser in {"nnap-em": PARSER, **COMMANDS}.items():
        for line in (parser.epilog or "").splitlines():
            if line.startswith("  nnap-em "):
                yield f"{name} --help", shlex.split(re.split(r"\s{2,}", line.strip())[0])


def test_every_line_that_is_shown_is_accepted_by_the_parser(capsys):
    shown = [*_shown()]
    assert len(shown) > 50
    for where, words in shown:
        try:
            PARSER.parse_args(words[next(i for i, word in enumerate(words) if word in COMMANDS) :])
        except SystemExit:
            pytest.fail(f"{where}: {shlex.join(words)}: {capsys.readouterr().err}")


def test_every_option_of_the_parser_runs():
    for command, parser in COMMANDS.items():
        options = {a.option_strings[-1] for a in parser._actions if a.option_strings} - {"--help"}
        words = {word for line in RUNS if line.startswith(command) for word in line.split()}
        assert options == {word for word in words if word.startswith("--")}, command


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """Two data sets and fits of them that no epoch has changed; logs to be imported; a machine from a file."""
    root = tmp_path_factory.mktemp("lines")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(root)
        for seed, name in enumerate(("bench", "february")):
            size = ("--sequences", 2, "--test", 1, "--steps", 95, "--seed", seed)
            assert nnap("simulate", name, "--system", "slide", *size) == 0
        (root / "log.csv").write_text((root / "bench/train/000.csv").read_text())
        for i, name in enumerate(("one", "two")):
            table = np.genfromtxt(root / f"bench/train/00{i}.csv", delimiter=",", names=True)
            with h5py.File(root / f"{name}.h5", "w") as file:
                for column in table.dtype.names:
                    file[f"drive/{column}"] = table[column]
        rig = read_rig(root / "bench/rig.toml", specs)
        fitted = begun(rig, read_logs(root / "bench/train", rig).data)
        for name, logs, more in (("fit", "bench", 0.0), ("other", "february", 1.0), ("january", "february", 0.5)):
            best = dataclasses.replace(fitted.model, log_r=fitted.model.log_r + more)
            one = fitted._replace(state=fitted.state._replace(best=best))
            save(root / name / "model.npz", one, notes={"logs": [str(root / logs)]})
        (root / "rod.xml").write_text(rod.FILE)
        (root / "rod.urdf").write_text(rod.URDF)
        inputs = '[input]\ncolumns = ["tau"]\njoints = [1]\n'
        (root / "rod.toml").write_text(file_rig("rod.urdf", ("hinge", "dhinge"), inputs, friction="none", dt=rod.DT))
        machine = begin(read_rig(root / "rod.toml", specs), rod.logs(0), key=jax.random.key(0))
        save(root / "rod" / "model.npz", machine)
    return root


@pytest.fixture(scope="module")
def beside(place):
    """`compare`, once for the same fits: it fits laws to the curves."""
    return functools.cache(nnap_em.compare)


@pytest.fixture(scope="module")
def fit(place):
    return load(place / "fit/model.npz")


@pytest.fixture(scope="module")
def designed(place, fit):
    """A small design, tried with few models."""
    data = read_logs(place / "bench/train", fit.rig).data
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(experiment, "CHECKED", 8)
        patch.setattr(experiment, "DRAWN_IN", 4)
        small = Effort(pool=6, batch=12, rounds=1, tries=4, few=1)
        return experiment.design(fit, data, key=jax.random.key(0), seconds=1.8, sequences=6, effort=small)


def _first(designed: experiment.Design, count: int) -> experiment.Design:
    """Some of its sequences."""
    parts = ("u", "start", "low", "middle", "high")
    return designed._replace(**{name: getattr(designed, name)[:count] for name in parts})


@pytest.fixture
def light(place, beside, designed, fit, monkeypatch):
    """The commands without the engines that need minutes: these give what `place` has, and refuse other arguments."""

    def bound(function, result):
        signature = inspect.signature(function)

        def called(*args, **options):
            signature.bind(*args, **options)
            return result(options)

        return called

    def fitted(options):
        options["smoother"](fit.bank)
        options["watch"](fit.state, 40, np.ones(2, bool))
        return fit

    for name in ("identify", "identify_from"):
        monkeypatch.setattr(identify, name, bound(getattr(identify, name), fitted))
    monkeypatch.setattr(identify, "write_identification", bound(identify.write_identification, lambda _: True))
    monkeypatch.setattr(diagnose, "diagnose", bound(diagnose.diagnose, lambda _: Diagnosis(fit, fit, (), ())))
    monkeypatch.setattr(diagnose, "write_diagnosis", bound(diagnose.write_diagnosis, lambda _: True))
    monkeypatch.setattr(compare, "compare", beside)
    monkeypatch.setattr(design, "design", bound(experiment.design, lambda o: _first(designed, o["sequences"])))
    monkeypatch.chdir(place)
    return place


@pytest.mark.parametrize("line", RUNS)
def test_it_runs_and_replaces_files_of_its_own(line, light, tmp_path, capsys):
    for _ in range(2 if line.startswith(("compare", "predict", "smooth", "export")) else 1):
        assert cli.main(line.replace("DIR", str(tmp_path)).split()) == 0, capsys.readouterr().err


@pytest.mark.parametrize("line, file", [(line, file) for line, files in RUNS.items() for file in files])
def test_a_file_of_somebody_else_is_never_replaced(line, file, light, tmp_path, capsys):
    """Refused before anything else is written."""
    mine = tmp_path / file
    mine.parent.mkdir(exist_ok=True)
    mine.write_text("time,u\n0.0,1.0\n")
    assert cli.main(line.replace("DIR", str(tmp_path)).split()) == 2
    assert f"{mine}: is there already, and nnap_em did not write it" in capsys.readouterr().err
    assert mine.read_text() == "time,u\n0.0,1.0\n"
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == [mine]


def test_a_fit_is_replaced_by_another(light, tmp_path, capsys):
    shutil.copytree(light / "other", tmp_path / "fit")
    before = (tmp_path / "fit/model.npz").read_bytes()
    assert nnap("identify", "bench", "--out", tmp_path / "fit") == 0
    assert f"nnap-em: the fit in {tmp_path}/fit will be replaced" in capsys.readouterr().err.splitlines()
    assert (tmp_path / "fit/model.npz").read_bytes() != before


def test_a_file_that_is_no_log_is_refused_in_one_line(light, capsys):
    assert nnap("predict", "fit", "rod.xml", "--given", 0.1, "--out", "x") == 2
    said = capsys.readouterr().err
    assert re.fullmatch(r"nnap-em: error: .*: no log \(\*\.csv, .*\); `nnap-em import` conv.*\n", said)


def test_the_source_of_an_observer_includes_the_header_that_is_written(light, tmp_path):
    assert nnap("export", "fit", "--observer", tmp_path / "my-arm.c") == 0
    assert {path.name for path in tmp_path.iterdir()} == {"my-arm.c", "my-arm.h"}
    subprocess.run(["gcc", "-std=c99", "-fsyntax-only", "my-arm.c"], cwd=tmp_path, check=True)


def test_a_design_is_as_long_in_python_as_by_the_command():
    parameters, args = (
        inspect.signature(experiment.design).parameters,
        PARSER.parse_args(["design", "fit", "--out", "x"]),
    )
    for option, name in (("seconds", "seconds"), ("sequences", "sequences")):
        assert getattr(args, option) == parameters[name].default


def test_a_design_replaces_the_older_one_and_no_other_table(light, tmp_path):
    plan = ("design", "fit", "--out", tmp_path, "--quiet")
    others = [tmp_path / name for name in ("inputs/mine.csv", "motion/12.csv", "inputs/notes.txt")]
    for path in others:
        path.parent.mkdir(exist_ok=True)
        path.write_text("mine")
    for count in (3, 2):
        assert nnap(*plan, "--sequences", count) == 0
        names = {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*.csv")} - {
            "inputs/mine.csv",
            "motion/12.csv",
        }
        assert names == {f"{folder}/{i + 1}.csv" for folder in ("inputs", "motion") for i in range(count)}
    assert [path.read_text() for path in others] == ["mine"] * 3
