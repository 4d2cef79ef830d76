"""Insides of hollow objects: convexity cuts them to pieces, and off the outside they belong to."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from caryatid.geometry import transforms
from caryatid.geometry.polygons import hull
from caryatid.geometry.transforms import Array
from caryatid.segmentation.lccp import Index, hollowness
from caryatid.segmentation.samples import Labels, Samples

Mask = NDArray[np.bool_]

MEETING = 5
"""Rows and columns of samples on which two parts must meet to be one [1]; 3 cm at 1.5 m."""
HOLLOW = 0.2
"""Mean cosine at which an inside faces its middle [1]: 0.6 in a bowl, 0.05 on flat faces with noise."""
RIM = 0.015
"""Heights within which two parts end at one rim [m]: its width, and noise at depth edges."""
RIM_WIDTH = 0.01
"""Width of a rim, on which samples fail or are mixed with what is behind it [m]."""
ALONG = 0.35
"""Share of the hull of an inside along which its outside is seen [1]; from the side, that of half of it."""


def merge_insides(samples: Samples, part: Labels, floor: Mask, floor_size: float) -> tuple[Labels, Index]:
    """Make one part of each hollow object.

    Pieces that end at one rim, face each other and meet, or are parted by something nearer alone, are one
    inside if they face inwards together. Parts within its hull in the image belong to it too, unless they
    face outwards or stand out as contents do. The outside lies along the hull and does not rise above the
    rim.

    An inside with most of the support surface in its hull is the walls of a bin, and left out.

    Args:
        samples: The samples.
        part: Part (N,) of each, 0 = none.
        floor: Which places (H, W) show the support surface.
        floor_size: How many places of the whole view do.

    Returns:
        Part (N,) of each sample, and at places (H, W) within the hull of an inside one of its samples, −1
        elsewhere.
    """
    merged, within = part.copy(), np.full(samples.places.shape, -1)
    if not merged.any():
        return merged, within
    reach = max(2, round(RIM_WIDTH * samples.K[0, 0] / float(np.median(samples.points_camera[:, 2]))))
    top = _tops(samples, merged)
    alike, into = np.abs(top - top[:, None]) < RIM, np.arange(len(top))
    image, spots = samples.image(merged), np.argwhere(samples.places)
    order = np.argsort(merged, kind="stable")
    rows = np.split(order, np.cumsum(np.bincount(merged))[:-1])
    for first, second in np.argwhere(np.triu(alike & _facing(samples, part), 1)):
        a, b = into[first], into[second]
        if a == b:
            continue
        both = np.concatenate([rows[a], rows[b]])
        points, normals = samples.points_camera[both], samples.normals_camera[both]
        if hollowness(points, normals, np.zeros(len(both), dtype=np.intp))[0] <= HOLLOW:
            continue
        middles = np.stack([samples.points_camera[rows[k]].mean(axis=0) for k in (a, b)])
        if _meet(image, spots[rows[a]], a, b, reach) or _parted(samples, image, middles, a, b):
            merged[both], into[into == b], rows[a] = a, a, both
            image[tuple(spots[rows[b]].T)] = a
    look, top = hollowness(samples.points_camera, samples.normals_camera, merged), _tops(samples, merged)
    look[0] = 0.0
    for number in np.flatnonzero(look > HOLLOW).tolist():
        own = merged == number
        if not own.any() or np.ptp(np.quantile(samples.height[own], (0.05, 0.95))) < RIM:
            continue
        image = samples.image(merged)
        inner = _hull_of(image == number)
        if np.count_nonzero(inner & floor) > 0.5 * floor_size:
            merged[own] = 0
            continue
        sizes = np.bincount(merged, minlength=len(look))
        held = np.bincount(image[inner], minlength=len(look)) >= 0.8 * np.maximum(sizes, 1)
        for other in np.flatnonzero(held & (np.arange(len(look)) != number)).tolist():
            held[other] = look[other] > -HOLLOW and not _stands_out(image == other, samples)
        possible = ~held & (top < top[number] + RIM) & (look <= HOLLOW)
        held[_outside(inner, image, possible, reach)] = True
        held[0] = False
        merged[held[merged]] = number
        within[inner | ndimage.binary_fill_holes(samples.image(merged) == number)] = np.argmax(own)
    return merged, within


def _tops(samples: Samples, part: Labels) -> Array:
    """Height (P,) [m] up to which parts 0 … P − 1 reach; there is no part 0."""
    tops = np.full(int(part.max()) + 1, np.nan)
    for number in np.unique(part[part > 0]).tolist():
        tops[number] = np.quantile(samples.height[part == number], 0.95)
    return tops


def _facing(samples: Samples, part: Labels) -> Mask:
    """Which of parts 0 … P − 1 of samples (N,) face each other (P, P), by their middles and mean normals."""
    sizes = np.maximum(np.bincount(part), 1)[:, None]
    points, normals = (
        np.stack([np.bincount(part, x) for x in of.T], axis=-1) / sizes
        for of in (samples.points_camera, samples.normals_camera)
    )
    faces = np.einsum("ijk,ik->ij", transforms.unit(points - points[:, None]), normals) > HOLLOW
    return np.asarray(faces & faces.T)


def _parted(samples: Samples, image: Labels, ends: Array, first: int, second: int) -> bool:
    """Whether nothing but what is nearer lies between two parts of an image (H, W), with middles (2, 3)."""
    pixels = (ends @ samples.K.T)[:, :2] / ends[:, 2:]
    steps = np.linspace(0.0, 1.0, 2 + int(np.abs(np.diff(pixels, axis=0)).max()))[:, None]
    column, row = np.rint(pixels[0] + steps * (pixels[1] - pixels[0])).astype(np.intp).T
    inverse_depth = (1.0 - steps[:, 0]) / ends[0, 2] + steps[:, 0] / ends[1, 2]
    between = image[row, column]
    own = (between == first) | (between == second)
    return bool((own | (samples.depth[row, column] * inverse_depth < 1.0)).all())


def _meet(image: Labels, spots: NDArray[np.intp], first: int, second: int, reach: int) -> bool:
    """Whether two parts of an image (H, W) lie within a reach of each other; the first is at spots (N, 2)."""
    (top, left), (bottom, right) = np.maximum(spots.min(axis=0) - reach, 0), spots.max(axis=0) + reach + 1
    image = image[top:bottom, left:right]
    if not (image == second).any():
        return False
    around = ndimage.binary_dilation(image == first, np.ones((3, 3)), iterations=reach)
    return int(np.count_nonzero(image[around] == second)) >= MEETING * reach


def _box(own: Mask) -> tuple[slice, ...]:
    """Rows and columns of the pixels set in an image (H, W)."""
    return tuple(ndimage.find_objects(own.astype(np.intp))[0])


def _outside(inner: Mask, image: Labels, possible: Mask, reach: int) -> int:
    """The possible part that lies along most of the contour of an inside, if along enough; 0 = none."""
    rows, columns = (slice(max(0, own.start - 2 * reach), own.stop + 2 * reach) for own in _box(inner))
    inner, image = inner[rows, columns], image[rows, columns]
    contour = inner & ~ndimage.binary_erosion(inner)
    best, most = 0, float(ALONG * np.count_nonzero(contour))
    for number in np.unique(image[possible[image]]):
        near = ndimage.binary_dilation(image == number, np.ones((3, 3)), iterations=2 * reach)
        if (along := np.count_nonzero(near & contour)) >= most:
            best, most = int(number), float(along)
    return best


def _stands_out(own: Mask, samples: Samples) -> bool:
    """Whether what is around a part of an image (H, W) mostly lies behind it by more than a rim's height."""
    rows, columns = (slice(max(0, side.start - 3), side.stop + 3) for side in _box(own))
    own, depth = own[rows, columns], samples.depth[rows, columns]
    near = ndimage.distance_transform_edt(~own, return_indices=True)
    ring = (near[0] > 0.0) & (near[0] <= 3.0) & (depth > 0.0)
    behind = depth[ring] - depth[tuple(near[1][:, ring])]
    return bool(np.median(behind) > RIM) if ring.any() else False


def _hull_of(own: Mask) -> Mask:
    """The convex hull of places in an image (H, W)."""
    corners = hull(np.argwhere(own).astype(np.float64, order="C"))
    row, column = np.ogrid[: own.shape[0], : own.shape[1]]
    inside = np.ones(own.shape, dtype=np.bool_)
    for (y, x), (down, right) in zip(corners, np.roll(corners, -1, axis=0) - corners, strict=True):
        inside &= down * (column - x) - right * (row - y) >= 0.0
    return inside
