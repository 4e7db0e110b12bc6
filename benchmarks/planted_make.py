"""Data sets with planted effects, made of real recordings.

The log is changed, not the machine: where the real torque was u, u minus the force e(q, v, t) is written (its mean over
the step, from the measured states), so that for a reader of the log the machine has the force e in addition.  Of a law
of the input, the input is written that the law maps to the real torque; a sensor's column is changed as the law says.
Noise, backlash and controllers stay real.  Two things are not exact: a delay cannot know the torque before the first
row (the first rows of a delayed input act as 0), and e is computed from readings with their noise.

The strength of an effect is the root mean square, over the training rows, of the torque that it adds at a joint, as a
share of the typical torque there: sqrt(mean of drive^2 + mean of gravity^2), with the published parameters.  Of an
effect at several joints the largest share counts; of a sensor, the torque is that by which the equation of motion
fails with the changed reading.  Delays are whole rows.  Friction by position is three times the share deep, because
friction cannot add more than itself.  `truth.toml` has what came out.
"""

import functools
import hashlib
import json
import math
import re
import shutil
import tomllib
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from planted_cases import STRENGTHS, WRONG, Body, Case, Columns, Motion, Plant, Ranges, Values, case_of, split
from runner import SHARED

from nnap_em.base.files import replace_text

DATA = SHARED / "measured"
STATES = ("theta1", "theta2", "dtheta1", "dtheta2")
INPUTS = ("tau1", "tau2")
MOMENTS = 8
"""Of each step, at which a force is asked for."""
TOUCH = 0.1
"""Hidden torque that counts as a touch [N m]."""
Text = tuple[list[str], list[list[str]]]
"""Header and rows of a file."""


class Rig(NamedTuple):
    """A recorded rig: its declaration, and all columns of the windows that it shows."""

    folder: Path
    declared: dict[str, Any]
    body: Body
    logs: dict[str, Columns]
    """By path under the folder."""
    texts: dict[str, Text]
    """The fields as they are in the files."""
    shown: list[str]
    """Columns of its own files."""


def _fields(path: Path) -> Text:
    """The names in the header of a CSV file, and the fields of every row under it."""
    names, *rows = (line.split(",") for line in path.read_text().splitlines())
    return names, rows


@functools.cache
def read(rig: str, data: Path = DATA) -> Rig:
    """A rig; of one with a hidden joint, the same windows with both joints."""
    folder, full = data / rig, data / rig.removesuffix("_joint1")
    for each in (folder, full):
        if not (each / "rig.toml").exists():
            raise FileNotFoundError(f"{each / 'rig.toml'} is not there: the recordings are no part of the repository")
    declared = tomllib.loads((folder / "rig.toml").read_text())
    source = tomllib.loads((full / "source.toml").read_text())
    body = {n: v["mean"] if isinstance(v, dict) else v for n, v in declared["model"].items() if not isinstance(v, str)}
    published = source["models"][source["default_model"]]
    body |= {f"friction{j}": 0.5 * math.pi * published[f"cf{j}"] for j in (1, 2)}  # of cf arctan(100 w)
    logs, texts, shown = {}, {}, []
    for path in sorted(folder.glob("t*/*.csv")):
        part = f"{path.parent.name}/{path.name}"
        if path.parent.name not in ("train", "test"):
            continue
        names, rows = texts[part] = _fields(full / part)
        logs[part] = dict(zip(names, np.asarray(rows, float).T, strict=True))
        shown, table = _fields(path)
        for name, column in zip(shown, np.asarray(table, float).T, strict=True):
            if not np.array_equal(column, logs[part][name]):
                raise ValueError(f"{path}: column {name!r} is not that of {full / part}")
    return Rig(folder, declared, body, logs, texts, shown)


def _motion(log: Columns) -> Motion:
    q, v = (np.stack([log[f"{d}theta{j}"] for j in (1, 2)], axis=-1) for d in ("", "d"))
    return Motion(q, v, log["time"])


def mean_force(plant: Plant, log: Columns, values: Values, body: Body) -> np.ndarray:
    """Mean of the force over the step after each row; in the last row its value there.

    Between the rows velocities are linear, and angles bend as that asks for.
    """
    ends, force = _motion(log), plant.law.force
    assert force is not None
    dt, dv = np.diff(ends.t), np.diff(ends.v, axis=0)
    means = np.zeros_like(dv)
    for s in (np.arange(MOMENTS) + 0.5) / MOMENTS:
        q, v = ((1 - s) * a[:-1] + s * a[1:] for a in ends[:2])
        inside = Motion(q - 0.5 * s * (1 - s) * dt[:, None] * dv, v, ends.t[:-1] + s * dt)
        means += force(inside, plant.joint or 0, values, body) / MOMENTS
    last = Motion(*(a[-1:] for a in ends))
    return np.concatenate([means, force(last, plant.joint or 0, values, body)])


