"""Imports point one way: a folder knows only the folders above it; random numbers hang on a key that is passed."""

import ast
import re
from pathlib import Path

import pytest
from shell import ROOT

import nnap_em

FOLDERS = ("numerics", "storage", "data", "machines", "import_", "systems", "effects", "model", "smoother", "em",
           "fit", "diagnosis", "comparison", "experiment", "report",
           "export", "init", "commands")  # fmt: skip
PACKAGE = ROOT / "nnap_em"


def _imports(path: Path) -> set[str]:
    """Folders of the package that a module imports from, at the top or inside a function."""
    package, imported = ("nnap_em", *path.relative_to(PACKAGE).parent.parts), set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.level:
            base = package[: len(package) - node.level + 1]
            target = (*base, *(node.module or "").split("."))[1:]
            imported |= {target[0]} if target and target[0] else {alias.name for alias in node.names}
    return imported & set(FOLDERS)


@pytest.mark.parametrize("folder", FOLDERS)
def test_a_folder_imports_only_from_those_above_it(folder):
    allowed = set(FOLDERS[: FOLDERS.index(folder) + 1])
    wrong = {p.name: _imports(p) - allowed for p in (PACKAGE / folder).rglob("*.py")}
    assert not {name: up for name, up in wrong.items() if up}


def test_every_folder_is_in_the_order():
    folders = {p.name for p in PACKAGE.iterdir() if p.is_dir() and p.name != "__pycache__"}
    assert folders == set(FOLDERS)
    assert tuple(re.findall(r"\]\(nnap_em/(\w+)/\)", (ROOT / "CONTRIBUTING.md").read_text())) == FOLDERS


def test_no_folder_has_the_name_of_a_public_function():
    """Its import would replace the function as an attribute of the package."""
    assert not set(FOLDERS) & set(nnap_em._home)


def test_random_numbers_hang_on_a_key_that_is_passed():
    """None is made of a constant, but where nothing is drawn: a check, and the blank fit that a file fills."""
    constant = re.compile(r"random\.(?:key|PRNGKey)\(\d")
    found = {str(p.relative_to(PACKAGE)) for p in PACKAGE.rglob("*.py") if constant.search(p.read_text())}
    assert found == {"commands/check.py", "fit/store.py"}
