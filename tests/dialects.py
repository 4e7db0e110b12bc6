"""Logs as drives, PLCs and tools write them, made from what their documentation says."""

import zipfile
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import scipy.io

DT = 0.004
T = DT * np.arange(200)
Q, V, U = np.sin(3 * T), 3 * np.cos(3 * T), np.cos(2 * T)


def _number(x: float, decimal: str = ".") -> str:
    return (f"{x:.9g}" if abs(x) < 1e6 else repr(float(x))).replace(".", decimal)


def _write(path: Path, lines, encoding: str = "utf-8") -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(("\r\n".join(lines) + "\r\n").encode(encoding))
    return path


def twincat(path: Path, *, ticks: bool = False, separator: str = "\t", decimal: str = ",", full: bool = True) -> Path:
    """TwinCAT Scope, two sample times in one table, the slower one on the first rows."""
    names = ["Name", "fAngle", "fSpeed", "Name", "fTorque"]
    head = ["Name\tbench", "File\tC:\\scope\\bench.csv"]
    head += [f"{word} of export\t13295973384376{k}000\tMontag\t15:56:24.376" for k, word in ((0, "Start"), (9, "End"))]
    head += ["", ""]
    rows = [names]
    for key, *values in (
        ("SymbolComment", "", "", ""),
        ("Data-Type", "REAL64", "REAL64", "REAL32"),
        ("SampleTime[ms]", "4", "4", "8"),
        ("Port", "851", "851", "851"),
        ("SymbolName", "MAIN.fAngle", "MAIN.fSpeed", "GVL.fTorque"),
        ("Unit", "deg (Angle)", "rad/s (Speed)", "(None)"),
        ("Unit Offset", "0", "0", "0"),
    ):
        rows += [[key, *values[:2], key, values[2]]] * full
    t = [str(132959733843760000 + round(1e7 * x)) if ticks else _number(1e3 * x, decimal) for x in T]
    body = []
    for k, time in enumerate(t):
        slow = [t[2 * k], _number(U[2 * k], decimal)] if 2 * k < len(T) else []
        body.append([time, _number(np.degrees(Q[k]), decimal), _number(V[k], decimal), *slow])
    lines = [*head * full, *(separator.join(row) for row in rows), *([""] * full)]
    return _write(path, [*lines, *(separator.join(row) for row in body), "EOF"])


def workbook(path: Path, columns: dict[str, np.ndarray]) -> Path:
    """An Excel workbook of one sheet, texts inside the cells [ECMA-376, part 1, 18.3]."""
    cell = lambda x: f'<c t="inlineStr"><is><t>{x}</t></is></c>' if isinstance(x, str) else f"<c><v>{x!r}</v></c>"  # noqa: E731
    rows = [[*columns], *zip(*(y.tolist() for y in columns.values()), strict=True)]
    sheet = "".join(f"<row>{''.join(map(cell, row))}</row>" for row in rows)
    main, office = (
        f"http://schemas.openxmlformats.org/{of}" for of in ("spreadsheetml/2006/main", "officeDocument/2006")
    )
    package = "http://schemas.openxmlformats.org/package/2006"
    link = lambda kind, to: (  # noqa: E731
        f'<Relationships xmlns="{package}/relationships">'
        f'<Relationship Id="r1" Type="{office}/relationships/{kind}" Target="{to}"/></Relationships>'
    )
    book = f'<sheets><sheet name="a" sheetId="1" r:id="r1" xmlns:r="{office}/relationships"/></sheets>'
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("[Content_Types].xml", f'<Types xmlns="{package}/content-types"/>')
        file.writestr("_rels/.rels", link("officeDocument", "xl/workbook.xml"))
        file.writestr("xl/workbook.xml", f'<workbook xmlns="{main}">{book}</workbook>')
        file.writestr("xl/_rels/workbook.xml.rels", link("worksheet", "worksheets/sheet1.xml"))
        file.writestr(
            "xl/worksheets/sheet1.xml", f'<worksheet xmlns="{main}"><sheetData>{sheet}</sheetData></worksheet>'
        )
    return path


def codesys(path: Path, flags: int = 16, comment: bool = False) -> Path:
    """CODESYS trace (`*.trace.csv`): a block for each variable, maybe with keys without a value."""
    unit = 1e6 if flags & 32 else 1e3
    lines = ["[key]; [value]", "Version; 0x03050000", *["Comment", ";", ""] * comment, f"Flags; {flags}"]
    for i, (name, y) in enumerate({"PLC_PRG.theta1": Q, "PLC_PRG.dtheta1": V, "PLC_PRG.u": U}.items()):
        lines += [f"{i}.Variable; {name}", f"{i}.Color; 4278190335", f"{i}.Data; "]
        lines += [f"; {round(unit * t)}; {_number(x)}" for t, x in zip(T, y, strict=True)]
    return _write(path, lines)


