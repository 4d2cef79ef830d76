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


def public() -> Iterator[tuple[str, ast.FunctionDef | ast.ClassDef, docstring_parser.Docstring, str]]:
    """Place, node, parsed docstring and docstring of each public function and class."""
    for file in sorted(ROOT.rglob("*.py")):
        stack = list(ast.parse(file.read_text(encoding="utf-8")).body)
        while stack:
            node = stack.pop()
            if not isinstance(node, ast.FunctionDef | ast.ClassDef) or node.name.startswith("_"):
                continue
            stack += node.body if isinstance(node, ast.ClassDef) else []
            text = ast.get_docstring(node) or ""
            parsed = docstring_parser.parse(text, style=docstring_parser.DocstringStyle.GOOGLE)
            yield f"{file.relative_to(ROOT)}:{node.lineno} {node.name}", node, parsed, text


def annotated(node: ast.FunctionDef | ast.ClassDef) -> Iterator[tuple[str, ast.AST | None, str | None]]:
    """Name, annotation and docstring of each argument and of the result, or of each field."""
    if isinstance(node, ast.FunctionDef):
        for a in (*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs):
            yield a.arg, a.annotation, None
        yield "its result", node.returns, None
        return
    for field, below in itertools.pairwise([*node.body, None]):
        if isinstance(field, ast.AnnAssign) and not field.target.id.startswith("_"):
            said = isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant)
            yield field.target.id, field.annotation, str(below.value.value) if said else None


def test_arrays_in_parameters_results_and_fields_have_shapes():
    missing = []
    for place, node, parsed, text in public():
        if ELSEWHERE.search(text) or node.name in PROTOCOLS:
            continue
        told: dict[str, str] = {}
        for entry in parsed.meta:
            if len(entry.args) > 1:  # `a, b` speak of several at once
                names = [name.strip().lstrip("*") for name in entry.args[1].split(",")]
                told |= dict.fromkeys(names, entry.description or "")
        for name, annotation, said in annotated(node):
            array = annotation is not None and ARRAYS.search(ast.unparse(annotation))
            if array and not SHAPE.search(said or told.get(name, text)):
                missing.append(f"{place}: {name}")
    assert not missing, "\n".join(missing)


def test_errors_of_ours_are_documented():
    missing = []
    for place, node, parsed, text in public():
        known = {entry.type_name for entry in parsed.raises}
        # Linters accept a missing docstring only of functions that run commands.
        if isinstance(node, ast.FunctionDef) and text and "CaryatidError" not in known:
            raises = [
                r.exc for r in ast.walk(node) if isinstance(r, ast.Raise) and isinstance(r.exc, ast.Call)
            ]
            missing += [f"{place} raises {k}" for k in {ast.unparse(r.func) for r in raises} & OURS - known]
    assert not missing, "\n".join(missing)
