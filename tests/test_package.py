"""What is published: wheel and sdist hold what they should, and extras are needed only where asked for."""

from __future__ import annotations

import ast
import itertools
import json
import re
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from email.parser import Parser
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest
from bag_files import write_bag
from conftest import SMALL, run_command
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from phone_files import write_stray

import caryatid

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
NOT_SOURCE = {"__pycache__", ".git", ".venv", "dist", "build", "_build"}


def sources(folder):
    """Files of a folder of the repository, without what tools leave behind."""
    found = {p.relative_to(ROOT) for p in (ROOT / folder).rglob("*") if p.is_file()}
    return {p.as_posix() for p in found if not NOT_SOURCE & set(p.parts) and p.suffix != ".pyc"}


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """Wheel and sdist, built without a network."""
    folder = tmp_path_factory.mktemp("dist")
    done = subprocess.run(
        [sys.executable, "-m", "hatchling", "build", "-d", str(folder)],
        cwd=ROOT, capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    (wheel,), (sdist,) = folder.glob("*.whl"), folder.glob("*.tar.gz")
    return zipfile.ZipFile(wheel), tarfile.open(sdist)


def test_the_wheel_holds_the_package_and_nothing_else(built):
    names = set(built[0].namelist())
    assert {name for name in names if name.startswith("caryatid/")} == {
        name.removeprefix("src/") for name in sources("src/caryatid")
    }
    assert {"caryatid/py.typed", "caryatid/viz/page.html.jinja"} <= names
    assert {name.split("/")[0] for name in names} == {
        "caryatid",
        f"caryatid-{caryatid.__version__}.dist-info",
    }
    assert any(name.endswith("licenses/LICENSE") for name in names)
    assert sum(info.file_size for info in built[0].infolist()) < 5_000_000


def test_the_sdist_holds_tests_docs_and_what_the_tests_read(built):
    names = {name.partition("/")[2] for name in built[1].getnames()}
    for folder in ("src", "tests", "examples", "benchmarks", "ros", "tools"):
        assert sources(folder) <= names
    files = ("README.md", "CHANGELOG.md", "CITATION.cff", "LICENSE", "Makefile", "constraints.txt")
    assert {*files, "docs/method.md", "pyproject.toml"} <= names
    assert not any(NOT_SOURCE & set(name.split("/")) or name.endswith((".nbi", ".nbc")) for name in names)


def test_metadata_for_package_indices(built):
    (path,) = (name for name in built[0].namelist() if name.endswith(".dist-info/METADATA"))
    told = Parser().parsestr(built[0].read(path).decode())
    assert told["Version"] == caryatid.__version__
    assert told["License-Expression"] == "BSD-3-Clause"
    assert told["Description-Content-Type"] == "text/markdown"
    assert told.get_payload() == (ROOT / "README.md").read_text()
    users = {*MODULES, "arm", "all"}
    extras = users | {"bench", "docs", "dev"}
    assert set(told.get_all("Provides-Extra")) == extras
    (scripts,) = (name for name in built[0].namelist() if name.endswith("entry_points.txt"))
    assert "caryatid = caryatid.cli:run_from_shell" in built[0].read(scripts).decode()


def test_the_version_is_written_in_one_place_and_cited():
    assert PROJECT["dynamic"] == ["version"]
    cited = (ROOT / "CITATION.cff").read_text()
    fields = re.findall(r"^(?: {4}title|version|.*family-names): (.+)$", cited, re.M)
    bibtex = re.search(r"```text\n(@.*?)```", (ROOT / "README.md").read_text(), re.S)[1]
    assert caryatid.__version__ in fields
    assert all(text in bibtex for text in fields)
    assert f"## {caryatid.__version__}" in (ROOT / "CHANGELOG.md").read_text()


def test_all_that_is_needed_is_pinned():
    """A clone installs the same packages wherever it is set up."""
    pinned = {
        canonicalize_name(line.partition("==")[0])
        for line in (ROOT / "constraints.txt").read_text().splitlines()
        if "==" in line
    }
    lines = [PROJECT["dependencies"], *PROJECT["optional-dependencies"].values()]
    wanted = {canonicalize_name(Requirement(line).name) for line in itertools.chain(*lines)}
    assert wanted - {"caryatid"} <= pinned


def test_all_that_the_package_imports_is_declared():
    trees = [ast.parse(path.read_text()) for path in (ROOT / "src").rglob("*.py")]
    nodes = [node for tree in trees for node in ast.walk(tree)]
    names = {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
    names |= {node.module for node in nodes if isinstance(node, ast.ImportFrom) and not node.level}
    roots = {name.partition(".")[0] for name in names} - sys.stdlib_module_names - {"caryatid"}
    extras = PROJECT["optional-dependencies"]
    lines = [PROJECT["dependencies"], *(extras[name] for name in MODULES)]
    declared = {canonicalize_name(Requirement(line).name) for line in itertools.chain(*lines)}
    found = packages_distributions()
    assert {r for r in roots if not {canonicalize_name(n) for n in found.get(r, [r])} & declared} == set()


# Extras

MODULES = {
    "view": ["viser"],
    "serve": ["fastapi", "starlette", "uvicorn"],
    "phone": ["av", "lzfse"],
    "ros": ["rosbags"],
    "usd": ["pxr"],
    "rerun": ["rerun"],
    "foxglove": ["foxglove"],
    "learn": ["gymnasium"],
    "benchmark": ["pandas"],
}

BLOCKED = """
import json, sys

class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in blocked:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

blocked = json.loads(sys.argv[1])
sys.meta_path.insert(0, Missing())
import caryatid
assert all(getattr(caryatid, name) is not None for name in caryatid.__all__)
from caryatid.cli import main
sys.exit(main(sys.argv[2:]))
"""


def without(modules, *words):
    """Run a command where some modules are not installed."""
    return subprocess.run(
        [sys.executable, "-c", BLOCKED, json.dumps(modules), *map(str, words)],
        capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip


def test_every_extra_of_users_is_in_all_and_tried_here():
    (line,) = PROJECT["optional-dependencies"]["all"]
    assert set(line.partition("[")[2].rstrip("]").split(",")) == set(MODULES)


def test_the_core_needs_no_extra(tmp_path, scene_file):
    modules = [name for names in MODULES.values() for name in names]
    done = without(modules, "explore", scene_file, "--views", 1, "--out", tmp_path / "run", *SMALL)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "run/report.html").is_file()


WORDS = {
    "view": "view {run}",
    "serve": "serve {folder}/sessions",
    "phone": "import {folder}/scan --out {folder}/phone",
    "ros": "import {folder}/pour.bag --depth /d --info /i --out {folder}/pour",
    "usd": "export {run} --out {folder}/scene.usda",
    "rerun": "export {run} --out {folder}/run.rrd",
    "foxglove": "export {run} --out {folder}/run.mcap",
    "benchmark": "benchmark --out {folder}/bench",
}


@pytest.mark.parametrize("extra", WORDS)
def test_a_missing_extra_is_named(tmp_path, scene_file, views, extra):
    if extra == "phone":
        write_stray(tmp_path / "scan", views)
    if extra == "ros":
        write_bag(tmp_path / "pour.bag", views)
    run = tmp_path / "run"
    if extra in ("view", "usd", "rerun", "foxglove"):
        words = ["--views", 1, "--out", run, *SMALL, "--quiet", "--no-report"]
        assert run_command("explore", scene_file, *words) == 0
    before = sorted(tmp_path.rglob("*"))
    done = without(MODULES[extra], *WORDS[extra].format(folder=tmp_path, run=run).split())
    assert done.returncode == 1
    assert done.stderr.startswith("error: ")
    assert done.stderr.count("\n") == 1
    assert re.search(rf'-m pip install ".*\[{extra}\]"', done.stderr)
    assert sorted(tmp_path.rglob("*")) == before
