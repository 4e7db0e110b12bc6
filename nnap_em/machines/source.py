"""The XML of a machine file: every element with its place in the user's own file, which messages name."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import NoReturn
from xml.etree import ElementTree as ET
from xml.parsers import expat

from ..data.rig import RigError


class MachineError(RigError):
    """A machine file that cannot be used: the message names the file, the obstacle, and the remedy."""


def refuse(path: Path, problem: str, hint: str, at: ET.Element | None = None) -> NoReturn:
    """Raise MachineError; `at` is the element of the file that the problem is about."""
    raise MachineError(f"{path}: {f'{place(at)}: ' if at is not None else ''}{problem}; {hint}")


class _Element(ET.Element):
    place: str = ""
    """Line of its tag."""


def place(element: ET.Element) -> str:
    """Place of an element that `parse` has read, as "line 33"."""
    return element.place if isinstance(element, _Element) else ""


def parse(path: Path) -> ET.Element:
    """The root of the file, by which MJCF and URDF are distinguished."""
    try:
        root = _read(path)
    except OSError as error:
        refuse(path, f"cannot be read ({error.strerror})", "file = names an MJCF or URDF file beside rig.toml")
    except expat.ExpatError as error:
        refuse(path, f"not XML ({error})", "give the MJCF or URDF file as it was written, whole")
    if (macro := _macro(root)) is not None:
        what, element = macro
        suffix = ".xml" if root.tag == "mujoco" else ".urdf"
        hint = f"expand it first, with xacro {path.name} > expanded{suffix}, and give that file"
        refuse(path, f"{what} is xacro", hint, element)
    if root.tag not in ("mujoco", "robot"):
        refuse(path, f"its root element is <{root.tag}>", "give MJCF (<mujoco>) or URDF (<robot>)")
    return root


def _read(path: Path) -> _Element:
    """The tree of a file; prefixes of names stay as they are written."""
    builder, parser = ET.TreeBuilder(element_factory=_Element), expat.ParserCreate()

    def start(tag: str, attributes: dict[str, str]) -> None:
        builder.start(tag, attributes).place = f"line {parser.CurrentLineNumber}"  # pyright: ignore[reportAttributeAccessIssue]

    parser.StartElementHandler, parser.EndElementHandler = start, builder.end
    parser.CharacterDataHandler = builder.data
    parser.Parse(path.read_bytes(), True)
    return builder.close()  # pyright: ignore[reportReturnType]


def _macro(element: ET.Element) -> tuple[str, ET.Element] | None:
    """The first macro of a file that is not expanded, and its element."""
    names = (element.tag, *element.attrib)
    xacro = "xacro:"  # prefix of what the macro language xacro replaces; so are numbers in `${...}` and `$(...)`
    if any(name.startswith(xacro) for name in names):
        return f"<{next(name for name in names if name.startswith(xacro))}>", element
    for value in (*element.attrib.values(), element.text or ""):
        if found := re.search(r"\$[{(].*?[})]", value):
            return f"the value {found[0]!r}", element
    # Elements of which no number is read, so that a macro in there is no obstacle
    inert = ("visual", "collision", "gazebo", "ros2_control")
    inner = (_macro(child) for child in element if child.tag not in inert)
    return next((macro for macro in inner if macro is not None), None)


def included(path: Path, home: Path) -> Iterator[Path]:
    """The files that a file includes, and those that they include; their places are relative to `home`."""
    for element in _read(path).iter("include"):
        inner = home / str(element.get("file"))
        yield inner
        yield from included(inner, home)


def located(path: Path, name: str) -> str:
    """Place of the element of this name in a file and in those that it includes, as "line 3 of inner.xml"."""
    for file in (path, *included(path, path.parent)):
        for element in _read(file).iter():
            if element.get("name") == name:
                return place(element) + (f" of {file.relative_to(path.parent)}" if file != path else "")
    return ""
