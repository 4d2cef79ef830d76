"""Every public name says what it is: arrays with their shapes, parameters, and the errors it raises.

ruff checks that docstrings are there and well formed, and that `Args` is complete where there is one. What it
does not know is checked here: constants, fields, shapes, and errors of ours.
"""

from __future__ import annotations

import ast
import inspect
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import docstring_parser
import pytest

import caryatid
from caryatid import errors

ROOT = Path(caryatid.__file__).parent
FILES = sorted(ROOT.rglob("*.py"))
ARRAYS = re.compile(r"\b(Array|NDArray|ArrayLike|ndarray)\b")
"""Annotations of arrays."""
NUMBERS = re.compile(
    r"(float|Positive|NotNegative|Share|Likelihood|Factor|Cosine|Angle|Acute|Elevation|Azimuth)( \| None)?"
)
"""Annotations of numbers that may have a unit."""
SHAPE = re.compile(r"\((?:(?:[\dA-Z]|\.\.\.)[\w₀-₉]*(?: ?[-−+×·] ?\w+)*(?:, ?|(?=\))))+\)")
"""A shape: (N, 3), (4, 4), (N,), (..., 3), (N − 1,)."""
ALIAS = re.compile(
    r"^(NDArray|Literal|Annotated|Callable|tuple|list|dict|Mapping|Sequence|TypeVar|ParamSpec)\b|^\w+ \| "
    r"|^[A-Z]\w+\(\)$"
)
"""What types, and objects made of nothing, are assigned by: it says itself what they stand for."""
OURS = {
    name
    for name, kind in vars(errors).items()
    if inspect.isclass(kind) and issubclass(kind, errors.CaryatidError)
}
FEW, SEVERAL = 1, 3
"""Parameters a first sentence may speak of without `Args`: where users call, and inside."""
INSIDE = (
    "association",
    "benchmark",
    "change",
    "commands",
    "convexity",
    "explanation",
    "formats/json_files",
    "formats/pcd",
    "formats/staging",
    "interior",
    "joint_registration",
    "kernels",
    "late",
    "manipulation/telling",
    "merging",
    "notebook",
    "object_models",
    "object_points",
    "perception",
    "plain_colours",
    "polish",
    "pose_graph",
    "recordings/messages",
    "recordings/sources",
    "recordings/transforms",
    "refine",
    "registration",
    "rejoining",
    "report",
    "samples",
    "segmentation",
    "service",
    "sessions/captures",
    "sessions/checks",
    "sessions/durable",
    "sessions/folder",
    "sessions/next_view",
    "simulation/lifting",
    "simulation/mjcf",
    "simulation/noise",
    "simulation/solids",
    "simulation/world",
    "splitting",
    "stability",
    "surfels",
    "uniting",
    "viewer",
)
"""Parts nobody calls but caryatid itself."""
TOLD_BY_THEIR_PROTOCOL = frozenset({"capture", "candidates", "move_to", "plan"})
"""What cameras, robots and planners take is told once, by the protocol they follow."""
TOLD_ELSEWHERE = re.compile(r"rguments\s+(?:are\s+)?as\s+(?:in `|there|below)")
"""Says of which docstring the arguments are."""
TOLD_BY_THEIR_CLASS = frozenset({"general", "modelling", "settings", "step"})
"""Fields of commands that are groups of options: the class of the group says what it is."""


@dataclass(frozen=True)
class Name:
    """A public name and where it stands."""

    module: str
    path: tuple[str, ...]
    node: ast.AST

    @property
    def inside(self) -> bool:
        return any(self.module.startswith((f"{part}/", f"{part}.py")) for part in INSIDE)

    @property
    def text(self) -> str:
        return ast.get_docstring(self.node) or ""

    def __str__(self) -> str:
        return f"{self.module}:{self.node.lineno} {'.'.join(self.path)}"


@cache
def tree(file: Path) -> ast.Module:
    return ast.parse(file.read_text(encoding="utf-8"))


def named(file: Path, *path: str, node: ast.AST) -> Name:
    return Name(file.relative_to(ROOT).as_posix(), path, node)


def functions() -> Iterator[Name]:
    """All public functions and methods, but those Python calls itself."""
    for file in FILES:
        yield from _functions(file, tree(file).body)


def _functions(file: Path, body: Sequence[ast.stmt], *path: str) -> Iterator[Name]:
    for node in body:
        match node:
            case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name) if not name.startswith("_"):
                yield named(file, *path, name, node=node)
            case ast.ClassDef(name=name) if not name.startswith("_"):
                yield from _functions(file, node.body, *path, name)
            case ast.If():
                yield from _functions(file, node.body, *path)


