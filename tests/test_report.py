"""The report: complete, self-contained, safe to open, and drawn where things are."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from report_steps import SMALL, K, at, good, make_cloud, make_graph, make_step, make_view, render_report

from caryatid.geometry import transforms
from caryatid.geometry.shapes import Box, Cylinder, Sphere
from caryatid.graph import SceneObject, Support, SupportGraph
from caryatid.planning.candidates import Candidates
from caryatid.sensing.views import SUPPORT_LABEL, Cloud, View
from caryatid.viz import draw_model, draw_view
from caryatid.viz.charts import Line, bar_chart, line_chart
from caryatid.viz.colours import PALETTE, object_colour
from caryatid.viz.graphs import draw_graph
from caryatid.viz.images import draw_image
from caryatid.viz.layout import arrange, layers
from caryatid.viz.svg import keep_apart
from caryatid.viz.wireframes import Projection

VOID = {"meta", "input", "br", "link", "img", "hr"}


@pytest.fixture(scope="module")
def html() -> str:
    pages = [draw_view(make_step(0), SMALL), draw_view(make_step(1, decide=False), SMALL)]
    settings = {"source": "a<b>.xml", "seed": 0, "report": SMALL}
    return render_report(
        pages, title="Run <script>alert(1)</script>", settings=settings, scores=[good(0.5), good(0.9)]
    )


class Balanced(HTMLParser):
    """Fails on tags that are not closed in order; keeps texts and attributes."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.references: list[str] = []
        self.words: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.references += [value or "" for name, value in attrs if name in ("src", "href", "data", "srcset")]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.references += [value or "" for name, value in attrs if name in ("src", "href", "data", "srcset")]

    def handle_endtag(self, tag: str) -> None:
        assert self.open, f"</{tag}> closes nothing"
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.words.append(data)


def read(html: str) -> Balanced:
    parser = Balanced()
    parser.feed(html)
    parser.close()
    return parser


def test_it_is_one_well_formed_file_that_loads_nothing(html: str) -> None:
    parser = read(html)
    assert parser.open == []
    assert parser.references
    assert all(r.startswith(("data:image/", "#")) for r in parser.references)
    assert not re.search(r"https?://|url\(|@import|<script", html)


def test_every_object_edge_score_and_setting_is_in_it(html: str) -> None:
    words = " ".join(read(html).words)
    for item in make_graph().objects:
        assert f'data-object="{item.id}"' in html
        assert item.id in words
    for support in make_graph().supports:
        assert f'data-edge="{support.supporter} {support.supported}"' in html
        assert f"{support.occurrences} of {support.opportunities}" in words
    for said in (
        "0.900",
        "sees o2 & o7 best",
        "the graph did not change",
        "report.cloud_width",
        "100 × 160 × 100",
    ):
        assert said in words


def test_what_users_write_is_escaped(html: str) -> None:
    assert "Run &lt;script&gt;" in html
    words = " ".join(read(html).words)
    for said in ("Run <script>alert(1)</script>", "a<b>.xml", "view <7> & more", "the table lies below <o1>"):
        assert said in words


def test_charts_appear_with_scores_and_travel_only() -> None:
    pages = [draw_view(make_step(0), SMALL), draw_view(make_step(1), SMALL)]
    with_scores = render_report(pages, title="t", settings={}, scores=[good(0.5), good(0.9)])
    without = render_report(pages, title="t", settings={})
    assert "F1 over travelled path" in with_scores
    assert "F1 over views" in with_scores
    assert "F1 over views" not in without
    assert "travelled path" not in without
    still = [replace(page, path_travelled=0.0, angle_travelled=0.0) for page in pages]
    assert "travelled path" not in render_report(still, title="t", settings={}, scores=[good(0.5), good(0.9)])


def chart_words(chart: str) -> list[str]:
    return [word for word in read(chart).words if word.strip()]


def numbers(words: list[str]) -> list[float]:
    return [float(word) for word in words if re.fullmatch(r"-?[\d.]+", word)]