def planted(log: Columns, effects: list[tuple[Plant, Values]], body: Body, dt: float) -> Columns:
    """The log with the effects in: first forces, then what makes torques of inputs, then sensors."""
    out = dict(log)
    for plant, values in effects:
        if plant.law.force:
            e = mean_force(plant, log, values, body)
            out |= {name: out[name] - e[:, i] for i, name in enumerate(INPUTS) if np.any(e[:, i])}
    for plant, values in effects:
        if plant.law.undo:
            name, rate = f"tau{plant.joint}", log[f"dtheta{plant.joint}"]
            mean = np.append(0.5 * (rate[:-1] + rate[1:]), rate[-1])
            out[name] = plant.law.undo(out[name], mean, values, dt)
    for plant, values in effects:
        if plant.law.reading and plant.channel:
            out[plant.channel] = plant.law.reading(out[plant.channel], values)
        if plant.law.delay:
            out = _late(out, STATES if plant.channel == "all" else (plant.channel or "",), round(values["delay"] / dt))
    return out


def _late(log: Columns, late: tuple[str, ...], rows: int) -> Columns:
    """Some columns come late; the rows before the first late reading go, and the clock starts at the same time."""
    size = len(log["time"]) - rows
    return {n: c[:size] if n in late or n == "time" else c[rows:] for n, c in log.items()}


def gravity(q: np.ndarray, body: Body) -> np.ndarray:
    """Torque of gravity (time, 2) that a drive must hold [N m]."""
    outer = body["m2"] * body["lc2"] * body["g"] * np.sin(q.sum(axis=1))
    inner = (body["m1"] * body["lc1"] + body["m2"] * body["l1"]) * body["g"] * np.sin(q[:, 0])
    return np.stack([inner + outer, outer], axis=-1)


def needed(log: Columns, body: Body) -> np.ndarray:
    """Torque (time, 2) that the published equation of motion asks for, without friction [N m]."""
    q, v, t = _motion(log)
    smooth = np.apply_along_axis(lambda c: np.convolve(np.pad(c, 2, mode="edge"), np.ones(5) / 5, "valid"), 0, v)
    a = np.gradient(smooth, t, axis=0)
    rotor, wheel = body["gr"] ** 2 * body["Ir"], body["gr"] * body["Ir"]
    h = body["m2"] * body["l1"] * body["lc2"]
    m22 = body["I2"] + body["m2"] * body["lc2"] ** 2
    m12 = m22 + h * np.cos(q[:, 1]) - wheel
    m11 = body["I1"] + body["m1"] * body["lc1"] ** 2 + body["m2"] * body["l1"] ** 2 + m22
    m11 = m11 + 2 * h * np.cos(q[:, 1]) + rotor + body["Ir"]
    swing = h * np.sin(q[:, 1])
    first = m11 * a[:, 0] + m12 * a[:, 1] - swing * v[:, 1] * (2 * v[:, 0] + v[:, 1])
    second = m12 * a[:, 0] + (m22 + rotor) * a[:, 1] + swing * v[:, 0] ** 2
    return np.stack([first, second], axis=-1) + gravity(q, body)


def _rms(rows: list[np.ndarray]) -> np.ndarray:
    return np.sqrt(np.mean(np.concatenate(rows) ** 2, axis=0))


def _inputs(log: Columns) -> np.ndarray:
    return np.stack([log[name] for name in INPUTS], axis=-1)


def typical(logs: list[Columns], body: Body) -> np.ndarray:
    """Typical torque at each joint [N m]: of the drive and of gravity, root mean square."""
    return np.hypot(_rms([_inputs(log) for log in logs]), _rms([gravity(_motion(log).q, body) for log in logs]))


def share(logs: list[Columns], plant: Plant, values: Values, body: Body, dt: float) -> float:
    """Torque that an effect adds, relative to the typical one, at the joint where that is most."""
    added = []
    for log in logs:
        changed = planted(log, [(plant, values)], body, dt)
        size = len(changed["time"])
        first = len(log["time"]) - size
        lack = _inputs(changed) - _inputs(log)[first:]
        if plant.law.force is None and plant.law.undo is None:
            real = {n: c[first:] for n, c in log.items()}
            lack = needed(changed, body) - needed(real | {"time": log["time"][:size]}, body)
        added.append(lack)
    return float(np.max(_rms(added) / typical(logs, body)))


def _values(rig: Rig, case: Case, plant: Plant) -> tuple[dict[str, float], float]:
    """Parameters of an effect, drawn by the names of rig and law, and the share that they come to."""
    logs = [log for part, log in rig.logs.items() if part.startswith("train")]
    dt, law = rig.declared["sampling"]["dt"], plant.law
    seed = hashlib.sha256(f"{case.rig} {plant}".encode()).digest()
    angle = np.concatenate([log[f"theta{plant.joint or 1}"] for log in logs])
    drawn = law.draw(np.random.default_rng(list(seed)), Ranges(*map(float, np.quantile(angle, (0.1, 0.9)))))
    aim = STRENGTHS[case.strength]
    measure = lambda s: share(logs, plant, drawn | law.amount(s), rig.body, dt)  # noqa: E731
    if law.scored == ("delay",):
        rows = min(range(1, 7), key=lambda n: abs(measure(n * dt) - aim))
        strength = rows * dt
    elif law.direct:
        strength = law.direct * aim
    else:
        strength = 1.0
        for _ in range(8):
            last, strength = strength, strength * aim / measure(strength)  # nearly in proportion
            if abs(strength / last - 1) < 1e-3:
                break
    values = drawn | law.amount(strength)
    return values, measure(strength)


