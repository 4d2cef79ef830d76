"""The report: complete, self-contained, safe to open, and drawn where things are."""

from __future__ import annotations

import io
import json
import os
import re
from base64 import b64decode
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from conftest import SMALL as SMALL_SENSOR
from conftest import run_command
from PIL import Image
from pypdf import PdfReader
from synthetic import shelf_graph

from caryatid.config import ReportConfig
from caryatid.errors import InputError
from caryatid.exploration import RobotPose, Step
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Box, Cylinder, Sphere, Uncertainty, fibonacci_sphere
from caryatid.graph import Change, SceneObject, Stability, Support, SupportGraph, TakeStep
from caryatid.manipulation.order import Order
from caryatid.objects.reasons import Option, Reasons
from caryatid.planning.candidates import Candidates, Posture
from caryatid.planning.decision import Decision
from caryatid.planning.points_of_interest import PointOfInterest
from caryatid.sensing.view_sphere import ViewSphere
from caryatid.sensing.views import SUPPORT_LABEL, Cloud, View
from caryatid.viz.colours import object_colour, rgb
from caryatid.viz.drawings import (
    draw_chart,
    draw_cloud,
    draw_image,
    draw_sphere,
    draw_stands,
)
from caryatid.viz.graph_drawing import arrange, draw_graph, widths
from caryatid.viz.pictures import picture_svg
from caryatid.viz.report import Figure, Report, make_report, print_pdf, render_html
from caryatid.viz.scene_3d import scene_3d_html, support_ends
from caryatid.viz.tables import census, changes, describe_order, describe_removed, sides_to_see

SMALL = ReportConfig(image_width=160)
TOP = 0.7


def at(x: float, y: float, z: float) -> np.ndarray:
    return transforms.rigid(np.eye(3), (x, y, z))


def make_graph() -> SupportGraph:
    """The table, crate and can of `views`, and a ball that none of them shows."""
    table = SceneObject("o0", 0, Box(at(0, 0, TOP - 0.02), np.array([0.6, 0.8, 0.04])), "support_surface")
    box = SceneObject("o1", 1, Box(at(0, 0, TOP + 0.05), np.array([0.16, 0.18, 0.1])), why="three faces seen")
    sigma = Uncertainty(
        np.array([0.002, 0.011, 0.001]), np.zeros(3), np.array([0.0036, 0.002, 0.021]), np.zeros(6)
    )
    box = replace(box, seen=(True, False, True, True, False, True), uncertainty=sigma)
    can = SceneObject("o2", 2, Cylinder(at(0.01, 0, TOP + 0.15), 0.035, 0.1), residual=0.0024, poor_fit=True)
    ball = SceneObject("o7", 7, Sphere(at(0.2, 0.2, TOP + 0.04), 0.04), occurrences=1, opportunities=2)
    supports = (
        Support("o0", "o1", occurrences=2, opportunities=2, why="the table lies below <o1>"),
        Support("o1", "o2", occurrences=1, opportunities=2, probability=0.93),
        Support("o0", "o2", certain=False, occurrences=1, opportunities=5, why="o2 tips"),
        Support("o2", "o1", "top-down", certain=False, occurrences=3, opportunities=4),
    )
    stability = {"o1": Stability(1.0, -0.05, False, False), "o2": Stability(0.06, 0.012, True, True)}
    return SupportGraph((table, box, can, ball), supports, stability)


def make_cloud(graph: SupportGraph) -> Cloud:
    surfaces = [item.shape.surface(0.015) for item in graph.objects]
    labels = np.repeat([item.label or SUPPORT_LABEL for item in graph.objects], [len(p) for p, _ in surfaces])
    points, normals = (np.concatenate(part) for part in zip(*surfaces, strict=True))
    return Cloud(points, normals, labels.astype(np.int32), name="fused")


@pytest.fixture(scope="module")
def make_step(views):
    """Makes a step after one of `views`."""
    return partial(step_after, replace(views[0], name="view <7> & more"))