def test_counts_have_whole_ticks_and_gaps_stay_gaps() -> None:
    found = Line("found", [9.0, math.nan, 11.0])
    chart = line_chart([0.0, 1.0, 2.0], [found], title="t", x_name="view", y_name="number")
    words = chart_words(chart)
    ticks = numbers(words)
    assert {0.0, 1.0, 2.0} <= set(ticks)
    assert max(ticks) >= 11.0
    assert all(tick.is_integer() for tick in ticks)
    assert [word for word in words if word.startswith("found")] == ["found 9", "found 11"]
    assert len(re.findall("<use", chart)) == 2


def test_axes_are_named_and_f1_runs_from_0_to_1() -> None:
    low = Line("F1", [0.62, 0.64])
    words = chart_words(line_chart([0.0, 3.7], [low], title="t", x_name="m", y_name="F1", y_range=(0.0, 1.0)))
    assert {"t", "m", "F1"} <= set(words)
    assert numbers(words)[-6:] == [0.0, 0.2, 0.4, 0.6, 0.8, 1.0]


def test_each_view_has_a_bar_with_its_parts_and_a_whole_tick() -> None:
    bars = [{"fit": 0.25}, {"fit": 0.5, "plan": 0.125}] + [{"plan": 0.75}] * 8
    words = chart_words(bar_chart(bars, title="t", x_name="view", y_name="time [s]"))
    assert numbers(words)[:10] == [float(k) for k in range(10)]
    assert {"fit 0.25", "fit 0.5", "plan 0.125", "plan 0.75", "time [s]"} <= set(words)
    assert {"fit", "plan"} <= set(words)
    alone = chart_words(bar_chart(bars[:1], title="t", x_name="view", y_name="time [s]"))
    assert alone[:2] == ["0", "view"]


def test_charts_are_the_same_whatever_the_user_set_and_leave_it_alone() -> None:
    import matplotlib as mpl

    def draw() -> str:
        lines = [Line("a", [1.0, 2.0]), Line("b", [2.0, 2.0])]
        return line_chart([0.0, 1.0], lines, title="t", x_name="view", y_name="number")

    usual = draw()
    with mpl.rc_context({"font.size": 30.0, "axes.facecolor": "red", "svg.fonttype": "path"}):
        assert draw() == usual
        assert mpl.rcParams["font.size"] == 30.0
    assert draw() == usual
    assert "var(--soft)" in usual
    assert not re.search(r"xmlns|url\(|<style|<metadata|<\?xml", usual)


def test_ids_in_charts_are_found_once(html: str) -> None:
    ids = re.findall(r'\bid="([^"]+)"', html)
    assert len(ids) == len(set(ids))
    charts = re.findall(r'<svg [^>]*class="chart".*?</svg>', html, re.DOTALL)
    assert len(charts) == 4
    used = set(re.findall(r'href="#([^"]+)"', "".join(charts)))
    assert used
    assert used <= set(ids)


def test_views_are_numbered_like_the_folders_of_the_run(html: str) -> None:
    headings = re.findall(r"<h2>(.*?)</h2>", html)
    for number, heading in zip(("00", "01"), headings, strict=False):
        assert re.sub("<[^>]+>", "", heading) == f"View {number} (views/{number})"
        assert f'<a href="#view{number}"' in html
        assert f'id="view{number}"' in html


def test_scores_must_match_the_pages() -> None:
    page = draw_view(make_step(), SMALL)
    with pytest.raises(ValueError, match="2 scores for 1 views"):
        render_report([page], title="t", settings={}, scores=[good(0.1), good(0.2)])
    with pytest.raises(ValueError, match="one view"):
        render_report([], title="t", settings={})


def test_a_step_without_decision_or_colour_is_drawn() -> None:
    page = draw_view(make_step(rgb=False, decide=False), SMALL)
    assert [f.kind for f in page.figures] == ["camera", "graph", "cloud", "cloud"]
    assert "depth image" in page.figures[0].caption
    assert page.choice == ""
    assert "the graph did not change" in render_report([page], title="t", settings={})


def test_a_cloud_alone_has_no_camera_picture() -> None:
    graph = make_graph()
    page = draw_model(graph, make_cloud(graph), config=SMALL)
    assert [f.kind for f in page.figures] == ["graph", "cloud", "cloud"]
    assert page.name == "fused"
    assert "data-object" in render_report([page], title="t", settings={})


