"""Colours: the same for an object everywhere, and told apart by those who do not see them all."""

from __future__ import annotations

import io
import re
from base64 import b64decode
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from report_steps import SMALL, good, make_cloud, make_graph, make_step, make_view, render_report

from caryatid.sensing.views import SUPPORT_LABEL
from caryatid.viz import draw_view
from caryatid.viz.charts import Line, line_chart
from caryatid.viz.colours import (
    PALETTE,
    PLAIN,
    SALIENCY_STOPS,
    SERIES,
    label_colours,
    object_colour,
    object_stripes,
    rgb,
    striped_colours,
)
from caryatid.viz.graphs import draw_graph
from caryatid.viz.images import draw_image
from caryatid.viz.layout import arrange
from caryatid.viz.rows import object_rows, support_rows

VISIONS = {
    "full": np.eye(3),
    "protanopia": np.array(
        [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]]
    ),
    "deuteranopia": np.array(
        [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]
    ),
    "tritanopia": np.array(
        [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]]
    ),
}
"""What the colour-blind see of linear RGB, Machado, Oliveira and Fernandes 2009, severity 1."""
XYZ = np.array(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
)
WHITE = np.array([0.95047, 1.0, 1.08883])
JUST_SEEN = 2.3
"""The least difference of colours, CIE 1976 ΔE, that is seen when they lie side by side."""


def seen(colours, vision):
    """CIE L*a*b* (N, 3) of `#rrggbb` colours as they look to somebody."""
    share = np.array([rgb(c) for c in colours]) / 255.0
    linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    t = np.clip(linear @ VISIONS[vision].T, 0.0, 1.0) @ XYZ.T / WHITE
    f = np.where(t > (6 / 29) ** 3, np.cbrt(t), t / (3 * (6 / 29) ** 2) + 4 / 29)
    return np.stack([116 * f[:, 1] - 16, 500 * (f[:, 0] - f[:, 1]), 200 * (f[:, 1] - f[:, 2])], axis=-1)


def differences(colours, vision):
    """CIE 1976 ΔE of each pair (N, N)."""
    lab = seen(colours, vision)
    return np.linalg.norm(lab[:, None] - lab[None], axis=-1)


def test_the_simulation_knows_what_is_confused():
    """Equally light red and green are far apart for most, and near for who lacks either."""
    red_and_green = ["#c05040", "#7a7f3a"]
    far = differences(red_and_green, "full")[0, 1]
    assert far > 45.0
    assert differences(red_and_green, "deuteranopia")[0, 1] < far / 3.0
    assert np.allclose(seen(["#ffffff", "#000000"], "full"), [[100, 0, 0], [0, 0, 0]], atol=0.05)
    for vision in VISIONS:
        assert np.allclose(seen(["#808080"], vision)[0, 1:], 0.0, atol=0.1)


@pytest.mark.parametrize("vision", VISIONS)
def test_neighbours_of_the_palette_are_far_apart(vision):
    """ΔE ≥ 30 between objects numbered one after the other, thirteen times what is just seen."""
    apart = differences([object_colour(k) for k in range(1, len(PALETTE) + 1)], vision)
    assert np.diag(apart, 1).min() >= 30.0 > 13.0 * JUST_SEEN


@pytest.mark.parametrize("vision", VISIONS)
def test_colours_too_near_to_tell_have_other_stripes(vision):
    """ΔE ≥ 16 between any two of the objects 1 … 28 with the same stripes, on their first 14 colours."""
    labels = range(1, len(PALETTE) + 1)
    apart = differences([object_colour(k) for k in labels], vision)
    alike = np.array([[object_stripes(a) == object_stripes(b) for b in labels] for a in labels])
    assert apart[alike & ~np.eye(len(alike), dtype=bool)].min() >= 16.0


def test_28_objects_differ_in_colour_or_stripes():
    looks = [(object_colour(k), object_stripes(k)) for k in range(1, 4 * PLAIN + 1)]
    assert len(set(looks)) == len(looks)
    assert object_stripes(1) == object_stripes(SUPPORT_LABEL) == ()


@pytest.mark.parametrize("vision", VISIONS)
def test_parts_of_bars_that_touch_are_told_apart(vision):
    assert np.diag(differences(SERIES, vision), 1).min() >= 30.0


@pytest.mark.parametrize("vision", VISIONS)
def test_saliency_goes_one_way_for_everyone(vision):
    """Each stop of the scale differs from each other one; the ends by 60."""
    apart = differences([colour for _, colour in SALIENCY_STOPS], vision)
    assert apart[~np.eye(len(apart), dtype=bool)].min() >= 12.0
    assert apart[0, -1] >= 60.0