def step_after(view: View, index: int = 0, *, decide: bool = True) -> Step:
    graph = make_graph()
    directions = fibonacci_sphere(2000)
    sphere = ViewSphere(np.array([0.0, 0.0, TOP]), 1.5, directions)
    reached = np.flatnonzero((directions[:, 2] > 0.3) & (directions[:, 2] < 0.7))
    poses = sphere.poses(directions[reached])
    candidates = Candidates(poses, directions[reached], np.ones(len(reached)), {"too low": 12}, reached)
    point = PointOfInterest(
        np.array([0, 0, TOP + 0.1]), np.array([0.6, 0, 0.8]), 0.62, ("o1", "o2"), "seen once <i>"
    )
    saliency = np.linspace(-1.0, 1.0, len(directions))
    decision = Decision(poses[3], 3, 0.8, 0.25, 0.55, "sees o2 & o7 best", (point,), None, saliency)
    return Step(
        index=index,
        name=view.name,
        view=view,
        labels=view.labels,
        graph=graph,
        cloud=make_cloud(graph),
        sphere=sphere,
        visited=transforms.unit(np.array([[0.8, 0.1, 0.5], [0.0, 0.8, 0.5]]))[: index + 1],
        candidates=candidates if decide else None,
        decision=decision if decide else None,
        timings={"capture": 0.04, "fit": 0.2},
        angle_travelled=0.9 * index,
        path_travelled=1.4 * index,
        stop=None if decide else "the graph did not change",
        reasons=() if decide else REASONS,
    )


REASONS = (
    Reasons(("o1",), (Option("a box", 99.6, 0.0, 40.5), Option("a <can>", 150.0, 3.0, 31.5))),
    Reasons(("o7",), (Option("a sphere", 12.0, 0.0, 18.0),)),
)
LIFTED = {"object": "o9", "body": "lid", "held": ["o7"], "disturbed": ["can"]}
SAFE = Order((TakeStep("o2", ("o1", "o7"), True, 0.02, "disturbed nothing in 24 rehearsals"),), risk=0.02)
TAKEN = Change("removed", "o9", 1, "empty <space> where it stood")
STOOD = RobotPose(Posture(np.array([-1.2, 0.0, 0.0]), 1.6, 0.0, -0.5), at(-1.2, 0.0, 1.6), 0.35, False)


def good(f1: float, **errors) -> dict[str, object]:
    none = {"matches": {"o0": "table", "o1": "crate", "o2": "can"}, "wrong": [], "missing": [], "unfound": []}
    return {"precision": f1 + 0.02, "recall": f1 - 0.02, "f1": f1} | none | errors


@pytest.fixture(scope="module")
def report(make_step) -> Report:
    return make_report(
        "Run <script>alert(1)</script> $x$",
        [make_step(0), replace(make_step(1, decide=False), changes=(TAKEN,), robot=STOOD)],
        warnings=["view 2: too few <readings>"],
        about="masks: simulator · caryatid <1>",
        settings={"source": "a<b>.xml", "seed": 0, "report": SMALL},
        scores=[
            good(0.5),
            good(0.9, wrong=[("o0", "o2")], missing=[("o1", "o7"), ("o0", "lid")], unfound=["lid"]),
        ],
        strip=[Figure("1: o2", draw_graph(make_graph()), "Nothing else moved")],
        answer="\n".join([*describe_removed([LIFTED]), *describe_order(SAFE, make_graph())]),
        order=SAFE,
        config=SMALL,
    )


@pytest.fixture(scope="module")
def html(report) -> str:
    return render_html(report)


class Page:
    """Fails where a tag is not closed in order; keeps texts, ids, classes and references."""

    def __init__(self, text: str) -> None:
        parts = list(ElementTree.fromstring(text).iter())
        self.references = [part.get(name) for part in parts for name in ("src", "href") if part.get(name)]
        self.ids = [part.get("id") for part in parts if part.get("id")]
        self.classes = [part.get("class") for part in parts if part.get("class")]
        read = (part for part in parts if part.tag != "style")
        texts = [text or "" for part in read for text in (part.text, part.tail)]
        self.words = "\n".join(texts).split("\n")
        self.text = " ".join(" ".join(self.words).split())


def pixels(svg: str, number: int) -> np.ndarray:
    """The raster of this number (H, W, 4) in a picture."""
    data = re.findall(r'href="data:image/webp;base64,([^"]+)"', svg)[number]
    return np.asarray(Image.open(io.BytesIO(b64decode(data))).convert("RGBA"))