def test_an_empty_graph_and_cloud_are_drawn() -> None:
    cloud = Cloud(np.empty((0, 3)), np.empty((0, 3)), name="nothing")
    page = draw_model(SupportGraph(), cloud, config=SMALL)
    read(render_report([page], title="t", settings={}))
    assert page.objects == ()


def test_a_view_without_a_pose_is_drawn_without_shapes() -> None:
    graph = make_graph()
    view = make_view(graph)
    posed = draw_image(view, make_step().labels, graph, SMALL)
    unposed = draw_image(replace(view, T_world_camera=None), make_step().labels, graph, SMALL)
    assert 'class="wire' in posed
    assert 'class="wire' not in unposed


def test_changes_between_views_are_said() -> None:
    first = draw_view(make_step(0), SMALL)
    fewer = make_graph()
    ball_gone = SupportGraph(fewer.objects[:3], fewer.supports[:2], fewer.stability)
    second = draw_view(replace(make_step(1), graph=ball_gone), SMALL)
    html = render_report([first, second], title="t", settings={})
    assert "objects gone: o7" in html
    assert "supports gone: o0 → o2, o2 → o1" in html


def test_uncertain_edges_and_unsupported_objects_are_marked_and_dashed(html: str) -> None:
    graph = make_graph()
    svg = draw_graph(graph, arrange(graph))
    kinds = {pair: kind for kind, pair in re.findall(r'<g class="edge([^"]*)" data-edge="(\w+ \w+)"', svg)}
    assert {pair for pair, kind in kinds.items() if "uncertain" in kind} == {"o0 o2", "o2 o1"}
    assert "top-down" in kinds["o2 o1"]
    unsupported = re.findall(r'<g class="node unsupported"[^>]*data-object="(\w+)"', svg)
    assert unsupported == ["o7"]
    for selector in ("svg .edge.uncertain path", "svg .node.unsupported rect"):
        assert "stroke-dasharray" in html.split(selector)[1].split("}")[0]


def test_what_the_boxes_hide_is_in_the_page(html: str) -> None:
    """Parts and shapes can be taken off the camera's picture: their rules name what is drawn."""
    head, body = html.split("<body>")
    for name in ("tinted", "wire", "tag"):
        assert f".camera .{name}" in head
        assert re.search(rf'class="{name}[" ]', body)


def test_evidence_is_written_on_the_edges() -> None:
    graph = make_graph()
    notes = re.findall(r'class="note[^"]*">([^<]+)<', draw_graph(graph, arrange(graph)))
    assert sorted(notes) == ["1/2", "1/5", "2/2", "top-down 3/4"]


def test_layers_follow_the_support_order_whatever_the_circles() -> None:
    assert layers(make_graph()) == {"o0": 0, "o1": 1, "o2": 2, "o7": 1}


def chain(pairs: list[tuple[str, str]], count: int) -> SupportGraph:
    shape = Sphere(np.eye(4), 0.05)
    objects = [SceneObject(f"o{k}", k, shape, "object" if k else "support_surface") for k in range(count)]
    return SupportGraph(tuple(objects), tuple(Support(a, b) for a, b in pairs))


def test_edges_point_upwards_and_vertices_keep_apart() -> None:
    rng = np.random.default_rng(3)
    for _ in range(20):
        count = int(rng.integers(2, 16))
        pairs = {(f"o{rng.integers(0, k)}", f"o{k}") for k in range(1, count) for _ in range(2)}
        graph = chain(sorted(pairs), count)
        layout = arrange(graph)
        for lower, upper in pairs:
            assert layout.position[lower][1] < layout.position[upper][1]
            route = layout.route[lower, upper]
            assert [level for _, level in route] == list(
                np.arange(layout.position[lower][1], layout.position[upper][1] + 1)
            )
        places = [at for name, at in layout.position.items() if name != "o0"]
        for k, (x, level) in enumerate(places):
            assert 0.0 <= x <= layout.width
            for other_x, other_level in places[:k]:
                assert level != other_level or abs(x - other_x) >= 1.0 - 1e-9


