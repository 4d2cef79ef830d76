"""The whole loop: a simulated humanoid explores a table until it knows which object supports which."""

import numpy as np

import caryatid as ct
from caryatid.evaluation import score, true_scene_from_simulation
from caryatid.simulation import ground_truth, load_scene
from caryatid.simulation.setup import make_simulation

VIEWS = 3


def main() -> None:
    """Explore, and score every view against what physics says."""
    scene = load_scene("clutter")
    truth = true_scene_from_simulation(scene, ground_truth(scene))
    stage = make_simulation(scene, ct.Config(), noise="carmine", seed=0)

    # `explore` yields after every view; camera and robot could be real ones, or a recording.
    f1 = []
    for step in ct.explore(stage.camera, stage.robot, seed=0):
        f1.append(score(step.graph, truth, np.random.default_rng(0)).f1)
        print(f"view {step.index + 1}: F1 {f1[-1]:.2f} after {step.path_travelled:.1f} m over the floor")
        if step.decision is not None:
            print(f"  next: {step.decision.why}")
        if len(f1) == VIEWS:
            break

    for support in step.graph.supports:
        seen = f"in {support.occurrences} of {support.opportunities} views"
        likely = f"probability {support.belief:.2f}"
        print(f"{support.supporter} supports {support.supported} ({support.kind}, {seen}, {likely})")

    assert f1[-1] > f1[0], "looking around must pay"
    assert f1[-1] > 0.9


if __name__ == "__main__":
    main()