def test_it_is_one_well_formed_file_that_loads_nothing(report, html):
    assert html == render_html(report)
    page = Page(html)
    assert all(r.startswith(("data:image/", "#")) for r in page.references)
    around = re.sub(r'srcdoc="[^"]*"', "", html)
    assert not re.search(r"https?://|url\([^#]|@import|<script", around)
    assert len(page.ids) == len(set(page.ids))
    assert {r[1:] for r in page.references if r.startswith("#")} <= set(page.ids)


GOLDEN = Path(__file__).parent / "golden"


def assert_kept(name: str, text: str) -> None:
    """Compare with a file in `golden`, which RENEW=1 writes: look at what changed before you commit it.

    Numbers of drawings may differ in their last digit.
    """
    if os.environ.get("RENEW"):
        (GOLDEN / name).write_text(text)
    kept, number = (GOLDEN / name).read_text(), re.compile(r"\d+\.?\d*")
    if name.endswith(".svg"):
        found, known = (np.array(number.findall(svg), dtype=float) for svg in (text, kept))
        np.testing.assert_allclose(found, known, atol=0.11)
        text, kept = (number.sub("0", svg) for svg in (text, kept))
    assert text == kept


def test_all_of_a_run_is_in_its_page(report, html):
    """Each vertex and edge is in the four graphs drawn, and all words are those kept."""
    page = Page(html)
    for item in make_graph().objects:
        assert sum(kind.startswith(f"node {item.id}") for kind in page.classes) == 4
    for support in make_graph().supports:
        edge = f"edge {support.supporter} {support.supported} "
        assert sum(kind.startswith(edge) for kind in page.classes) == 4
    for figure in (f for section in report.sections for f in section.figures):
        assert figure.heading in page.text
        assert figure.caption in page.text
    assert_kept("report.txt", "\n".join(filter(None, map(str.strip, page.words))) + "\n")


def test_an_unsafe_or_unknown_lift_is_said_to_be_so():
    step = TakeStep("o1", ("o2",), False, 0.62, "disturbed o2 with probability 0.60 in 24 rehearsals")
    unsafe = Order((step,), "no safe order: lifting o1 disturbs o2", 0.62)
    assert describe_order(unsafe, make_graph()) == [
        "No lift is safe; the least risky (nothing else moves: 38%): o1 (hold o2).",
        "No safe order: lifting o1 disturbs o2.",
    ]
    assert describe_order(Order((), "no object can be grasped"), make_graph()) == [
        "No lift is possible.",
        "No object can be grasped.",
    ]
    assert describe_removed([LIFTED | {"disturbed": []}]) == [
        "Removed, in this order: o9 (o7 held); nothing else moved."
    ]


def test_ids_lead_to_the_rows_of_their_objects(html):
    page = ElementTree.fromstring(html)
    (row,) = (part for part in page.iter("tr") if part.get("id") == "o1")
    said = " ".join("".join(row.itertext()).split())
    assert "160±3.6 × 180±2 × 100±21" in said.replace("\u00a0", " ")
    assert "0, 0, 750 ± 11" in said.replace("\u00a0", " ")
    leads = {part.get("href"): part for part in page.iter("{http://www.w3.org/1999/xhtml}a")} or page.iter(
        "a"
    )
    linked = [part.get("href") for part in leads]
    assert linked.count("#o1") > 8  # text, doubts, tables, and the graphs of the answer and of two views


def test_the_map_shows_from_where_to_look_with_and_without_a_robot(make_step):
    graph, step = make_graph(), make_step(0)
    sides = sides_to_see(graph)
    assert [(item.id, side) for item, side in sides] == [("o1", 0)]
    for shown in (step, replace(step, robot=STOOD)):
        svg = picture_svg(draw_stands([shown], sides))
        ((x, y),) = re.findall(r'<text x="([\d.]+)" y="([\d.]+)"[^>]*>o1 0°</text>', svg)
        ((u, v),) = re.findall(r'<polygon points="([\d.]+),([\d.]+)[^"]*" fill="var\(--doubt', svg)
        assert float(x) > float(u) + 20.0  # From x, which is to the right.
        assert float(y) == pytest.approx(float(v), abs=1.0)


