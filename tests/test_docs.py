"""What the documentation says runs: every Python, shell and TOML block of README.md and docs/, page by page.

The blocks of a page share one folder and one namespace.  `<!-- not run: reason -->` above a block leaves it out.
"""

import ast
import re
import shlex
import sys
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

import pytest

from nnap_em.cli import main as cli
from nnap_em.machines.rig import read_rig
from nnap_em.machines.systems import register, specs, systems
from nnap_em.model.effects import catalogue

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
_BLOCK = re.compile(r"(?:^<!-- not run:(?P<reason>.*?)-->\n)?^```(?P<kind>.*)\n(?P<text>(?:.*\n)*?)```$", re.MULTILINE)


class Block(NamedTuple):
    """A fenced block, the line where its text begins, and the reason why it is not run."""

    kind: str
    text: str
    line: int
    reason: str | None


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


def test_every_block_is_run_or_says_why_not():
    for page in PAGES:
        blocks = _blocks(page)
        assert len(blocks) * 2 == len(re.findall(r"^\s*```", page.read_text(), re.MULTILINE)), page
        for block in blocks:
            assert block.kind in {*RUN, "math", "text"}, f"{page}:{block.line}"
            assert block.reason is None or block.reason.strip(), f"{page}:{block.line}"


RUNNING = [p for p in PAGES if any(b.kind in RUN for b in _blocks(p))]


@pytest.mark.slow  # fast: test_cli.py has the commands of README.md, test_public.py the functions
@pytest.mark.parametrize("page", RUNNING, ids=lambda page: str(page.relative_to(ROOT)))
def test_page_runs(page, tmp_path, monkeypatch, registries):
    monkeypatch.chdir(tmp_path)
    module = ModuleType("page")
    monkeypatch.setitem(sys.modules, "page", module)  # the home of its classes
    for block in _blocks(page):
        if block.kind in RUN and block.reason is None:
            RUN[block.kind](block, page, module)


def test_a_name_that_is_taken_is_refused(registries):
    register("slide", systems["slide"])
    with pytest.raises(ValueError, match="is the name of Slide"):
        register("slide", systems["pendulum"])
