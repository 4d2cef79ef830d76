"""The front door: a moving picture that browsers show, and a citation that is the one in CITATION.cff."""

from __future__ import annotations

import re
from pathlib import Path

from PIL import Image

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()


def test_it_begins_with_a_picture_that_moves_for_ever_at_800_pixels_within_3_megabytes():
    first = re.search(r"!\[[^\]]{40,}\]\(([^)]+)\)", README)
    assert README[: first.start()].count("\n") <= 3
    assert (ROOT / first[1]).stat().st_size <= 3_000_000
    with Image.open(ROOT / first[1]) as film:
        assert (film.width, film.info["loop"]) == (800, 0)
        assert film.n_frames > 30
        seconds = 0.0
        for number in range(film.n_frames):
            film.seek(number)
            seconds += film.info["duration"] / 1e3
    assert 10.0 < seconds < 40.0


def test_two_commands_and_five_lines_are_enough_to_begin():
    block = re.search(r"## Two commands\n\n```sh\n(.*?)```", README, re.S)
    assert block[1].splitlines() == ["make demo", ".venv/bin/caryatid view clutter"]
    program = re.search(r"## Five lines of Python\n\n```python\n(.*?)```", README, re.S)[1]
    assert len([line for line in program.splitlines() if line and not re.match("import|from", line)]) <= 5


def test_the_citation_is_that_of_the_citation_file():
    cited = (ROOT / "CITATION.cff").read_text()
    bibtex = re.search(r"```text\n(.*?)```", README, re.S)[1]
    fields = re.findall(r"^(?: {4}title|version): (.+)$", cited, re.M)
    names = [f"{name}," for name in re.findall(r"family-names: (.+)$", cited, re.M)]
    assert fields
    assert names
    assert all(text in bibtex for text in (*fields, *names))