def test_the_arrow_of_a_support_runs_through_its_contact():
    graph, up = make_graph(), np.array([0.0, 0.0, 1.0])
    ends = support_ends(Support("o0", "o1", contact_world=np.array([0.05, 0.0, TOP]), normal_world=up), graph)
    np.testing.assert_allclose(ends, [(0.05, 0.0, TOP), (0.05, 0.0, TOP + 0.03)])
    lean = Support("o2", "o1", "lean", contact_world=np.array([0.08, 0.0, TOP + 0.1]), normal_world=-up)
    np.testing.assert_allclose(np.subtract(*support_ends(lean, graph)), (0.0, 0.0, 0.06))
    assert support_ends(Support("o0", "o2"), graph)[0][2] == pytest.approx(TOP)


def test_graph_sphere_and_chart_are_drawn_as_they_were(make_step):
    """Doubt is dashed, no line runs through a note, the next view is marked, and axes are named."""
    gaps = draw_chart("t", "number", {"found": [9.0, np.nan, 11.0], "gone": [2.0, 3.0, 4.0]})
    for name, picture in (
        ("graph", draw_graph(make_graph())),
        ("sphere", draw_sphere(make_step(1))),
        ("chart", gaps),
    ):
        svg = re.sub(r'href="data:[^"]*"', "", picture_svg(picture))
        assert_kept(f"{name}.svg", svg.replace("><", ">\n<"))


HOSTILE = """"'><script>alert(1)</script><g onload="x"|]]>&lt;$x$"""


def test_an_id_is_text_whatever_it_holds(make_step, html):
    def named(name):
        return HOSTILE if name == "o2" else name

    graph = make_graph()
    objects = tuple(replace(item, id=named(item.id)) for item in graph.objects)
    supports = tuple(
        replace(s, supporter=named(s.supporter), supported=named(s.supported), why=HOSTILE)
        for s in graph.supports
    )
    stability = {named(name): value for name, value in graph.stability.items()}
    graph = replace(graph, objects=objects, supports=supports, stability=stability)
    steps = [replace(make_step(number), graph=graph, name=HOSTILE) for number in range(2)]
    page = render_html(make_report(HOSTILE, steps, settings={"source": HOSTILE}, config=SMALL))

    def attributes(text):
        return {(part.tag, name) for part in ElementTree.fromstring(text).iter() for name in part.attrib}

    assert attributes(page) <= attributes(html)
    assert Page(page).text.count(HOSTILE) > 10


@pytest.mark.slow
def test_the_pdf_says_what_the_page_says(report, html, browser):
    pdf = PdfReader(io.BytesIO(print_pdf(html)))
    assert pdf.metadata.title == report.title
    for sheet in pdf.pages:
        assert float(sheet.mediabox.height) / float(sheet.mediabox.width) == pytest.approx(2**0.5, abs=0.01)
    bookmarks = {
        entry.title for part in pdf.outline[1] for entry in (part if isinstance(part, list) else [part])
    }
    assert {section.title for section in report.sections[1:]} <= bookmarks
    text = " ".join(" ".join(sheet.extract_text() for sheet in pdf.pages).split())
    for said in (
        "Run <script>alert(1)</script> $x$", "a<b>.xml", "view <7> & more", "the table lies", "F1 0.900",
        "top-down 0.50", "sees o2 & o7 best", "The graph did not change", "doubtful", "o7", "seen once <i>",
        "How it went", "F1 over views", "Removal", "Camera image", "wrong 0.50",
    ):  # fmt: skip
        assert said in text, said
    assert "Drag to rotate" not in text


def test_without_chromium_one_sentence_says_what_to_install(monkeypatch, tmp_path):
    monkeypatch.setenv("CHROMIUM", "")
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(InputError, match="install Chromium"):
        print_pdf("<p></p>")
    for program, said in (("nothing", "No such file"), ("broken", "no display")):
        (tmp_path / "broken").write_text("#!/bin/sh\necho no display >&2\nexit 3\n")
        (tmp_path / "broken").chmod(0o755)
        monkeypatch.setenv("CHROMIUM", str(tmp_path / program))
        with pytest.raises(InputError, match=f"{said}.*; print .* from a browser"):
            print_pdf("<p></p>")


