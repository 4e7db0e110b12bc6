"""Every command line that the documentation and the help show is parsed, and every option runs, in its cheapest form.

The engines are replaced by what a fit already gave; their own tests run them.
"""

import argparse
import dataclasses
import inspect
import re
import shlex
import shutil
from collections.abc import Iterator
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest
from helpers import begun, nnap
from recorders import write_hdf5
from shell import ROOT

from nnap_em import load
from nnap_em.cli import check, design, diagnose, export, identify, predict, smooth
from nnap_em.cli import main as cli
from nnap_em.estimate.predict import Prediction
from nnap_em.estimate.store import save
from nnap_em.explain.diagnosis.outcome import Diagnosis
from nnap_em.logs.read import read_logs
from nnap_em.machines.rig import read_rig
from nnap_em.machines.systems import specs

PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
LAUNCH = "python -m nnap_em.cli.launch"

EVERY = "--seed 1 --quiet --trust-readings"
RUNS: dict[str, tuple[str, ...]] = {
    "simulate DIR/new --system slide --sequences 2 --test 1 --steps 95 --seed 1 --measured x"
    " --process-noise 0.001 0.01 --measurement-noise 0.001 0.01": (),
    "init log.csv --system slide --out DIR": (),
    "init log.csv --model equations --out DIR": (),
    "import one.h5 two.h5 --rig bench/rig.toml --out DIR/new --test 1 --shift /drive=0.0 --unwrap x": (),
    "check bench --trust-readings": (),
    "identify bench --out DIR": ("model.npz", "report.json", "friction.csv"),
    f"identify bench --out DIR --more february --smoother particle --particles 9 --epochs 3 {EVERY}": (),
    "identify bench --out DIR --from january": (),
    "diagnose bench --out DIR": ("after.npz",),
    f"diagnose bench --out DIR --from january --logs bench --more february --minutes 1 {EVERY}": (),
    f"design fit --out DIR --seconds 1.2 --sequences 2 --logs bench {EVERY}": (),
    "design fit --out DIR": ("design.json", "inputs/1.csv", "motion/6.csv"),
    "compare fit other --out DIR": ("compare.html",),
    "predict fit bench/test --given 0.1 --out DIR --seed 1 --trust-readings": ("000.csv",),
    "smooth fit bench/test --out DIR --trust-readings": ("000.csv",),
    "export fit --out DIR": ("parameters.json",),
    "export fit --c DIR/arm.c": ("arm.c",),
    "export fit --observer DIR/arm.c --float": (),
    "export fit --mjcf DIR/rod.xml --urdf DIR/rod.urdf": (),
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
    assert len(shown) > 30
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
    """Two data sets and fits of them that no epoch has changed; logs to be imported."""
    root = tmp_path_factory.mktemp("lines")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(root)
        for seed, name in enumerate(("bench", "february")):
            size = ("--sequences", 2, "--test", 1, "--steps", 95, "--seed", seed)
            assert nnap("simulate", name, "--system", "slide", *size) == 0
        (root / "log.csv").write_text((root / "bench/train/000.csv").read_text())
        for i, name in enumerate(("one", "two")):
            table = np.genfromtxt(root / f"bench/train/00{i}.csv", delimiter=",", names=True)
            write_hdf5(root / f"{name}.h5", {"drive": {column: table[column] for column in table.dtype.names}})
        rig = read_rig(root / "bench/rig.toml", specs)
        fitted = begun(rig, read_logs(root / "bench/train", rig).data)
        for name, logs, more in (("fit", "bench", 0.0), ("other", "february", 1.0), ("january", "february", 0.5)):
            best = dataclasses.replace(fitted.model, log_r=fitted.model.log_r + more)
            one = fitted._replace(state=fitted.state._replace(best=best))
            save(root / name / "model.npz", one, notes={"logs": [str(root / logs)]})
    return root


@pytest.fixture
def light(place, monkeypatch):
    """The commands without engines and pages: these give what `place` has, and refuse other arguments."""
    fit = load(place / "fit/model.npz")

    def bind(command, name, result):
        signature = inspect.signature(getattr(command, name))
        monkeypatch.setattr(command, name, lambda *args, **options: result(signature.bind(*args, **options).arguments))

    def fitted(options):
        options["smoother"](fit.bank)
        options["watch"](fit.state, 40, np.ones(2, bool))
        return fit

    def state(options):
        return jnp.zeros((*options["data"].t.shape, 2)), jnp.ones((*options["data"].t.shape, 2))

    for name in ("identify", "identify_from"):
        bind(identify, name, fitted)
    for command, report in {identify: "identification", diagnose: "diagnosis", design: "design"}.items():
        bind(command, f"write_{report}", lambda _: True)
    bind(diagnose, "diagnose", lambda _: Diagnosis(fit, fit, (), ()))
    bind(design, "design", lambda _: None)
    bind(check, "check", lambda _: [])
    bind(predict, "predict", lambda o: Prediction(*state(o), o["data"].valid))
    bind(smooth, "smooth", lambda o: SimpleNamespace(mean=state(o)[0], cov=np.ones((*o["data"].t.shape, 2, 2))))
    for name in ("write_mjcf", "write_urdf", "write_observer"):
        bind(export, name, lambda _: ["a law"])
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
