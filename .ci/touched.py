"""Print the files of slow tests that the last commits may have broken: those of the four hours up to HEAD.

A test uses the folders of the package that it names, and all that these import from, which stand before them in
CONTRIBUTING.md.
"""

import re
import subprocess
from datetime import datetime, timedelta
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = re.findall(r"\]\(nnap_em/(\w+)/\)", (ROOT / "CONTRIBUTING.md").read_text())


def _git(*words: str) -> str:
    return subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=True).stdout


def main() -> None:
    """One name a line."""
    try:
        since = datetime.fromisoformat(_git("show", "-s", "--format=%cI", "HEAD").strip()) - timedelta(hours=4)
        changed = set(_git("log", f"--since={since.isoformat()}", "--name-only", "--format=").split())
    except (OSError, subprocess.CalledProcessError):  # no clone: all of them
        changed = {"nnap_em/base/"}
    inside = [name.split("/")[1] for name in changed if name.startswith("nnap_em/")]
    first = min((FOLDERS.index(folder) if folder in FOLDERS else 0 for folder in inside), default=len(FOLDERS))
    for path in sorted((ROOT / "tests").glob("test_*.py")):
        text, name = path.read_text(), f"tests/{path.name}"
        used = {FOLDERS.index(folder) for folder in re.findall(r"from nnap_em\.(\w+)", text) if folder in FOLDERS}
        # by the package's top, a command or an example all of it may be used
        top = re.search(r"(?m)^\s*(import nnap_em|from nnap_em import)", text)
        last = len(FOLDERS) - 1 if top or not used else max(used)
        if "mark.slow" in text and (name in changed or first <= last):
            print(name)


if __name__ == "__main__":
    main()