def test_any_step_is_drawn(make_step):
    """Without colour, decision, pose, view, objects or points."""
    dark = make_step(decide=False)
    dark = replace(dark, view=replace(dark.view, rgb=None))
    cloud = replace(make_step(), view=None, decision=None, candidates=None)
    empty = Cloud(np.empty((0, 3)), np.empty((0, 3)), name="nothing")
    nothing = replace(make_step(), view=None, graph=SupportGraph(), cloud=empty, decision=None)
    report = make_report("t", [dark, cloud, nothing], config=SMALL)
    Page(render_html(report))
    first, second, _ = (section for section in report.sections if section.title.startswith("View"))
    assert len(first.figures) == 3
    assert "depth image" in first.figures[0].caption
    assert [figure.heading[:9] for figure in second.figures] == ["Support g", "Fused clo"]
    Page(render_html(make_report("t", [nothing])))
    with pytest.raises(ValueError, match="1 scores for 2 views"):
        make_report("t", [dark, cloud], scores=[good(0.5)])


@pytest.mark.parametrize(
    ("probability", "doubtful", "text"),
    [
        (0.89, True, "Arrows on the map"),
        (0.91, False, "Nothing: "),
        (None, False, "The probability of supports is unknown"),
    ],
)
def test_all_that_is_doubtful_is_listed(make_step, probability, doubtful, text):
    table, box, *_ = make_graph().objects
    objects = [replace(box, id=f"o{k}", label=k, probability=1.0, poor_fit=False) for k in range(1, 10)]
    supports = tuple(Support("o0", o.id, probability=probability, why=f"why {o.id}") for o in objects)
    step = replace(make_step(0), graph=SupportGraph((table, *objects), supports))
    (section,) = (s for s in make_report("t", [step], config=SMALL).sections if "doubtful" in s.title)
    said = [(name.split(",")[0], why.split(".")[0]) for name, why in section.facts]
    assert said == [(f"o0 → {o.id}", f"why {o.id}") for o in objects if doubtful]
    assert section.text.startswith(text)


def test_a_doubt_of_two_objects_is_listed_once(make_step):
    both = {
        "o1": "overlaps o2 by 9 mm; overlaps o2 by 3 mm",
        "o2": "overlaps o1 by 9 mm; floats over o1 by 4 mm",
    }
    table, *objects = make_graph().objects[:3]
    objects = [replace(o, doubt=both[o.id], poor_fit=False, probability=1.0) for o in objects]
    supports = tuple(Support("o0", o.id, probability=1.0) for o in objects)
    step = replace(make_step(0), graph=SupportGraph((table, *objects), supports))
    (section,) = (s for s in make_report("t", [step], config=SMALL).sections if "doubtful" in s.title)
    said = [(name, why.split(".")[0]) for name, why in section.facts]
    assert said == [("o1", "overlaps o2 by 9 mm"), ("o2", "floats over o1 by 4 mm")]


# Drawings


def test_each_object_is_drawn_over_its_own_support_surface():
    graph, broad = shelf_graph(), widths(shelf_graph())
    places, _ = arrange(graph)
    spans = {i: (places[i][0] - width / 2.0, places[i][0] + width / 2.0) for i, width in broad.items()}
    assert list(spans) == ["o0", "s1", "s2"]
    ordered = sorted(spans.values())
    assert all(end <= start + 1e-9 for (_, end), (start, _) in pairwise(ordered))
    for support in (s for s in graph.supports if s.supporter in spans):
        low, high = spans[support.supporter]
        x, layer = places[support.supported]
        assert low + 0.5 <= x + 1e-9 <= high - 0.5 + 2e-9
        assert layer == 1.0
    svg = picture_svg(draw_graph(graph))
    assert all(f"{i} · support surface" in svg for i in spans)


def test_several_support_surfaces_are_named_and_one_is_the_table(make_step):
    graph, levels = make_graph(), shelf_graph()
    assert census(levels) == "6 objects on 3 support surfaces, 6 supports"
    (found,) = changes(None, replace(make_step(0), graph=levels)).values()
    held = ["o1 (box) supported by o0", "o2 (cylinder) supported by o1", "o3 (box) supported by s1"]
    assert found[:3] == held
    (found,) = changes(None, replace(make_step(0), graph=graph)).values()
    assert found[0] == "o1 (box) supported by the table and o2?"
    tags = re.findall(r">(\w+)</text>", picture_svg(draw_cloud(make_cloud(levels), levels, 0.0)))
    assert sorted(tags) == sorted(levels)


