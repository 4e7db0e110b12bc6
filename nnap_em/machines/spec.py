"""A machine file in MuJoCo's own parser and writer: opened, freed of shapes whose files are missing, compiled."""

import ctypes
import os
import re
import warnings
from pathlib import Path
from typing import Any, NoReturn

from ..data.rig import RigWarning
from .source import MachineError, included, located, refuse

DIGITS = 15
"""Significant digits of a written number: those that a decimal number keeps as a double; MuJoCo's own are 6."""


def mujoco() -> Any:
    """The parser, an extra of the package.

    Raises MachineError where it is not installed.
    """
    try:
        import mujoco
    except ImportError:
        raise MachineError(
            'type = "mjcf" needs MuJoCo\'s parser, which is not installed; pip install "nnap-em[robots]"'
        ) from None
    return mujoco


def opened(path: Path, urdf: bool) -> Any:
    """The content of an MJCF or URDF file as an MjSpec; a link of a URDF file without an inertial weighs nothing.

    Raises MachineError at what MuJoCo's parser refuses.
    """
    parser, heard = mujoco(), []
    parser.set_mju_user_warning(heard.append)
    try:
        spec = parser.MjSpec.from_file(str(path))
    except ValueError as error:
        _refuse(path, _in_included(path, _plain(error)))
    finally:
        parser.set_mju_user_warning(None)
    for line in heard:
        if "equal lower and upper limits" not in line:  # a limit without room is none
            warnings.warn(f"{path}: {line}", RigWarning, 2)
    for body in [body for body in spec.bodies[1:] if urdf and not body.explicitinertial]:
        body.explicitinertial, body.ipos = True, [0.0, 0.0, 0.0]
    return spec


def compiled(path: Path, spec: Any) -> Any:
    """MuJoCo's model; where files of textures or shapes are missing, `spec` loses these.

    Raises MachineError at what the compiler refuses, and where a mesh is missing that a body takes its mass from.
    """
    message = ""
    for without in (None, _without_textures, _without_meshes):
        if without is not None:
            without(path, spec)
        try:
            return spec.compile()
        except ValueError as error:
            message = _plain(error)
            if not re.search(r"opening file|resource|not found|reading file|file type", message, re.I):
                break
    _refuse(path, _in_file(path, message))


def written(spec: Any, home: Path | None = None) -> str:
    """A compiled spec as MJCF; places of meshes and textures are relative to `home`, or whole."""
    if any(asset.file for asset in (*spec.meshes, *spec.textures, *spec.hfields, *spec.skins)):
        spec.meshdir, spec.texturedir = (_place(spec, part, home) for part in (spec.meshdir, spec.texturedir))
        spec.modelfiledir = str(home or "")
    ctypes.CDLL(mujoco()._specs.__file__)._mjPRIVATE__set_xml_precision(DIGITS)
    return spec.to_xml()


def _place(spec: Any, part: str, home: Path | None) -> str:
    whole = (Path(spec.modelfiledir) / part).resolve()
    return str(whole) if home is None else os.path.relpath(whole, home.resolve())


def _without_textures(path: Path, spec: Any) -> None:
    for material in spec.materials:
        material.textures = [""] * len(material.textures)
    for texture in list(spec.textures):
        spec.delete(texture)


def _without_meshes(path: Path, spec: Any) -> None:
    if spec.compiler.inertiafromgeom == mujoco().mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE:
        refuse(path, 'inertiafromgeom = "true", but its meshes are missing', "put them beside the file")
    for geom in [geom for geom in spec.geoms if geom.meshname or geom.hfieldname]:
        if geom.parent.name != "world" and not geom.parent.explicitinertial:
            problem = f"body {geom.parent.name!r} has no <inertial>, and its mesh {geom.meshname!r} is missing"
            refuse(path, problem, "put the mesh beside the file, or give the body an <inertial>")
        spec.delete(geom)
    for asset in [*spec.meshes, *spec.hfields, *spec.skins]:
        spec.delete(asset)


def _plain(error: Exception) -> str:
    return " ".join(str(error).split())


def _in_included(path: Path, message: str) -> str:
    """A message of the parser with the line of the included file that it is about; MuJoCo counts no lines there."""
    if not message.endswith(", line 0"):
        return message
    for inner in included(path, path.parent):
        try:
            mujoco().MjSpec.from_file(str(inner))
        except ValueError as error:
            within, line = _plain(error).rsplit(", line ", 1)
            if within == message.removesuffix(", line 0"):
                return f"{within}, line {line} of {inner.relative_to(path.parent)}"
    return message.removesuffix(", line 0")


def _in_file(path: Path, message: str) -> str:
    """A message of the compiler with the line of the element that it names."""
    named = re.search(r"Element name '([^']+)'", message)
    at = located(path, named[1]) if named else ""
    return re.sub(r", line -?\d+", "", message).replace(named[0], f"{named[0]}, {at}") if named and at else message


def _refuse(path: Path, message: str) -> NoReturn:
    """Raise MachineError with the message of the compiler and the remedy of the commonest errors."""
    hints = {
        r"mass and inertia of moving bodies": "give every body that moves an <inertial> with mass and inertia above 0",
        r"must satisfy A \+ B >= C": "an inertia's largest part is at most the sum of the other two: correct it",
        r"inertia.*(positive|negative)|(positive|negative).*inertia": "masses and inertias are above 0: correct it",
        r"repeated name|already|duplicate": "give every body, joint, motor and sensor a name of its own",
        r"Element 'include'": "put the included file where the main file looks for it",
        r"opening file|not found": "put the file where it is looked for, or give its body an <inertial>",
        r"cycl|loop|parent": "a machine here is a tree: every link has one parent",
    }
    matching = (hint for pattern, hint in hints.items() if re.search(pattern, message, re.I))
    hint = next(matching, "correct the file; MuJoCo's viewer shows the same error")
    refuse(path, f"MuJoCo's compiler refuses it: {message}", hint)


def in_comment(text: str) -> str:
    """A text as it may stand in a comment of XML, which has no two dashes in a row."""
    return re.sub("-(?=-)", "- ", text)
