"""Directives that generate the reference from the code: `every-command` and `every-setting`."""

from __future__ import annotations

import contextlib
import io
import os
import re
import sys
from dataclasses import fields
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints
from unittest.mock import patch

from docutils import nodes
from pydantic import AfterValidator
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

from caryatid import cli, config
from caryatid.config.settings import field_docs

WIDTH = 100
"""Width of the help [characters]."""


def help_of(command: str) -> str:
    """Return what `caryatid COMMAND --help` prints, without colours."""
    printed = io.StringIO()
    environment = os.environ | {"COLUMNS": str(WIDTH), "NO_COLOR": "1", "TERM": "dumb"}
    with (
        patch.dict(os.environ, environment),
        contextlib.redirect_stdout(printed),
        contextlib.suppress(SystemExit),
    ):
        cli.main([*command.split(), "--help"])
    text = re.sub(r"\x1b\[[0-9;]*m", "", printed.getvalue())
    return "\n".join(line.rstrip() for line in text.strip("\n").splitlines())


def commands_of(command: str) -> list[str]:
    """Return the subcommands of a command; an empty name means `caryatid` itself."""
    listed = re.search(r"^usage:.*?\{([\w,-]+)\}", help_of(command), re.M | re.S)
    return listed[1].split(",") if listed else []


def command_pages() -> str:
    """Return the help of all commands and subcommands as Markdown."""
    lines = []
    for name in commands_of(""):
        lines.append(f"## {name}\n")
        for command in [name, *(f"{name} {own}" for own in commands_of(name))]:
            lines.append(f"```text\n{help_of(command)}\n```\n")
    return "\n".join(lines)


class EveryCommand(SphinxDirective):
    """The help of every command, one section each."""

    def run(self) -> list[nodes.Node]:
        """Write the help."""
        for name, module in sys.modules.items():
            if name.startswith("caryatid.cli.") or module is cli:
                self.env.note_dependency(module.__file__ or "")
        return list(self.parse_text_to_nodes(command_pages(), allow_section_headings=True))


def kind_of(stage: str) -> Any:
    """Return the settings class of a stage; a stage outside settings files is named by its class."""
    return getattr(config, stage) if stage in config.__all__ else type(getattr(config.Config(), stage))


def table_of(stage: str) -> str:
    """Return the settings of a stage as a Markdown table, with their descriptions in the code."""
    kind = kind_of(stage)
    values = kind()
    ranges = get_type_hints(kind, include_extras=True)
    reasons = field_docs(kind)
    lines = ["| setting | default | allowed | description, and reason for the value |", "|---|---|---|---|"]
    for field in fields(kind):
        unit, reason = _unit(reasons.get(field.name, ""))
        cells = [
            f"`{stage}.{field.name}`",
            f"`{_toml(getattr(values, field.name))}` {unit}".rstrip(),
            _allowed(ranges[field.name]),
            reason,
        ]
        lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return "\n".join(lines)


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return "[" + ", ".join(map(_toml, value)) + "]"
    return f'"{value}"' if isinstance(value, str) else repr(value)


def _unit(reason: str) -> tuple[str, str]:
    """Split the unit, in brackets in the first sentence, from a setting's description."""
    match = re.search(r" ?\[((?:1|m|deg|px|rad|s|kg|points|views|voxels|nats|N|%)[^\]]*)\]", reason)
    if match is None:
        return "", reason
    unit = "" if match[1] == "1" else match[1]
    return unit, reason[: match.start()] + reason[match.end() :]


SIGNS = {"gt": ">", "ge": "≥", "lt": "<", "le": "≤"}


def _allowed(kind: Any) -> str:
    """Describe the values that a type allows."""
    if get_origin(kind) is Annotated:
        plain, *rules = get_args(kind)
        limits = [
            f"{sign} {getattr(limit, name):g}"
            for rule in rules
            for limit in getattr(rule, "metadata", [])
            for name, sign in SIGNS.items()
            if hasattr(limit, name)
        ]
        rising = ["in ascending order"] if any(isinstance(rule, AfterValidator) for rule in rules) else []
        return "; ".join(filter(None, [_allowed(plain), ", ".join(limits), *rising]))
    if get_origin(kind) is Literal:
        return ", ".join(f"`{name}`" for name in get_args(kind))
    if get_origin(kind) is tuple:
        parts = [part for part in get_args(kind) if part is not Ellipsis]
        each = "; ".join(sorted({allowed for part in parts if (allowed := _allowed(part))}))
        count = "a list" if Ellipsis in get_args(kind) else f"{len(parts)} numbers"
        return count + (f", each {each}" if each else "")
    return {bool: "`true`, `false`"}.get(kind, "")


def settings_page() -> str:
    """Return the tables of all stages as Markdown; those in settings files come first."""
    held = [field.name for field in fields(config.Config)]
    own = {type(getattr(config.Config(), stage)).__name__ for stage in held}
    others = [name for name in config.__all__ if name.endswith("Config") and name not in {"Config", *own}]
    return "\n\n".join(f"## {stage}\n\n{table_of(stage)}" for stage in [*held, *others])


class EverySetting(SphinxDirective):
    """Tables of all settings, a section for each stage."""

    def run(self) -> list[nodes.Node]:
        """Write the tables."""
        for name, module in sys.modules.items():
            if name.startswith("caryatid.config"):
                self.env.note_dependency(module.__file__ or "")
        return list(self.parse_text_to_nodes(settings_page(), allow_section_headings=True))


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the directives."""
    app.add_directive("every-command", EveryCommand)
    app.add_directive("every-setting", EverySetting)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