def test_segments_have_their_objects_hue_in_the_image(make_step):
    step = make_step()
    step = replace(step, view=replace(step.view, rgb=np.full_like(step.view.rgb, 90)))
    svg = picture_svg(draw_image(step.view, step.labels, step.graph, 640))
    plain, tinted = pixels(svg, 0)[..., :3].astype(float), pixels(svg, 1)[..., :3].astype(float)
    assert np.ptp(plain, axis=-1).max() < 6.0
    for item in step.graph.objects[1:3]:
        colour = np.array(rgb(object_colour(item.label)), dtype=float)
        found = tinted[np.ptp(tinted, axis=-1) > 25.0]
        nearest = np.linalg.norm(found - (0.62 * colour + 0.38 * 90.0), axis=-1).min()
        assert nearest < 16.0, item.id
        assert f">{item.id}</text>" in svg
    unposed = picture_svg(draw_image(replace(step.view, T_world_camera=None), step.labels, step.graph, 640))
    assert "o2, cylinder" not in unposed


def test_the_cloud_is_drawn_in_the_objects_colours_at_their_places():
    graph = make_graph()
    only = replace(graph, objects=graph.objects[1:2], supports=(), stability={})
    svg = picture_svg(draw_cloud(make_cloud(only), only, 0.3))
    raster = pixels(svg, 0)
    shown = raster[raster[..., 3] > 200][:, :3].astype(float)
    lit = shown[np.ptp(shown, axis=1) > 40.0].mean(axis=0)
    assert np.corrcoef(lit, rgb(object_colour(1)))[0, 1] > 0.98
    assert (raster[..., 3] > 0).mean() > 0.2
    across = np.flatnonzero((raster[..., 3] > 0).any(axis=0))
    assert abs(across.mean() - raster.shape[1] / 2.0) < 0.05 * raster.shape[1]


# The command


@pytest.fixture(scope="module")
def run(tmp_path_factory, scene_file):
    folder = tmp_path_factory.mktemp("runs") / "run"
    quick = ("--goal=o2", "--set=rehearsal.draws=2", "--risk=0.2", "--set=lift.watch=1.0")
    assert run_command("clear", scene_file, "--out", folder, "--quiet", *SMALL_SENSOR, *quick) == 0
    return folder


@pytest.mark.slow
def test_the_command_writes_page_and_print_of_a_run(run, tmp_path, capsys, browser):
    before = (run / "report.html").read_text()
    (run / "report.html").unlink()
    capsys.readouterr()
    assert run_command("report", run, "--pdf", tmp_path / "run.pdf", "--json") == 0
    files = {"html": str(run / "report.html"), "pdf": str(tmp_path / "run.pdf")}
    assert json.loads(capsys.readouterr().out) == files
    assert (run / "report.html").read_text() == before
    after = Page(before)
    assert "Removed, in this order: o2; nothing else moved." in after.text
    assert "Safe order (nothing else moves: " in after.text
    assert "Nothing else moved" in after.text
    assert "View 2" in "".join(sheet.extract_text() for sheet in PdfReader(tmp_path / "run.pdf").pages)


@pytest.mark.slow
def test_a_report_that_cannot_be_written_leaves_the_page(run, tmp_path, capsys, browser):
    kept = (run / "report.html").stat().st_mtime_ns
    assert run_command("report", run, "--pdf", tmp_path / "no/where.pdf") == 1
    assert "where.pdf" in capsys.readouterr().err
    step = run / "views/01/step.npz"
    content = step.read_bytes()
    step.write_bytes(content[:1000])
    assert run_command("report", run) == 1
    assert "step.npz" in capsys.readouterr().err
    step.write_bytes(content)
    assert (run / "report.html").stat().st_mtime_ns == kept
    assert run_command("report", tmp_path / "nowhere") == 1


# In a real browser


