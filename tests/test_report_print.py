"""The report in print and stored: a PDF that holds what the page does, and JSON that gives both again."""

from __future__ import annotations

import io
import json
import subprocess
import sys

import pytest
from conftest import SMALL as SMALL_SENSOR
from conftest import run_command
from pypdf import PdfReader
from report_steps import SMALL, good, make_cloud, make_graph, make_step

from caryatid.errors import InputError
from caryatid.viz import (
    compose_report,
    draw_model,
    draw_view,
    read_report,
    render_html,
    render_pdf,
    store_report,
)
from caryatid.viz.contents import ScoreRow
from caryatid.viz.style import alone

A4 = (595.3, 841.9)
"""Width and height of a page [pt]."""


@pytest.fixture(scope="module")
def report():
    pages = [draw_view(make_step(0), SMALL), draw_view(make_step(1, decide=False), SMALL)]
    settings = {"source": "a<b> #x $y$ \\z.xml", "seed": 0}
    return compose_report(
        pages, title="Run #1 *of* $two$", settings=settings, scores=[good(0.5), good(0.9)],
        strip=[pages[0].figures[0]],
    )  # fmt: skip


@pytest.fixture(scope="module")
def print_(report):
    return PdfReader(io.BytesIO(render_pdf(report)))


def words(pdf):
    return " ".join(" ".join(page.extract_text() for page in pdf.pages).split())


def test_it_is_a_pdf_of_a4_pages(print_):
    assert len(print_.pages) >= 4
    for page in print_.pages:
        assert (float(page.mediabox.width), float(page.mediabox.height)) == pytest.approx(A4, abs=0.5)
        assert page.extract_text().strip()
    assert print_.metadata.title == "Run #1 *of* $two$"


def test_what_the_page_says_is_in_print(report, print_):
    said = words(print_)
    for item in make_graph().objects:
        assert item.id in said
    for text in (
        "Run #1 *of* $two$",
        "a<b> #x $y$ \\z.xml",
        "view <7> & more",
        "the table lies below <o1>",
        "F1 0.900",
        "sees o2 & o7 best",
        "the graph did not change",
        "100 × 160 × 100",
        "uncertain",
        "top-down 3/4",
        "seen once <i>",
        "Contact sheet",
        "F1 over travelled path",
        "Taken apart",
    ):
        assert text in said, text


def test_chapters_are_bookmarks(print_):
    titles = [entry.title for entry in print_.outline if not isinstance(entry, list)]
    assert titles == ["Run #1 *of* $two$", "View 00", "View 01", "Taken apart", "Settings"]


def test_pictures_say_what_they_show_to_those_who_hear_them(print_):
    """The PDF is tagged, and each picture has a text in its place."""
    said = []

    def walk(node):
        node = node.get_object()
        if isinstance(node, list):
            for child in node:
                walk(child)
        elif isinstance(node, dict):
            if "/Alt" in node:
                said.append(node["/Alt"])
            if "/K" in node:
                walk(node["/K"])

    walk(print_.trailer["/Root"]["/StructTreeRoot"])
    for name in ("What the camera saw", "What supports what", "F1 over views", "Time of each stage"):
        assert name in said
    assert said.count("View 00 with the parts found in it") == 1


def test_the_same_report_gives_the_same_bytes(report):
    first = render_pdf(report)
    assert render_pdf(report) == first
    assert b"CreationDate" not in first


def test_letters_are_in_the_file(print_):
    """Every font is embedded, so that the print looks the same everywhere."""
    fonts = [
        font.get_object()["/DescendantFonts"][0].get_object()["/FontDescriptor"]
        for page in print_.pages
        for font in page["/Resources"]["/Font"].values()
    ]
    assert fonts
    for font in fonts:
        assert "DejaVu" in font["/FontName"]
        assert {"/FontFile2", "/FontFile3"} & font.keys()


def test_a_cloud_alone_is_printed():
    graph = make_graph()
    report = compose_report([draw_model(graph, make_cloud(graph), config=SMALL)], title="t", settings={})
    said = words(PdfReader(io.BytesIO(render_pdf(report))))
    assert "o7" in said
    assert "Contact sheet" not in said
    assert "None given." in said


def test_drawings_for_print_have_light_colours_of_their_own(report):
    for page in report.pages:
        for figure in page.figures:
            drawing = alone(figure.svg)
            assert drawing.startswith('<svg xmlns="http://www.w3.org/2000/svg"')
            assert "var(" not in drawing


