"""Imports point one way: a wing knows only those above it."""

import ast
import re
from pathlib import Path

import pytest
from shell import ROOT

WINGS = ("base", "machines", "logs", "model", "estimate", "explain", "output", "cli")
PACKAGE = ROOT / "nnap_em"


def _imports(path: Path) -> set[str]:
    """Wings that a module imports from, at the top or inside a function."""
    package, imported = ("nnap_em", *path.relative_to(PACKAGE).parent.parts), set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.level:
            base = package[: len(package) - node.level + 1]
            target = (*base, *(node.module or "").split("."))[1:]
            imported |= {target[0]} if target and target[0] else {alias.name for alias in node.names}
    return imported & set(WINGS)


@pytest.mark.parametrize("wing", WINGS)
def test_a_wing_imports_only_from_those_above_it(wing):
    allowed = set(WINGS[: WINGS.index(wing) + 1])
    wrong = {p.name: _imports(p) - allowed for p in (PACKAGE / wing).rglob("*.py")}
    assert not {name: up for name, up in wrong.items() if up}


def test_every_wing_is_in_the_order():
    folders = {p.name for p in PACKAGE.iterdir() if p.is_dir() and p.name != "__pycache__"}
    assert folders == set(WINGS)
    assert tuple(re.findall(r"\]\(nnap_em/(\w+)/\)", (ROOT / "CONTRIBUTING.md").read_text())) == WINGS