def classes() -> Iterator[Name]:
    for file in FILES:
        for node in ast.walk(tree(file)):
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                yield named(file, node.name, node=node)


def constants() -> Iterator[tuple[Name, str]]:
    """Public names a module assigns, and the words that follow."""
    for file in FILES:
        for name, node, words in _assigned(tree(file).body):
            if node.value is not None and not ALIAS.search(ast.unparse(node.value)):
                yield named(file, name, node=node), words


def fields(kind: Name) -> Iterator[tuple[str, str, str]]:
    """Public fields of a class: name, annotation, and the words about it."""
    given = [(name, node, words) for name, node, words in _assigned(kind.node.body) if name != "model_config"]
    given.reverse()
    told = told_of(kind.text, [name for name, _, _ in given])
    for name, node, words in given:
        annotation = ast.unparse(node.annotation) if isinstance(node, ast.AnnAssign) else ""
        described = re.search(r"description=", ast.unparse(node))
        yield name, annotation, words or told.get(name, "") or ("described" if described else "")


def _assigned(body: Sequence[ast.stmt]) -> Iterator[tuple[str, ast.Assign | ast.AnnAssign, str]]:
    """Public names that are assigned, in order, with the text that follows; lines without a gap share it."""
    words, below = "", 0
    for node in reversed(body):
        match node:
            case ast.Expr(ast.Constant(str() as text)):
                words, below = text, node.lineno
            case ast.Assign() | ast.AnnAssign():
                words, below = words if node.end_lineno + 1 == below else "", node.lineno
                targets = node.targets if isinstance(node, ast.Assign) else [node.target]
                for item in [item for target in targets for item in getattr(target, "elts", [target])]:
                    if isinstance(item, ast.Name) and not item.id.startswith("_"):
                        yield item.id, node, words
            case _:
                words, below = "", 0


def told_of(text: str, names: Sequence[str]) -> dict[str, str]:
    """What a docstring's sections say of each name; `a, b` and `a, …, d` speak of several at once."""
    told: dict[str, str] = {}
    for entry in parsed(text).meta:
        if len(entry.args) > 1:
            group = [part.strip().lstrip("*") for part in entry.args[1].split(",")]
            if "…" in group:
                group = [*names[names.index(group[0]) : names.index(group[-1]) + 1]]
            told |= dict.fromkeys(group, entry.description or "")
    return told


@cache
def parsed(text: str) -> docstring_parser.Docstring:
    return docstring_parser.parse(text, style=docstring_parser.DocstringStyle.GOOGLE)


def parameters(function: Name) -> dict[str, str]:
    """Names and annotations, without `self` and what begins with an underscore."""
    arguments = function.node.args
    given = [*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs]
    given += [a for a in (arguments.vararg, arguments.kwarg) if a is not None]
    return {
        a.arg: ast.unparse(a.annotation) if a.annotation else ""
        for a in given
        if a.arg not in ("self", "cls") and not a.arg.startswith("_")
    }


def told_elsewhere(function: Name) -> bool:
    """Whether another docstring tells what it takes: its protocol's, its kernel's, or one it names."""
    plain_twin = function.module.startswith("kernels/") and function.path[-1].endswith("_reference")
    of_protocol = function.path[-1] in TOLD_BY_THEIR_PROTOCOL and len(function.path) > 1
    return plain_twin or of_protocol or bool(TOLD_ELSEWHERE.search(function.text))


@cache
def makers(module: str) -> dict[str, str]:
    """What each function of a module returns: some make the errors that others raise."""
    made = [node for node in ast.walk(tree(ROOT / module)) if isinstance(node, ast.FunctionDef)]
    return {node.name: ast.unparse(node.returns) for node in made if node.returns is not None}


def raised(function: Name) -> set[str]:
    """Errors of ours a function raises itself, or by a helper of its module that makes them."""
    found = set()
    for node in ast.walk(function.node):
        if isinstance(node, ast.Raise) and node.exc is not None:
            name = ast.unparse(node.exc.func if isinstance(node.exc, ast.Call) else node.exc)
            found.add(makers(function.module).get(name, name))
    return found & OURS


def test_there_is_something_to_look_at():
    assert len(list(functions())) > 800
    assert len(list(classes())) > 200
    assert len(list(constants())) > 200
    assert len([field for kind in classes() for field in fields(kind)]) > 1000
    assert {"InputError", "PlanningError", "PerceptionError", "CaryatidError"} <= OURS
    assert all((ROOT / part).is_dir() or (ROOT / f"{part}.py").is_file() for part in INSIDE)


