"""rig.toml: what is declared comes back, what is wrong is refused by name and with a hint."""

import dataclasses
import re
import shutil
import tomllib

import pytest

from nnap_em.cli import main as cli
from nnap_em.errors import RigError
from nnap_em.machines.limits import Bounds
from nnap_em.machines.rig import Declared, Rig, SystemSpec, read_rig, write_rig
from nnap_em.machines.systems import specs
from nnap_em.machines.table import flat
from nnap_em.machines.units import parameter_unit

STATES = ("theta1", "theta2", "dtheta1", "dtheta2")
REQUIRED = ("m1", "m2", "l1", "l2", "lc1", "lc2", "I1", "I2", "g")
SYSTEMS = {"acrobot": SystemSpec(STATES, REQUIRED, {"Ir": 0.0, "gr": 1.0}, joints=2)}

GOOD = """\
format = 1
name = "bench"

[model]
type = "acrobot"
m1 = { mean = 0.2, std = 0.02 }
m2 = 0.25
l1 = 0.275
l2 = 0.285
lc1 = 0.1375
lc2 = 0.1425
I1 = { mean = 0, std = 0 }
I2 = -0.004
g = 9.81
friction = "unknown"

[input]
columns = ["tau1", "tau2"]
joints = [1, 2]

[sampling]
dt = 0.01
input_hold = "zero-order"
clock = "sequence"

[measurement]
columns = ["theta1", "dtheta1"]

[measurement.noise_std]
theta1 = 0.005

[start]
theta2 = { mean = 0.0, std = 0.5 }
"""


def _read(tmp_path, text):
    path = tmp_path / "rig.toml"
    path.write_text(text, encoding="utf-8")
    return read_rig(path, SYSTEMS)


def test_all_that_is_declared_is_read(tmp_path):
    rig = _read(tmp_path, GOOD)
    assert (rig.name, rig.system, rig.friction, rig.dt, rig.clock) == ("bench", "acrobot", True, 0.01, "sequence")
    assert tuple(rig.parameters) == REQUIRED
    assert rig.parameters["m1"] == Declared(0.2, 0.02)
    assert rig.parameters["I1"] == Declared(0.0, 0.0)  # as in a published rig: no inertia, and trusted
    assert rig.parameters["I2"] == Declared(-0.004, 0.0)  # published inertias about the centre of mass may be negative
    assert (rig.input_columns, rig.input_joints) == (("tau1", "tau2"), (1, 2))
    assert (rig.measured, rig.noise_std) == (("theta1", "dtheta1"), {"theta1": 0.005})
    assert rig.start == {"theta2": Declared(0.0, 0.5)}
    units = {"mc": "kg", "mu": "SI", "lag": "SI", "lc": "m", "Imax": "SI", "m1": "kg", "lc2": "m", "I2": "kg m^2"}
    assert {name: parameter_unit(name) for name in units} == units


NO_INPUT = re.sub(r"\[input\]\n.*\n.*\n", "", GOOD)


def test_tables_may_be_absent_and_marks_and_lines_those_of_windows(tmp_path):
    """Without a table of inputs the column u drives the actuated joint."""
    text = NO_INPUT.replace('friction = "unknown"', 'friction = "none"\nactuated_joint = 2')
    rig = _read(tmp_path, text[: text.index("[measurement.noise_std]")])
    assert (rig.input_columns, rig.input_joints, rig.friction) == (("u",), (2,), False)
    assert (rig.noise_std, rig.start) == ({}, {})
    assert _read(tmp_path, "\ufeff" + GOOD.replace("\n", "\r\n")) == _read(tmp_path, GOOD)


MISTAKES = {  # name: (in GOOD, instead, and the message: place | finding | hint)
    "syntax": ("dt = 0.01", "dt = ", "line 22 | not TOML | key = value"),
    "format of the future": ("format = 1", "format = 2", "format: | found 2 | write format = 1"),
    "measurement missing": (GOOD[GOOD.index("[measurement]") :], "", "measurement: | missing | [measurement] with"),
    "model no table": (GOOD[GOOD.index("[model]") :], "model = 3\n[sampling]\n[measurement]", "model: | 3 | a table"),
    "parameter misspelt": ("lc2", "cl2", "[model] cl2: | unknown | did you mean 'lc2'?"),
    "parameter a boolean": ("m2 = 0.25", "m2 = true", "[model] m2: | True | finite number"),
    "mass negative": ("m2 = 0.25", "m2 = -0.25", "[model] m2: | -0.25 | mass above 0 [kg]"),
    "std misspelt": ("std = 0.02", "sd = 0.02", "[model.m1] sd: | unknown | did you mean 'std'?"),
    "no input at all": (GOOD, NO_INPUT, "[model] actuated_joint: | missing | actuated_joint = 2"),
    "joint out of range": ("[1, 2]", "[1, 3]", "[input] joints: | [1, 3] | from 1 to 2"),
    "joint twice": ("[1, 2]", "[1, 1]", "[input] columns: | tau1 and tau2 drive one joint | log their sum"),
    "input the time": ('"tau2"', '"time"', "[input] columns: | 'time' | torque columns only"),
    "input key unknown": ("joints =", "joint =", "[input] joint: | unknown | did you mean 'joints'?"),
    "hold of second order": ("zero-order", "second-order", "[sampling] input_hold: | 'second-order' | first-order"),
    "measured no state": ('"dtheta1"]', '"thteta1"]', "[measurement] columns: | 'thteta1' | did you mean 'theta1'?"),
    "noise unmeasured": ("theta1 = 0.005", "theta2 = 0.005", "[measurement.noise_std] theta2: | unknown | theta1"),
    "another encoding": ("bench", "Prüfstand", "line 2 | not UTF-8 | save the file as plain UTF-8 text"),
}