@pytest.mark.slow
def test_the_page_answers_on_the_first_screen_and_is_short_offline_and_accessible(tmp_path, browser):
    axe = pytest.importorskip("axe_playwright_python.sync_playwright").Axe()
    sensor = ("--set=sensor.width=240", "--set=sensor.height=180", "--set=sensor.focal=197")
    options = ("--noise", "carmine", "--views", 3, "--no-early-stop", "--quiet", *sensor)
    assert run_command("explore", "clutter", "--out", tmp_path / "run", *options) == 0
    file = tmp_path / "run/report.html"
    assert file.stat().st_size < 3e6
    page, asked, errors = browser.new_page(viewport={"width": 1280, "height": 800}), [], []
    page.on("request", lambda request: asked.append(request.url))
    page.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.goto(file.as_uri())
    graph = page.locator('svg[aria-label*="support graph"]').first
    picture = page.locator('svg[aria-label*="segments and fitted shapes"]').first
    for shown in (graph, picture):
        box = shown.bounding_box()
        assert box["y"] + box["height"] <= 800
    for name in [f"o{k}" for k in range(1, 10)]:
        assert graph.get_by_text(name, exact=True).count() == 1
        assert picture.get_by_text(name, exact=True).count() == 1
    assert page.evaluate("document.documentElement.scrollHeight") <= 4 * 800

    turning = page.frame_locator("iframe").get_by_text("Drag to rotate")
    assert page.locator("figure:has(iframe) svg").is_visible()
    assert not turning.is_visible()
    page.locator("iframe").scroll_into_view_if_needed()
    turning.wait_for()
    canvas = page.frame_locator("iframe").locator("canvas")
    canvas.wait_for()
    page.wait_for_timeout(1000)
    box, turned = canvas.bounding_box(), []
    for _ in range(4):
        turned.append(np.asarray(Image.open(io.BytesIO(canvas.screenshot())).convert("RGB"), dtype=int))
        page.mouse.move(box["x"] + 300.0, box["y"] + 200.0)
        page.mouse.down()
        page.mouse.move(box["x"] + 600.0, box["y"] + 200.0, steps=5)
        page.mouse.up()
        page.wait_for_timeout(500)
    assert (np.abs(turned[1] - turned[0]).max(axis=-1) > 16).mean() > 0.02
    for label in range(1, 10):  # its name plate has exactly its colour
        like = [(np.abs(picture - rgb(object_colour(label))).max(axis=-1) < 16).sum() for picture in turned]
        assert max(like) > 20, f"o{label} is not to be seen in 3D"

    page.frame_locator("iframe").get_by_role("button", name="Reset").click()
    page.wait_for_timeout(500)
    reset = np.asarray(Image.open(io.BytesIO(canvas.screenshot())).convert("RGB"), dtype=int)
    assert (np.abs(reset - turned[0]).max(axis=-1) > 16).mean() < 0.002

    page.get_by_role("link", name="View 2", exact=True).click()
    assert page.get_by_text("Camera image").nth(1).is_visible()
    page.evaluate("document.querySelectorAll('details').forEach(part => part.open = true)")
    for scheme in ("light", "dark"):
        page.emulate_media(color_scheme=scheme)
        found = axe.run(page).response["violations"]
        assert [(v["id"], v["impact"], v["nodes"][0]["html"]) for v in found] == []
    page.close()
    assert errors == []
    assert all(url.startswith(("file:", "data:", "blob:", "about:")) for url in asked)


def test_print_has_a_still_picture_of_the_shapes_and_room_for_words(html, browser):
    page = browser.new_page(viewport={"width": 700, "height": 1000})
    page.set_content(html)
    page.emulate_media(media="print")
    assert not page.locator("iframe").is_visible()
    assert page.locator("figure:has(iframe) svg").is_visible()
    page.evaluate("document.querySelectorAll('details').forEach(part => part.open = true)")
    objects = page.locator("table:has(th:text-is('evidence'))").first
    for column, least in (("td:last-child", 100), ("td:nth-child(4)", 60), ("td:nth-last-child(2)", 55)):
        boxes = [cell.bounding_box() for cell in objects.locator(column).all()]
        assert min(box["width"] for box in boxes) > least
    page.close()


def test_on_a_phone_there_is_one_column_and_only_frames_scroll_sideways(html, browser):
    page = browser.new_page(viewport={"width": 390, "height": 844})
    page.set_content(html)
    page.evaluate("document.querySelectorAll('details').forEach(part => part.open = true)")
    assert page.evaluate("document.documentElement.scrollWidth") == 390
    for figure in page.locator("figure").all():
        assert figure.bounding_box()["width"] > 350
    graph = page.locator('svg[aria-label*="support graph"]').first
    assert graph.bounding_box()["width"] > 400  # Its letters are not smaller than 9 px.
    page.close()


def test_a_browser_without_3d_shows_a_message_in_place_of_the_shapes(browser):
    page = browser.new_page()
    page.add_init_script("HTMLCanvasElement.prototype.getContext = () => null")
    page.goto("about:blank")
    page.set_content(scene_3d_html(make_graph(), 0.0))
    page.get_by_text("WebGL is missing").wait_for(timeout=10_000)
    page.close()
