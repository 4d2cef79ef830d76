"""README and docs: their Python runs, their commands do, their links lead somewhere, their picture moves."""

from __future__ import annotations

import ast
import importlib
import importlib.util
import inspect
import json
import re
import shlex
import shutil
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import get_type_hints

import numpy as np
import pytest
from arms import SLIDES, gantry
from bag_files import write_bag, write_tum
from conftest import SMALL, pcd_text, run_command, without_labels
from PIL import Image

import caryatid as ct
from caryatid.cli import NOT_SAFE
from caryatid.cli.commands import COMMANDS
from caryatid.config.settings import write_settings
from caryatid.io.images import png
from caryatid.robots.reachability import sample_reachability, write_reachability

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
SOURCE = ROOT / "src/caryatid"
README = (ROOT / "README.md").read_text()
GENERATED = {kept.name.replace("json.gz", "md") for kept in DOCS.glob("results/*.json.gz")}
"""Pages that are written when the documentation is built."""
BUILT = ("_build", "gallery", "notebooks")
"""Folders in docs that hold no pages of this kind."""
PAGES = [
    ROOT / "README.md",
    *sorted(p for p in DOCS.rglob("*.md") if p.relative_to(DOCS).parts[0] not in (*BUILT, *GENERATED)),
]
LANGUAGES = {"python", "sh", "console", "bash", "text", "json", "toml", "xml", ""}
FENCE = re.compile(r"^(`{3,})([^\n`]*)\n(.*?)^\1$", re.M | re.S)
COMMAND = re.compile(r"^(?:\$ )?(?:caryatid|pip|make|python|docker|git|import|from) ", re.M)
STAYS = {"serve", "view"}
"""Commands that go on until they are stopped."""
SHORT = {
    "explore": (*SMALL, "--views=2", "--no-report"),
    "demo": (*SMALL, "--views=2", "--no-report"),
    "clear": (*SMALL, "--no-report", "--set=rehearsal.draws=2", "--risk=0.2", "--set=lift.watch=1.0"),
    "order": ("--set=rehearsal.draws=2", "--risk=0.2"),
    "extract": ("--no-report",),
}
"""Few pixels, few views and no report make commands quick here."""


def name_of(page: Path) -> str:
    return str(page.relative_to(ROOT)).removeprefix("docs/")


def blocks(page: Path) -> list[tuple[str, str, str]]:
    """Language, the rest of what is said of it, and content of a page's blocks."""
    found = []
    for match in FENCE.finditer(page.read_text()):
        language, _, rest = match[2].strip().partition(" ")
        found.append((language, rest, match[3]))
    return found


def runs(page: Path) -> list[tuple[str, str]]:
    """Language and content of the blocks that are run; of a console what was typed."""
    found = []
    for language, rest, text in blocks(page):
        if language == "python" and not rest:
            found.append((language, text))
        elif language in ("sh", "bash") and not rest:
            found.append(("sh", re.sub(r"^source <\((.*)\)$", r"\1", text, flags=re.M)))
        elif language == "console" and not rest:
            found.append(("sh", "\n".join(re.findall(r"^\$ (.*)$", text, re.M))))
    return found


RUNNING = [page for page in PAGES if runs(page)]


@pytest.fixture(scope="session")
def prepared(tmp_path_factory, kept_recording, scene_file, points, views):
    """The files the pages speak of."""
    folder = tmp_path_factory.mktemp("pages")
    (folder / "table.pcd").write_text(pcd_text(*points))
    write_bag(folder / "pour.bag", views)
    write_tum(
        folder / "rgbd_dataset_freiburg1_desk",
        [replace(v, depth=enlarged(v.depth), rgb=enlarged(v.rgb)) for v in without_labels(views)],
    )
    shutil.copytree(kept_recording, folder / "recording")
    shutil.copytree(scene_file.parent, folder / "my-scene")
    write_reachability(
        folder / "arm.npz", sample_reachability(gantry, SLIDES, 100_000, np.random.default_rng(0))
    )
    shutil.copy(folder / "arm.npz", folder / "ur5e.npz")
    shutil.copytree(ROOT / "examples/arms", folder / "examples/arms")
    camera = {"K": views[0].K.tolist(), "T_world_camera": views[0].pose.tolist()}
    (folder / "camera.json").write_text(json.dumps(camera))
    (folder / "depth.png").write_bytes(png(np.round(1e3 * views[0].depth).astype(np.uint16)))
    (folder / "labels.png").write_bytes(png(views[0].labels.astype(np.uint16)))
    (folder / "my-depth.png").write_bytes(png(enlarged(np.round(1e3 * views[0].depth).astype(np.uint16))))
    return folder