# Stored


def test_a_stored_report_is_read_back(report, tmp_path):
    path = tmp_path / "report.json"
    path.write_text(store_report(report))
    read = read_report(path)
    assert read == report
    assert render_html(read) == render_html(report)


def test_the_contact_sheet_says_number_score_and_reason(report):
    first, second = report.contacts
    assert (first.number, first.score, first.reason) == ("00", "F1 0.500", "The first view")
    assert (second.number, second.score, second.reason) == ("01", "F1 0.900", "Sees o2 & o7 best")
    assert "<image " in first.svg
    html = render_html(report)
    assert html.count('<a href="#view01"><div class="frame">') == 1
    alone_ = compose_report(report.pages[:1], title="t", settings={})
    assert "Contact sheet" not in render_html(alone_)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda d: d.pop("pages"), "the document is missing something"),
        (lambda d: d.update(pages=[]), "holds no view"),
        (lambda d: d.update(version=2), "is not of format 'caryatid/report', version 1"),
        (lambda d: d.update(scores=d["scores"][:1]), "1 scores for 2 views"),
        (lambda d: d["pages"][0].update(index="0"), "index is missing something or of another kind"),
        (lambda d: d["pages"][0].update(index=True), "index is missing something or of another kind"),
        (lambda d: d["pages"][0].update(timings={"fit": "long"}), "timings is missing something"),
        (lambda d: d["pages"][0]["figures"][0].update(kind="poem"), "kind is missing something"),
        (lambda d: d["pages"][0]["figures"][0].pop("svg"), "figures is missing something"),
        (lambda d: d["settings"].append(["one"]), "settings is missing something"),
    ],
)
def test_broken_reports_are_refused(report, tmp_path, change, said):
    document = json.loads(store_report(report))
    change(document)
    path = tmp_path / "report.json"
    path.write_text(json.dumps(document))
    with pytest.raises(InputError, match=said):
        read_report(path)


def test_scores_are_kept_as_the_page_shows_them(report):
    assert report.scores == (ScoreRow(0.5, 0.52, 0.48), ScoreRow(0.9, 0.92, 0.88))


# The command


@pytest.fixture
def run(tmp_path, scene_file):
    assert (
        run_command("explore", scene_file, "--out", tmp_path / "run", "--views", 2, "--quiet", *SMALL_SENSOR)
        == 0
    )
    return tmp_path / "run"


def test_the_command_writes_page_and_print_of_a_run(run, tmp_path, capsys):
    before = (run / "report.html").read_text()
    (run / "report.html").unlink()
    capsys.readouterr()
    assert run_command("report", run, "--pdf", tmp_path / "run.pdf", "--json") == 0
    assert json.loads(capsys.readouterr().out) == {
        "html": str(run / "report.html"),
        "pdf": str(tmp_path / "run.pdf"),
    }
    assert (run / "report.html").read_text() == before
    assert "View 01" in words(PdfReader(tmp_path / "run.pdf"))


def test_a_run_without_a_report_is_refused(run, tmp_path, capsys):
    (run / "report.json").unlink()
    kept = (run / "report.html").read_bytes()
    assert run_command("report", run, "--pdf", tmp_path / "run.pdf") == 1
    error = capsys.readouterr().err
    assert "report.json: the file is missing; make the run again, without --no-report" in error
    assert (run / "report.html").read_bytes() == kept
    assert not (tmp_path / "run.pdf").exists()
    assert run_command("report", tmp_path / "nowhere") == 1


def test_a_print_that_cannot_be_written_leaves_the_page(run, tmp_path, capsys):
    kept = (run / "report.html").stat().st_mtime_ns
    assert run_command("report", run, "--pdf", tmp_path / "no/where.pdf") == 1
    assert "where.pdf" in capsys.readouterr().err
    assert (run / "report.html").stat().st_mtime_ns == kept


def test_without_typst_the_extra_is_named(run, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "typst", None)
    assert run_command("report", run, "--pdf", tmp_path / "run.pdf") == 1
    assert 'a PDF needs typst; pip install "caryatid[pdf]"' in capsys.readouterr().err
    assert run_command("report", run) == 0


def test_reports_are_made_without_typst_being_imported():
    code = "import sys, caryatid.viz; sys.exit('typst' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
