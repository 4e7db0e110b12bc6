"""Check of the sentences in docstrings and comments of the package: `python tests/prose.py`, a part of `make lint`.

A docstring starts with what it documents: a noun, or a verb in the imperative or the third person.  It does not start
with a question word or a preposition ("Of every sequence").  Data, models and laws do not speak: words of `BANNED`
stand in no docstring and no comment, except as names in backticks.  CONTRIBUTING.md has the terms to use instead.
A number below one has its zero (0.03 rad), in every text of the package and on every page.
"""

import ast
import io
import re
import sys
import tokenize
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
START = re.compile(
    r"(What|Where|Whether|Who|Whose|Whom|Which|How|When|Why|Of|For|As|With|Without|In|On|At|From|To|By|That|If|After"
    r"|Before|Because)\b"
)
"""Words that start no docstring."""
BANNED = re.compile(
    r"\b(told|tells?|telling|foretold|untold|unsaid|says?|said|saying|believes?|believed|beliefs?|feels?|felt|forgets?"
    r"|forgotten|shouts?|asks?|asked|asking|mends?|mended|promised?s?|owns? up|knows|speaks?|loud)\b",
    re.IGNORECASE,
)
"""Words that describe data, models and laws as people, or that the vocabulary replaces."""
FRACTION = re.compile(r"(?<![\w.:%)\]}/\\])\.\d+(?![\w%])")
"""A number without its zero, and no format (`.3g`, `:.2f`, `%.1f`)."""
PAGES = ("*.md", "docs/**/*.md", "nnap_em/**/*.md", "benchmarks/*.md")


def docstrings(source: str) -> Iterator[tuple[int, str]]:
    """Line and text of every docstring, those of attributes among them."""
    for node in ast.walk(ast.parse(source)):
        body = getattr(node, "body", None)
        for one in body if isinstance(body, list) else ():
            if isinstance(one, ast.Expr) and isinstance(one.value, ast.Constant) and isinstance(one.value.value, str):
                yield one.lineno, one.value.value


def comments(source: str) -> Iterator[tuple[int, str]]:
    """Line and text of every comment."""
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            yield token.start[0], token.string


def strings(source: str) -> Iterator[tuple[int, str]]:
    """Line and text of every string, in messages and templates too."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.lineno, node.value


def fractions(text: str) -> list[str]:
    """Reasons of the numbers without their zero."""
    return [f"has {number!r}, not '0{number}'" for number in FRACTION.findall(text)]


def mistakes(source: str) -> list[tuple[int, str]]:
    """Line and reason of every docstring and comment to be rewritten."""
    rows = [(line, f"starts with {m[1]!r}") for line, text in docstrings(source) if (m := START.match(text.lstrip()))]
    for line, text in (*docstrings(source), *comments(source)):
        words = BANNED.findall(re.sub(r"`[^`]*`", "", text))
        rows += [(line, f"has the word {word!r}") for word in words]
    for line, text in (*strings(source), *comments(source)):
        rows += [(line, reason) for reason in fractions(text)]
    return sorted(rows)


def in_package() -> dict[str, list[tuple[int, str]]]:
    """Mistakes by file of the package."""
    paths = {str(path.relative_to(ROOT)): path for path in sorted((ROOT / "nnap_em").rglob("*.py"))}
    rows = {name: mistakes(path.read_text()) for name, path in paths.items()}
    return {name: lines for name, lines in rows.items() if lines}


def on_pages() -> dict[str, list[tuple[int, str]]]:
    """Numbers without their zero by page."""
    pages = {str(path.relative_to(ROOT)): path for pattern in PAGES for path in sorted(ROOT.glob(pattern))}
    rows = {
        name: [(at, reason) for at, line in enumerate(path.read_text().splitlines(), 1) for reason in fractions(line)]
        for name, path in pages.items()
    }
    return {name: lines for name, lines in rows.items() if lines}


if __name__ == "__main__":
    wrong = in_package() | on_pages()
    for name, lines in wrong.items():
        for line, reason in lines:
            print(f"{name}:{line}: {reason}")
    sys.exit(bool(wrong))
