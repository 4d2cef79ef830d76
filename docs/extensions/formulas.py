"""Draw formulas with matplotlib when the site is built, so that pages load nothing from other sites."""

from __future__ import annotations

import base64
import io
import re
from html import escape
from typing import Any

from docutils import nodes
from matplotlib import rc_context
from matplotlib.font_manager import FontProperties
from matplotlib.mathtext import math_to_image
from sphinx.application import Sphinx
from sphinx.errors import ExtensionError

SIZES = {"inline": 12.0, "display": 14.0}
"""Font size [pt]."""


def drawn(formula: str, kind: str) -> str:
    """Return a formula as an image, with its TeX source as alternative text."""
    picture = io.BytesIO()
    text = re.sub(r"\s+", " ", formula).strip()
    try:
        with rc_context({"mathtext.fontset": "cm", "svg.hashsalt": "caryatid"}):
            math_to_image(f"${text}$", picture, prop=FontProperties(size=SIZES[kind]), format="svg", dpi=72)
    except ValueError as error:
        raise ExtensionError(f"matplotlib cannot draw the formula {text}: {error}") from None
    data = base64.b64encode(picture.getvalue()).decode("ascii")
    return f'<img class="formula" alt="{escape(text)}" src="data:image/svg+xml;base64,{data}"/>'


def inline(translator: Any, node: nodes.math) -> None:
    """Write an inline formula."""
    translator.body.append(drawn(node.astext(), "inline"))
    raise nodes.SkipNode


def display(translator: Any, node: nodes.math_block) -> None:
    """Write a displayed formula."""
    translator.body.append(f'<div class="formula">{drawn(node.astext(), "display")}</div>\n')
    raise nodes.SkipNode


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the renderer of formulas."""
    app.add_html_math_renderer("drawn", (inline, None), (display, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
