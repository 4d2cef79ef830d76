"""From one view or cloud to labelled, oriented points in the world, and the support surface among them."""

from __future__ import annotations

import copy
import logging
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from caryatid.config import CloudConfig, Config, SegmentationMethod
from caryatid.errors import InputError, NoSurfaceError, PerceptionError
from caryatid.geometry import transforms
from caryatid.geometry.transforms import UP, Array
from caryatid.runtime.parallel import kernel
from caryatid.segmentation.segments import segment, segment_cloud
from caryatid.segmentation.support_plane import SupportSurface, find_support_surface
from caryatid.sensing.clouds import oriented_points, thin
from caryatid.sensing.views import MAX_LABEL, SUPPORT_LABEL, Cloud, View

WHOLE = 0.1
"""A piece smaller than this share of a mask's largest body is a crumb [1]; something thin may cut a body."""


ALONE = 0.7
"""Share of the points on the table's plane that a mask of the table has, and share of its points there [1]; a
flat object leaves more of the table to see."""

log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False, slots=True)
class Observation:
    """One view, perceived.

    Attributes:
        view: The view, posed and thinned; None for a cloud.
        cloud: Oriented points in the world frame with labels: 0 nothing, 65535 the support surface.
        pixels: Flat index (N,) of each point in the image, or in the cloud it came from.
        surface: The support surface as this view shows it.
        apart: Pairs (P, 2) of labels, as `observe` gives them, that this view shows to be two bodies.
    """

    view: View | None
    cloud: Cloud
    pixels: NDArray[np.intp]
    surface: SupportSurface
    apart: NDArray[np.int32]

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

    def footprint(self, surface: SupportSurface, spacing: float) -> Array:
        """Places (M, 3) of the surface straight below points of objects, one per square of a spacing [m]."""
        points = self.cloud.points_world[(self.labels != 0) & (self.labels != SUPPORT_LABEL)]
        feet = points - surface.height(points)[:, None] * surface.normal_world
        feet = feet[surface.over(feet, -np.inf, np.inf, 0.0)]
        return feet[thin(feet, spacing)]

    def moved(self, T: Array) -> Observation:
        """Return the observation moved by a rigid transform (4, 4) of the world."""
        view = None if self.view is None else self.view.with_pose(T @ self.view.pose)
        return replace(self, view=view, cloud=self.cloud.moved(T), surface=self.surface.moved(T))


def observe(
    source: View | Cloud,
    config: Config,
    *,
    segmentation: SegmentationMethod | None,
    known: SupportSurface | None,
    rng: np.random.Generator,
) -> Observation:
    """Find the support surface and the segments on it.

    Args:
        source: A view (only the first one may lack a pose: the table then gives it one) or a cloud, z up.
        config: All stages' settings.
        segmentation: `labels` requires labels, `auto` ignores them, None uses them where given.
        known: The known support surface, or None.
        rng: Source of the samples.

    Raises:
        InputError: Required labels are missing, or a later view has no pose.
        NoSurfaceError: No support surface is known, and none seen.
        PerceptionError: There are no readings.
    """
    if segmentation == "labels" and source.labels is None:
        raise InputError(source.name, "has no labels", "give masks, or segment with --segmentation auto")
    use_labels = source.labels is not None and segmentation != "auto"
    source = thinned(source, config.cloud)
    if isinstance(source, View) and source.T_world_camera is None:
        if known is not None:
            raise InputError(source.name, "has no camera pose", "give one; only the first view may lack it")
        source = source.with_pose(level_transform(source, config, rng, use_labels=use_labels))
    if use_labels and isinstance(source, View):
        source = _with_whole_masks(source, 2.0 * config.segmentation.edge_jump)
    cloud, pixels = _points(source, config, known)
    given = np.take(source.labels, pixels) if use_labels and source.labels is not None else None
    pose = source.T_world_camera if isinstance(source, View) else None
    if given is not None:
        given = _without_table(cloud, given, known, UP, config, rng)
    surface = _surface(cloud, given, known, UP, config, rng, pose)
    apart = np.empty((0, 2), dtype=np.int32)
    if given is not None:
        labels = given
    elif isinstance(source, View):
        image, apart = segment(source, surface, config.segmentation, config.cloud, config.fit, rng)
        labels = image.ravel()[pixels]
    else:
        labels = segment_cloud(cloud, surface, config.segmentation)
    reach = config.surface.tolerance
    on_surface = (labels == 0) & surface.over(cloud.points_world, -reach, reach, reach)
    labels = np.where(on_surface, np.int32(SUPPORT_LABEL), labels)
    view = source if isinstance(source, View) else None
    return Observation(view, replace(cloud, labels=labels), pixels, surface, apart)


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
    body = _bodies(labels, inverse_depth, jump).ravel()[shown]
    sizes = np.bincount(body, minlength=1)
    largest = np.zeros(int(labels.max()) + 1)
    first = np.flatnonzero(sizes)
    np.maximum.at(largest, labels.ravel()[first], sizes[first])
    whole = np.zeros(labels.size, dtype=labels.dtype)
    whole[shown] = np.where(sizes[body] >= WHOLE * largest[owner], owner, 0)
    return replace(view, labels=whole.reshape(labels.shape))


