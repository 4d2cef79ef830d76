"""How drawings look: one style sheet for the page, light and dark, and for the print."""

from __future__ import annotations

import re
from importlib import resources

LIGHT = {
    "paper": "#ffffff", "panel": "#f7f7f5", "ink": "#1d2126", "soft": "#5d666f", "line": "#dcdfe2",
    "accent": "#0b5c94", "doubt": "#b4480b", "good": "#1d6b45",
}  # fmt: skip
"""The page's colours by day, and in print."""
DARK = {
    "paper": "#15181b", "panel": "#1d2125", "ink": "#e6e8ea", "soft": "#a0a8b0", "line": "#363c42",
    "accent": "#7cbcf0", "doubt": "#f2a068", "good": "#7fd0a4",
}  # fmt: skip
"""The page's colours on a screen set to dark."""
PRINT_RULES = """
svg .wire path { stroke-width: 1.3; } svg .wire .casing { stroke-width: 2.4; }
svg .wire .hidden { stroke-width: .7; }
svg .surface.wire path { stroke-width: .8; } svg .surface.wire .casing { stroke-width: 1.4; }
"""
"""What differs in print, where lines grow and shrink with the drawing."""


def drawing_rules() -> str:
    """Return the style sheet of all drawings; `var(--…)` stands for the page's colours."""
    return resources.files("caryatid.viz").joinpath("drawings.css").read_text(encoding="utf-8")


def declared(colours: dict[str, str]) -> str:
    """Return colours as declarations of CSS."""
    return " ".join(f"--{name}: {colour};" for name, colour in colours.items())


def in_light(text: str) -> str:
    """Put the colours of `LIGHT` in place of `var(--…)`."""
    return re.sub(r"var\(--(\w+)\)", lambda found: LIGHT[found[1]], text)


def alone(drawing: str) -> str:
    """Make a drawing of the page an SVG file of its own, in light colours."""
    head = f'<svg xmlns="http://www.w3.org/2000/svg" fill="{LIGHT["ink"]}" font-family="DejaVu Sans" '
    opening, rest = in_light(drawing).split(">", 1)
    rules = in_light(drawing_rules()).replace("font-family: inherit !important;", "")
    return f"{head}{opening.removeprefix('<svg ')}><style>{rules}{PRINT_RULES}</style>{rest}"
