"""What someone does first: a scene, a first look without labels, a second one, and where to look next.

    python benchmarks/performance/first_view.py

It prints the seconds from the start of Python's main module on.
"""

from __future__ import annotations

import time

STARTED = time.perf_counter()


def look() -> None:
    """Explore the scene of `caryatid demo` for two views, with all that a turn compiles."""
    import caryatid as ct
    from caryatid.simulation import load_scene
    from caryatid.simulation.setup import make_simulation

    for segmentation in ("auto", "labels"):
        stage = make_simulation(load_scene("clutter"), ct.Config(), noise="carmine", seed=0)
        scene = ct.Scene(segmentation="auto" if segmentation == "auto" else "labels")
        for _ in range(2):
            scene.update(stage.camera.capture(stage.robot.T_world_camera))
            stage.robot.move_to(ct.next_best_view(scene, stage.robot).T_world_camera)


if __name__ == "__main__":
    look()
    print(time.perf_counter() - STARTED)
