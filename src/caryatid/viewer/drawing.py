"""What is drawn for a moment, as data: the canvas hands it to the browser, tests look at it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from caryatid.geometry.transforms import Array
from caryatid.viewer.bodies import draw_robot, draw_shapes, draw_supports
from caryatid.viewer.marks import Colours, Drawing, Frustum, Label, Lines, Points
from caryatid.viewer.moments import Dots, Moment, Shot
from caryatid.viz.colours import NOTHING_COLOUR, SALIENCY_STOPS, object_colour, rgb, scale

LAYERS = ("cloud", "shapes", "names", "supports", "sphere", "interest", "cameras", "robot")
"""What can be shown and hidden, as the page has it."""
SPHERE_DOTS, SPHERE_SIZE = 10_000, 0.01
"""Points that are drawn of a whole view sphere, and their size [m]; a robot reaches a quarter of them."""
BEYOND_DOTS, BEYOND = 900, (206, 209, 213)
"""How many points are drawn where the robot cannot bring its camera, and their colour."""
INTEREST_SIZE = 0.02
"""Of a point of interest [m]."""
EARLIER, NEWEST, NEXT, BY_HAND = (128, 136, 146), (26, 32, 40), (11, 92, 148), (170, 30, 120)
"""Colours of cameras: earlier views, the newest, the planner's choice, the choice by hand."""
CAMERA_SIZE = 0.09
"""Of a drawn camera [m]; the newest is larger by half."""


def draw_moment(
    moment: Moment,
    shots: Sequence[Shot],
    *,
    chosen: str = "",
    point_size: float = 0.004,
    true_colours: bool = False,
) -> Drawing:
    """Say what is drawn for a moment.

    Args:
        moment: What is known.
        shots: The views so far, the newest last.
        chosen: Id of the object that stands out.
        point_size: Diameter of the cloud's points [m].
        true_colours: Points as the camera saw them, not in their objects' colours.
    """
    drawing: Drawing = {}
    if moment.dots is not None and len(moment.dots):
        drawing["cloud/points"] = draw_dots(moment.dots, point_size, true_colours=true_colours)
    drawing |= draw_shapes(moment.graph, chosen)
    drawing |= draw_supports(moment.graph)
    drawing |= _draw_sphere(moment)
    drawing |= _draw_interest(moment)
    drawing |= _draw_cameras(moment, shots)
    if moment.robot is not None:
        drawing |= draw_robot(moment.robot)
    return drawing


def draw_dots(dots: Dots, size: float, *, true_colours: bool = False) -> Points:
    """Draw a cloud in its objects' colours, or as the camera saw it where it has colour."""
    middle = dots.points_world[:: max(1, len(dots) // 1000)].mean(axis=0)
    colours = dots.rgb if true_colours and dots.rgb is not None else _label_colours(dots)
    return Points(middle.astype(np.float64), dots.points_world - middle, colours, size)


def _label_colours(dots: Dots) -> Colours:
    """As `report.colours.label_colours`, by a table, for large clouds."""
    table = np.zeros((65536, 3), dtype=np.uint8)
    for label in np.flatnonzero(np.bincount(dots.labels, minlength=1)):
        table[label] = rgb(NOTHING_COLOUR if label == 0 else object_colour(int(label)))
    return table[dots.labels]


def _draw_sphere(moment: Moment) -> Drawing:
    """Where the camera can go, painted with saliency; where it cannot, pale and only over the table."""
    sphere, candidates, decision = moment.sphere, moment.candidates, moment.decision
    if sphere is None:
        return {}
    drawing: Drawing = {}
    directions = sphere.directions
    beyond = directions[directions[:, 2] > 0.0]
    beyond = beyond[:: max(1, len(beyond) // BEYOND_DOTS)]
    if candidates is not None and len(candidates):
        few = candidates.looks(SPHERE_DOTS).chosen
        rated = None if decision is None else decision.candidate_saliency
        saliency = np.zeros(len(few)) if rated is None else _stretched(rated)[few]
        at = (sphere.radius * candidates.directions[few]).astype(np.float32)
        size = SPHERE_SIZE if len(few) > 100 else 4.0 * SPHERE_SIZE
        drawing["sphere/reachable"] = Points(
            sphere.centre_world, at, scale(saliency, SALIENCY_STOPS), 0.6 * size if rated is None else size
        )
    pale = np.tile(np.array(BEYOND, np.uint8), (len(beyond), 1))
    at = (sphere.radius * beyond).astype(np.float32)
    drawing["sphere/beyond"] = Points(sphere.centre_world, at, pale, 0.5 * SPHERE_SIZE)
    return drawing


def _stretched(saliency: Array) -> Array:
    """Saliency (N,) such that the largest is 1, of either sign: planners differ in what they count in."""
    largest = float(np.abs(saliency).max(initial=0.0))
    return saliency / largest if largest > 0.0 else saliency


def _draw_interest(moment: Moment) -> Drawing:
    """Points of interest where they are, joined to where on the view sphere they are seen best."""
    points = () if moment.decision is None else moment.decision.points_of_interest
    if not points:
        return {}
    at = np.array([p.position_world for p in points])
    colours = scale(np.array([p.saliency for p in points]), SALIENCY_STOPS)
    middle = at.mean(axis=0)
    drawing: Drawing = {
        "interest/points": Points(middle, (at - middle).astype(np.float32), colours, INTEREST_SIZE)
    }
    if moment.sphere is not None:
        ends = moment.sphere.centre_world + moment.sphere.radius * np.array([p.direction for p in points])
        drawing["interest/rays"] = Lines(np.stack([at, ends], axis=1), colours, 1.0)
    return drawing


def _draw_cameras(moment: Moment, shots: Sequence[Shot]) -> Drawing:
    drawing: Drawing = {}
    for number, shot in enumerate(shots):
        newest = number == len(shots) - 1
        size = 1.5 * CAMERA_SIZE if newest else CAMERA_SIZE
        colour = NEWEST if newest else EARLIER
        drawing[f"cameras/{number:02d}"] = Frustum(
            shot.T_world_camera, shot.field_of_view, shot.aspect, size, colour, shot.picture
        )
        drawing[f"cameras/number{number:02d}"] = Label(_over(shot.T_world_camera), str(number))
    if not shots:
        return drawing
    lens = shots[-1]
    if moment.decision is not None:
        T = moment.decision.T_world_camera
        colour = BY_HAND if moment.by_hand else NEXT
        drawing["cameras/next"] = Frustum(
            T, lens.field_of_view, lens.aspect, CAMERA_SIZE, colour, filled=True
        )
        drawing["cameras/next-name"] = Label(_over(T), "next")
    return drawing


def _over(T_world_camera: Array) -> Array:
    return T_world_camera[:3, 3] + [0.0, 0.0, 0.06]
