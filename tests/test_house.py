"""Imports point one way: a folder knows only the folders above it."""

import ast
import re
from pathlib import Path

import pytest
from prose import fractions, in_package, mistakes, on_pages
from shell import ROOT

import nnap_em

FOLDERS = ("numerics", "storage", "data", "machines", "import_", "systems", "effects", "model", "smoother", "em",
           "fit", "diagnosis", "comparison", "experiment", "report",
           "export", "init", "commands")  # fmt: skip
PACKAGE = ROOT / "nnap_em"


LINES, CONSTANTS = 32_636, 344
"""Lines and module constants of the package: they may fall, and then these fall with them."""


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


def test_the_names_at_the_top_fit_on_a_screen():
    """What most users need; the rest is in namespaces."""
    assert 25 <= len(nnap_em._home) <= 30


def test_the_package_does_not_grow():
    """New lines and constants take the place of others; CHANGELOG.md says of which."""
    sources = [path.read_text() for path in PACKAGE.rglob("*.py")]
    assert sum(len(source.splitlines()) for source in sources) <= LINES
    assert sum(len(_constants(source)) for source in sources) <= CONSTANTS


def test_a_constant_has_one_meaning():
    """Its name is that of one module."""
    homes: dict[str, list[str]] = {}
    for path in PACKAGE.rglob("*.py"):
        for name in _constants(path.read_text()):
            homes.setdefault(name, []).append(str(path.relative_to(PACKAGE)))
    assert {name: modules for name, modules in homes.items() if len(modules) > 1} == {}


def test_random_numbers_hang_on_a_key_that_is_passed():
    """None is made of a constant, but where nothing is drawn: a check, and the blank fit that a file fills."""
    constant = re.compile(r"random\.(?:key|PRNGKey)\(\d")
    found = {str(p.relative_to(PACKAGE)) for p in PACKAGE.rglob("*.py") if constant.search(p.read_text())}
    assert found == {"commands/check.py", "fit/store.py"}


def test_the_file_of_numbers_that_decide_names_those_that_are_elsewhere():
    number = re.compile(r"^[A-Z][A-Z_, ]* = [-(]?\d", re.M)
    places = [p for folder in ("diagnosis", "residual") for p in (PACKAGE / folder).glob("*.py")]
    elsewhere = {p.name for p in places if number.search(p.read_text())} - {"verdict.py"}
    text = ast.get_docstring(ast.parse((PACKAGE / "diagnosis" / "verdict.py").read_text())) or ""
    assert not {name for name in elsewhere if name not in text}


def _constants(source: str) -> list[str]:
    """Names in capitals that a module sets."""
    sets = [node for node in ast.parse(source).body if isinstance(node, ast.Assign | ast.AnnAssign)]
    targets = [target for node in sets for target in (node.targets if isinstance(node, ast.Assign) else [node.target])]
    names = [name.id for target in targets for name in ast.walk(target) if isinstance(name, ast.Name)]
    return [name for name in names if name.isupper()]


def test_no_test_imports_another():
    """What two of them need is in helpers.py."""
    tests = list((ROOT / "tests").glob("test_*.py"))
    names = {path.stem for path in tests}
    for path in tests:
        imports = [n for n in ast.walk(ast.parse(path.read_text())) if isinstance(n, ast.ImportFrom | ast.Import)]
        taken = {alias.name for n in imports for alias in n.names}
        taken |= {n.module for n in imports if isinstance(n, ast.ImportFrom)}
        assert not taken & names, path.name


def test_docstrings_and_comments_speak_the_language_of_the_field():
    assert in_package() == {}


def test_numbers_have_their_zero_on_every_page():
    assert on_pages() == {}


def test_the_check_of_numbers_sees_fractions_and_no_formats():
    assert fractions("0.03 rad, {x:.2f}, .3g, %.1f, 1.5, a.0, 10.4121/12960104") == []
    assert fractions("a grid of .02 Hz, [.5, 1]") == ["has '.02', not '0.02'", "has '.5', not '0.5'"]
    assert mistakes('x = f"{y:.1f} of (.3)"  # -.4\n') == [(1, "has '.3', not '0.3'"), (1, "has '.4', not '0.4'")]


def test_the_check_of_sentences_sees_starts_and_words():
    assert mistakes('"""Rows of the log that `told` returns."""\n') == []
    assert mistakes('"""Of every row."""\nx = 1\n"""What a model tells."""  # felt\n') == [
        (1, "starts with 'Of'"),
        (3, "has the word 'felt'"),
        (3, "has the word 'tells'"),
        (3, "starts with 'What'"),
    ]


@pytest.mark.parametrize("folder", FOLDERS)
def test_a_readme_names_the_files_of_its_folder(folder):
    """Each file and each folder within, and none that is not there."""
    text = (PACKAGE / folder / "README.md").read_text()
    inner = {p.name for p in (PACKAGE / folder).iterdir() if p.is_dir() and p.name != "__pycache__"}
    files = {p.name for p in (PACKAGE / folder).glob("*.py") if p.name != "__init__.py"}
    entries = {f"`{name}`" for name in files} | {f"`{name}/`" for name in inner}
    named = set(re.findall(r"`\w+(?:\.py|/)`", text))
    assert entries - named == set()
    assert named - entries - {f"`{p.name}`" for p in PACKAGE.rglob("*.py")} == set()
