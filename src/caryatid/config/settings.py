"""Settings from TOML files and `section.name=value` flags: flag > file > default."""

from __future__ import annotations

import ast
import inspect
import math
import textwrap
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar, get_args, get_type_hints

from caryatid.config import Config
from caryatid.config.ranges import kinds, out_of_range
from caryatid.errors import InputError

T = TypeVar("T")


def read_settings(file: Path | None, flags: Sequence[str], base: Config | None = None) -> Config:
    """Build the configuration from a file and flags.

    Args:
        file: TOML, one table a stage: `[fit]`, `hypotheses = 200`. None = defaults.
        flags: `fit.hypotheses=200`, each value as TOML writes it; quotes around words may be left out.
        base: What to start from.

    Raises:
        InputError: The file cannot be read, or a name or value is not valid; the message says what would be.
    """
    config = base or Config()
    if file is not None:
        try:
            document = tomllib.loads(file.read_text(encoding="utf-8"))
        except OSError as error:
            raise InputError(file, f"cannot be read ({error.strerror})", "give a TOML file") from None
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise InputError(file, f"is not TOML: {error}", "correct it, or see `caryatid config`") from None
        config = _changed(config, document, str(file), "")
    for flag in flags:
        config = _changed(config, _parse_flag(flag), f"--set {flag}", "")
    return config


def changed_settings(base: Config, document: Mapping[str, Any], source: str) -> Config:
    """Return a configuration with some settings changed: stage → name → value.

    Args:
        base: What to start from.
        document: As `tomllib` or `json` read it.
        source: What to call it in errors.

    Raises:
        InputError: A name or value is not valid.
    """
    return _changed(base, document, source, "")


def write_settings(config: Config) -> str:
    """Write a configuration as TOML that `read_settings` reads, with unit and reason of each setting."""
    lines: list[str] = []
    for stage in fields(config):
        section = getattr(config, stage.name)
        reasons = field_docs(type(section))
        lines.append(f"[{stage.name}]")
        for f in fields(section):
            lines += textwrap.wrap(reasons.get(f.name, ""), 100, initial_indent="# ", subsequent_indent="# ")
            lines.append(f"{f.name} = {_toml(getattr(section, f.name))}")
        lines.append("")
    return "\n".join(lines)


def field_docs(kind: type) -> dict[str, str]:
    """Unit and reason of each setting of a stage: the text below its field, in one line."""
    stage = ast.parse(inspect.getsource(kind)).body[0]
    assert isinstance(stage, ast.ClassDef)
    return {
        field.target.id: " ".join(str(below.value.value).split())
        for field, below in pairwise(stage.body)
        if isinstance(field, ast.AnnAssign)
        and isinstance(field.target, ast.Name)
        and isinstance(below, ast.Expr)
        and isinstance(below.value, ast.Constant)
    }


def _parse_flag(flag: str) -> dict[str, Any]:
    name, equals, value = flag.partition("=")
    if not equals or name.count(".") != 1:
        raise InputError("--set", f"'{flag}' is not of the form stage.name=value", "see `caryatid config`")
    for text in (value, f'"{value}"'):
        try:
            return tomllib.loads(f"{name} = {text}")
        except tomllib.TOMLDecodeError:
            continue
    raise InputError("--set", f"'{value}' is not a TOML value", "write it as TOML does")


def _changed(config: T, document: Mapping[str, Any], source: str, prefix: str) -> T:
    """Return a (nested) dataclass with some fields replaced."""
    assert is_dataclass(config)
    hints = get_type_hints(type(config))
    values: dict[str, Any] = {}
    for name, value in document.items():
        if name not in hints:
            raise InputError(source, f"there is no setting '{prefix}{name}'", f"there are {', '.join(hints)}")
        current = getattr(config, name)
        if is_dataclass(current):
            if not isinstance(value, Mapping):
                raise InputError(source, f"'{prefix}{name}' is a table of settings", f"write [{name}]")
            values[name] = _changed(current, value, source, f"{name}.")
        else:
            values[name] = _typed(value, current, get_args(hints[name]), source, prefix + name)
            if wanted := out_of_range(values[name], kinds(type(config))[name]):
                raise _refused(value, wanted, source, prefix + name)
    return replace(config, **values)  # type: ignore[type-var]


def _typed(value: Any, current: Any, choices: tuple[Any, ...], source: str, name: str) -> Any:
    """Check a value against the type of the one it replaces."""
    if isinstance(current, str):
        if value in choices or (not choices and isinstance(value, str)):
            return value
        wanted = "one of " + ", ".join(map(str, choices)) if choices else "a word"
    elif isinstance(current, bool) or isinstance(value, bool):
        if isinstance(current, bool) and isinstance(value, bool):
            return value
        wanted = "true or false" if isinstance(current, bool) else "a number"
    elif isinstance(current, float):
        if isinstance(value, int | float) and math.isfinite(value):
            return float(value)
        wanted = "a finite number"
    elif isinstance(current, tuple):
        if isinstance(value, list) and len(value) == len(current):
            pairs = zip(value, current, strict=True)
            return tuple(_typed(v, c, (), source, name) for v, c in pairs)
        wanted = f"a list of {len(current)} numbers"
    else:
        if isinstance(value, int):
            return value
        wanted = "a whole number"
    raise _refused(value, wanted, source, name)


def _refused(value: Any, wanted: str, source: str, name: str) -> InputError:
    return InputError(source, f"{name} = {value!r} is not valid", f"give {wanted}")


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return f'"{value}"'
    if isinstance(value, tuple):
        return "[" + ", ".join(_toml(v) for v in value) + "]"
    return repr(value)
