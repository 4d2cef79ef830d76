"""English that a native reader would stumble over, in messages, help, docstrings and pages."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
TEXTS = [
    *(ROOT / "src").rglob("*.py"), *(ROOT / "examples").rglob("*.py"),
    *(ROOT / "ros").rglob("*.*"),
    *(page for page in (*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")) if "_build" not in page.parts),
    *(ROOT / ".github").rglob("*.yml"), *(ROOT / "benchmarks").glob("*.py"), *(ROOT / "tools").glob("*.py"),
    *(p for p in (ROOT / "docs").rglob("*.py") if not {"_build", "gallery"} & {*p.parts}), ROOT / "Makefile",
]  # fmt: skip
COMPARED = "longer|more|smaller|larger|higher|wider|later|surer|better|shorter|difference|inhibition|IG"
"""Words that may follow `is no`."""
BANNED = {
    rf"(?<!here )\b(?:is|are) no (?!{COMPARED}|w\b|\W)\w+": "is not a …",
    r"\b(?:is|are) told\b": "give, say",
    r"\bof no known\b": "unknown",
    r"\banew\b": "again, for the first time",
    r"\bwhat there is\b": "what it is",
    r"\bmend the\b": "correct the",
    r"\bviews? 0\b(?!\d|[.,]\d)": "people count views from 1",
    r"\bat the most\b": "at most",
    r"\bknown by then\b": "known so far",
    r"\bholds? up what\b|\bwho supports whom\b": "which object supports which",
    r"\bbears? out\b": "confirm",
    r"\blaid (?:on|onto|into)\b": "registered to, projected to",
    r"\bnought\b": "zero",
    r"\bgoes on where\b|\bgo on with\b": "continue",
    r"\bsomething else than\b": "anything but",
    r"\bas it is by now\b": "current",
    r"\btaken away\b": "removed",
    r"\bleave \S+ out\b": "omit",
    r"\bthere is no (?:such|\w+ ')": "unknown …, no such …",
    r"\bnothing has been seen\b": "the scene has no views",
    r"\bwhole number of at\b|\bwhole numbers\b": "integer",
}
"""Pattern → what to write in its place."""


@pytest.mark.parametrize("pattern", BANNED)
def test_no_text_holds_a_banned_phrase(pattern):
    found = [
        f"{path.relative_to(ROOT)}:{text.count(chr(10), 0, match.start()) + 1}: {match[0]}"
        for path in TEXTS
        for text in [path.read_text()]
        for match in re.finditer(pattern, text)
    ]
    assert not found, "\n".join([f"write '{BANNED[pattern]}'", *found])


def test_the_readme_fits_on_a_screen_and_has_short_sentences():
    text = (ROOT / "README.md").read_text()
    assert len(text.splitlines()) <= 120
    prose = re.sub(r"(?s:```.*?```)|^\|.*$|^#.*$|^!\[.*$", "\n\n", text, flags=re.M)
    prose = re.sub(r"\]\([^)]*\)", "]", prose)
    for sentence in re.split(r"(?<=[.:?!])\s+|\n\n", prose):
        assert len(sentence.split()) <= 30, sentence
