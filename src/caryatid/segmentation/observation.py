"""From one view or cloud to labelled, oriented points in the world, and the support surface among them."""

from __future__ import annotations

import copy
from collections.abc import Sequence, Set
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from caryatid.config import CloudConfig, Config, SegmentationMethod
from caryatid.errors import InputError, NoSurfaceError, PerceptionError
from caryatid.geometry import transforms
from caryatid.geometry.transforms import UP, Array
from caryatid.runtime.parallel import SHARES, for_each, kernel
from caryatid.segmentation.diagnosis import describe_unit, name_causes
from caryatid.segmentation.foreground import find_bodies, find_foreground, find_furniture
from caryatid.segmentation.samples import Labels
from caryatid.segmentation.seams import Pairs
from caryatid.segmentation.segments import PLAIN, SMALLEST, colour_shares, segment, segment_cloud
from caryatid.segmentation.support_plane import SupportSurface, find_support_surfaces, find_surface_below
from caryatid.segmentation.void import VOID, is_void
from caryatid.sensing.clouds import average_pixels, oriented_points, slope_limit, thin, working_distance
from caryatid.sensing.views import MAX_LABEL, SUPPORT_LABEL, Cloud, View

FRINGE = 2
"""Width of an object's fringe in the colour of what lies behind, in pixels of a resampled view [px]; half a
window of stereo matching."""
WHOLE = 0.1
"""A piece smaller than this share of a mask's largest body is a crumb [1]; something thin may cut a body."""
ALONE = 0.7
"""Share of the points on the table's plane that a mask of the table has, and share of its points there [1]; a
flat object leaves more of the table to see."""


@dataclass(frozen=True, eq=False, slots=True)
class Observation:
    """One view, perceived.

    Attributes:
        view: The view, posed and at working resolution; None for a cloud.
        cloud: Oriented points in the world frame with labels: 0 nothing, 65535 the support surface.
        pixels: Flat index (N,) of each point in the image, or in the cloud it came from.
        surfaces: The support surfaces as this view shows them, the main one first.
        apart: Pairs (P, 2) of labels, as `observe` gives them, that this view shows to be two bodies.
        notes: What is to be said about given labels.
    """

    view: View | None
    cloud: Cloud
    pixels: NDArray[np.intp]
    surfaces: tuple[SupportSurface, ...]
    apart: NDArray[np.int32]
    notes: tuple[str, ...] = ()

    @property
    def surface(self) -> SupportSurface:
        """The main support surface."""
        return self.surfaces[0]

    @property
    def labels(self) -> NDArray[np.int32]:
        """Label (N,) of each point."""
        if self.cloud.labels is None:
            raise ValueError("an observation's cloud is labelled")
        return self.cloud.labels

    @property
    def shown(self) -> list[int]:
        """Labels that points carry, each once, in ascending order."""
        last_of_run = np.append(self.labels[1:] != self.labels[:-1], True)[: len(self.labels)]
        labels: list[int] = np.unique(self.labels[last_of_run]).tolist()
        return labels

    @property
    def shown_objects(self) -> list[int]:
        """Labels of the objects among them."""
        return [label for label in self.shown if 0 < label <= MAX_LABEL]

    def relabelled(self, names: dict[int, int]) -> Observation:
        """Return the observation with some labels changed: old → new."""
        names = {old: new for old, new in names.items() if old != new}
        if not names:
            return self
        labels = self.labels.copy()
        for old, new in names.items():
            labels[self.labels == old] = new
        return self.with_labels(labels)

    def with_labels(self, labels: NDArray[np.int32]) -> Observation:
        """Return the observation with other labels (N,)."""
        return replace(self, cloud=replace(self.cloud, labels=labels))

    def footprint(self, surfaces: Sequence[SupportSurface], spacing: float) -> Array:
        """Places (M, 3) of surfaces straight below points of objects, one per square of a spacing [m]."""
        points = self.cloud.points_world[(self.labels > 0) & (self.labels <= MAX_LABEL)]
        below, feet = find_surface_below(surfaces, points), [np.empty((0, 3))]
        for k, surface in enumerate(surfaces):
            own = points[below == k]
            own = own[surface.region.holds(own)]
            feet.append(own - surface.height(own)[:, None] * surface.normal_world)
        places = np.concatenate(feet)
        return places[thin(places, spacing)]

    def moved(self, T: Array) -> Observation:
        """Return the observation moved by a rigid transform (4, 4) of the world."""
        view = None if self.view is None else self.view.with_pose(T @ self.view.pose)
        surfaces = tuple(surface.moved(T) for surface in self.surfaces)
        return replace(self, view=view, cloud=self.cloud.moved(T), surfaces=surfaces)


