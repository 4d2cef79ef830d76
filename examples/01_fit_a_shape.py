"""Fit a shape to the points of one object, without knowing whether it is a box, a cylinder or a sphere."""

import numpy as np

import caryatid as ct
from caryatid.fitting.primitives import FitFailure
from caryatid.geometry import transforms

NOISE = 0.001
"""σ of a reading [m]."""


def half_of(shape: ct.Cylinder, eye_world: transforms.Array) -> tuple[transforms.Array, transforms.Array]:
    """Oriented points of the side of a shape that can be seen from a place, with noise."""
    points_world, normals_world = shape.surface(spacing=0.004)
    seen = np.sum((eye_world - points_world) * normals_world, axis=1) > 0.0
    noise = np.random.default_rng(0).normal(scale=NOISE, size=(seen.sum(), 3))
    return points_world[seen] + noise, normals_world[seen]


def main() -> None:
    """Fit half a can and compare it with the whole one."""
    # A can that stands upright on a table 0.7 m high, seen from one side and from above.
    can = ct.Cylinder(transforms.rigid(np.eye(3), (0.1, 0.2, 0.76)), radius=0.035, height=0.12)
    points_world, normals_world = half_of(can, eye_world=np.array([-1.0, 0.0, 1.6]))

    fit = ct.fit(points_world, normals_world, config=ct.Config().fit, rng=np.random.default_rng(0))
    assert not isinstance(fit, FitFailure), fit.reason

    print(f"{len(points_world)} points of one side, {1000 * NOISE:.0f} mm noise")
    print(f"best shape: {fit.shape.kind}, {1000 * fit.residual:.1f} mm from the points on average")
    for name, value in zip(("width", "depth", "height"), fit.shape.extents, strict=True):
        print(f"  {name:<6} {1000 * value:6.1f} mm")

    # What is known about the can holds for the fit, although its back was never seen.
    assert isinstance(fit.shape, ct.Cylinder)
    assert abs(fit.shape.radius - can.radius) < 0.002
    assert abs(fit.shape.height - can.height) < 0.003
    tilt = np.degrees(np.arccos(abs(fit.shape.T_world_object[2, 2])))
    assert tilt < 2.0
    print(f"ground truth: radius {1000 * can.radius:.0f} mm, height {1000 * can.height:.0f} mm, upright")


if __name__ == "__main__":
    main()
