"""Views reported a little off are laid onto each other; what they do not share stays as reported."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from synthetic import TABLE_TOP, box, cylinder, direction, sphere, surface_points

from caryatid.config import RegistrationConfig
from caryatid.geometry import transforms
from caryatid.geometry.transforms import Array
from caryatid.sensing.registration import ViewRegistration, twist_transform
from caryatid.sensing.views import SUPPORT_LABEL, Cloud

CONFIG = RegistrationConfig()
PIVOT = np.array([0.0, 0.0, TABLE_TOP])
TABLE = box((0.0, 0.0, TABLE_TOP - 0.02), (0.7, 1.0, 0.04))
SCENE = (
    box((0.0, 0.0, TABLE_TOP + 0.05), (0.12, 0.09, 0.1), turn_deg=20.0),
    box((-0.12, 0.15, TABLE_TOP + 0.03), (0.06, 0.14, 0.06), turn_deg=-35.0),
    cylinder((0.1, -0.2, TABLE_TOP + 0.06), 0.04, 0.12),
    sphere((0.15, 0.15, TABLE_TOP + 0.04), 0.04),
)


def seen_from(azimuth_deg: float, shapes=SCENE, *, sigma=1e-3, seed=0) -> Cloud:
    """What a camera 1.5 m away sees of shapes and table, each reading with its own noise."""
    eye = PIVOT + 1.5 * direction(np.radians(azimuth_deg), np.radians(38.0))
    rng = np.random.default_rng(seed)
    points, normals, labels = [], [], []
    for label, shape in [*enumerate(shapes, start=1), (SUPPORT_LABEL, TABLE)]:
        spacing = 0.006 if label == SUPPORT_LABEL else 0.003
        p, n = surface_points(shape, rng, spacing=spacing, sigma=sigma, eye=eye)
        facing_up = (label != SUPPORT_LABEL) | (n[:, 2] > 0.9)
        points.append(p[facing_up])
        normals.append(n[facing_up])
        labels.append(np.full(facing_up.sum(), label, dtype=np.int32))
    return Cloud(np.concatenate(points), np.concatenate(normals), np.concatenate(labels), viewpoint_world=eye)


def registered(clouds, config=CONFIG, *, same_labels=True) -> ViewRegistration:
    registration = ViewRegistration(PIVOT, config)
    for cloud in clouds:
        registration.add(cloud, same_labels=same_labels)
    return registration


def motion(translation_mm=(0.0, 0.0, 0.0), rotation_deg=(0.0, 0.0, 0.0)) -> Array:
    twist = np.concatenate([np.array(translation_mm) / 1000.0, np.radians(rotation_deg)])
    return twist_transform(twist, PIVOT)


def drawn_error(rng, sigma_mm=10.0, sigma_deg=1.0) -> Array:
    """A random error of the size that robots with worn joints report; 1.5 m make 26 mm of a degree."""
    return motion(sigma_mm * rng.normal(size=3), sigma_deg / np.sqrt(3.0) * rng.normal(size=3))


def left(registration: ViewRegistration, view: int, error: Array) -> float:
    """How far a point 20 cm from the pivot is from where it belongs, at the worst [m]."""
    corners = PIVOT + 0.2 * np.array([(1, 0, 0), (0, 1, 0), (0, 0, 1), (-1, 0, 0), (0, -1, 0)])
    T = twist_transform(registration.twists[view], PIVOT) @ error
    return float(np.linalg.norm(transforms.transform(T, corners) - corners, axis=1).max())


LARGE = motion(translation_mm=(30.0, -25.0, 20.0), rotation_deg=(1.5, -1.5, 2.0))


@pytest.mark.parametrize("error", [*(drawn_error(np.random.default_rng(k)) for k in range(3)), LARGE])
@pytest.mark.parametrize("same_labels", [True, False])
def test_errors_of_centimetres_and_degrees_are_undone(error, same_labels):
    views = [seen_from(180.0, seed=1), seen_from(120.0, seed=2).moved(error)]
    result = registered(views, same_labels=same_labels)
    assert left(result, 0, error) > 0.005
    assert left(result, 1, error) < 0.002
    assert result.outcomes[1] == "aligned"


def test_what_lies_elsewhere_or_is_next_to_nothing_stays_as_reported():
    first, other = seen_from(180.0, seed=1), seen_from(120.0, seed=2)
    nothing = replace(other, labels=np.zeros_like(other.labels))
    line = other.points_world[0] + np.outer(np.linspace(0.0, 0.1, len(other)), (1.0, 0.0, 0.0))
    elsewhere = other.moved(motion(translation_mm=(0.0, 0.0, 900.0)))
    for second in (other.select(np.arange(60)), nothing, replace(other, points_world=line), elsewhere):
        result = registered([first, second])
        assert result.outcomes[1] == "too few partners"
        np.testing.assert_allclose(result.twists[1], 0.0, atol=1e-12)


def test_a_view_that_is_refused_changes_nothing_for_the_others():
    small, large = motion(translation_mm=(4.0, -3.0, 5.0)), motion(translation_mm=(30.0, -20.0, 12.0))
    views = [seen_from(a, seed=k) for k, a in enumerate((180.0, 140.0, 100.0, 60.0))]
    views = [v.moved(e) for v, e in zip(views, (np.eye(4), small, large, small), strict=True)]
    limited = replace(CONFIG, max_translation=0.03)
    result, without = registered(views, limited), registered([views[0], views[1], views[3]], limited)
    assert result.outcomes[1:] == ["aligned", "beyond the limits", "aligned"]
    np.testing.assert_array_equal(result.twists[2], 0.0)
    for k, alone in ((1, 1), (3, 2)):
        assert left(result, k, small) < 0.002
        assert result.twists[k].tobytes() == without.twists[alone].tobytes()