def enlarged(image):
    """An image of 160×120 as one of 640×480."""
    return np.kron(image, np.ones((4, 4) + (1,) * (image.ndim - 2), image.dtype))


@pytest.fixture
def workplace(prepared, tmp_path, monkeypatch):
    """A copy of these files, in the current folder."""
    place = shutil.copytree(prepared, tmp_path / "here")
    monkeypatch.chdir(place)
    monkeypatch.setattr("caryatid.cli.results.run_locally", lambda *arguments: (row for row in ()))
    return place


@pytest.mark.slow
@pytest.mark.parametrize("page", RUNNING, ids=name_of)
def test_blocks_run_in_order(page, workplace, capsys):
    names: dict = {"__name__": "__main__"}
    for language, text in runs(page):
        if language == "python":
            exec(compile(text, str(page), "exec"), names)
        else:
            for line in text.replace("\\\n", " ").splitlines():
                run_line(shlex.split(line, comments=True), capsys)


def run_line(words: list[str], capsys) -> None:
    """Run a line of a shell: a command of ours as it is; of others see that what they name is there."""
    match words:
        case []:
            pass
        case ["make", *targets]:
            assert {f"{t}:" for t in targets} <= set(
                re.findall(r"^\S+:", (ROOT / "Makefile").read_text(), re.M)
            )
        case ["pip", "install", *packages]:
            for package in packages:
                check_package(package)
        case ["python", program, *_]:
            assert (ROOT / program).is_file(), program
        case [".venv/bin/caryatid", *rest]:
            run_line(["caryatid", *rest], capsys)
        case ["caryatid", name, *options] if name in STAYS:
            assert run_command(name, "--help") == 0
            shown = capsys.readouterr().out
            assert all(option.split("=")[0] in shown for option in options if option.startswith("--"))
        case ["caryatid", *command]:
            redirected = command[command.index(">") + 1] if ">" in command else None
            arguments = command[: command.index(">")] if redirected else command
            changes = list(SHORT.get(arguments[0], ()))
            if "sensor.width" in " ".join(arguments):
                changes = changes[len(SMALL) :]
            capsys.readouterr()
            # Too few pixels may show no safe lift.
            assert run_command(*arguments, *changes) in (0, NOT_SAFE), command
            if redirected:
                Path(redirected).write_text(capsys.readouterr().out)
        case _:
            pytest.fail(f"'{' '.join(words)}' is not run; say why, as in `sh norun`")


def check_package(package: str) -> None:
    """See that a package to be installed is this one, with extras it has, or one in this repository."""
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    name, _, rest = package.partition("[")
    assert name in ("caryatid", ".") or (ROOT / name / "pyproject.toml").is_file(), package
    assert set(filter(None, rest.rstrip("]").split(","))) <= set(extras), package


def test_what_is_not_run_says_why():
    for page, (language, rest, text) in [(each, block) for each in PAGES for block in blocks(each)]:
        if language.startswith("{"):
            continue
        before = page.read_text()
        assert language in LANGUAGES, language
        if rest:
            assert rest == "norun"
            above = before.split(f"```{language} {rest}\n{text}")[0].rstrip().splitlines()[-1]
            assert re.fullmatch(r"\*Not run .*: .+\.\*|\*Not run .*, as .+\.\*", above), text
            if language == "python":
                compile(text, str(page), "exec")
        elif language == "":
            assert not COMMAND.search(text), f"say which language it is, so that it is run: {text}"


