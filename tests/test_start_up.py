"""Starting is fast: the package and the help of its commands import nothing heavy, and no name is missed."""

from __future__ import annotations

import ast
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

import caryatid
import caryatid.io

pytestmark = pytest.mark.slow

HEAVY = ("numpy", "scipy", "numba", "mujoco", "shapely", "networkx", "matplotlib", "trimesh", "PIL", "jinja2")

IMPORTED = """
import json, sys
from caryatid.cli import main
try:
    main(sys.argv[2:])
except SystemExit:
    pass
print("\\n" + json.dumps([name for name in json.loads(sys.argv[1]) if name in sys.modules]))
"""


def python(code, *arguments, **environment):
    """Run code in a process of its own."""
    return subprocess.run(
        [sys.executable, "-c", code, *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=120,
        env=os.environ | environment,
        check=False,
    )


@pytest.mark.parametrize(
    "command",
    [
        "",
        "juggle",
        "--help",
        "demo --help",
        "explore --help",
        "extract --help",
        "evaluate --help",
        "import --help",
        "export --help",
        "benchmark --help",
        "session add --help",
        "serve --help",
        "completion --help",
        "completion sh",
        "--version",
        "benchmark --suite nothing",
        "explore --planner support",
        "config",
        "config --set fit.step=1",
    ],
)
def test_what_only_talks_imports_nothing_heavy(command):
    done = python(IMPORTED, json.dumps(HEAVY), *command.split())
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout.splitlines()[-1]) == []


def test_the_package_imports_nothing_heavy():
    code = "import caryatid, sys; print(caryatid.Config, *sys.modules)"
    done = python(code)
    assert done.returncode == 0, done.stderr
    assert not set(HEAVY) & set(done.stdout.split())


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
def test_names_come_from_where_type_checkers_are_told(package):
    names = declared(package)
    assert names
    assert set(names) <= set(package.__all__) <= set(dir(package))
    for name, module in names.items():
        assert getattr(package, name) is getattr(sys.modules[module], name)
    assert all(hasattr(package, name) for name in package.__all__)


def test_a_package_has_its_modules_and_nothing_else():
    done = python("import caryatid; caryatid.scene.Scene; caryatid.frame")
    assert done.returncode == 1
    assert "AttributeError: module 'caryatid' has no attribute 'frame'" in done.stderr


def test_what_is_missing_in_a_module_of_ours_is_said_as_it_is():
    """A module that cannot be imported is not taken for a name that does not exist."""
    done = python("import sys; sys.modules['numpy'] = None; import caryatid; caryatid.scene")
    assert done.returncode == 1
    assert "ModuleNotFoundError: import of numpy halted" in done.stderr


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
@pytest.mark.parametrize("command", ["demo", "explore tower", "extract nowhere"])
def test_an_interrupt_while_modules_are_imported_is_one_line(tmp_path, module, command):
    done = python(INTERRUPTED, module, *command.split(), "--out", tmp_path / "run")
    assert done.returncode == 130
    assert done.stderr == "interrupted: nothing was written\n"
    assert not (tmp_path / "run").exists()