@pytest.mark.parametrize(("good", "bad", "words"), MISTAKES.values(), ids=MISTAKES)
def test_a_mistake_is_refused_with_file_place_finding_and_hint(tmp_path, good, bad, words):
    assert good in GOOD
    (tmp_path / "rig.toml").write_bytes(GOOD.replace(good, bad, 1).encode("latin-1" if "ü" in bad else "utf-8"))
    with pytest.raises(RigError) as refused:
        read_rig(tmp_path / "rig.toml", SYSTEMS)
    for part in (str(tmp_path / "rig.toml"), *words.split(" | ")):
        assert part in str(refused.value)


def test_every_mistake_is_named_at_once(tmp_path, capsys):
    """Those of the model, the rows and the name, a line each; with them right, those of readings and starts."""
    text = GOOD.replace("m2 = 0.25", "m2 = -0.25").replace("l1 = 0.275", 'l1 = "long"').replace("dt = 0.01", "dt = 0")
    with pytest.raises(RigError) as refused:
        _read(tmp_path, text.replace('"bench"', '""').replace("[start]", "[start]\nx = 3"))
    places = [re.search(r"rig.toml: (.*?): ", line)[1] for line in str(refused.value).splitlines()]
    assert places == ["name", "[model] m2", "[model] l1", "[sampling] dt"]
    assert cli.main(["check", str(tmp_path)]) == 2
    assert capsys.readouterr().err == f"nnap-em: error: {refused.value}\n"
    text = GOOD.replace('"dtheta1"]', '"speed"]').replace("[start]", "[start]\nx = 3\ny = 4")
    with pytest.raises(RigError) as refused:
        _read(tmp_path, text)
    places = [re.search(r"rig.toml: (.*?): ", line)[1] for line in str(refused.value).splitlines()]
    assert places == ["[start] x", "[start] y", "[measurement] columns"]


def test_every_shared_rig_is_read_and_written_back(shared, tmp_path):
    paths = sorted((shared / "data").glob("*/*/rig.toml"))
    assert paths
    for path in paths:
        rig = read_rig(path, specs)
        free = path.with_name("expected.txt").exists() or path.parents[1].name == "ode"  # strangers call theirs so
        assert rig.name == path.parent.name or free
        for model in (*path.parent.glob("*.xml"), *path.parent.glob("*.urdf")):
            shutil.copy(model, tmp_path)
        write_rig(rig, tmp_path / "rig.toml")
        assert read_rig(tmp_path / "rig.toml", specs) == rig


ODD = ("joint 1 [rad]", "a.b", 'Gelenk ä"', "limits")


@pytest.mark.parametrize("name", ODD)
def test_a_name_of_any_letters_comes_back(tmp_path, name):
    """Names of states, readings, inputs, limits and parameters come back as they are."""
    rig = Rig(
        name=name, system="odd", friction=True,
        parameters={f"{name}.mass": Declared(1.0, 0.1), f"{name}.mass of it": Declared(1.0, 0.0)},
        input_columns=(f"u {name}",), input_joints=(1,), dt=0.01, clock="session",
        measured=(name, f"d{name}"), noise_std={name: 0.1, f"d{name}": 0.2}, start={f"d{name}": Declared(0.0, 1.0)},
        limits=Bounds({f"d{name}": (-1.0, 2.0)}, {f"u {name}": (-3.0, 3.0)}, {name: (0.5, 0.5)}),
        input_kinds=("velocity",),
    )  # fmt: skip
    rig = dataclasses.replace(rig, parameters={**rig.parameters, f"u {name}.kv": Declared(2.0, 0.5)})
    write_rig(rig, tmp_path / "rig.toml")
    table = tomllib.loads(text := (tmp_path / "rig.toml").read_text())
    assert "dt = 0.01    # s\n" in text
    assert table["start"] == {f"d{name}": {"mean": 0.0, "std": 1.0}} and table["name"] == name
    assert set(dict(flat(table["measurement"]["noise_std"]))) == {name, f"d{name}"}
    assert table["limits"] == {f"d{name}": [-1.0, 2.0], "rate": {f"u {name}": [-3.0, 3.0]}, "start": {name: [0.5, 0.5]}}
    assert table["input"][f"u {name}"]["kv"] == {"mean": 2.0, "std": 0.5}