def test_the_names_people_use_are_in_the_reference_of_python():
    pages = "".join(page.read_text() for page in (DOCS / "api").glob("*.md"))
    modules = re.findall(r"^\.\. automodule:: (\S+)$", pages, re.M)
    documented = set(modules)
    assert len(modules) == len(documented)
    assert all(importlib.util.find_spec(name) for name in modules)
    index = (DOCS / "api/index.md").read_text()
    for name in ct.__all__:
        home = getattr(ct, name).__module__
        assert home in documented or f"autoclass:: {name}\n" in pages, name
        assert f"`ct.{name} <{home}.{name}>`" in index, name


def test_what_pages_repeat_is_as_in_the_code():
    lists = {"reference.md": COMMANDS, "settings.md": get_type_hints(ct.Config)}
    for page, known in lists.items():
        listed = (DOCS / page).read_text().split("## Every command")[-1]
        rows = re.findall(r"^\| `(\w+)` \| (.*) \|$", listed, re.M)
        assert rows == [(name, inspect.getdoc(kind).partition("\n")[0]) for name, kind in known.items()]
    for file in ("src/above_first.py", "pyproject.toml"):
        assert (ROOT / "examples/planner_package" / file).read_text() in (DOCS / "planners.md").read_text()


def slugs(page: Path) -> set[str]:
    """What the headings of a page are called in links."""
    headings = re.findall(r"^#+ (.*)$", FENCE.sub("", page.read_text()), re.M)
    return {re.sub(r"[^\w\- ]", "", h.lower()).replace(" ", "-") for h in headings}


def test_links_lead_somewhere():
    link = re.compile(r"\]\((?!https?:)([^)#]*)(?:#([^)]+))?\)")
    for page in PAGES:
        for target, anchor in link.findall(FENCE.sub("", page.read_text())):
            path = page.parent / target if target else page
            if path.name in GENERATED:
                continue
            assert path.exists(), f"{page.name}: {target}"
            assert not anchor or anchor in slugs(path), f"{page.name}: {target}#{anchor}"


def test_the_settings_a_page_names_exist():
    settings = tomllib.loads(write_settings(ct.Config()))
    pages = "".join(page.read_text() for page in PAGES)
    for stage, name in re.findall(r"`([a-z]+)\.([a-z_]+)(?: = [^`]+|=[^`]+)?`", pages):
        if stage not in settings or name in settings[stage] or name in ("html", "json"):
            continue
        home = importlib.import_module(f"caryatid.{stage}")
        inside = hasattr(home, "__path__") and importlib.util.find_spec(f"{home.__name__}.{name}")
        assert hasattr(home, name) or inside, f"{stage}.{name}"


def test_the_errors_the_questions_quote_are_what_the_code_says():
    """Without the texts that are in the code, little is left of each but names and numbers."""
    trees = [ast.parse(path.read_text()) for path in SOURCE.rglob("*.py")]
    constants = {node.value for tree in trees for node in ast.walk(tree) if isinstance(node, ast.Constant)}
    texts = sorted((text for text in constants if isinstance(text, str) and len(text) > 4), key=len)
    quoted = re.findall(r"^error: (.+)$", (DOCS / "faq.md").read_text(), re.M)
    assert len(quoted) > 15
    for line in quoted:
        left = line
        for text in reversed(texts):
            left = left.replace(text, "")
        assert len(left) < 0.7 * len(line), line


# The front door


def test_it_begins_with_a_picture_that_moves_for_ever_at_800_pixels_within_3_megabytes():
    first = re.search(r"!\[[^\]]{40,}\]\(([^)]+)\)", README)
    assert README[: first.start()].count("\n") <= 3
    assert (ROOT / first[1]).stat().st_size <= 3_000_000
    with Image.open(ROOT / first[1]) as film:
        assert (film.width, film.info["loop"]) == (800, 0)
        assert film.n_frames > 30
