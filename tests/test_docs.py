"""What the documentation says runs: every Python, shell and TOML block of README.md and docs/, page by page.

The blocks of a page share one folder and one namespace.  `<!-- not run: reason -->` above a block leaves it out.
"""

import argparse
import ast
import re
import shlex
import sys
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

import pytest

import nnap_em
from nnap_em import cli
from nnap_em.effects import catalogue
from nnap_em.rig import read_rig
from nnap_em.systems import register, specs, systems

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
_BLOCK = re.compile(r"(?:^<!-- not run:(?P<reason>.*?)-->\n)?^```(?P<kind>.*)\n(?P<text>(?:.*\n)*?)```$", re.MULTILINE)


class Block(NamedTuple):
    """A fenced block."""

    kind: str
    text: str
    line: int
    """Where its text begins."""
    reason: str | None
    """Why it is not run."""


def _blocks(page: Path) -> list[Block]:
    text = page.read_text()
    return [
        Block(m["kind"], m["text"], text.count("\n", 0, m.start("text")) + 1, m["reason"])
        for m in _BLOCK.finditer(text)
    ]


def _python(block: Block, page: Path, module: ModuleType) -> None:
    tree = ast.increment_lineno(ast.parse(block.text), block.line - 1)  # a traceback names the line of the page
    exec(compile(tree, str(page), "exec"), module.__dict__)


def _shell(block: Block, page: Path, module: ModuleType) -> None:
    for line in block.text.splitlines():
        program, *words = shlex.split(line, comments=True)
        assert program == "nnap-em", f"{page}: say why this is not run: {line}"
        assert cli.main(words) == 0, line


def _toml(block: Block, page: Path, module: ModuleType) -> None:
    Path("rig.toml").write_text(block.text)
    read_rig(Path("rig.toml"), specs)


RUN = {"python": _python, "sh": _shell, "toml": _toml}


@pytest.fixture
def registries():
    """The machines and effects of the package; what a page adds is gone after it."""
    known = [(each, dict(each)) for each in (systems, specs, catalogue)]
    yield
    for each, before in known:
        each.clear()
        each.update(before)


def test_files_import_from_files_above_them():
    """As README lists them; all are there, and what stands in a line stands in its order."""
    package = ROOT / "nnap_em"
    house = (ROOT / "README.md").read_text().partition("## The house")[2].partition("## Documentation")[0]
    listed = re.findall(r"`(\w+)(?:\.py|/)`", "\n".join(re.findall(r"(?m)^\|[^|]*\|[^|]*\|", house)))
    order = {name: place for place, name in enumerate(listed)}
    assert sorted(order) == sorted(p.stem for p in package.iterdir() if p.stem[:2] != "__" and p.suffix in (".py", ""))
    wrong = []
    for path in package.rglob("*.py"):
        own = path.relative_to(package).parts
        if len(own) > 1 or own[0] != "__init__.py":
            name = own[0].removesuffix(".py")
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.ImportFrom) and node.level == len(own):
                    others = [node.module.split(".")[0]] if node.module else [alias.name for alias in node.names]
                    wrong += [f"{name} imports {other}" for other in others if order.get(other, -1) >= order[name]]
    assert not wrong


def test_every_block_is_run_or_says_why_not():
    for page in PAGES:
        blocks = _blocks(page)
        assert len(blocks) * 2 == len(re.findall(r"^\s*```", page.read_text(), re.MULTILINE)), page
        for block in blocks:
            assert block.kind in {*RUN, "math", "text"}, f"{page}:{block.line}"
            assert block.reason is None or block.reason.strip(), f"{page}:{block.line}"


@pytest.mark.slow
@pytest.mark.parametrize(
    "page", [p for p in PAGES if any(b.kind in RUN for b in _blocks(p))], ids=lambda p: str(p.relative_to(ROOT))
)
def test_page_runs(page, tmp_path, monkeypatch, registries):
    monkeypatch.chdir(tmp_path)
    module = ModuleType("page")
    monkeypatch.setitem(sys.modules, "page", module)  # the home of its classes
    for block in _blocks(page):
        if block.kind in RUN and block.reason is None:
            RUN[block.kind](block, page, module)


def test_own_rig_is_forty_lines_of_python():
    blocks = _blocks(ROOT / "docs/own_rig.md")
    assert sum(bool(line.strip()) for b in blocks if b.kind == "python" for line in b.text.splitlines()) <= 40


def test_a_name_that_is_taken_is_refused(registries):
    register("slide", systems["slide"])
    with pytest.raises(ValueError, match="is the name of Slide"):
        register("slide", systems["pendulum"])


def test_reference_has_every_public_name():
    listed = re.findall(r"^::: nnap_em\.(\w+)\.(\w+)$", (ROOT / "docs/api.md").read_text(), re.MULTILINE)
    assert sorted(listed) == sorted((nnap_em._home[name], name) for name in nnap_em.__all__ if name in nnap_em._home)


def test_pages_made_from_the_code_are_whole():
    hooks = pytest.importorskip("docs.hooks")
    commands, effects = hooks.commands(), hooks.effects()
    under = next(a for a in cli.parser()._actions if isinstance(a, argparse._SubParsersAction))
    assert all(f"## {name}\n" in commands for name in under.choices)
    assert all(f"| `{name}` |" in effects for name in catalogue)