def observe(
    source: View | Cloud,
    config: Config,
    *,
    segmentation: SegmentationMethod | None,
    known: Sequence[SupportSurface],
    carrying: Set[int] = frozenset(),
    rng: np.random.Generator,
) -> Observation:
    """Find the support surfaces and the segments on them.

    Args:
        source: A view (only the first one may lack a pose: the table then gives it one) or a cloud, z up.
        config: All stages' settings.
        segmentation: `labels` requires labels, `auto` ignores them, None uses them where given.
        known: The support surfaces known so far, the main one first.
        carrying: Numbers of those that carry something.
        rng: Source of the samples.

    Raises:
        InputError: Required labels are missing, or a later view has no pose.
        NoSurfaceError: No support surface is known, and none seen.
        PerceptionError: There are no readings.
    """
    if segmentation == "labels" and source.labels is None:
        raise InputError(source.name, "has no labels", "give masks, or segment with --segmentation auto")
    use_labels = source.labels is not None and segmentation != "auto"
    source = resample(source, config)
    if isinstance(source, View) and source.T_world_camera is None:
        if known:
            raise InputError(source.name, "has no camera pose", "give one; only the first view may lack it")
        source = source.with_pose(level_transform(source, config, rng, use_labels=use_labels))
    if isinstance(source, View) and source.depth.shape[1] < SMALLEST * config.segmentation.stride:
        # Too few samples would leave the network out.
        config = replace(config, segmentation=replace(config.segmentation, stride=1))
    whole = source
    if use_labels and isinstance(source, View):
        source = _with_whole_masks(source, 2.0 * config.segmentation.edge_jump)
    cloud, pixels = _points(source, config, known)
    given = np.take(source.labels, pixels) if use_labels and source.labels is not None else None
    pose = source.T_world_camera if isinstance(source, View) else None
    if pose is None and (eye := cloud.viewpoint_world) is not None:
        # A single sensor looks at the middle of what it sees.
        pose = transforms.look_at(eye, eye + transforms.unit(cloud.points_world - eye).mean(axis=0))
    notes, surfaces = tuple[str, ...](), tuple[SupportSurface, ...]()
    if given is not None:
        given, notes, surfaces = _without_others(whole, cloud, given, known, UP, config, rng, pose)
    try:
        surfaces = surfaces or find_surfaces(cloud, given, known, UP, config, rng, pose)
    except NoSurfaceError as error:
        causes = name_causes(whole, config.surface.max_tilt) if isinstance(whole, View) else []
        tilted = f" or, if that plane is the table, {' or '.join(causes)}" if causes else ""
        raise NoSurfaceError(f"{error}{tilted}") from None
    if isinstance(source, View):
        # A level face no larger than an object and closed below is the top of an object.
        surfaces = tuple(
            surface
            for k, surface in enumerate(surfaces)
            if k < max(len(known), 1)
            or surface.shape.extents.max() > config.fit.max_extent
            or surface.is_open_below(source, [s for s in surfaces if s is not surface], config.surface)
        )
        surfaces = tuple(s.continued(source, config.surface) for s in surfaces)
    apart = np.empty((0, 2), dtype=np.int32)
    if given is not None:
        labels = given
    elif isinstance(source, View):
        image, apart = segment_view(source, surfaces, config, rng, carrying)
        labels = image.ravel()[pixels]
        apart = apart[np.isin(apart, labels).all(axis=1)]
    else:
        labels = segment_cloud(cloud, surfaces[0], config.segmentation)
    if not known:
        # The camera looks at what carries something, and past it at what does not.
        below = find_surface_below(surfaces, cloud.points_world[labels > 0])
        held = np.bincount(below, minlength=len(surfaces))
        main = 0 if held[0] else int(np.argmax(held))
        surfaces = (surfaces[main], *surfaces[:main], *surfaces[main + 1 :])
    reach = config.surface.tolerance
    for k, surface in enumerate(surfaces):
        on_surface = (labels == 0) & surface.over(cloud.points_world, -reach, reach, reach)
        labels = np.where(on_surface, np.int32(SUPPORT_LABEL - k), labels)
    view = source if isinstance(source, View) else None
    cloud = replace(cloud, labels=labels)
    if view is not None and view.rgb is not None:
        objects = pixels[(labels > 0) & (labels <= MAX_LABEL)]
        cloud = replace(cloud, rgb=_correct_colours(view, objects, config.cloud)[pixels])
    return Observation(view, cloud, pixels, surfaces, apart, notes)


