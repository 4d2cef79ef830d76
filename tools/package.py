"""Build wheel and sdist, and try them in clean environments: the wheel in each Python, the sdist in one."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import tyro

ROOT = Path(__file__).parents[1]
VERSIONS = tuple(re.findall(r"Python :: (3\.\d+)", (ROOT / "pyproject.toml").read_text()))
"""Python versions in the classifiers."""


def find_python(wanted: str) -> Path | None:
    """Find an interpreter of a version such as 3.12: this one, or one in pyenv or on the PATH."""
    if sys.version.startswith(f"{wanted}."):
        return Path(sys.executable)
    pyenv = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
    found = max(pyenv.glob(f"{wanted}[.-]*/bin/python"), key=numbers, default=None)
    command = shutil.which(f"python{wanted}")  # of pyenv, a shim that may start none
    return found or (Path(command) if command else None)


def numbers(python: Path) -> list[int]:
    """Return the numbers in the version of a pyenv interpreter."""
    return [int(digits) for digits in re.findall(r"\d+", python.parts[-3])]


def try_out(python: Path, distribution: Path, folder: Path) -> dict[str, object]:
    """Install a distribution in a new environment, and try it in an empty folder."""
    begun = time.monotonic()
    run(str(python), "-m", "venv", str(folder / "venv"))
    installed_python = str(folder / "venv/bin/python")
    pip = installed_python, "-m", "pip", "--disable-pip-version-check", "--quiet"
    run(*pip, "install", "--constraint", str(ROOT / "constraints.txt"), str(distribution))
    installed = time.monotonic() - begun
    (folder / "empty").mkdir()
    said = run(installed_python, "-I", str(ROOT / "tools/smoke.py"), cwd=folder / "empty")
    size = sum(f.stat().st_size for f in (folder / "venv").rglob("*") if f.is_file() and not f.is_symlink())
    told: dict[str, object] = json.loads(said.splitlines()[-1])
    return told | {"install seconds": round(installed, 1), "environment MB": round(size / 1e6)}


def run(*words: str, cwd: Path | None = None) -> str:
    """Run a program and return its output; if it fails, exit with the end of its output."""
    own = ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV", "NUMBA_CACHE_DIR")
    environment = {name: value for name, value in os.environ.items() if name not in own}
    done = subprocess.run(words, cwd=cwd, env=environment, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        sys.exit(f"{' '.join(words)}\n{done.stdout[-2000:]}\n{done.stderr[-4000:]}")
    return done.stdout


def main(out: Path = ROOT / "dist", python: tuple[str, ...] = VERSIONS) -> None:
    """Build into a folder, install and try in these Pythons; print one line per Python and distribution."""
    shutil.rmtree(out, ignore_errors=True)
    run(sys.executable, "-m", "build", "--outdir", str(out), str(ROOT))
    (wheel,), (sdist,) = out.glob("*.whl"), out.glob("*.tar.gz")
    run(sys.executable, "-m", "twine", "check", "--strict", str(wheel), str(sdist))
    for file in (wheel, sdist):
        print(f"{file.name}: {file.stat().st_size / 1e6:.2f} MB", flush=True)
    pythons = {wanted: find_python(wanted) for wanted in python}
    distributions = [wheel, sdist]
    for wanted, found in pythons.items():
        if found is None:
            print(f"Python {wanted}: not installed, skipped", flush=True)
            continue
        for distribution in distributions:
            with tempfile.TemporaryDirectory(prefix="caryatid-") as folder:
                told = try_out(found, distribution, Path(folder))
            print(f"Python {wanted}, {distribution.suffix.lstrip('.')}: {json.dumps(told)}", flush=True)
        distributions = [wheel]
    if not any(pythons.values()):
        sys.exit("none of these Python versions is installed")


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