def codesys_text(path: Path) -> Path:
    """CODESYS trace as text: title, project, then columns between blanks."""
    head = ["CODESYS V3.5 SP20 Patch 4 Trace: Trace", "C:\\plc\\bench.project",
            "Timestamp(ms) PLC_PRG.theta1 PLC_PRG.dtheta1 PLC_PRG.u"]  # fmt: skip
    return _write(path, [*head, *(" ".join(map(_number, row)) for row in zip(1e3 * T, Q, V, U, strict=True))], "utf-16")


def labview(path: Path, x_columns: str = "One") -> Path:
    """LabVIEW measurement file with one, many or no columns of times, in German."""
    many, names = x_columns == "Multi", ["theta1", "dtheta1", "u"]
    wide = [text for name in names for text in ("X_Value", name)] if many else ["X_Value", *names]

    def tag(key: str, values) -> str:
        """One value a channel; many columns of times stand in the way."""
        return "\t".join(
            [key, *(("\t".join(f"{v}\t" for v in values)).rstrip("\t") if many else "\t".join(values)).split("\t")]
        )

    multi = "Yes" if many else "No"
    lines = ["LabVIEW Measurement\t", "Writer_Version\t2", "Reader_Version\t2", "Separator\tTab"]
    lines += ["Decimal_Separator\t,", f"Multi_Headings\t{multi}", f"X_Columns\t{x_columns}", "Time_Pref\tRelative"]
    lines += ["Date\t2026/07/22", "Time\t17:18:18,938945770263671875", "***End_of_Header***\t", "\t"]
    lines += [tag("Channels", ["3"]), tag("Samples", ["200"] * 3), tag("Date", ["2026/07/22"] * 3)]
    lines += [tag("Y_Unit_Label", ["deg", "rad/s", "Volts"]), tag("X_Dimension", ["Time"] * 3)]
    lines += [tag("X0", ["0,0000000000000000E+0"] * 3), tag("Delta_X", ["0,004000"] * 3)]
    lines += ["***End_of_Header***\t\t\t\t", "\t".join([*wide, "Comment"])]
    for row in zip(T, np.degrees(Q), V, U, strict=True):
        t, *y = (_number(x, ",") for x in row)
        lines.append("\t".join([t, y[0], t, y[1], t, y[2]] if many else ["" if x_columns == "No" else t, *y]))
    return _write(path, lines)


def lerobot(folder: Path, fixed: bool = False) -> Path:
    """A LeRobot set of two episodes: lists in every row, times that restart."""
    half = len(T) // 2
    lists = [[float(q), float(v)] for q, v in zip(Q, V, strict=True)]
    kind = pa.list_(pa.float32(), 2) if fixed else pa.list_(pa.float32())
    table = {
        "observation.state": pa.array(lists, kind),
        "action": pa.array([[float(u)] for u in U], pa.list_(pa.float32())),
        "timestamp": pa.array(np.tile(T[:half], 2), pa.float32()),
        "frame_index": np.tile(np.arange(half), 2),
        "episode_index": np.repeat([0, 1], half),
        "index": np.arange(len(T)),
        "task_index": np.zeros(len(T), int),
    }
    path = folder / "data/chunk-000/file-000.parquet"
    path.parent.mkdir(parents=True)
    pq.write_table(pa.table(table), path)
    return path


def control_desk(path: Path) -> Path:
    """dSPACE ControlDesk: a struct with X and Y."""
    x = np.zeros(1, [("Name", "O"), ("Data", "O")])
    x[0] = ("", T)
    y = np.zeros(3, [("Name", "O"), ("Data", "O"), ("XIndex", "O"), ("Unit", "O")])
    for k, (name, data) in enumerate(
        {"Model Root/arm/theta1": Q, "Model Root/arm/dtheta1": V, "Model Root/u\\Out1": U}.items()
    ):
        y[k] = (f"{name}", data, 1, "")
    record = {"X": x, "Y": y, "Description": {"General": "bench"}, "RTProgram": "arm.sdf", "Capture": {"Length": 2.0}}
    scipy.io.savemat(path, {"rec_001": record})
    return path


def structure_with_time(path: Path) -> Path:
    """Simulink, To Workspace blocks as structures with time: one of two signals, one with none called."""
    signals = np.zeros(2, [("values", "O"), ("dimensions", "O"), ("label", "O"), ("blockName", "O")])
    signals[0], signals[1] = (Q[:, None], 1, "theta1", "arm/Out"), (V[:, None], 1, "dtheta1", "arm/Out")
    drive = {"values": U[:, None], "dimensions": 1, "label": "", "blockName": "arm/u"}
    content = {"out": {"time": T[:, None], "signals": signals, "blockName": "arm"},
               "u": {"time": T[:, None], "signals": drive, "blockName": "arm"}}  # fmt: skip
    scipy.io.savemat(path, content)
    return path


def table(path: Path, header: str, columns, separator: str = ",", decimal: str = ".", above=(), encoding="utf-8",
          quote: bool = False, last: str = "") -> Path:  # fmt: skip
    """A text table with lines above, and one more below."""
    mark = '"' if quote else ""
    rows = [separator.join(f"{mark}{_number(x, decimal)}{mark}" for x in row) for row in zip(*columns, strict=True)]
    return _write(path, [*above, *header.split("\n"), *rows, *([last] if last else [])], encoding)
