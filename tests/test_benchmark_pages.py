"""Page and document: complete, self-contained, safe to open, the same every time; and where they are from."""

from __future__ import annotations

import re
import subprocess
import sys
from html.parser import HTMLParser

import numpy as np
import pytest
from benchmark_records import make_record, make_suite

import caryatid
from caryatid.benchmark import provenance as module
from caryatid.benchmark.document import render_document, write_document
from caryatid.benchmark.page import render_page
from caryatid.benchmark.provenance import Provenance, collect_provenance
from caryatid.benchmark.sections import report_suite
from caryatid.benchmark.statistics import summarise
from caryatid.config import StatisticsConfig

MACHINE = Provenance("0.1.0", "0123456789abcdef", False, "3.11", "Linux x86_64", "A <fast> one", 4, "numpy 2")
NASTY = "<script>alert(1)</script> | *x*"
VOID = {"meta", "br", "link", "img", "hr", "input"}


def report(name, records, planned=None, **options):
    summary = summarise(records, np.random.default_rng(0), config=StatisticsConfig(resamples=50), **options)
    return report_suite(name, f"What {name} compares.", summary, planned)


@pytest.fixture(scope="module")
def suites():
    failed = make_record(
        error=f"no view: {NASTY}", seed=7, method=NASTY, scene="/home/somebody/heap7", views=3
    )
    good = make_suite(["support", "random", NASTY], scenes=3, seeds=1, views=3)
    noise = [r for c in ("none", "carmine") for r in make_suite(["support"], scenes=2, seeds=1, condition=c)]
    return (report("planners", [*good, failed], gap=("random", NASTY)), report("noise", noise, planned=11))


@pytest.fixture(scope="module")
def page(suites):
    return render_page(suites, MACHINE, title="Results", command="caryatid benchmark --x")


class Structure(HTMLParser):
    """Checks that elements nest, and gathers ids, references and text."""

    def __init__(self):
        super().__init__()
        self.open, self.ids, self.used, self.seen, self.text = [], [], [], set(), []

    def handle_starttag(self, tag, attributes):
        self.seen.add(tag)
        if tag not in VOID:
            self.open.append(tag)
        for name, value in attributes:
            if name == "id":
                self.ids.append(value)
            elif name in ("href", "xlink:href", "src"):
                self.used.append(value)
            self.used += [f"#{found}" for found in re.findall(r"url\(#([^)]+)\)", value or "")]

    def handle_startendtag(self, tag, attributes):
        self.handle_starttag(tag, attributes)
        if tag not in VOID:
            self.open.pop()

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)


@pytest.fixture(scope="module")
def structure(page):
    found = Structure()
    found.feed(page)
    assert found.open == []
    return found


def test_page_loads_nothing_and_runs_nothing(structure):
    assert not structure.seen & {"script", "link", "iframe", "img"}
    assert all(target.startswith("#") for target in structure.used)


def test_ids_are_unique_and_all_references_lead_somewhere(structure):
    assert len(set(structure.ids)) == len(structure.ids)
    assert {target[1:] for target in structure.used} <= set(structure.ids)


def test_page_says_all_there_is_to_say(structure, suites):
    text = " ".join(" ".join(structure.text).split())
    for said in (
        "What planners compares.", "1 failed", f"no view: {NASTY}", "heap7", "0123456789ab", "A <fast> one",
        "caryatid benchmark --x", "F1 of edges", "Until F1 reaches a threshold", "F1 along the path",
        "F1 compared with support", "dense scenes only", "none failed", "F1 by condition",
        "Share of the gap from random to", "Not finished: 7 episodes of 11 to be run.",
    ):  # fmt: skip
        assert said in text, said
    mean = suites[0].summary.groups[0].methods[0].curves["f1"][1]
    assert f"{mean.value:.3f} [{mean.low:.3f}, {mean.high:.3f}]" in text
    assert "/home/somebody" not in text


def test_every_figure_is_on_the_page_once(structure, page, suites):
    assert page.count("<svg ") == sum(len(suite.figures) for suite in suites)


def test_page_and_document_are_the_same_every_time(suites, page, tmp_path):
    assert render_page(suites, MACHINE, title="Results", command="caryatid benchmark --x") == page
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        write_document(suites, MACHINE, tmp_path / name / "benchmark.md", title="Benchmark", command="c")
    files = [
        {p.relative_to(tmp_path / n): p.read_bytes() for p in (tmp_path / n).rglob("*") if p.is_file()}
        for n in ("one", "two")
    ]
    assert files[0] == files[1]


