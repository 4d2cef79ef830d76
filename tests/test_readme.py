"""The front door: a moving picture that browsers show, and a citation that is the one in CITATION.cff."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from PIL import Image

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
GIF = ROOT / "docs/pictures/explore.gif"


def test_it_begins_with_the_moving_picture():
    first = re.search(r"!\[[^\]]{40,}\]\(([^)]+)\)", README)
    assert first[1] == str(GIF.relative_to(ROOT))
    assert README[: first.start()].count("\n") <= 3


def test_the_picture_moves_for_ever_at_800_pixels_within_3_megabytes():
    assert GIF.stat().st_size <= 3_000_000
    with Image.open(GIF) as film:
        assert film.width == 800
        assert film.info["loop"] == 0
        assert film.n_frames > 30
        still = []
        seconds = 0.0
        before = None
        for number in range(film.n_frames):
            film.seek(number)
            seconds += film.info["duration"] / 1e3
            frame = np.asarray(film.convert("RGB"))
            still.append(before is not None and np.array_equal(frame, before))
            before = frame
        assert 10.0 < seconds < 40.0
        assert sum(still) <= 2


def test_two_commands_lead_to_a_robot_in_the_browser():
    block = re.search(r"## Two commands\n\n```sh\n(.*?)```", README, re.S)
    assert block[1].splitlines() == ["make demo", ".venv/bin/caryatid view clutter"]


def test_the_first_program_has_five_lines():
    program = re.search(r"## Five lines of Python\n\n```python\n(.*?)```", README, re.S)[1]
    lines = [line for line in program.splitlines() if line and not line.startswith(("import", "from"))]
    assert len(lines) <= 5


def test_the_citation_is_that_of_the_citation_file():
    cited = (ROOT / "CITATION.cff").read_text()
    bibtex = re.search(r"```text\n(.*?)```", README, re.S)[1]
    for title in re.findall(r"^ {4}title: (.+)$", cited, re.M):
        assert title in bibtex
    for name in re.findall(r"family-names: (.+)$", cited, re.M):
        assert f"{name}," in bibtex
    assert re.search(r"^version: (.+)$", cited, re.M)[1] in bibtex
