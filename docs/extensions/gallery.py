"""Copy the programs of `examples/` for sphinx-gallery, each with a title above its docstring."""

from __future__ import annotations

import re
from pathlib import Path

HEADING = """Examples
========

Short programs. Each runs when this page is built; its output follows it. Each checks its result against the
ground truth. The client and the real arm are only shown, because they need a service and a model.
"""
RUN = re.compile(r"/\d\d_")
"""Matches the programs to run: those with a number. The others need a service, or the model of an arm."""


def copy_examples(examples: Path, destination: Path) -> None:
    """Copy the programs, with titles from their names; unchanged copies are not rewritten.

    Args:
        examples: Folder of the programs.
        destination: Folder in which sphinx-gallery looks for them.
    """
    destination.mkdir(parents=True, exist_ok=True)
    texts = {path.name: _titled(path) for path in sorted(examples.glob("*.py"))}
    texts["GALLERY_HEADER.rst"] = HEADING
    for old in destination.iterdir():
        if old.name not in texts:
            old.unlink()
    for name, text in texts.items():
        path = destination / name
        if not path.is_file() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


def title_of(path: Path) -> str:
    """Make a title from a program's name: `06_robot_over_http.py` becomes Robot over HTTP."""
    words = re.sub(r"^\d+_", "", path.stem).replace("_", " ").replace("http", "HTTP")
    return words[0].upper() + words[1:]


def _titled(path: Path) -> str:
    """Return a program with a title at the top of its docstring, converted to reStructuredText."""
    title = title_of(path)
    # An indented block after a colon is code.
    opening, text, rest = path.read_text(encoding="utf-8").split('"""', 2)
    text = re.sub(r":\n\n(?= {4})", "::\n\n", text)
    return f'{opening}"""{title}\n{"=" * len(title)}\n\n{text}"""{rest}'