@kernel
def _bodies(labels, inverse_depth, jump):  # type: ignore[no-untyped-def]
    """The first pixel (H, W), counted by rows, of the surface of one label (H, W) that each pixel is on.

    Neighbours of one label are on one surface where 1/z (H, W) differs by no more than a jump [1/m].
    """
    height, width = labels.shape
    first = np.arange(height * width)
    for row, column in np.ndindex(height, width):
        if labels[row, column] <= 0:
            continue
        for r, c in ((row - 1, column), (row, column - 1)):
            if r < 0 or c < 0 or labels[r, c] != labels[row, column]:
                continue
            if abs(inverse_depth[r, c] - inverse_depth[row, column]) <= jump:
                one, other = r * width + c, row * width + column
                while first[one] != one:
                    first[one] = first[first[one]]
                    one = first[one]
                while first[other] != other:
                    first[other] = first[first[other]]
                    other = first[other]
                first[max(one, other)] = min(one, other)
    for here in range(height * width):
        first[here] = first[first[here]]
    return first.reshape(height, width)


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


def thinned(source: View | Cloud, config: CloudConfig) -> View | Cloud:
    """Return every n-th pixel of a view whose pixels are denser than needed."""
    step = 1 if isinstance(source, Cloud) else int(config.voxel * source.K[0, 0] / config.max_depth)
    return source.every(step) if isinstance(source, View) and step > 1 else source


def _points(
    source: View | Cloud, config: Config, known: SupportSurface | None = None
) -> tuple[Cloud, NDArray[np.intp]]:
    """Oriented points of a view, and their pixels; for a cloud, all its points.

    Unlabelled points further below the known support surface than its search range are left out.
    """
    if isinstance(source, Cloud):
        if len(source) == 0:
            raise PerceptionError(f"{source.name}: has no points")
        return source, np.arange(len(source), dtype=np.intp)
    among = None
    if known is not None:
        among = known.pixels_over(source, -config.surface.search, np.inf)
        if source.labels is not None:
            among |= source.labels > 0
        among = among if among.any() else None
    points, normals, pixels = oriented_points(source, config.cloud, among=among)
    if len(points) == 0:
        raise PerceptionError(f"{source.name}: {_why_nothing(source, config.cloud)}")
    rgb = None if source.rgb is None else np.take(source.rgb.reshape(-1, 3), pixels, axis=0)
    eye = None if source.T_world_camera is None else source.T_world_camera[:3, 3]
    return Cloud(points, normals, None, rgb, eye, source.name), pixels


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
    return f"all depth readings are at {'–'.join(ends)} m, none within {near:g}–{far:g} m; {remedy}"


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
    source = thinned(source, config.cloud)
    cloud, pixels = _points(source, config)
    given = np.take(source.labels, pixels) if use_labels and source.labels is not None else None
    if given is not None:
        given = _without_table(cloud, given, None, None, config, rng)
    surface = _surface(cloud, given, None, None, config, rng)
    return transforms.level_world(surface.normal_world, surface.point_world)


def _without_table(
    cloud: Cloud,
    given: NDArray[np.int32],
    known: SupportSurface | None,
    up: Array | None,
    config: Config,
    rng: np.random.Generator,
) -> NDArray[np.int32]:
    """Labels (N,) without that of the table, if its points have one, as segmenters of whole images give it.

    In a first view, labels are asked only if no other points show a table, or only a floor a storey lower.
    """
    surface, apart = known, copy.deepcopy(rng)  # The same view without that label gives the same scene.
    if known is None:
        with suppress(NoSurfaceError):
            found = _surface(cloud, given, None, up, config, apart)
            heights = found.height(cloud.points_world[given > 0])
            if np.count_nonzero(heights > config.surface.storey) < config.surface.min_points:
                return given
        with suppress(NoSurfaceError):
            surface = _surface(cloud, None, None, up, config, apart)
    if surface is None:
        return given
    reach = config.surface.tolerance
    on_surface = surface.over(cloud.points_world, -reach, reach, 0.0)
    if not on_surface.any():
        return given
    covered = np.bincount(given[on_surface])
    label = int(np.argmax(covered))
    flat = covered[label] > ALONE * np.count_nonzero(given == label)
    if label == 0 or not flat or covered[label] < ALONE * np.count_nonzero(on_surface):
        return given
    log.warning("%s: label %d covers the table, and is taken for it; give it 0", cloud.name, label)
    return np.where(given == label, np.int32(0), given)


def _surface(
    cloud: Cloud,
    given: NDArray[np.int32] | None,
    known: SupportSurface | None,
    up: Array | None,
    config: Config,
    rng: np.random.Generator,
    T_world_camera: Array | None = None,
) -> SupportSurface:
    """Find the support surface in points without a labelled object: near the known one, or anywhere."""
    loose = np.ones(len(cloud), dtype=bool) if given is None else given == 0
    if known is None and not loose.any():
        raise NoSurfaceError(
            f"{cloud.name}: every point has the label of an object, and none is left for the table; give the "
            "table label 0 (for a cloud, try --label-divisor), or use --segmentation auto"
        )
    if known is not None:
        loose &= np.abs(known.height(cloud.points_world)) < config.surface.search
    # Spread evenly, 20,000 points give its height to 0.1 mm. Once it is known, a quarter is enough: as many
    # of a first view's are the table's, the rest is floor.
    index, (count, planes) = np.flatnonzero(loose), (20_000, 6) if known is None else (5_000, 1)
    some = cloud.select(index[:: max(1, len(index) // count)])
    try:
        return find_support_surface(
            some.points_world,
            some.normals_world,
            up,
            config.surface,
            rng,
            planes,
            T_world_camera=T_world_camera,
        )
    except NoSurfaceError as error:
        if known is not None:
            return known
        raise NoSurfaceError(f"{cloud.name}: {error}") from None
