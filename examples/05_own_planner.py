"""A planner of your own: any object with `plan(state, rng) -> Decision`.

To use it on the command line as `--planner opposite`, provide it as an entry point of a package:

    [project.entry-points."caryatid.planners"]
    opposite = "my_package:OppositePlanner"

`planner_package/`, beside this file, is such a package.
"""

import numpy as np

import caryatid as ct
from caryatid.geometry import transforms
from caryatid.planning.decision import Decision, PlanningState, check_candidates, path_cost
from caryatid.simulation import load_scene
from caryatid.simulation.setup import make_simulation


class OppositePlanner:
    """Goes where it is farthest from every view so far."""

    def plan(self, state: PlanningState, rng: np.random.Generator) -> Decision:
        """Take the candidate whose nearest earlier view is farthest away."""
        check_candidates(state)
        angle = transforms.angle_between(state.candidates.directions[:, None], state.visited[None]).min(
            axis=1
        )
        best = int(np.argmax(angle))
        cost = path_cost(state)[best]
        return Decision(
            T_world_camera=state.candidates.T_world_camera[best],
            index=best,
            saliency=float(angle[best]),
            cost=float(cost),
            score=float(angle[best] - cost),
            why=f"{np.degrees(angle[best]):.0f}° from the nearest earlier view",
        )


def main() -> None:
    """Let it look behind a box, beside the planner that comes with caryatid."""
    for planner in (OppositePlanner(), "support"):
        stage = make_simulation(load_scene("hidden_stack"), ct.Config(), noise="none", seed=0)
        name = planner if isinstance(planner, str) else type(planner).__name__
        print(name)
        for step in ct.explore(stage.camera, stage.robot, planner=planner, early_stop=False):
            print(f"  view {step.index + 1}: {len(step.graph.movable)} objects", end="")
            print(f", next {step.decision.why}" if step.decision else "")
            if step.index == 1:
                break
        # Behind the big box stand a stack of three and a ball: five objects in all.
        assert len(step.graph.movable) == 5
        assert np.degrees(step.angle_travelled) > 60.0


if __name__ == "__main__":
    main()
