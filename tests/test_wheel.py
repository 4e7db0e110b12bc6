"""What is published: a wheel from the source archive, installed beside nothing of the checkout, runs elsewhere."""

import os
import subprocess
import sys
import sysconfig
import tarfile
import zipfile
from pathlib import Path

import pytest

import nnap_em

ROOT = Path(__file__).resolve().parents[1]


def _run(*command: object, cwd: Path, **env: str) -> str:
    """Run a command that sees neither the checkout nor the caller's settings of Python."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    words = [str(word) for word in command]
    done = subprocess.run(words, cwd=cwd, env=kept | env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.slow  # fast: none, it builds the package
def test_the_wheel_holds_the_package_and_runs_elsewhere(tmp_path):
    """Built from the source archive, in an environment that sees the packages of this one, not the checkout."""
    build = (sys.executable, "-m", "hatchling", "build", "-d", tmp_path)
    _run(*build, "-t", "sdist", cwd=ROOT)
    (archive,) = tmp_path.glob("*.tar.gz")
    with tarfile.open(archive) as source:
        source.extraction_filter = getattr(tarfile, "data_filter", None)  # Python 3.11.4 and newer
        source.extractall(tmp_path)
    _run(*build, "-t", "wheel", cwd=tmp_path / f"nnap_em-{nnap_em.__version__}")
    (wheel,) = tmp_path.glob("*.whl")
    package = [p for p in (ROOT / "nnap_em").rglob("*") if p.is_file() and p.suffix not in (".pyc", ".md")]
    about = f"nnap_em-{nnap_em.__version__}.dist-info"
    extra = {f"{about}/{name}" for name in ("METADATA", "RECORD", "WHEEL", "entry_points.txt", "licenses/LICENSE")}
    assert set(zipfile.ZipFile(wheel).namelist()) == {str(p.relative_to(ROOT)) for p in package} | extra

    _run(sys.executable, "-m", "venv", "--without-pip", tmp_path / "env", cwd=tmp_path)
    python, command = tmp_path / "env/bin/python", tmp_path / "env/bin/nnap-em"
    _run(sys.executable, "-m", "pip", "--python", python, "install", "--no-deps", "--no-index", wheel, cwd=tmp_path)
    site = _run(python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))", cwd=tmp_path).strip()
    (Path(site) / "packages_of_the_test.pth").write_text(sysconfig.get_path("purelib") + "\n")
    assert _run(python, "-c", "import nnap_em; print(nnap_em.__file__)", cwd=tmp_path).startswith(site)
    written = _run(
        python, "-c", "from nnap_em.output.report.page import page; print(page({'effects': []}))", cwd=tmp_path
    )
    assert "No effect of the catalogue" in written
    assert _run(command, "--version", cwd=tmp_path) == f"nnap-em {nnap_em.__version__}\n"
    small = ("--system", "slide", "--sequences", 1, "--test", 1, "--steps", 20)
    _run(command, "simulate", "bench", *small, cwd=tmp_path, XDG_CACHE_HOME=str(tmp_path / "cache"))
    assert (tmp_path / "bench/train/000.csv").read_text().count("\n") == 22
