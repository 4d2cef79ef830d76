"""The report: complete, self-contained, safe to open, and drawn where things are."""

from __future__ import annotations

import io
import json
import re
from base64 import b64decode
from dataclasses import replace
from functools import partial
from xml.etree import ElementTree

import numpy as np
import pytest
import shapely
from conftest import SMALL as SMALL_SENSOR
from conftest import run_command
from PIL import Image
from pypdf import PdfReader

from caryatid.config import ReportConfig
from caryatid.errors import InputError
from caryatid.exploration import RobotPose, Step
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Box, Cylinder, Sphere, fibonacci_sphere
from caryatid.graph import Change, SceneObject, Stability, Support, SupportGraph
from caryatid.planning.candidates import Candidates, Posture
from caryatid.planning.decision import Decision
from caryatid.planning.points_of_interest import PointOfInterest
from caryatid.sensing.view_sphere import ViewSphere
from caryatid.sensing.views import SUPPORT_LABEL, Cloud, View
from caryatid.viz.colours import object_colour, rgb
from caryatid.viz.drawings import (
    Projection,
    draw_chart,
    draw_cloud,
    draw_image,
    draw_sphere,
)
from caryatid.viz.graph_drawing import arrange, draw_graph, layers
from caryatid.viz.pdf import print_pdf
from caryatid.viz.pictures import Tag, draw_tags, picture_svg
from caryatid.viz.report import Figure, Report, make_report, render_html
from caryatid.viz.scene_3d import scene_3d_html
from caryatid.viz.tables import object_table

SMALL = ReportConfig(image_width=160)
TOP = 0.7


def at(x: float, y: float, z: float) -> np.ndarray:
    return transforms.rigid(np.eye(3), (x, y, z))


def make_graph() -> SupportGraph:
    """The table, crate and can of `views`, and a ball that none of them shows."""
    table = SceneObject("o0", 0, Box(at(0, 0, TOP - 0.02), np.array([0.6, 0.8, 0.04])), "support_surface")
    box = SceneObject("o1", 1, Box(at(0, 0, TOP + 0.05), np.array([0.16, 0.18, 0.1])), why="three faces seen")
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
    )


def good(f1: float, **errors) -> dict[str, object]:
    none = {"matches": {"o0": "table", "o1": "crate", "o2": "can"}, "wrong": [], "missing": [], "unfound": []}
    return {"precision": f1 + 0.02, "recall": f1 - 0.02, "f1": f1} | none | errors


