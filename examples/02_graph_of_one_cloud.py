"""Infer the support graph from one cloud of labelled points."""

import numpy as np

import caryatid as ct
from caryatid.geometry import transforms

UP = np.array([0.0, 0.0, 1.0])


def upright(x: float, y: float, z: float) -> transforms.Array:
    """Pose of something that stands upright with its centre at (x, y, z) [m]."""
    return transforms.rigid(np.eye(3), (x, y, z))


def main() -> None:
    """Make a cloud of four objects whose supports are known, and find them again."""
    # A plank on two pillars, with a ball on top; z = 0 is the table.
    shapes: list[ct.Box | ct.Cylinder | ct.Sphere] = [
        ct.Cylinder(upright(0.0, -0.12, 0.06), radius=0.035, height=0.12),
        ct.Box(upright(0.0, 0.12, 0.06), extents=np.array([0.06, 0.07, 0.12])),
        ct.Box(upright(0.0, 0.0, 0.13), extents=np.array([0.1, 0.34, 0.02])),
        ct.Sphere(upright(0.0, 0.02, 0.18), radius=0.04),
    ]
    truth = {("o0", "o1"), ("o0", "o2"), ("o1", "o3"), ("o2", "o3"), ("o3", "o4")}

    # Points all over them, as many views together would give, and the table around them.
    surfaces = [shape.surface(spacing=0.005) for shape in shapes]
    x, y = np.meshgrid(np.arange(-0.4, 0.4, 0.01), np.arange(-0.4, 0.4, 0.01))
    table = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    cloud = ct.Cloud(
        points_world=np.concatenate([table, *(points for points, _ in surfaces)]),
        normals_world=np.concatenate([np.tile(UP, (len(table), 1)), *(normals for _, normals in surfaces)]),
        labels=np.repeat(np.arange(5, dtype=np.int32), [len(table), *(len(p) for p, _ in surfaces)]),
    )

    scene = ct.Scene()
    graph = scene.update(cloud)

    print(f"{len(cloud)} points, {len(graph.movable)} objects on the table (o0)")
    for support in graph.supports:
        print(f"  {support.supporter} supports {support.supported}: {support.why}")
    assert {support.pair for support in graph.supports} == truth

    # The same as a networkx graph: what falls if the first pillar is removed?
    assert sorted(scene.supports.successors("o1")) == ["o3"]
    print("removing o1 would disturb", ", ".join(sorted(scene.supports.successors("o1"))))


if __name__ == "__main__":
    main()