def test_an_object_has_one_colour_in_image_cloud_graph_and_tables():
    graph = make_graph()
    view, labels = make_view(graph), make_view(graph).labels
    image, drawing = draw_image(view, labels, graph, SMALL), draw_graph(graph, arrange(graph))
    page = draw_view(make_step(), SMALL)
    cloud = next(figure.svg for figure in page.figures if figure.kind == "cloud")
    rows = {row.id: row.colour for row in object_rows(graph)}
    for item in graph.objects:
        colour = object_colour(item.label)
        assert rows[item.id] == colour
        assert f'fill="{colour}" data-object="{item.id}"' in drawing
        for picture in (image, cloud):
            lines = re.search(rf"<g([^>]*)><title>{item.id}, [^<]*</title>", picture)
            assert f'stroke="{colour}"' in lines[1]
            if item.role != "support_surface":
                tag = re.search(rf'fill="([^"]+)"/><text [^>]*>{item.id}</text>', picture)
                assert tag[1] == colour
    for row in support_rows(graph):
        assert (row.supporter_colour, row.supported_colour) == (rows[row.supporter], rows[row.supported])


def pixels(picture, number):
    """An image put into a picture (H, W, 3), the `number`-th."""
    data = re.findall(r"data:image/\w+;base64,([^\"]+)", picture)[number]
    image = Image.open(io.BytesIO(b64decode(data))).convert("RGBA")
    return np.asarray(image)[..., :3].astype(float)


def test_parts_have_their_objects_hue_whatever_colour_they_are():
    """A red thing that is object 1 is blue in the tinted image, and red in the plain one."""
    graph = make_graph()
    view = make_view(graph)
    red = replace(view, rgb=np.full((*view.depth.shape, 3), (200, 30, 30), np.uint8))
    labels = np.ones(view.depth.shape, np.int32)
    picture = draw_image(replace(red, T_world_camera=None), labels, graph, SMALL)
    plain, tinted = pixels(picture, 0).mean((0, 1)), pixels(picture, 1).mean((0, 1))
    own = np.array(rgb(object_colour(1)), float)
    assert np.allclose(plain, (200, 30, 30), atol=4.0)
    assert np.ptp(tinted) > 0.5 * np.ptp(own)
    assert np.corrcoef(tinted, own)[0, 1] > 0.999


def test_stripes_are_on_the_objects_that_need_them_and_leave_the_colour():
    v, u = np.indices((60, 60)).astype(float)
    for label in (1, 7, 8, 15, 22):
        labels = np.full((60, 60), label, np.int32)
        flat, drawn = label_colours(labels), striped_colours(labels, u, v, 12.0)
        lighter = (drawn != flat).any(axis=-1)
        assert lighter.mean() == pytest.approx(
            {0: 0.0, 1: 1 / 3, 2: 5 / 9}[len(object_stripes(label))], abs=0.03
        )
        assert (drawn >= flat).all()


def test_the_eighth_object_is_striped_in_the_graph():
    graph = make_graph()
    eighth = replace(graph.objects[3], id="o8", label=8)
    plain = draw_graph(graph, arrange(graph))
    drawn = replace(graph, objects=(*graph.objects[:3], eighth))
    assert 'class="stripes"' not in plain
    assert draw_graph(drawn, arrange(drawn)).count('class="stripes"') == 1


def test_lines_of_a_chart_differ_in_dashes_and_points():
    lines = [Line(name, [1.0, 2.0]) for name in "abcd"]
    chart = line_chart([0.0, 1.0], lines, title="t", x_name="x", y_name="y")
    styles = {
        re.search(r"stroke-dasharray: ([^;\"]+)", style)[1] if "dasharray" in style else "solid"
        for style in re.findall(r'<path [^>]*style="(fill: none[^"]*stroke-width: 2[^"]*)"', chart)
    }
    assert len(styles) == 4


def test_doubt_and_kind_are_told_without_colour():
    """An uncertain arrow is dashed and says so in the table; kinds are written."""
    html = render_report([draw_view(make_step(), SMALL)], title="t", settings={}, scores=[good(0.5)])
    assert "stroke-dasharray" in html.split("svg .edge.uncertain path")[1].split("}")[0]
    assert ">uncertain</td>" in html
    assert ">top-down 3/4<" in html


def test_the_cloud_is_drawn_in_the_objects_colours():
    graph = make_graph()
    only = graph.objects[1]
    cloud = make_cloud(replace(graph, objects=(only,), supports=(), stability={}))
    step = replace(make_step(), graph=replace(graph, objects=(only,), supports=(), stability={}), cloud=cloud)
    picture = next(f.svg for f in draw_view(step, SMALL).figures if f.kind == "cloud")
    colour = pixels(picture, 0).reshape(-1, 3)
    drawn = colour[np.ptp(colour, axis=1) > 40.0].mean(axis=0)
    assert np.corrcoef(drawn, rgb(object_colour(only.label)))[0, 1] > 0.99
