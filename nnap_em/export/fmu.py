"""The observer of a fit as an FMU: a zip file with its description, the C sources, and a binary for this machine.

[Modelica Association 2022, "Functional Mock-up Interface 3.0", co-simulation]
"""

import hashlib
import io
import platform
import re
import shutil
import subprocess
import tempfile
import xml.etree.ElementTree as ET
import zipfile
from pathlib import Path

from .. import __version__
from ..fit.identify import Identified
from ..storage.files import replace_bytes
from .c99 import identifier
from .model import states_of
from .online import numbers, observer_c


def write_fmu(fitted: Identified, out: Path | str, *, single: bool = False) -> bool:
    """Write the observer as a co-simulation FMU (FMI 3.0).

    Inputs: those of the rig, and `reading.NAME` (NaN: none). Outputs: states, `std.NAME`, `innovation.NAME`, misfit,
    weight and flags. Parameters: estimated numbers and noise. A step is a multiple of the rows of the logs: readings of
    its beginning count, and states are predicted for its end.

    Args:
        fitted: the model.
        out: the file, an fmu.
        single: numbers of 32 bits.

    Returns:
        False where no C compiler `cc` made a binary: the sources alone are inside.

    Raises:
        ExportError: a law has no plain C form; nothing is written.
    """
    out = Path(out)
    name = identifier(out.stem)
    source, header = observer_c(fitted, name, single=single)
    token = hashlib.sha256(source.encode()).hexdigest()[:32]
    wrapper = Path(__file__).with_name("fmu.c").read_text(encoding="utf-8")
    for word, text in (("token", token), ("dt", repr(fitted.rig.dt)), ("upper", name.upper())):
        wrapper = re.sub(rf"\bnnap_{word}(?=\b|_)", text, wrapper)
    wrapper = wrapper.replace("nnap_", f"{name}_").replace("nnap.h", f"{name}.h")
    files = {f"{name}.c": source, f"{name}.h": header, f"{name}_fmu.c": wrapper}
    binary = _binary(name, files)
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("modelDescription.xml", _text(_description(fitted, name, token)))
        archive.writestr("sources/buildDescription.xml", _text(_build(name)))
        for file, text in files.items():
            archive.writestr(f"sources/{file}", text)
        if binary:
            archive.writestr(f"binaries/{platform.machine()}-linux/{name}.so", binary)
    replace_bytes(out, packed.getvalue())
    return bool(binary)


def _binary(name: str, files: dict[str, str]) -> bytes:
    """Shared library of the sources; empty where there is no compiler."""
    if not shutil.which("cc") or platform.system() != "Linux":
        return b""
    with tempfile.TemporaryDirectory() as folder:
        for file, text in files.items():
            Path(folder, file).write_text(text, encoding="utf-8")
        sources = [file for file in files if file.endswith(".c")]
        options = ["-std=c99", "-O2", "-shared", "-fPIC", "-fvisibility=hidden"]
        subprocess.run(["cc", *options, "-o", f"{name}.so", *sources, "-lm"], cwd=folder, check=True)
        return Path(folder, f"{name}.so").read_bytes()


def _description(fitted: Identified, name: str, token: str) -> ET.Element:
    rig, system, own = fitted.rig, fitted.model.system, numbers(fitted)
    states = states_of(fitted.model)
    forces = ["" if rig.input_kinds else system.force_unit(joint) for joint in rig.input_joints]
    forces += [""] * len(rig.scale_columns)
    units = [system.unit(state) if state in system.readable else "" for state in states]
    readings = [system.unit(reading) for reading in rig.measured]
    inputs = [*zip((*rig.input_columns, *rig.scale_columns), forces, strict=True)]
    inputs += [(f"reading.{reading}", unit) for reading, unit in zip(rig.measured, readings, strict=True)]
    outputs = [*zip(states, units, strict=True), *((f"std.{s}", u) for s, u in zip(states, units, strict=True))]
    outputs += [(f"innovation.{reading}", "") for reading in rig.measured] + [("misfit", ""), ("weight", "")]
    parameters = [*zip(own.names, own.units, strict=True)]
    root = ET.Element(
        "fmiModelDescription", fmiVersion="3.0", modelName=name, instantiationToken=token,
        generationTool=f"nnap_em {__version__}", description=f"Observer of {rig.name}",
    )  # fmt: skip
    step = {"fixedInternalStepSize": repr(rig.dt), "canHandleVariableCommunicationStepSize": "true"}
    ET.SubElement(root, "CoSimulation", {"modelIdentifier": name, **step})
    definitions = ET.SubElement(root, "UnitDefinitions")
    for unit in dict.fromkeys(unit for _, unit in (*inputs, *outputs, *parameters) if unit):
        ET.SubElement(definitions, "Unit", name=unit)
    variables = ET.SubElement(root, "ModelVariables")
    ET.SubElement(
        variables, "Float64", name="time", valueReference="0", causality="independent", variability="continuous"
    )
    kinds = [("input", {"start": "0", "variability": "discrete"})] * len(forces)
    kinds += [("input", {"start": "NaN", "variability": "discrete"})] * len(readings)
    kinds += [("output", {})] * len(outputs)
    kinds += [("parameter", {"variability": "fixed", "start": repr(value)}) for value in own.values]
    for i, ((label, unit), (causality, more)) in enumerate(
        zip([*inputs, *outputs, *parameters], kinds, strict=True), 1
    ):
        more = more | ({"unit": unit} if unit else {})
        ET.SubElement(variables, "Float64", {"name": label, "valueReference": str(i), "causality": causality, **more})
    last = 1 + len(kinds)
    ET.SubElement(variables, "Int32", name="flags", valueReference=str(last), causality="output")
    structure = ET.SubElement(root, "ModelStructure")
    known = [*range(1 + len(inputs), 1 + len(inputs) + len(outputs)), last]
    for kind in ("Output", "InitialUnknown"):
        for place in known:
            ET.SubElement(structure, kind, valueReference=str(place))
    return root


def _build(name: str) -> ET.Element:
    root = ET.Element("fmiBuildDescription", fmiVersion="3.0")
    configuration = ET.SubElement(root, "BuildConfiguration", modelIdentifier=name)
    files = ET.SubElement(configuration, "SourceFileSet", language="C99")
    for file in (f"{name}.c", f"{name}_fmu.c"):
        ET.SubElement(files, "SourceFile", name=file)
    ET.SubElement(configuration, "Library", name="m")
    return root


def _text(root: ET.Element) -> str:
    ET.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(root, encoding="unicode") + "\n"
