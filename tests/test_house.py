"""Imports point one way: a folder knows only the folders above it."""

import ast
import re
from pathlib import Path

import pytest
from shell import ROOT

FOLDERS = ("numerics", "storage", "data", "systems", "effects", "model", "smoother", "em", "residual", "curves",
           "diagnose", "design", "report", "portable", "commands")  # fmt: skip
PACKAGE = ROOT / "nnap_em"


def _imports(path: Path) -> set[str]:
    """Folders of the package that a module imports from, at the top or inside a function."""
    here, found = ("nnap_em", *path.relative_to(PACKAGE).parent.parts), set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.level:
            base = here[: len(here) - node.level + 1]
            target = (*base, *(node.module or "").split("."))[1:]
            found |= {target[0]} if target and target[0] else {alias.name for alias in node.names}
    return found & set(FOLDERS)


@pytest.mark.parametrize("folder", FOLDERS)
def test_a_folder_imports_only_from_those_above_it(folder):
    allowed = set(FOLDERS[: FOLDERS.index(folder) + 1])
    wrong = {p.name: _imports(p) - allowed for p in (PACKAGE / folder).rglob("*.py")}
    assert not {name: up for name, up in wrong.items() if up}


def test_every_folder_is_in_the_order():
    there = {p.name for p in PACKAGE.iterdir() if p.is_dir() and p.name != "__pycache__"}
    assert there == set(FOLDERS)
    assert tuple(re.findall(r"\]\(nnap_em/(\w+)/\)", (ROOT / "README.md").read_text())) == FOLDERS


def test_no_test_imports_another():
    """What two of them need is in helpers.py."""
    tests = list((ROOT / "tests").glob("test_*.py"))
    names = {path.stem for path in tests}
    for path in tests:
        imports = [n for n in ast.walk(ast.parse(path.read_text())) if isinstance(n, ast.ImportFrom | ast.Import)]
        taken = {alias.name for n in imports for alias in n.names}
        taken |= {n.module for n in imports if isinstance(n, ast.ImportFrom)}
        assert not taken & names, path.name
