"""Settings from TOML files and `section.name=value` flags: flag > file > default."""

from __future__ import annotations

import json
import textwrap
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from caryatid.config.choices import Preset
from caryatid.config.stages import Config
from caryatid.errors import InputError, did_you_mean

_ADAPTER = TypeAdapter(Config)


def read_settings(file: Path | None, flags: Sequence[str], base: Config | None = None) -> Config:
    """Build the configuration from a file and flags.

    Args:
        file: TOML with one table per stage: `[fit]`, `hypotheses = 200`. None = defaults.
        flags: `fit.hypotheses=200`, with values as in TOML; strings need no quotes.
        base: Configuration to start from.

    Raises:
        InputError: The file cannot be read, or a name or value is not valid; the error lists what is valid.
    """
    config = base or Config()
    if file is not None:
        try:
            document = tomllib.loads(file.read_text(encoding="utf-8"))
        except OSError as error:
            raise InputError(file, f"cannot be read ({error.strerror})", "give a TOML file") from None
        except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
            raise InputError(file, f"invalid TOML: {error}", "correct it, or see `caryatid config`") from None
        config = changed_settings(config, document, str(file))
    for flag in flags:
        config = changed_settings(config, _parse_flag(flag), f"--set {flag}")
    return config


def preset(name: Preset) -> Config:
    """The settings of a preset."""
    return Config.paper() if name == "paper" else Config()


def changed_settings(base: Config, document: Mapping[str, Any], source: str) -> Config:
    """Return a configuration with some settings changed: stage → name → value; errors name the source.

    Raises:
        InputError: A name or value is not valid.
    """
    settings: dict[str, Any] = asdict(base)
    for stage, values in document.items():
        known = isinstance(values, Mapping) and stage in settings
        settings[stage] = settings[stage] | dict(values) if known else values
    try:
        return _ADAPTER.validate_json(json.dumps(settings, default=str), strict=True)
    except ValidationError as error:
        raise _refusal(error, settings, source) from None
    except RecursionError:
        raise InputError(source, "is nested too deeply", "correct it, or see `caryatid config`") from None


def write_settings(config: Config) -> str:
    """Write a configuration as TOML that `read_settings` reads, with unit and reason of each setting."""
    lines: list[str] = []
    for stage in fields(config):
        section = getattr(config, stage.name)
        reasons, ranges = field_docs(type(section)), _ranges(type(section))
        lines.append(f"[{stage.name}]")
        for f in fields(section):
            lines += textwrap.wrap(
                f"{reasons[f.name]}{ranges[f.name]}", 100, initial_indent="# ", subsequent_indent="# "
            )
            lines.append(f"{f.name} = {json.dumps(getattr(section, f.name))}")
        lines.append("")
    return "\n".join(lines)


def _ranges(stage: Any) -> dict[str, str]:
    """Range of each setting of a stage as text; empty if it has none."""
    words = {
        "minimum": "at least",
        "exclusiveMinimum": "above",
        "maximum": "at most",
        "exclusiveMaximum": "below",
    }
    found = {}
    for name, schema in TypeAdapter(stage).json_schema()["properties"].items():
        values = next(iter(schema.get("prefixItems", ())), schema.get("items", schema))
        # Larger bounds only keep numbers from overflowing.
        limits = [f"{word} {values[key]:g}" for key, word in words.items() if values.get(key, 1e9) < 1e9]
        if "enum" in values:
            limits.append(f"one of {', '.join(map(str, values['enum']))}")
        found[name] = f" Range: {', '.join(limits)}." if limits else ""
    return found


def field_docs(stage: Any) -> dict[str, str]:
    """Unit and reason of each setting of a stage: the docstring of its field, in one line."""
    documented = stage.__pydantic_fields__.items()
    return {name: " ".join((info.description or "").split()) for name, info in documented}


def _parse_flag(flag: str) -> dict[str, Any]:
    name, equals, value = flag.partition("=")
    if not equals or name.count(".") != 1:
        raise InputError("--set", f"expected STAGE.NAME=VALUE, not '{flag}'", "see `caryatid config`")
    for text in (value, f'"{value}"'):
        try:
            return tomllib.loads(f"{name} = {text}")
        except (tomllib.TOMLDecodeError, RecursionError):
            continue
    raise InputError("--set", f"'{value}' is not a TOML value", "write the value as in TOML")


def _refusal(error: ValidationError, settings: Mapping[str, Any], source: str) -> InputError:
    """The first error, in one sentence."""
    fault = error.errors(include_url=False, include_context=False)[0]
    if not fault["loc"]:
        return InputError(source, fault["msg"], "correct it, or see `caryatid config`")
    stage, *names = map(str, fault["loc"])
    name = ".".join([stage, *names[:1]])
    if fault["type"] == "unexpected_keyword_argument":
        known = fields(Config) if not names else fields(getattr(Config(), stage))
        listed = [field.name for field in known]
        remedy = f"{did_you_mean(name.rpartition('.')[2], listed)}choose from {', '.join(listed)}"
        return InputError(source, f"unknown setting '{name}'", remedy)
    if not names:
        return InputError(source, f"'{stage}' is a table, not a setting", f"write [{stage}]")
    wanted = fault["msg"].removeprefix("Value error, ").replace("Input should", "the value should")
    value = settings[stage][names[0]]
    return InputError(source, f"{name} = {value!r} is not valid", wanted)
