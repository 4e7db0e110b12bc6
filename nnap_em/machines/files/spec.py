"""A machine file in MuJoCo's own parser and writer: opened, freed of shapes whose files are missing, compiled."""

import ctypes
import os
import re
import warnings
from pathlib import Path
from typing import Any, NoReturn

from ...errors import MachineError, RigWarning

DIGITS = 15
"""Significant digits of a written number: those that a decimal number keeps as a double; MuJoCo's own are 6."""


def refuse(path: Path, problem: str, hint: str) -> NoReturn:
    """Raise MachineError."""
    raise MachineError(f"{path}: {problem}; {hint}")


def mujoco() -> Any:
    """The parser, an extra of the package; MachineError where it is not installed."""
    try:
        import mujoco
    except ImportError:
        raise MachineError(
            'type = "mjcf" needs MuJoCo\'s parser, which is not installed; pip install "nnap-em[robots]"'
        ) from None
    return mujoco


def opened(path: Path) -> Any:
    """The content of an MJCF or URDF file as an MjSpec; a link of a URDF file without an inertial weighs nothing."""
    parser, heard, text = mujoco(), [], uncommented(path)
    unread = r"(?s)<(visual|collision|gazebo|ros2_control)\b.*?</\1>"  # of which no number is read
    macros = re.sub(unread, lambda part: "\n" * part[0].count("\n"), text)
    if macro := re.search(r"<xacro:\w+|\$\{[^}\n]*\}|\$\(arg[^)\n]*\)", macros):
        line = macros.count("\n", 0, macro.start()) + 1
        hint = f"expand it first, with xacro {path.name} > expanded.urdf, and give that file"
        refuse(path, f"line {line}: {macro[0]}{'>' * (macro[0][0] == '<')} is xacro", hint)
    parser.set_mju_user_warning(heard.append)
    try:
        spec = parser.MjSpec.from_file(str(path))
    except ValueError as error:
        _refuse(path, error)
    finally:
        parser.set_mju_user_warning(None)
    for line in heard:
        if "equal lower and upper limits" not in line:  # a limit without room is none
            warnings.warn(f"{path}: {line}", RigWarning, 2)
    if re.search(r"(?is)<transmission\b(?:(?!</transmission>).)*<\w*inertia", text):
        hint = "write its inertia times the reduction squared as JOINT.armature in [model.uncertain]"
        warnings.warn(f"{path}: the rotor of a <transmission> is not read; {hint}", RigWarning, 2)
    for body in [body for body in spec.bodies[1:] if "<robot" in text and not body.explicitinertial]:
        body.explicitinertial, body.ipos = True, [0.0, 0.0, 0.0]
    return spec


def uncommented(path: Path) -> str:
    """The file without its comments; its tags are ASCII in every encoding."""
    try:
        text = path.read_bytes().decode("latin-1")
    except OSError as error:
        refuse(path, f"cannot be read ({error.strerror})", "file = names an MJCF or URDF file beside rig.toml")
    return re.sub(r"(?s)<!--.*?-->", lambda comment: "\n" * comment[0].count("\n"), text)


def compiled(path: Path, spec: Any) -> Any:
    """MuJoCo's model; where files of textures or shapes are missing, `spec` loses these, but no mesh that has mass."""
    for without in (_without_textures, _without_meshes, None):
        try:
            return spec.compile()
        except ValueError as error:
            if not without or not re.search(
                r"opening file|resource|not found|reading file|file type", str(error), re.I
            ):
                _refuse(path, error)
            without(path, spec)
    raise AssertionError  # the third round returns or refuses


def weightless(path: Path, spec: Any) -> Any:
    """MuJoCo's model, in which bodies may move that weigh nothing; none is joined to another."""
    compiler, tenth = spec.compiler, 0.1 * NOTHING
    before = compiler.boundmass, compiler.boundinertia, compiler.fusestatic
    compiler.boundmass, compiler.boundinertia = (max(bound, tenth) for bound in before[:2])
    compiler.fusestatic = False
    model = compiled(path, spec)
    compiler.boundmass, compiler.boundinertia, compiler.fusestatic = before
    return model


NOTHING = 1e-13
"""Mass [kg] and inertia [kg m^2] that count as none: a hundred times the least that MuJoCo's compiler accepts."""


def written(spec: Any, home: Path | None = None) -> str:
    """A compiled spec as MJCF; places of meshes and textures are relative to `home`, or whole."""
    if any(asset.file for asset in (*spec.meshes, *spec.textures, *spec.hfields, *spec.skins)):
        spec.meshdir, spec.texturedir = (_place(spec, part, home) for part in (spec.meshdir, spec.texturedir))
        spec.modelfiledir = str(home or "")
    # MuJoCo has no setting for it; a release without this one writes its six digits
    set_digits = getattr(ctypes.CDLL(mujoco()._specs.__file__), "_mjPRIVATE__set_xml_precision", None)
    if set_digits is not None:
        set_digits(DIGITS)
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


def _refuse(path: Path, error: Exception) -> NoReturn:
    """Raise MachineError with the message of MuJoCo, which has a line where it reads the file."""
    message = re.sub(r", line (-1|0)\b", "", " ".join(str(error).split()))
    hint = "correct the file: bodies form a tree on a fixed base, the largest part of an inertia is at most the sum of "
    hint += "the others, names are different, and each body that moves has an <inertial> above 0 (shapes of URDF weigh "
    hint += "nothing), or its joint is held: [model] locked = { JOINT = 0.0 }"
    refuse(path, f"MuJoCo's compiler refuses it: {message}", hint)


def in_comment(text: str) -> str:
    """A text as it may stand in a comment of XML, which has no two dashes in a row."""
    return re.sub("-(?=-)", "- ", text)
