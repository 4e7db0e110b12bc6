"""What the site adds to the Markdown: formulas as MathML (no script), the commands' help, effects, modules."""

import argparse
import ast
import itertools
import os
import re
from html import unescape
from pathlib import Path
from typing import Any
from unittest.mock import patch
from xml.etree.ElementTree import tostring

from latex2mathml.converter import convert_to_element

from nnap_em.cli.main import parser
from nnap_em.model.effects import catalogue
from nnap_em.output.export.placement import PLACES

ROOT = Path(__file__).resolve().parents[1]
BAR = r"\|"
"""In a table."""
_FORMULA = re.compile(r'<(span|div) class="arithmatex">\s*\\([(\[])(.*?)\\[)\]]\s*</\1>', re.DOTALL)
_FIRST = {"script": 0x1D49C, "double-struck": 0x1D538}
_LETTERS = {("script", letter): known for letter, known in zip("BEFHILMR", "ℬℰℱℋℐℒℳℛ", strict=True)}
_FUNCTIONS = {"log", "ln", "sin", "cos", "tanh", "exp", "tr"}
_ACCENTS = set("¨˙¯~^")


def on_page_markdown(markdown: str, page: Any, **_) -> str:
    """Put what is made from the code in the place of its marker; a search finds guides before figures and reference."""
    if page.file.src_uri.startswith(("results/", "how/", "api.md")):
        page.meta.setdefault("search", {"boost": 0.2})
    for made in (commands, effects, folders, verdict):
        marker = f"<!-- {made.__name__} -->"
        if marker in markdown:
            markdown = markdown.replace(marker, made())
    return markdown


def on_page_content(html: str, **_) -> str:
    """Turn every formula into MathML."""
    return _FORMULA.sub(lambda m: _mathml(unescape(m[3]), "inline" if m[2] == "(" else "block"), html)


def _mathml(latex: str, display: str) -> str:
    formula = convert_to_element(latex.strip(), display=display)
    for node in formula.iter():
        node.text = unescape(node.text) if node.text else None
        style = node.attrib.get("mathvariant", "")
        if style in _FIRST and node.text:  # browsers know these letters as characters of their own, not as a style
            node.text = _LETTERS.get((style, node.text)) or chr(_FIRST[style] + ord(node.text) - ord("A"))
            del node.attrib["mathvariant"]
        if node.tag == "mi" and node.text in _FUNCTIONS:
            node.tag = "mo"
            node.attrib.update(form="prefix", lspace="0.1em", rspace="0.1em")
    for node in formula.iter("mover"):
        if node[1].text in _ACCENTS:
            node.set("accent", "true")  # else dots are half as large, and far above
    return tostring(formula, encoding="unicode")


def commands() -> str:
    """A section for each command."""
    top = parser()
    under = next(a for a in top._actions if isinstance(a, argparse._SubParsersAction))
    with patch.dict(os.environ, COLUMNS="100"):
        return "\n\n".join(f"## {name}\n\n```text\n{p.format_help()}```" for name, p in under.choices.items())


def effects() -> str:
    """A row for each class of the catalogue: law, parameters, confirmation on the machine, place in an MJCF file."""
    rows = ["| name | law | parameters | to be sure | in an MJCF file |", "| --- | --- | --- | --- | --- |"]
    for name, kind in catalogue.items():
        law = _first_paragraph(kind.__doc__).rstrip(".")
        units = ", ".join(f"`{parameter}` [{unit}]" for parameter, unit in kind.units.items())
        rows.append(f"| `{name}` | {law} | {units} | {kind.confirm} | {_place(name)} |")
    return "\n".join(rows)


def _place(name: str) -> str:
    """Place of a law in MuJoCo, if it has one."""
    return PLACES[name].where if name in PLACES else "-"


def verdict() -> str:
    """A row for each number that decides whether an effect enters a model or leaves it."""
    body = ast.parse((ROOT / "nnap_em/explain/diagnosis/verdict.py").read_text()).body
    rows = ["| number | value | meaning |", "| --- | --- | --- |"]
    for number, text in itertools.pairwise(body):
        if isinstance(number, ast.Assign) and isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant):
            value, meaning = ast.unparse(number.value), " ".join(str(text.value.value).split())
            rows.append(f"| `{ast.unparse(number.targets[0])}` | {value} | {meaning.replace('|', BAR)} |")
    return "\n".join(rows)


def folders() -> str:
    """A section for each folder of the package, in the order of CONTRIBUTING.md: README and modules."""
    return "\n\n".join(map(_folder, re.findall(r"\]\(nnap_em/(\w+)/\)", (ROOT / "CONTRIBUTING.md").read_text())))


def _folder(name: str) -> str:
    folder = ROOT / "nnap_em" / name
    told = (folder / "README.md").read_text().replace("](../../docs/how/", "](").replace("](../../docs/", "](../")
    rows = [
        f"| `{path.relative_to(folder)}` | {_first_paragraph(ast.get_docstring(ast.parse(path.read_text())))} |"
        for path in sorted(folder.rglob("*.py"))
        if path.name != "__init__.py"
    ]
    return "\n".join([f"#{told}", "| module | |", "| --- | --- |", *rows])


def _first_paragraph(docstring: str | None) -> str:
    """The beginning of a docstring as one line of a table."""
    return " ".join((docstring or "").split("\n\n")[0].split()).replace("|", BAR)