def test_objects_of_one_layer_that_hold_each_other_are_joined_by_an_arc() -> None:
    graph = chain([("o0", "o1"), ("o0", "o2")], 3)
    leaning = replace(
        graph, supports=(*graph.supports, Support("o1", "o2", "lean"), Support("o2", "o1", "lean"))
    )
    svg = draw_graph(leaning, arrange(leaning))
    assert svg.count("lean 1/1") == 2
    assert "NaN" not in svg
    assert "nan" not in svg


def test_colours_depend_on_the_label_alone_and_differ() -> None:
    colours = [object_colour(k) for k in range(1, 3 * len(PALETTE) + 1)]
    assert len(set(colours)) == len(colours)
    assert object_colour(0) == object_colour(SUPPORT_LABEL)
    assert object_colour(5) == object_colour(5)


@pytest.mark.parametrize(
    "shape",
    [
        Box(at(0.1, 0.2, 0.3), np.array([0.1, 0.2, 0.3])),
        Cylinder(at(0.1, 0.2, 0.3), 0.05, 0.2),
        Sphere(at(0.1, 0.2, 0.3), 0.07),
    ],
)
def test_wireframes_lie_on_the_surface(shape: Box | Cylinder | Sphere) -> None:
    lines = shape.lines(np.array([1.0, -0.5, 1.2]))
    points = np.concatenate(lines)
    assert np.abs(shape.signed_distance(points)).max() < 1e-9


@pytest.mark.parametrize("shape", [Cylinder(at(0, 0, 0.1), 0.05, 0.2), Sphere(at(0, 0, 0.1), 0.07)])
def test_round_shapes_are_outlined_by_their_silhouette(shape: Cylinder | Sphere) -> None:
    eye = np.array([0.9, 0.3, 0.6])
    T_world_camera = transforms.look_at(eye, (0.0, 0.0, 0.1))
    projection = Projection(T_world_camera, K, np.zeros((1, 1), dtype=np.float32))
    drawn, _ = projection.project(np.concatenate(shape.lines(eye)))
    solid, _ = projection.project(shape.surface(0.001)[0])
    assert np.allclose(drawn.min(axis=0), solid.min(axis=0), atol=0.3)
    assert np.allclose(drawn.max(axis=0), solid.max(axis=0), atol=0.3)


def test_projection_agrees_with_the_view() -> None:
    view = make_view(make_graph())
    points_world = transforms.transform(view.pose, view.points_camera.reshape(-1, 3))
    valid = view.valid.ravel()
    pixels, z = Projection(view.pose, view.K, view.depth).project(points_world[valid])
    v, u = np.nonzero(view.valid)
    assert np.allclose(pixels, np.stack([u, v], axis=-1), atol=1e-6)
    assert np.allclose(z, view.depth[view.valid], atol=1e-6)


def test_lines_behind_what_is_seen_are_hidden() -> None:
    projection = Projection(np.eye(4), K, np.full((120, 160), 1.0, dtype=np.float32))
    pixels, z = projection.project(
        np.array([[0.0, 0.0, 0.9], [0.0, 0.0, 1.01], [0.0, 0.0, 1.5], [9.0, 0.0, 1.5]])
    )
    assert projection.hidden(pixels, z, 0.02).tolist() == [False, False, True, False]


def test_tags_end_up_apart_and_inside() -> None:
    rng = np.random.default_rng(0)
    anchors = rng.uniform((0.0, 0.0), (300.0, 200.0), (14, 2))
    anchors[3] = anchors[4]
    sizes = np.tile((34.0, 18.0), (14, 1))
    centres = keep_apart(anchors, sizes, (0.0, 0.0, 300.0, 200.0))
    gaps = np.abs(centres[:, None] - centres[None, :]) - sizes
    overlapping = (gaps < -0.5).all(axis=-1) & ~np.eye(14, dtype=bool)
    assert not overlapping.any()
    assert (centres >= sizes / 2 - 1e-9).all()
    assert (centres <= np.array([300.0, 200.0]) - sizes / 2 + 1e-9).all()


