from __future__ import annotations

import numpy as np
import pytest
from synthetic import TABLE_TOP, box, cylinder, seen_free, sphere, surface_at, thing

from caryatid.config import CompletionConfig, VoxelConfig
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Box, Cylinder
from caryatid.objects.hidden_extents import complete
from caryatid.sensing.voxel_map import VoxelMap

CONFIG = CompletionConfig()
SIDES_AND_TOP = (True, True, True, True, False, True)
"""All but the lower side of an upright shape."""
CENTRE = (0.0, 0.0, TABLE_TOP)
UNKNOWN = VoxelMap.around(CENTRE, VoxelConfig())


def completed(*objects, voxels=UNKNOWN, surface=None):
    return complete(objects, [surface or surface_at()], voxels, CONFIG)


def lowest(shape):
    return shape.T_world_object[2, 3] - shape.support(np.array([[0.0, 0.0, -1.0]]))[0]


def highest(shape):
    return shape.T_world_object[2, 3] + shape.support(np.array([[0.0, 0.0, 1.0]]))[0]


def upside_down(shape):
    """The same solid with its z axis downwards."""
    T = shape.T_world_object @ transforms.rigid(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
    return Box(T, shape.extents) if isinstance(shape, Box) else Cylinder(T, shape.radius, shape.height)


HOVERING = [
    box((0.1, 0.0, TABLE_TOP + 0.08), (0.06, 0.08, 0.04), turn_deg=25.0),
    cylinder((0.1, 0.0, TABLE_TOP + 0.08), 0.03, 0.04),
]

LIMIT = TABLE_TOP + 0.03
BELOW = thing(2, box((0.1, 0.0, TABLE_TOP + 0.02), (0.15, 0.15, 0.04)))


@pytest.mark.parametrize("upright", [True, False])
@pytest.mark.parametrize("shape", HOVERING, ids=lambda s: s.kind)
@pytest.mark.parametrize(
    ("free", "others", "bottom", "within", "why"),
    [
        (lambda p: p[:, 2] > 9.0, (), TABLE_TOP, 1e-9, "reach down to the table, 60 mm"),
        (lambda p: np.hypot(p[:, 0] - 0.1, p[:, 1]) > 0.07, (), TABLE_TOP, 1e-9, "table"),
        (lambda p: p[:, 2] < LIMIT, (), LIMIT, 1.5 * VoxelConfig().size, "free space"),
        (lambda p: p[:, 2] < 2.0, (), TABLE_TOP + 0.06, 1e-9, ""),
        (lambda p: p[:, 2] > 9.0, (BELOW,), TABLE_TOP + 0.04, CONFIG.overlap, "next object"),
    ],
    ids=["unseen space", "free beside", "free above the table", "free right below", "an object below"],
)
def test_a_hidden_lower_side_goes_down_to_what_bounds_it(shape, upright, free, others, bottom, within, why):
    """Whichever way the axes of the shape point."""
    hovering = thing(1, shape, seen=SIDES_AND_TOP)
    if not upright:
        hovering = thing(1, upside_down(shape), seen=(True, True, True, True, True, False))
    done, *kept = completed(hovering, *others, voxels=seen_free(free, CENTRE))
    assert lowest(done.shape) == pytest.approx(bottom, abs=within)
    assert highest(done.shape) == pytest.approx(highest(shape))
    np.testing.assert_allclose(done.shape.extents[:2], shape.extents[:2])
    assert why in done.why
    assert [(o.id, o.shape) for o in kept] == [(o.id, o.shape) for o in others]


BALL = thing(1, sphere((0.0, 0.0, TABLE_TOP + 0.1), 0.04), seen=SIDES_AND_TOP)


@pytest.mark.parametrize(
    "known", [*(thing(1, shape) for shape in HOVERING), BALL], ids=lambda o: o.shape.kind
)
def test_a_lower_side_that_was_seen_stays_where_it_is_and_a_ball_is_known_from_any_side(known):
    (done,) = completed(known)
    assert (done.shape, done.why) == (known.shape, "")


def test_what_sticks_in_the_table_is_cut_off_at_its_top():
    sunk = box((0.0, 0.0, TABLE_TOP + 0.02), (0.1, 0.1, 0.06))
    (done,) = completed(thing(1, sunk, seen=SIDES_AND_TOP))
    assert lowest(done.shape) == pytest.approx(TABLE_TOP)
    assert highest(done.shape) == pytest.approx(highest(sunk))


@pytest.mark.parametrize(("tilt_deg", "extended"), [(15.0, True), (45.0, False)])
def test_only_a_side_that_faces_down_is_one_to_rest_on(tilt_deg, extended):
    R = transforms.rotation_from_vector((np.radians(tilt_deg), 0.0, 0.0))
    tilted = cylinder((0.0, 0.0, 0.0), 0.02, 0.06).moved(transforms.rigid(R, (0.0, 0.0, TABLE_TOP + 0.1)))
    (done,) = completed(thing(1, tilted, seen=SIDES_AND_TOP))
    assert (done.shape.height > tilted.height) == extended
    # The face is tested at points, not on all of its rim.
    assert lowest(done.shape) >= TABLE_TOP - 0.001


def test_a_neighbour_that_overlaps_its_wall_does_not_stop_a_lower_side():
    """Both walls' positions are uncertain; the wall beside it holds nothing up."""
    hovering = thing(1, box((0.1, 0.0, TABLE_TOP + 0.06), (0.06, 0.08, 0.04)), seen=SIDES_AND_TOP)
    wall = 0.13 - 1.7 * CONFIG.overlap
    beside = thing(2, box((wall + 0.02, 0.0, TABLE_TOP + 0.05), (0.04, 0.2, 0.1)))
    done, _ = completed(hovering, beside)
    assert lowest(done.shape) == pytest.approx(TABLE_TOP)
    done, _ = completed(hovering, thing(2, box((wall, 0.0, TABLE_TOP + 0.02), (0.04, 0.2, 0.04))))
    assert lowest(done.shape) == pytest.approx(TABLE_TOP + 0.04, abs=CONFIG.overlap)