def test_document_shows_its_figures_and_no_others(suites, tmp_path):
    write_document(suites, MACHINE, tmp_path / "benchmark.md", title="Benchmark", command="caryatid --all")
    text = (tmp_path / "benchmark.md").read_text()
    linked = re.findall(r"\]\(([^)]+)\)", text)
    assert sorted(linked) == sorted(str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*.svg"))
    assert "benchmark/planners-f1-over-views.svg" in linked
    assert "commit 0123456789ab" in text
    assert "```\ncaryatid --all\n```" in text


def test_tables_of_the_document_are_whole(suites):
    text = render_document(suites, MACHINE, title="Benchmark", command="c", folder="benchmark")
    blocks = re.findall(r"(?:^\|.*\|\n)+", text, re.M)
    assert len(blocks) > 8
    for block in blocks:
        widths = {len(re.findall(r"(?<!\\)\|", line)) for line in block.splitlines()}
        assert len(widths) == 1
    assert "<script>" not in text.replace("\\<script\\>", "")


def test_document_compares_conditions_in_one_table(suites):
    text = render_document(suites[1:], MACHINE, title="Benchmark", command="c", folder="benchmark")
    assert re.findall(r"!\[(.*?)\]", text) == ["F1 by condition"]
    rows = re.findall(r"^\| (.*?) \| (.*?) \|", text, re.M)
    assert rows == [("condition", "method"), ("---", "---"), ("none", "support"), ("carmine", "support")]
    everything = [group for group in suites[1].summary.groups if not group.family]
    mean = everything[-1].methods[0].curves["f1"][1]
    assert f"{mean.value:.3f} [" in text


def test_nothing_to_tell_of_is_refused():
    with pytest.raises(ValueError, match="one suite"):
        render_page([], MACHINE)
    with pytest.raises(ValueError, match="one suite"):
        render_document([], MACHINE, title="", command="", folder="")


def test_provenance_goes_through_strings():
    assert Provenance.from_strings(MACHINE.as_strings() | {"else": "1"}) == MACHINE
    assert Provenance.from_strings({}).commit == "unknown"


def test_provenance_of_this_machine():
    found = collect_provenance()
    assert found.cores > 0
    assert found.version == caryatid.__version__
    assert "numpy" in found.libraries
    assert re.fullmatch(r"[0-9a-f]{40}|unknown", found.commit)


def make_checkout(folder):
    package = folder / "package" / "benchmark"
    package.mkdir(parents=True)
    (package.parent / "__init__.py").write_text("")
    identity = ["-c", "user.name=n", "-c", "user.email=e@example.org"]
    for command in (["init", "-q"], ["add", "."], [*identity, "commit", "-q", "-m", "first"]):
        subprocess.run(["git", "-C", str(folder), *command], check=True)
    return package


def test_commit_is_that_of_the_sources(tmp_path, monkeypatch):
    package = make_checkout(tmp_path)
    monkeypatch.setattr(module, "__file__", str(package / "provenance.py"))
    found = collect_provenance()
    assert re.fullmatch(r"[0-9a-f]{40}", found.commit)
    assert not found.dirty
    assert "changes" not in found.code
    (package.parent / "__init__.py").write_text("changed = True\n")
    assert collect_provenance().dirty
    assert "changes" in collect_provenance().code


def test_a_package_that_merely_lies_in_a_repository_has_no_commit(tmp_path, monkeypatch):
    make_checkout(tmp_path)
    installed = tmp_path / "venv" / "caryatid"
    installed.mkdir(parents=True)
    (installed / "__init__.py").write_text("")
    monkeypatch.setattr(module, "__file__", str(installed / "benchmark" / "provenance.py"))
    assert collect_provenance().commit == "unknown"


def test_without_git_the_commit_is_unknown(monkeypatch):
    monkeypatch.setenv("PATH", "")
    assert collect_provenance().commit == "unknown"


def test_drawing_is_loaded_when_it_is_needed():
    code = "import sys, caryatid.benchmark.page, caryatid.benchmark.document, caryatid.benchmark.export\n"
    code += "assert not {'matplotlib', 'jinja2', 'pyarrow'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)