def segment_view(
    view: View,
    surfaces: Sequence[SupportSurface],
    config: Config,
    rng: np.random.Generator,
    carrying: Set[int] = frozenset(),
) -> tuple[Labels, Pairs]:
    """Cut a view into the segments on all surfaces; the result is that of `segment`.

    Args:
        view: The view, which has a pose.
        surfaces: The support surfaces, the main one first.
        config: All settings.
        rng: Draws the samples of fits.
        carrying: Numbers of surfaces that carry something in earlier views.
    """
    foregrounds = find_foreground(view, surfaces, config, carrying)
    image, pairs = np.zeros(view.depth.shape, dtype=np.int32), [np.empty((0, 2), dtype=np.int32)]
    for k, (surface, own) in enumerate(zip(surfaces, foregrounds, strict=True)):
        others = [f for n, f in enumerate(foregrounds) if n != k]
        elsewhere = np.logical_or.reduce(others) if others else np.zeros_like(own)
        part, apart = segment(
            view, surface, own, elsewhere, config.segmentation, config.cloud, config.fit, rng
        )
        rows = np.flatnonzero(part)
        row, column = np.divmod(rows, part.shape[1])
        rays = np.stack([column, row, np.ones(len(rows))], axis=-1) @ np.linalg.inv(view.K).T
        points = transforms.transform(view.pose, view.depth.ravel()[rows, None] * rays)
        names = np.arange(part.max(initial=0))
        furniture = find_furniture(
            points, part.ravel()[rows] - 1, np.full(len(names), k), surfaces, config, names < 0
        )
        part = np.where(np.append(False, furniture)[part], 0, part)
        number = image.max()
        image = np.where((part > 0) & (image == 0), part + number, image)
        pairs.append(apart + number)
    return image, np.concatenate(pairs).astype(np.int32)


def _with_whole_masks(view: View, jump: float) -> View:
    """Remove from the masks of a view their crumbs of other objects, beyond a jump of 1/z [1/m].

    Masks drawn or learned are a few pixels too wide, and pixels at depth edges mix both sides.
    """
    if view.labels is None:
        return view
    labels = np.where(view.valid, view.labels, np.int32(0))
    inverse_depth = np.divide(1.0, view.depth, out=np.zeros(view.depth.shape), where=view.valid)
    shown = np.flatnonzero(labels > 0)
    owner = labels.ravel()[shown]
    body = find_bodies(labels, inverse_depth, jump).ravel()[shown]
    sizes = np.bincount(body, minlength=1)
    largest = np.zeros(int(labels.max()) + 1)
    first = np.flatnonzero(sizes)
    np.maximum.at(largest, labels.ravel()[first], sizes[first])
    whole = np.zeros(labels.size, dtype=labels.dtype)
    whole[shown] = np.where(sizes[body] >= WHOLE * largest[owner], owner, 0)
    return replace(view, labels=whole.reshape(labels.shape))