def make(name: str, out: Path, data: Path = DATA) -> dict[str, Any]:
    """Write the data set of a case into a folder, with truth.toml beside rig.toml; returns the truth."""
    case = case_of(name)
    rig = read(case.rig, data)
    dt = rig.declared["sampling"]["dt"]
    chosen = [(plant, *_values(rig, case, plant)) for plant in case.plants]
    if out.exists() and any(out.iterdir()):
        if not (out / "truth.toml").exists():
            raise FileExistsError(f"{out} holds something else than a planted data set; name another folder")
        shutil.rmtree(out)
    for part, log in rig.logs.items():
        changed = planted(log, [(plant, values) for plant, values, _ in chosen], rig.body, dt)
        _write(out / part, changed, log, rig.texts[part], rig.shown)
    old = f'name = "{case.rig}"'
    text = (rig.folder / "rig.toml").read_text()
    assert text.count(old) == 1
    replace_text(out / "rig.toml", wrong(text.replace(old, f'name = "{name}"'), name, WRONG.get(case.strength, 0.0)))
    truth = {"case": name, "rig": case.rig, "split": split(name), "strength": case.strength, "effects": []}
    for plant, values, reached in chosen:
        place = {"joint": plant.joint, "channel": plant.channel}
        entry = {"name": plant.law.name, "law": plant.tag} | {n: v for n, v in place.items() if v is not None}
        entry["inputs"] = [s.replace("j", str(plant.joint)) for s in plant.law.of]
        entry |= {"share": float(f"{reached:.3g}"), "parameters": values}
        truth["effects"].append(entry)
    if case.rig.endswith("hidden_pert"):
        truth["touches"] = touches(rig.folder)
    replace_text(out / "truth.toml", _toml(truth))
    return truth


def wrong(text: str, name: str, size: float) -> str:
    """rig.toml with every number that is declared with a standard deviation off by `size` of them."""
    rng = np.random.default_rng(list(hashlib.sha256(name.encode()).digest()))

    def moved(found: re.Match[str]) -> str:
        mean, std = float(found["mean"]), float(found["std"])
        return f"{{ mean = {mean + size * rng.choice((-1, 1)) * std:.8g}, std = {found['std']} }}"

    head, mark, tail = text.partition("[measurement]")
    return re.sub(r"\{ mean = (?P<mean>\S+), std = (?P<std>\S+) \}", moved, head) + mark + tail if size else text


def _write(path: Path, columns: Columns, real: Columns, text: Text, shown: list[str]) -> None:
    """The columns as CSV; where a value is the recorded one, the file's own digits."""
    names, rows = text
    fields = {name: [row[i] for row in rows] for i, name in enumerate(names)}
    table = []
    for name in shown:
        new, old = columns[name], real[name]
        same = len(new) == len(old)
        table.append([fields[name][k] if same and v == old[k] else f"{v:.12g}" for k, v in enumerate(new.tolist())])
    path.parent.mkdir(parents=True, exist_ok=True)
    replace_text(path, "\n".join([",".join(shown), *map(",".join, zip(*table, strict=True))]) + "\n")


def _toml(truth: dict[str, Any]) -> str:
    lines = [f"{n} = {json.dumps(v)}" for n, v in truth.items() if not isinstance(v, list) or not v]
    for key, rows in ((n, v) for n, v in truth.items() if isinstance(v, list)):
        for row in rows:
            lines += ["", f"[[{key}]]", *(f"{n} = {json.dumps(v)}" for n, v in row.items() if not isinstance(v, dict))]
            for name, values in ((n, v) for n, v in row.items() if isinstance(v, dict)):
                lines += [f"[{key}.{name}]", *(f"{n} = {json.dumps(v)}" for n, v in values.items())]
    return "\n".join([*lines, ""])


def touches(folder: Path) -> list[dict[str, Any]]:
    """Torques from outside that were taken out of the training logs: where a hidden column passes 0.1 N m."""
    out = []
    for path in sorted(folder.glob("truth/train/*.csv")):
        hidden = np.genfromtxt(path, delimiter=",", names=True)
        for joint in (1, 2):
            if (column := f"hidden{joint}") not in (hidden.dtype.names or ()):
                continue
            torque = hidden[column]
            edges = np.flatnonzero(np.diff(np.abs(torque) > TOUCH, prepend=False, append=False))
            for first, end in edges.reshape(-1, 2):
                size = torque[first + int(np.argmax(np.abs(torque[first:end])))]
                span = {"from": float(hidden["time"][first]), "to": float(hidden["time"][end - 1])}
                out.append({"file": path.name, "joint": joint, **span, "size": float(size)})
    return out