def test_the_chosen_view_and_the_points_of_interest_are_on_the_sphere() -> None:
    page = draw_view(make_step(1), SMALL)
    sphere = next(f for f in page.figures if f.kind == "sphere")
    assert sphere.svg.count('class="chosen') == 2
    assert sphere.svg.count('class="visited') == 4
    assert sphere.svg.count('class="ray') == 2
    assert "12 too low" in sphere.caption
    (point,) = page.points
    assert (point.subject, point.saliency, point.why) == ("o1 – o2", "0.62", "seen once <i>")


def test_few_candidates_are_drawn_one_by_one() -> None:
    step = make_step()
    few = Candidates(step.candidates.T_world_camera[:5], step.candidates.directions[:5], np.ones(5), {})
    sphere = draw_view(replace(step, candidates=few), SMALL).figures[-1]
    assert sphere.svg.count('class="candidate') == 10


def test_sizes_stability_and_unseen_sides_are_said() -> None:
    seen = (True, False, True, True, False, True)
    graph = make_graph()
    objects = (graph.objects[0], replace(graph.objects[1], seen=seen), *graph.objects[2:])
    rows = {
        row.id: row
        for row in draw_view(replace(make_step(), graph=replace(graph, objects=objects)), SMALL).objects
    }
    assert rows["o1"].unseen == "+x −z"
    assert (rows["o1"].stability, rows["o1"].ratio, rows["o1"].overhang) == ("stable", "1.00", "−50")
    assert (rows["o2"].stability, rows["o2"].unstable, rows["o2"].poor_fit) == (
        "small area, tips",
        True,
        True,
    )
    assert rows["o2"].size == "⌀ 60, 120 long"
    assert rows["o2"].supporters == "o1, o0?"
    assert rows["o7"].supporters == "nothing known"
    assert rows["o7"].size == "⌀ 80"


def test_nothing_drawn_is_not_a_number(html: str) -> None:
    places = re.findall(r'\b(?:x|y|cx|cy|r|width|height)="([^"]+)"', html)
    assert places
    assert all(math.isfinite(float(n)) for n in places)


def test_drawing_is_reproducible_and_leaves_the_step_alone() -> None:
    step = make_step()
    before = (step.cloud.points_world.copy(), step.labels.copy(), step.view.depth.copy())
    assert draw_view(step, SMALL) == draw_view(step, SMALL)
    for array, copy in zip((step.cloud.points_world, step.labels, step.view.depth), before, strict=True):
        assert np.array_equal(array, copy)


def test_ten_views_stay_small() -> None:
    rng = np.random.default_rng(0)
    step = make_step()
    noisy = rng.integers(0, 255, (480, 640, 3)).astype(np.uint8)
    graph = step.graph
    K_vga = np.array([[525.0, 0.0, 319.5], [0.0, 525.0, 239.5], [0.0, 0.0, 1.0]])
    view = View(np.ones((480, 640), np.float32), K_vga, step.view.pose, noisy)
    page = draw_view(
        replace(step, view=view, labels=rng.integers(0, 8, (480, 640)).astype(np.int32), graph=graph)
    )
    assert len(render_report([page], title="t", settings={})) < 8e5


def test_a_model_without_planning_is_drawn_from_the_sensors_side() -> None:
    graph = make_graph()
    cloud, view = make_cloud(graph), make_view(graph)
    backward = -view.pose[:3, 2]
    from_view = draw_model(graph, cloud, view=view, config=SMALL)
    asked = draw_model(
        graph, cloud, view=view, azimuth=float(np.arctan2(backward[1], backward[0])), config=SMALL
    )
    assert from_view.figures == asked.figures
    turned = draw_model(graph, cloud, view=view, azimuth=0.0, config=SMALL)
    assert turned.figures != asked.figures
    seen_from = replace(cloud, viewpoint_world=cloud.points_world.mean(axis=0) + np.array([0.0, 2.0, 1.0]))
    aside = draw_model(graph, seen_from, config=SMALL)
    assert aside.figures == draw_model(graph, cloud, azimuth=np.pi / 2, config=SMALL).figures
