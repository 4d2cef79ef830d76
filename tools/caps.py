"""Caps on the size of the code: print the table and what changed, and fail if a figure grew.

    python tools/caps.py            compare with tools/caps.json
    python tools/caps.py --update   write the present figures; a commit that raises one says why in its body

Lines are those of Python files, or of Markdown for `docs`. A constant is a name that a module sets to a
number, or to a tuple of numbers. A literal is a number without a name in a function, other than 0, 1 and 2
with either sign. `statements` is the number of statements of the longest function, its docstring included.
"""

from __future__ import annotations

import ast
import json
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path

import pandas as pd
import tyro

from caryatid.config import Config

ROOT = Path(__file__).parents[1]
SOURCE = ROOT / "src/caryatid"
TABLE = Path(__file__).with_name("caps.json")
METHOD = ("sensing", "fitting", "segmentation", "objects", "support", "planning", "manipulation")
"""Rooms of the method, where every number needs a name, a unit and a reason."""
FREE = (0, 1, 2)
"""Numbers that need no name."""


def count_lines(*paths: Path) -> int:
    """Count the lines of files."""
    return sum(len(path.read_text(encoding="utf-8").splitlines()) for path in paths)


def count_settings(settings: object) -> int:
    """Count the settings of a configuration and of the groups in it."""
    values = [getattr(settings, f.name) for f in fields(settings)]  # type: ignore[arg-type]
    return sum(count_settings(value) if is_dataclass(value) else 1 for value in values)


def is_numeric(node: ast.expr | None) -> bool:
    """Whether an expression is a number, or a tuple of numbers."""
    if isinstance(node, ast.Tuple):
        return bool(node.elts) and all(is_numeric(e) for e in node.elts)
    if isinstance(node, ast.BinOp):
        return is_numeric(node.left) and is_numeric(node.right)
    if isinstance(node, ast.UnaryOp):
        return is_numeric(node.operand)
    return isinstance(node, ast.Constant) and type(node.value) in (int, float)


def count_constants(module: ast.Module) -> int:
    """Count the names that a module sets to numbers."""
    return sum(isinstance(n, ast.Assign | ast.AnnAssign) and is_numeric(n.value) for n in module.body)


def find_functions(module: ast.Module) -> Iterator[ast.FunctionDef]:
    """Find all functions and methods."""
    return (n for n in ast.walk(module) if isinstance(n, ast.FunctionDef))


def count_literals(module: ast.Module) -> int:
    """Count the numbers without a name in the bodies of functions; those of nested functions count once."""
    numbers = {
        n
        for f in find_functions(module)
        for statement in f.body
        for n in ast.walk(statement)
        if isinstance(n, ast.Constant) and type(n.value) in (int, float) and n.value not in FREE
    }
    return len(numbers)


def count_statements(function: ast.FunctionDef) -> int:
    """Count the statements of a function."""
    return sum(isinstance(n, ast.stmt) for n in ast.walk(function)) - 1


def measure() -> dict[str, int]:
    """Measure the code, by `room: figure`."""
    paths = sorted(SOURCE.rglob("*.py"))
    modules = {path: ast.parse(path.read_text(encoding="utf-8")) for path in paths}
    rooms = {path: path.relative_to(SOURCE).parts[0].removesuffix(".py") for path in paths}
    # Builds of the docs write pages too, which git ignores.
    listed = subprocess.run(["git", "ls-files", "docs/*.md"], cwd=ROOT, capture_output=True, check=True)
    pages = listed.stdout.decode().split()
    found = {
        "src: lines": count_lines(*paths),
        "src: files": len(paths),
        "src: settings": count_settings(Config()),
        "src: constants": sum(map(count_constants, modules.values())),
        "tests: lines": count_lines(*(ROOT / "tests").rglob("*.py")),
        "benchmarks, tools: lines": count_lines(*ROOT.glob("benchmarks/*.py"), *ROOT.glob("tools/*.py")),
        "docs: lines": count_lines(*(ROOT / name for name in pages)),
        "README: lines": count_lines(ROOT / "README.md"),
    }
    for room in sorted(set(rooms.values()) - {"__init__", "__main__"}):
        inside = {path: module for path, module in modules.items() if rooms[path] == room}
        found[f"{room}: lines"] = count_lines(*inside)
        found[f"{room}: statements"] = max(
            count_statements(f) for module in inside.values() for f in find_functions(module)
        )
        if room in METHOD:
            found[f"{room}: literals"] = sum(map(count_literals, inside.values()))
    return found


def main(update: bool = False) -> int:
    """Compare the size of the code with the committed caps, and return 1 if a figure is above its cap.

    Args:
        update: Write the present figures as the caps.
    """
    found = measure()
    caps: dict[str, int] = json.loads(TABLE.read_text(encoding="utf-8")) if TABLE.exists() else {}
    keys = pd.MultiIndex.from_tuples([tuple(name.split(": ")) for name in found])
    table = pd.Series([*found.values()], keys, dtype="Int64").unstack(sort=False)
    print(table.to_string(na_rep=""))
    for name in sorted(found.keys() | caps.keys()):
        if found.get(name, 0) != caps.get(name, 0):
            print(f"{name}: {caps.get(name, 0)} → {found.get(name, 0)}")
    if update:
        TABLE.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
        return 0
    grown = [name for name, value in found.items() if value > caps.get(name, 0)]
    if grown:
        print(f"above the cap: {', '.join(grown)}", file=sys.stderr)
        print("simplify the code, or raise the cap (--update) and say why in the commit", file=sys.stderr)
    return min(len(grown), 1)


if __name__ == "__main__":
    sys.exit(tyro.cli(main))