@pytest.fixture(scope="module")
def report(make_step) -> Report:
    return make_report(
        "Run <script>alert(1)</script> $x$",
        [make_step(0), make_step(1, decide=False)],
        about="masks: simulator · caryatid <1>",
        settings={"source": "a<b>.xml", "seed": 0, "report": SMALL},
        scores=[
            good(0.5),
            good(0.9, wrong=[("o0", "o2")], missing=[("o1", "o7"), ("o0", "lid")], unfound=["lid"]),
        ],
        strip=[Figure("1: o2", draw_graph(make_graph()), "Nothing else moved")],
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
        texts = [text or "" for part in parts for text in (part.text, part.tail)]
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


def test_it_names_each_object_edge_figure_and_setting(report, html):
    page = Page(html)
    for item in make_graph().objects:
        assert sum(kind.startswith(f"node {item.id}") for kind in page.classes) == 4
    for support in make_graph().supports:
        edge = f"edge {support.supporter} {support.supported} "
        assert sum(kind.startswith(edge) for kind in page.classes) == 4
    assert sum(kind.startswith("edge o1 o7 ") for kind in page.classes) == 1  # what the ground truth has
    for support in make_graph().supports:
        assert f"{support.occurrences} of {support.opportunities}" in page.text
    for figure in (f for section in report.sections for f in section.figures):
        assert figure.heading in page.text
        assert figure.caption in page.text
    for said in (
        "View 1", "View 2", "0.900", "F1 over views", "Found so far", "How it went", "no change",
        "Sees o2 & o7 best", "The graph did not change", "12 too low", "Removal", "image_width=160",
        "masks: simulator · caryatid <1>",
        "1 object removed. 3 objects, 4 supports, 2 of them doubtful after 2 views",
        "Wrong supports: o0 → o2; missing supports: o1 → o7, o0 → lid; wrong objects: o7; "
        "missing objects: lid", "wrong 0.50", "missing",
        "160 × 180 × 100", "Run <script>alert(1)</script>", "a<b>.xml", "view <7> & more",
        "the table lies below <o1>", "o1 – o2",
    ):  # fmt: skip
        assert said in page.text, said


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


def test_charts_need_several_views_or_scores_and_changes_are_listed(make_step):
    graph = make_graph()
    fewer = replace(graph, objects=graph.objects[:3], supports=graph.supports[:2])
    steps, scores = [make_step(0), replace(make_step(1), graph=fewer)], [good(0.5), good(0.9)]

    def charts(steps, scores=()):
        sections = make_report("t", steps, scores=scores, config=SMALL).sections
        how = [figure for section in sections if section.title == "How it went" for figure in section.figures]
        return [figure.picture.name for figure in how if not figure.link]

    assert charts(steps, scores) == ["F1 over views", "Found so far"]
    stood = RobotPose(Posture(np.array([-1.2, 0.0, 0.0]), 1.6, 0.0, -0.5), steps[0].view.pose, 0.35, False)
    assert charts([replace(steps[0], robot=stood)]) == ["where the robot stood"]
    assert charts(steps[:1]) == []
    (changed,) = (s.text for s in make_report("t", steps, config=SMALL).sections if s.title == "View 2")
    assert "now: o1 (box) supported by the table, o2 (cylinder) supported by o1; gone: o7" in changed
    taken = Change("removed", "o2", 1, "empty <space> where it stood")
    steps[1] = replace(steps[1], changes=(taken,))
    page = Page(render_html(make_report("t", steps, warnings=["view 2: too few <readings>"], config=SMALL)))
    assert "o2 was removed: empty <space> where it stood" in page.text
    assert "view 2: too few <readings>" in page.text.casefold()
    with pytest.raises(ValueError, match="1 scores for 2 views"):
        charts(steps, scores[:1])


def test_all_that_is_doubtful_is_listed_with_its_reason(make_step):
    box = make_graph().objects[1]
    many = tuple(replace(box, id=f"o{k}", label=k, probability=1.0, poor_fit=False) for k in range(1, 10))

    def listed(objects, probability):
        supports = [Support("o0", o.id, probability=probability, why=f"why {o.id}") for o in objects]
        graph = SupportGraph((make_graph().objects[0], *objects), tuple(supports))
        sections = make_report("t", [replace(make_step(0), graph=graph)], config=SMALL).sections
        (section,) = (s for s in sections if s.title == "What is doubtful")
        return section.text, section.facts

    text, facts = listed(many, 0.89)
    assert text == ""
    assert [(name.split(",")[0], why.split(".")[0]) for name, why in facts] == [
        (f"o0 → {o.id}", f"why {o.id}") for o in many
    ]
    text, facts = listed(many, 0.91)
    assert text.startswith("Nothing: ")
    assert facts == []
    text, facts = listed((replace(many[0], probability=0.6), *many[1:]), 0.91)
    assert (text, [name for name, _ in facts]) == ("", ["o1"])
    assert "0.60" in facts[0][1]
    assert listed(many, None)[0].startswith("The probability of supports is unknown")


def test_a_chart_names_its_axes_and_lines_and_its_axis_ends_where_it_should():
    gaps = draw_chart("t", "number", {"found": [9.0, np.nan, 11.0], "gone": [2.0, 3.0, 4.0]})
    assert {"view", "number", "t", "found", "gone", "0", "1", "2", "10"} <= set(Page(picture_svg(gaps)).words)
    for top, there in ((None, False), (1.0, True)):
        words = Page(picture_svg(draw_chart("t", "F1", {"F1": [0.6, 0.7]}, top=top))).words
        assert ("1" in words[1:] and "0.8" in words) == there


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


def test_tables_give_sizes_stability_and_unseen_sides():
    graph = make_graph()
    seen = (True, False, True, True, False, True)
    objects = (graph.objects[0], replace(graph.objects[1], seen=seen), *graph.objects[2:])
    table = object_table(replace(graph, objects=objects))
    rows = {row[0].text: dict(zip(table.columns, row, strict=True)) for row in table.rows}
    said = {i: {name: entry.text for name, entry in row.items()} for i, row in rows.items()}
    assert said["o1"] | {"sides unseen": "+x −z", "stability": "stable", "r_s": "1.00"} == said["o1"]
    assert said["o1"]["overhang [mm]"] == "−50"
    assert said["o2"] | {"size [mm]": "⌀ 70 × 100", "supported by": "o1, o0?"} == said["o2"]
    assert rows["o2"]["stability"].doubt
    assert rows["o2"]["residual [mm]"].doubt
    assert (said["o7"]["supported by"], said["o7"]["size [mm]"]) == ("unknown", "⌀ 80")


# Drawings


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


def test_the_chosen_view_and_the_points_of_interest_are_on_the_sphere(make_step):
    step = make_step(1)
    svg = picture_svg(draw_sphere(step))
    page = Page(svg)
    assert (page.classes.count("point"), page.classes.count("chosen")) == (1, 1)
    assert {"1", "next", "saliency"} <= set(page.words)
    assert "o1 – o2: saliency 0.62; seen once <i>" in page.text
    few = Candidates(step.candidates.T_world_camera[:5], step.candidates.directions[:5], np.ones(5), {})
    assert picture_svg(draw_sphere(replace(step, candidates=few))) != svg


def drawn_edges(svg: str) -> dict[str, ElementTree.Element]:
    """The groups of a drawing's edges by class."""
    groups = {part.get("class", ""): part for part in ElementTree.fromstring(svg).iter("g")}
    return {kind: part for kind, part in groups.items() if kind.startswith("edge ")}


def test_no_line_runs_through_a_note_as_nothing_is_painted_behind_it():
    svg = picture_svg(draw_graph(make_graph()))
    notes = [part for part in ElementTree.fromstring(svg).iter("text") if part.get("font-size") == "12"]
    at = np.array([[float(part.get("x")), float(part.get("y"))] for part in notes])
    words = [shapely.box(x - 9.0, y - 4.0, x + 9.0, y + 4.0) for x, y in at]
    lines = [
        shapely.LineString(np.array(re.findall(r"[\d.]+", piece), dtype=float).reshape(-1, 2))
        for edge in drawn_edges(svg).values()
        for piece in edge.find("path").get("d").split("M")[1:]
    ]
    assert len(words) == len(make_graph().supports) <= len(lines) / 2
    assert not any(line.intersects(word) for line in lines for word in words)


def test_doubt_shows_in_the_graph_without_colour():
    graph = make_graph()
    svg = picture_svg(draw_graph(graph))
    edges = {kind: part.find("path") for kind, part in drawn_edges(svg).items()}
    dashed = {kind for kind, path in edges.items() if path.get("stroke-dasharray") != "none"}
    assert dashed == {"edge o0 o2 doubtful", "edge o2 o1 doubtful"}
    assert re.findall(r'class="node (\w+) unsupported"', svg) == ["o7"]
    assert {"1.00", "0.93", "0.50", "top-down 0.50"} <= set(Page(svg).words)
    pairs = ("o0 o2 doubtful", "o1 o2 sure", "o0 o1 sure")
    widths = [float(edges[f"edge {pair}"].get("stroke-width")) for pair in pairs]
    assert widths == sorted(set(widths))
    eighth = replace(graph.objects[1], id="o8", label=8)
    assert 'opacity="0.5"' not in svg
    assert 'opacity="0.5"' in picture_svg(draw_graph(SupportGraph((graph.objects[0], eighth))))


def chain(pairs: list[tuple[str, str]], count: int) -> SupportGraph:
    shape = Sphere(np.eye(4), 0.05)
    objects = [SceneObject(f"o{k}", k, shape, "object" if k else "support_surface") for k in range(count)]
    return SupportGraph(tuple(objects), tuple(Support(a, b) for a, b in pairs))


def test_edges_point_upwards_and_vertices_keep_apart():
    assert layers(make_graph()) == {"o0": 0, "o1": 1, "o2": 2, "o7": 1}
    rng = np.random.default_rng(3)
    for _ in range(20):
        count = int(rng.integers(2, 16))
        pairs = {(f"o{rng.integers(0, k)}", f"o{k}") for k in range(1, count) for _ in range(2)}
        position, route = arrange(chain(sorted(pairs), count))
        for lower, upper in pairs:
            assert position[lower][1] < position[upper][1]
            assert (route[lower, upper][0], route[lower, upper][-1]) == (position[lower], position[upper])
        places = [at for name, at in position.items() if name != "o0"]
        for k, (x, level) in enumerate(places):
            assert x >= 0.0
            assert all(level != row or abs(x - other) >= 1.0 - 1e-9 for other, row in places[:k])


def test_projection_agrees_with_the_view_and_knows_what_is_hidden(views):
    view = views[0]
    projection = Projection(view.pose, view.K, view.depth)
    points_world = transforms.transform(view.pose, view.points_camera.reshape(-1, 3))[view.valid.ravel()]
    found, z = projection.project(points_world)
    assert np.allclose(found, np.argwhere(view.valid)[:, ::-1], atol=1e-6)
    assert np.allclose(z, view.depth[view.valid], atol=1e-6)
    assert not projection.hidden(found, z).any()
    assert projection.hidden(found, z + 0.03).all()


def test_names_keep_apart_shrink_in_a_crowd_and_are_left_out_where_they_could_not_be_read():
    sizes = []
    for count in (14, 60, 400):
        places = np.random.default_rng(0).uniform(0.0, (400.0, 300.0), (count, 2))
        tags = [Tag(x, y, f"o{k}", "#0072b2") for k, (x, y) in enumerate(places.tolist())]
        parts = [part for group in draw_tags(tags, 400.0, 300.0, 15.0) for part in group]
        plates = [
            shapely.box(x, y, x + wide, y + high)
            for part in parts if part.tag == "rect"
            for x, y, wide, high in [[float(part.get(name)) for name in ("x", "y", "width", "height")]]
        ]  # fmt: skip
        assert len(plates) in (0, count)
        if count == 14:
            assert shapely.union_all(plates).area == pytest.approx(sum(plate.area for plate in plates))
            assert shapely.box(0.0, 0.0, 400.0, 300.0).covers(shapely.union_all(plates))
        sizes += {float(part.get("font-size")) for part in parts if part.tag == "text"} or {0.0}
    assert sizes[0] == 15.0 > sizes[1] >= 6.0 > sizes[2] == 0.0


# The command


@pytest.fixture(scope="module")
def run(tmp_path_factory, scene_file):
    folder = tmp_path_factory.mktemp("runs") / "run"
    options = ("--out", folder, "--quiet", *SMALL_SENSOR)
    assert run_command("clear", scene_file, *options) == 0
    return folder


@pytest.mark.slow
def test_the_command_writes_page_and_print_of_a_run(run, tmp_path, capsys, browser):
    before = Page((run / "report.html").read_text())
    (run / "report.html").unlink()
    capsys.readouterr()
    assert run_command("report", run, "--pdf", tmp_path / "run.pdf", "--json") == 0
    files = {"html": str(run / "report.html"), "pdf": str(tmp_path / "run.pdf")}
    assert json.loads(capsys.readouterr().out) == files
    after = Page((run / "report.html").read_text())
    assert [word for word in before.words if word not in after.words] == []
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
    options = ("--noise", "carmine", "--views", 4, "--no-early-stop", "--quiet")
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

    page.locator("iframe").scroll_into_view_if_needed()
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
    assert not page.get_by_text("Drag to rotate").is_visible()
    page.evaluate("document.querySelectorAll('details').forEach(part => part.open = true)")
    origins = page.locator("table:has(th:text-is('origin'))").first.locator("td:last-child")
    assert min(box["width"] for box in (cell.bounding_box() for cell in origins.all())) > 100
    page.close()


def test_a_browser_without_3d_shows_a_message_in_place_of_the_shapes(browser):
    page = browser.new_page()
    page.add_init_script("HTMLCanvasElement.prototype.getContext = () => null")
    page.goto("about:blank")
    page.set_content(scene_3d_html(make_graph(), 0.0))
    page.get_by_text("WebGL is missing").wait_for(timeout=10_000)
    page.close()
