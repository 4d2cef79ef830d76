"""Starting is fast: the package and what only talks import nothing heavy, and no name is missed."""

from __future__ import annotations

import ast
import json
import subprocess
import sys
from pathlib import Path

import pytest

import caryatid
import caryatid.io

pytestmark = pytest.mark.slow

HEAVY = ("numpy", "scipy", "numba", "mujoco", "shapely", "networkx", "matplotlib", "trimesh", "PIL", "jinja2")

TALK = (
    "juggle", "--help", "--version", "demo --help", "explore --help", "extract --help", "evaluate --help",
    "import --help", "export --help", "benchmark --help", "session add --help", "serve --help",
    "completion --help", "completion sh", "benchmark --suite nothing", "explore --planner support", "config",
    "config --set fit.step=1",
)  # fmt: skip
"""Commands that compute nothing."""

IMPORTED = """
import json, sys
heavy, commands = map(json.loads, sys.argv[1:])

def found(*more):
    return [name for name in (*heavy, *more) if name in sys.modules]

def said(command, *more):
    try:
        main(command.split())
    except SystemExit:
        pass
    return found(*more)

import caryatid
from caryatid.cli import main
imported = {"": said("--help", "pydantic", "rich")}
caryatid.Config
imported |= {command: said(command) for command in commands}
print("\\n" + json.dumps(imported))
"""


def python(code, *arguments):
    """Run code in a process of its own."""
    command = [sys.executable, "-c", code, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)


def test_what_only_talks_imports_nothing_heavy():
    done = python(IMPORTED, json.dumps(HEAVY), json.dumps(TALK))
    assert done.returncode == 0, done.stderr
    imported = json.loads(done.stdout.splitlines()[-1])
    assert len(imported) == len(TALK) + 1
    assert {command: names for command, names in imported.items() if names} == {}


def declared(package):
    """Name → module, as type checkers read it from the imports under TYPE_CHECKING."""
    tree = ast.parse(Path(package.__file__).read_text())
    blocks = [
        node for node in tree.body if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
    ]
    imports = [node for block in blocks for node in block.body]
    assert all(isinstance(node, ast.ImportFrom) for node in imports)
    return {alias.name: node.module for node in imports for alias in node.names}


@pytest.mark.parametrize("package", [caryatid, caryatid.io])
def test_names_come_from_where_type_checkers_look(package):
    names = declared(package)
    assert names
    assert set(names) <= set(package.__all__) <= set(dir(package))
    for name, module in names.items():
        assert getattr(package, name) is getattr(sys.modules[module], name)
    assert all(hasattr(package, name) for name in package.__all__)
    with pytest.raises(AttributeError, match=f"module '{package.__name__}' has no attribute 'frame'"):
        _ = package.frame


INTERRUPTED = """
import os, signal, sys

class Interrupt:
    def find_spec(self, name, path=None, target=None):
        if name == sys.argv[1]:
            os.kill(os.getpid(), signal.SIGINT)

sys.meta_path.insert(0, Interrupt())
signal.signal(signal.SIGINT, signal.default_int_handler)
from caryatid.cli import main
sys.exit(main(sys.argv[2:]))
"""


@pytest.mark.parametrize("module", ["tyro", "caryatid.config", "numba", "scipy.spatial", "caryatid.scene"])
def test_an_interrupt_while_modules_are_imported_is_one_line(tmp_path, module):
    done = python(INTERRUPTED, module, "explore", "tower", "--out", tmp_path / "run")
    assert done.returncode == 130
    assert done.stderr == "interrupted: nothing was written\n"
    assert not (tmp_path / "run").exists()
