"""What linters do not check of docstrings: arrays with their shapes, and our own errors."""

from __future__ import annotations

import ast
import inspect
import itertools
import re
from collections.abc import Iterator
from pathlib import Path

import docstring_parser

import caryatid
from caryatid import errors

ROOT = Path(caryatid.__file__).parent
ARRAYS = re.compile(r"\b(Array|NDArray|ArrayLike|ndarray)\b")
"""Annotations of arrays."""
SHAPE = re.compile(r"\((?:(?:[\dA-Z]|\.\.\.)[\w₀-₉]*(?: ?[-−+×·] ?\w+)*(?:, ?|(?=\))))+\)")
"""A shape: (N, 3), (4, 4), (N,), (..., 3), (N − 1,)."""
ELSEWHERE = re.compile(r"rguments\s+(?:are\s+)?as\s+(?:in `|there|below)")
"""Says of which docstring the arguments are."""
PROTOCOLS = ("capture", "candidates", "move_to", "plan")
"""Methods whose arguments are documented by their protocol."""
OURS = {
    n for n, kind in vars(errors).items() if inspect.isclass(kind) and issubclass(kind, errors.CaryatidError)
}


def public(kind: type) -> Iterator[tuple[str, ast.AST, str]]:
    """Place, node and docstring of each public function or class."""
    for file in sorted(ROOT.rglob("*.py")):
        tree = ast.parse(file.read_text(encoding="utf-8"))
        stack = list(tree.body)
        while stack:
            node = stack.pop()
            if getattr(node, "name", "_").startswith("_"):
                continue
            if isinstance(node, ast.ClassDef):
                stack += node.body
            if isinstance(node, kind):
                place = f"{file.relative_to(ROOT)}:{node.lineno} {node.name}"
                yield place, node, ast.get_docstring(node) or ""


def told(text: str) -> dict[str, str]:
    """What a docstring's sections say of each name; `a, b` speak of several at once."""
    found: dict[str, str] = {}
    for entry in docstring_parser.parse(text, style=docstring_parser.DocstringStyle.GOOGLE).meta:
        if len(entry.args) > 1:
            names = [name.strip().lstrip("*") for name in entry.args[1].split(",")]
            found |= dict.fromkeys(names, entry.description or "")
    return found


def shaped(annotation: ast.AST | None, text: str) -> bool:
    """Whether a text says the shape of what has this annotation, or need not."""
    array = annotation is not None and ARRAYS.search(ast.unparse(annotation))
    return not array or bool(SHAPE.search(text))


def test_arrays_in_parameters_and_results_have_shapes():
    missing = []
    for place, node, text in public(ast.FunctionDef):
        if ELSEWHERE.search(text) or node.name in PROTOCOLS:
            continue
        known = told(text)
        arguments = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
        missing += [
            f"{place}({a.arg})" for a in arguments if not shaped(a.annotation, known.get(a.arg, text))
        ]
        missing += [] if shaped(node.returns, text) else [f"{place} returns"]
    assert not missing, "\n".join(missing)


def test_arrays_in_fields_have_shapes():
    missing = []
    for place, node, text in public(ast.ClassDef):
        known = told(text)
        for field, below in itertools.pairwise([*node.body, None]):
            if not isinstance(field, ast.AnnAssign) or field.target.id.startswith("_"):
                continue
            own = isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant)
            words = str(below.value.value) if own else known.get(field.target.id, text)
            missing += [] if shaped(field.annotation, words) else [f"{place}.{field.target.id}"]
    assert not missing, "\n".join(missing)


def test_errors_of_ours_are_documented():
    missing = []
    for place, node, text in public(ast.FunctionDef):
        if not text:  # linters accept this only of functions that run commands
            continue
        parsed = docstring_parser.parse(text, style=docstring_parser.DocstringStyle.GOOGLE)
        known = {entry.type_name for entry in parsed.raises}
        raises = [n.exc for n in ast.walk(node) if isinstance(n, ast.Raise) and isinstance(n.exc, ast.Call)]
        if "CaryatidError" not in known:
            missing += [f"{place} raises {k}" for k in {ast.unparse(r.func) for r in raises} & OURS - known]
    assert not missing, "\n".join(missing)