def test_functions_and_classes_say_what_they_are():
    assert [str(name) for name in (*functions(), *classes()) if not name.text] == []
    assert [str(file) for file in FILES if not ast.get_docstring(tree(file))] == []


def test_constants_say_what_they_are():
    assert [str(name) for name, words in constants() if not words] == []


def test_fields_say_what_they_are():
    missing = [
        f"{kind}.{name}"
        for kind in classes()
        for name, _, words in fields(kind)
        if not words and not (kind.module.startswith("commands/") and name in TOLD_BY_THEIR_CLASS)
    ]
    assert not missing, "\n".join(missing)


def test_arrays_in_fields_have_shapes():
    missing = [
        f"{kind}.{name}"
        for kind in classes()
        for name, annotation, words in fields(kind)
        if ARRAYS.search(annotation) and not SHAPE.search(words)
    ]
    assert not missing, "\n".join(missing)


def test_parameters_are_told():
    missing = []
    for function in functions():
        given = parameters(function)
        told = told_of(function.text, list(given))
        few = SEVERAL if function.inside else FEW
        if (
            len(given) > few
            and not told_elsewhere(function)
            and function.path[-1] not in TOLD_BY_THEIR_PROTOCOL
        ):
            missing += [f"{function}({name})" for name in given if not told.get(name)]
    assert not missing, "\n".join(missing)


def test_protocols_tell_what_their_methods_take():
    for function in functions():
        if function.path[:-1] in (("Camera",), ("Robot",), ("Planner",)) and not function.inside:
            assert set(told_of(function.text, [])) >= set(parameters(function)), function


def test_arrays_in_parameters_have_shapes():
    missing = []
    for function in functions():
        given = parameters(function)
        told = told_of(function.text, list(given))
        if told_elsewhere(function):
            continue
        for name, annotation in given.items():
            if ARRAYS.search(annotation) and not SHAPE.search(told.get(name, function.text)):
                missing.append(f"{function}({name})")
    assert not missing, "\n".join(missing)


def test_arrays_that_are_returned_have_shapes():
    missing = []
    for function in functions():
        returned = function.node.returns
        if returned is not None and ARRAYS.search(ast.unparse(returned)) and not told_elsewhere(function):
            about = parsed(function.text)
            said = [about.short_description, about.long_description]
            said += [part for r in about.many_returns for part in (r.type_name, r.description)]
            if not SHAPE.search(" ".join(filter(None, said))):
                missing.append(str(function))
    assert not missing, "\n".join(missing)


def test_numbers_have_units():
    """In brackets behind what they are, [1] where they have none; of ranges those of what they are of."""
    given = [
        (f"{kind}.{name}", annotation, words)
        for kind in classes()
        for name, annotation, words in fields(kind)
        if not kind.inside and kind.path != ("Range",)
    ]
    for function in functions():
        if not function.inside and not told_elsewhere(function):
            told = told_of(function.text, [])
            given += [
                (f"{function}({n})", a, told.get(n, function.text)) for n, a in parameters(function).items()
            ]
    numbers = [(name, words) for name, annotation, words in given if NUMBERS.fullmatch(annotation)]
    assert len(numbers) > 200
    assert [name for name, words in numbers if not re.search(r"\[[^\]]+\]", words)] == []


def test_what_is_told_elsewhere_is_told_there():
    for function in functions():
        for module, name in re.findall(r"rguments\s+(?:are\s+)?as\s+in\s+`(?:(\w+)\.)?(\w+)`", function.text):
            home = (ROOT / function.module).with_name(f"{module}.py") if module else ROOT / function.module
            assert re.search(rf"^(class|def) {name}\b", home.read_text(), re.M), function


def test_errors_of_ours_are_told():
    missing = []
    for function in functions():
        told = {entry.type_name for entry in parsed(function.text).raises} | {""}
        if "CaryatidError" not in told:
            missing += [f"{function} raises {name}" for name in sorted(raised(function) - told)]
    assert not missing, "\n".join(missing)


@pytest.mark.parametrize(
    "shape",
    ["(N, 3)", "(4, 4)", "(N,)", "(H, W, 3)", "(..., 3)", "(N − 1,)", "(P · K, S, 3)", "(3,)", "(N, 2, 3)"],
)
def test_shapes_are_known(shape):
    assert SHAPE.search(f"points {shape} [m]")


@pytest.mark.parametrize(
    "text", ["(section IV)", "(see below)", "(0.1 s)", "(eq. 3)", "f(x)", "(PEP 562)", "()"]
)
def test_other_words_in_brackets_are_no_shapes(text):
    assert not SHAPE.search(text)
