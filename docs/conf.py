"""Configuration of the documentation, built by `make docs`."""

from __future__ import annotations

import os
import re
import sys
from pathlib import Path

DOCS = Path(__file__).parent
sys.path.insert(0, str(DOCS / "extensions"))
os.environ.setdefault("MPLBACKEND", "agg")

from array_types import keep_their_names  # noqa: E402

keep_their_names()
import results  # noqa: E402
from gallery import RUN, copy_examples  # noqa: E402

import caryatid  # noqa: E402
from caryatid.benchmark.report import read_results, write_document  # noqa: E402

results.watch()

project = "caryatid"
author = "the authors of caryatid"
copyright = author
version = release = caryatid.__version__
language = "en"

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx_gallery.gen_gallery",
    "formulas",
    "reference",
]
exclude_patterns = ["_build", "gallery/*.ipynb", "gallery/*.py", "notebooks/*.py"]
suppress_warnings = ["config.cache"]
default_role = "code"

myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 4
nb_execution_mode = "off"  # the committed notebooks contain their outputs
nb_merge_streams = True
html_math_renderer = "drawn"

autodoc_default_options = {"members": True}
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
autodoc_typehints_format = "short"
python_display_short_literal_types = True
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_custom_sections = [("Attributes", "params_style")]
python_use_unqualified_type_names = True

SOURCE = DOCS.parent / "src"
modules = {".".join(p.relative_to(SOURCE).with_suffix("").parts) for p in SOURCE.rglob("*.py")}
documented = set(
    re.findall(r"automodule:: (\S+)", "".join(p.read_text() for p in (DOCS / "api").glob("*.md")))
)
nitpicky = True
nitpick_ignore_regex = [
    ("py:.*", r"(?!caryatid\.).*"),  # names of other packages: no inventories are fetched
    ("py:.*", r"caryatid\.(\w+\.)*_\w+"),  # private names, in the annotations of settings
    ("py:.*", rf"({'|'.join(re.escape(m) for m in sorted(modules - documented))})\.\w+"),
]

for kept in (DOCS / "results").glob("*.json.gz"):
    page = kept.name.replace("json.gz", "md")
    write_document(*read_results(kept), DOCS / page, "caryatid benchmark --out results")

copy_examples(DOCS.parent / "examples", DOCS / "_build" / "examples")
sphinx_gallery_conf = {
    "examples_dirs": "_build/examples",
    "gallery_dirs": "gallery",
    "filename_pattern": RUN.pattern,
    "show_memory": False,
    "show_signature": False,
    "min_reported_time": 1e9,
    "write_computation_times": False,
    "download_all_examples": False,
    "abort_on_example_error": True,
    "image_scrapers": ("results.take_picture",),
    "reset_modules": ("results.forget",),
    "default_thumb_file": str(DOCS / "pictures" / "concepts" / "view.png"),
    "within_subsection_order": "FileNameSortKey",
}

html_theme = "pydata_sphinx_theme"
html_title = "caryatid"
html_static_path = ["static"]
html_css_files = ["caryatid.css"]
html_theme_options = {
    "show_prev_next": True,
    "secondary_sidebar_items": {"**": ["page-toc"], "settings": [], "reference": [], "index": []},
    "footer_start": [],
    "footer_end": ["theme-version"],
    "navigation_with_keys": False,
}
if site := os.environ.get("DOCS_URL"):  # of a site with a folder for each version: tools/publish_docs.sh
    html_theme_options |= {
        "switcher": {"json_url": f"{site}/switcher.json", "version_match": os.environ["DOCS_VERSION"]},
        "check_switcher": False,  # it exists only once the pages are published
        "navbar_start": ["navbar-logo", "version-switcher"],
    }
html_sidebars = {"index": [], "concepts": []}
html_copy_source = False
html_show_sourcelink = False


def adapt(app: object, name: str, source: list[str]) -> None:
    """Adapt a page of the repository to this site.

    Links to example programs lead to their pages. Entries of a table of contents without a file are removed.
    """
    text = re.sub(r"\]\(\.\./examples/(\w+)\.py\)", r"](gallery/\1.rst)", source[0])
    source[0] = re.sub(
        r"^[\w/-]+\*$", lambda m: m[0] if any(DOCS.glob(f"{m[0]}.*")) else "", text, flags=re.M
    )


def leave_settings_out(
    app: object,
    what: str,
    name: str,
    value: object,
    options: object,
    arguments: str | None,
    gives: str | None,
) -> tuple[str | None, str | None]:
    """Omit the dozens of arguments of settings classes; the settings page lists them."""
    return ("", None) if what == "class" and name.startswith("caryatid.config.") else (arguments, gives)


def head_modules(app: object, what: str, name: str, value: object, options: object, lines: list[str]) -> None:
    """Put the name of a module as a heading above its docstring."""
    if what == "module":
        lines[:0] = [name, "=" * len(name), ""]


def setup(app: object) -> None:
    """Register the handlers with Sphinx."""
    app.connect("autodoc-process-signature", leave_settings_out)  # type: ignore[attr-defined]
    app.connect("autodoc-process-docstring", head_modules)  # type: ignore[attr-defined]
    app.connect("source-read", adapt)  # type: ignore[attr-defined]
