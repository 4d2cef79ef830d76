from __future__ import annotations

import numpy as np
from synthetic import box, sphere, surface_points

from caryatid.config import SegmentationConfig
from caryatid.objects.models import associate

CRATE, BALL = box((0.0, 0.0, 0.8), (0.1, 0.12, 0.1)), sphere((0.3, 0.0, 0.79), 0.04)


def seen(shape, eye=None, seed=0):
    return surface_points(shape, np.random.default_rng(seed), eye=eye, sigma=0.001)[0]


KNOWN = {3: seen(CRATE, eye=(-1.0, 0.0, 1.5)), 7: seen(BALL, eye=(-1.0, 0.0, 1.5))}
SHAPES = {3: CRATE, 7: BALL}


def names_of(*parts, known=KNOWN, shapes=SHAPES, **options):
    """Labels that parts numbered 1, 2, … get; beside them are points of no part."""
    points = np.concatenate([*parts, np.zeros((5, 3))])
    labels = np.concatenate([np.full(len(p), k) for k, p in enumerate(parts, start=1)] + [np.zeros(5)])
    found = associate(points, labels.astype(np.int32), known, shapes, SegmentationConfig(), **options)
    assert (found[labels == 0] == 0).all()
    names = [sorted({int(k) for k in found[labels == part]}) for part in range(1, len(parts) + 1)]
    return {part: n[0] if len(n) == 1 else n for part, n in enumerate(names, start=1)}


def test_a_part_of_a_side_never_seen_is_the_object_in_whose_shape_it_lies():
    front = KNOWN[3][KNOWN[3][:, 0] < -0.045]
    behind = seen(CRATE)
    behind = behind[behind[:, 0] > 0.045]
    assert names_of(behind, known={3: front}) == {1: 3}
    assert names_of(behind, known={3: front}, shapes={}) == {1: 4}


def test_what_lies_elsewhere_is_a_new_object_with_a_label_never_given():
    elsewhere = seen(box((0.0, 0.4, 0.8), (0.1, 0.1, 0.1)))
    farther = seen(box((0.0, -0.4, 0.8), (0.1, 0.1, 0.1)))
    assert names_of(elsewhere, farther, labels_used=2) == {1: 8, 2: 9}
    assert names_of(elsewhere, labels_used=20) == {1: 21}
    assert names_of(elsewhere, known={}, shapes={}) == {1: 1}
    assert names_of() == {}


def unlike(**rows):
    """Points of these rows have another colour than the object of a name, `o3` or `o7`."""
    return lambda name, index: np.isin(index, rows.get(f"o{name}", []))


def test_a_part_of_another_colour_is_a_new_object_though_it_lies_on_a_shape():
    part = seen(CRATE, seed=1)
    assert names_of(part, other_colour=unlike()) == {1: 3}
    assert names_of(part, other_colour=unlike(o3=np.arange(4 * len(part) // 5))) == {1: 8}


def test_a_few_points_of_another_colour_go_to_the_neighbour_that_has_it():
    crate, few = seen(CRATE, seed=1), seen(BALL, seed=1)[:20]
    part = np.concatenate([crate, few])
    assert names_of(part, other_colour=unlike()) == {1: 3}
    rows = np.arange(len(part))
    other_colour = unlike(o3=rows[len(crate) :], o7=rows[: len(crate)])
    assert names_of(part, other_colour=other_colour) == {1: [3, 7]}


def test_a_few_points_beside_its_neighbour_do_not_divide_a_part():
    beside = box((0.0, 0.09, 0.8), (0.1, 0.06, 0.1))
    known = KNOWN | {5: seen(beside)}
    crate = seen(CRATE, seed=2)
    crate = crate[crate[:, 1] < 0.058]
    assert names_of(crate, known=known, shapes=SHAPES) == {1: 3}