def label_image(observation: Observation, source: View | Cloud) -> NDArray[np.int32]:
    """Labels of all pixels (H, W) of a view, or of all points (N,) of a cloud."""
    used = observation.view or source
    image = np.zeros(used.depth.shape if isinstance(used, View) else len(used), dtype=np.int32)
    image.ravel()[observation.pixels] = observation.labels
    if isinstance(used, View) and isinstance(source, View) and image.shape != source.depth.shape:
        step = round(source.K[0, 0] / used.K[0, 0])
        row, column = (np.arange(n) // step for n in source.depth.shape)
        image = image[row[:, None], column]
    return image


def resample(source: View | Cloud, config: Config) -> View | Cloud:
    """Return a view with averaged pixels, so that samples are `cloud.voxel` apart at its working distance.

    Windows, segments and the network then see the sizes that they were made for, from near and from far.
    """
    if isinstance(source, Cloud) or (distance := working_distance(source, config.cloud)) == 0.0:
        return source
    spacing = config.segmentation.stride * distance / source.K[0, 0]
    step = max(1, min(int(config.cloud.voxel / spacing), *source.depth.shape))
    return average_pixels(source, step, config.cloud)


def _points(
    source: View | Cloud, config: Config, known: Sequence[SupportSurface] = ()
) -> tuple[Cloud, NDArray[np.intp]]:
    """Oriented points of a view, and their pixels; for a cloud, all its points."""
    if isinstance(source, Cloud):
        if len(source) == 0:
            raise PerceptionError(f"{source.name}: has no points")
        return source, np.arange(len(source), dtype=np.intp)
    points, normals, pixels = oriented_points(source, config.cloud)
    if len(points) == 0:
        raise PerceptionError(f"{source.name}: {_why_nothing(source, config.cloud)}")
    rgb = None if source.rgb is None else np.take(source.rgb.reshape(-1, 3), pixels, axis=0)
    eye = None if source.T_world_camera is None else source.T_world_camera[:3, 3]
    return Cloud(points, normals, None, rgb, eye, source.name), pixels


def _correct_colours(view: View, objects: NDArray[np.intp], config: CloudConfig) -> NDArray[np.uint8]:
    """Give the fringe of each object, where it has the colour of what lies behind, that of its inside.

    Where stereo matches windows, and where colour and depth are not exactly aligned, an object seems to go on
    beyond its outline.

    Args:
        view: The view, which has colours.
        objects: Flat indices (N,) of the pixels that show objects.
        config: Limits of one surface.

    Returns:
        Colours (H · W, 3).
    """
    assert view.rgb is not None
    colours = view.rgb.reshape(-1, 3)
    limits = np.float32(config.edge_jump), np.float32(slope_limit(view.K[0, 0], config))
    steps = _steps(FRINGE)
    steps = steps[np.abs(steps).max(axis=1) == FRINGE]  # Next to an edge, pixels mix both sides.
    inside, behind = np.full((2, *view.depth.shape), -1)
    for_each(_find_nearest, SHARES, (view.depth, *limits, objects, steps, view.valid, 1.0, np.inf, behind))
    fringe = objects[behind.flat[objects] >= 0]
    body_mask = np.zeros(view.depth.shape, dtype=np.bool_)
    body_mask.flat[objects] = behind.flat[objects] < 0
    steps = _steps(2 * FRINGE)
    for_each(_find_nearest, SHARES, (view.depth, *limits, fringe, steps, body_mask, -1.0, 1.0, inside))
    fringe = fringe[inside.flat[fringe] >= 0]
    places = fringe, behind.flat[fringe], inside.flat[fringe]
    own, background, body = (colour_shares(colours[place]) for place in places)
    to_background, to_body = (np.linalg.norm(own - other, axis=1) for other in (background, body))
    wrong = fringe[to_background < np.minimum(to_body, 2.0 * PLAIN)]
    corrected = colours.copy()
    corrected[wrong] = colours[inside.flat[wrong]]
    return corrected


def _steps(reach: int) -> NDArray[np.intp]:
    """Steps (N, 2) of up to this many rows and columns, the shortest first."""
    steps = np.argwhere(np.ones((2 * reach + 1, 2 * reach + 1))) - reach
    return steps[np.argsort((steps**2).sum(axis=1), kind="stable")][1:]


@kernel
def _find_nearest(share, data):  # type: ignore[no-untyped-def]
    """Write, for every 16th of some pixels, the nearest pixel (H, W) of a mask that lies so far behind it.

    The least and the most are in limits of one surface [1].
    """
    depth, jump, slope, pixels, steps, mask, least, most, found = data
    height, width = depth.shape
    for i in range(share, len(pixels), SHARES):
        row, column = pixels[i] // width, pixels[i] % width
        for k in range(len(steps)):
            v, u = row + steps[k, 0], column + steps[k, 1]
            if v < 0 or v >= height or u < 0 or u >= width or not mask[v, u]:
                continue
            limit = jump + slope * np.float32(max(abs(steps[k, 0]), abs(steps[k, 1])))
            drop = np.float32(1.0) / depth[row, column] - np.float32(1.0) / depth[v, u]
            if least * limit < drop <= most * limit:
                found[row, column] = v * width + u
                break


def _why_nothing(view: View, config: CloudConfig) -> str:
    """Say why a view holds no oriented points, and what may help."""
    readings, near, far = view.depth[view.valid], config.min_depth, config.max_depth
    if len(readings) == 0:
        return "has no depth readings; omit it"
    if ((readings >= near) & (readings <= far)).any():
        why = "neighbouring pixels are too few, or differ too much in depth"
        return f"shows no surface: {why}; give a larger or less noisy image"
    ends = dict.fromkeys(
        f"{end:.0f}" if end >= 100.0 else f"{end:.3g}" for end in (readings.min(), readings.max())
    )
    remedy = "check the unit of depth, or set cloud.min_depth and cloud.max_depth"
    where = f"{'–'.join(ends)} m, none within {near:g}–{far:g} m{describe_unit(readings)}"
    return f"all depth readings are at {where}; {remedy}"


def level_transform(
    source: View | Cloud, config: Config, rng: np.random.Generator, *, use_labels: bool = False
) -> Array:
    """`T_world_source` (4, 4) by the support plane, for a view without a pose or a raw cloud.

    Args:
        source: The view or cloud.
        config: How points and planes are found.
        rng: Draws the hypotheses.
        use_labels: Leave out points of labelled objects.

    Raises:
        NoSurfaceError: There is no support surface.
        PerceptionError: There are no readings.
    """
    source = resample(source, config)
    cloud, pixels = _points(source, config)
    pose = np.eye(4)  # the source is in the frame of its camera
    given = np.take(source.labels, pixels) if use_labels and source.labels is not None else None
    if given is not None:
        given, *_ = _without_others(source, cloud, given, (), None, config, rng, pose)
    surface = find_surfaces(cloud, given, (), None, config, rng, pose)[0]
    return transforms.level_world(surface.normal_world, surface.point_world)


def _without_others(
    source: View | Cloud,
    cloud: Cloud,
    given: NDArray[np.int32],
    known: Sequence[SupportSurface],
    up: Array | None,
    config: Config,
    rng: np.random.Generator,
    T_world_camera: Array | None,
) -> tuple[NDArray[np.int32], tuple[str, ...], tuple[SupportSurface, ...]]:
    """Remove labels of no objects, as segmenters of whole images give them: of surfaces, and void.

    In a first view, a label is a surface's if no other points show one, or only a floor far below; or if it
    is larger than objects are.

    Returns:
        Labels (N,), what is to be said about them, and the surfaces of a first view if they were found with
        these labels.
    """
    surfaces, shown, found = list(known), False, tuple[SupportSurface, ...]()
    apart = copy.deepcopy(rng)  # The same view without that label gives the same scene.
    if not known:
        with suppress(NoSurfaceError):
            found = find_surfaces(cloud, given, (), up, config, apart, T_world_camera)
            heights = found[0].height(cloud.points_world[given > 0])
            high = int(np.count_nonzero(heights > config.segmentation.max_height))
            shown = high < config.surface.min_points
        with suppress(NoSurfaceError):
            surfaces = list(find_surfaces(cloud, None, (), up, config, apart, T_world_camera))
    reach, others = config.surface.tolerance, dict[int, str]()
    for k, surface in enumerate(surfaces):
        if not known and (k or shown) and surface.shape.extents.max() <= config.fit.max_extent:
            continue
        on_surface = surface.over(cloud.points_world, -reach, reach, 0.0)
        covered = np.bincount(given[on_surface], minlength=1)
        label = int(np.argmax(covered))
        whole = covered[label] > ALONE * np.count_nonzero(given == label)
        if label and whole and covered[label] >= ALONE * np.count_nonzero(on_surface):
            what = "a support surface" if k else "the table"
            others[label] = f"label {label} is {what}, which it covers, and no object"
    assert source.labels is not None
    if is_void(source, np.where(np.isin(source.labels, [*others.keys() - {VOID}]), 0, source.labels)):
        others[VOID] = f"label {VOID} is void, around the others, and no object"
    if not others:
        return given, (), found
    return np.where(np.isin(given, [*others]), np.int32(0), given), tuple(others.values()), ()


def find_surfaces(
    cloud: Cloud,
    given: NDArray[np.int32] | None,
    known: Sequence[SupportSurface],
    up: Array | None,
    config: Config,
    rng: np.random.Generator,
    T_world_camera: Array | None,
) -> tuple[SupportSurface, ...]:
    """Find the support surfaces in points without a labelled object, as `find_support_surfaces` does.

    Args:
        cloud: The points, with normals.
        given: Labels (N,) of the points, 0 = no object; None if there are none.
        known: The surfaces known so far, the main one first.
        up: Upward direction (3,), or None if the camera's pose is unknown.
        config: All stages' settings.
        rng: Draws the hypotheses.
        T_world_camera: Reported camera pose (4, 4) in the frame of the points, or None.

    Raises:
        NoSurfaceError: No surface is known, and none is seen.
    """
    loose = np.ones(len(cloud), dtype=bool) if given is None else given == 0
    if not known and not loose.any():
        raise NoSurfaceError(
            f"{cloud.name}: every point has the label of an object, and none is left for the table; give the "
            "table label 0 (for a cloud, try --label-divisor), or use --segmentation auto"
        )
    # Spread evenly, 20,000 points give its height to 0.1 mm.
    index = np.flatnonzero(loose)
    some = cloud.select(index[:: max(1, len(index) // 20_000)])
    points, normals = some.points_world, some.normals_world
    objects = cloud.points_world[~loose][:: max(1, len(index) // 20_000)]
    try:
        return tuple(
            find_support_surfaces(
                points, normals, up, config.surface, rng,
                known=known, objects=objects, T_world_camera=T_world_camera,
            )
        )  # fmt: skip
    except NoSurfaceError as error:
        raise NoSurfaceError(f"{cloud.name}: {error}") from None
