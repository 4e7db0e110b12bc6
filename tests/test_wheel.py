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


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    """Built from the unpacked source archive, so that the archive is known to be whole."""
    folder = tmp_path_factory.mktemp("dist")
    build = (sys.executable, "-m", "hatchling", "build", "-d", folder)
    _run(*build, "-t", "sdist", cwd=ROOT)
    (archive,) = folder.glob("*.tar.gz")
    with tarfile.open(archive) as source:
        source.extraction_filter = getattr(tarfile, "data_filter", None)  # Python 3.11.4 and newer
        source.extractall(folder)
    _run(*build, "-t", "wheel", cwd=folder / f"nnap_em-{nnap_em.__version__}")
    (built,) = folder.glob("*.whl")
    return built


@pytest.mark.slow
def test_wheel_holds_the_package_and_nothing_else(wheel):
    names = zipfile.ZipFile(wheel).namelist()
    source = [p for p in (ROOT / "nnap_em").rglob("*") if p.is_file() and p.suffix not in (".pyc", ".md")]
    about = f"nnap_em-{nnap_em.__version__}.dist-info"
    extra = {f"{about}/{name}" for name in ("METADATA", "RECORD", "WHEEL", "entry_points.txt", "licenses/LICENSE")}
    assert set(names) == {str(p.relative_to(ROOT)) for p in source} | extra
    assert wheel.stat().st_size < 1_000_000


@pytest.mark.slow
def test_installed_command_runs_elsewhere(wheel, tmp_path):
    """In a new environment that sees the packages of this one, but no link from it to the checkout."""
    _run(sys.executable, "-m", "venv", "--without-pip", tmp_path / "env", cwd=tmp_path)
    python = tmp_path / "env/bin/python"
    _run(sys.executable, "-m", "pip", "--python", python, "install", "--no-deps", "--no-index", wheel, cwd=tmp_path)
    site = _run(python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))", cwd=tmp_path).strip()
    (Path(site) / "packages_of_the_test.pth").write_text(sysconfig.get_path("purelib") + "\n")
    home = _run(python, "-c", "import nnap_em; print(nnap_em.__file__)", cwd=tmp_path)
    assert home.startswith(site)

    written = _run(python, "-c", "from nnap_em.report.page import page; print(page({'effects': []}))", cwd=tmp_path)
    assert "No effect of the catalogue" in written

    command = tmp_path / "env/bin/nnap-em"
    assert "simulate" in _run(command, "--help", cwd=tmp_path)
    assert _run(command, "--version", cwd=tmp_path) == f"nnap-em {nnap_em.__version__}\n"
    small = ("--system", "slide", "--sequences", 1, "--test", 1, "--steps", 20)
    _run(command, "simulate", "bench", *small, cwd=tmp_path, XDG_CACHE_HOME=str(tmp_path / "cache"))
    assert (tmp_path / "bench/train/000.csv").read_text().count("\n") == 22
