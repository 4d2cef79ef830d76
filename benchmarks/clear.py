"""Clear tables by alternately looking and taking; measure the harm done and the views needed.

    python benchmarks/clear.py [SCENES…] --hands 1
    python benchmarks/clear.py dense-10-301 --goals 2

Each scene is cleared in a physics simulation: the true objects are lifted, and disturbed objects are counted.
A scene is unharmed if no lift moves another object by more than 2 cm or 15°. It is cleared if no object is
left. With `--goals`, the task is to reach randomly drawn objects instead; a breadth-first search on the true
scene, among the objects that are in the way, finds the fewest lifts.

    python benchmarks/clear.py --set gripper.kind=parallel

    python benchmarks/clear.py overhang-6-0 overhang-8-1 --order 5 --hands 2

With `--order`, an order is planned after some views and carried out without looking again, as far as it is
safe.

With a gripper, a simulated one first performs each lift: a free-flying hand moves along the approach among
the true objects, closes its fingers with 30 N, and lifts the object by friction. A grasp is clear if it
touches only its object; it holds if the object rises with it.
"""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import takewhile
from typing import Annotated, Literal

import mujoco
import numpy as np
import pandas as pd
import tyro
from measures import OnScenes, Row, run_main

from caryatid.benchmark.episodes import open_scene
from caryatid.benchmark.suites import DENSE, HEAPED
from caryatid.config import Config, GripperConfig
from caryatid.config.settings import read_settings
from caryatid.geometry.transforms import Array, invert
from caryatid.graph import Grasp, TakeStep
from caryatid.manipulation.clearing import SimulatedHands, Taken, clear
from caryatid.manipulation.grasps import gripper_boxes, turn_of
from caryatid.manipulation.order import plan_order
from caryatid.simulation.lifting import ASIDE, Lifting
from caryatid.simulation.world import SimulatedScene, poses_of, quaternion


@dataclass(frozen=True)
class Clear(OnScenes):
    """Clear scenes in a physics simulation."""

    scenes: Annotated[tuple[str, ...], tyro.conf.Positional] = (*HEAPED, *DENSE)
    """Names of built-in scenes, or scene folders."""
    hands: Literal[1, 2] = 1
    """Number of hands."""
    goals: int = 0
    """Number of objects to reach in each scene, one by one; 0 clears the whole scene."""
    order: int = 0
    """Number of views after which a whole order is planned and carried out; 0 looks again after each lift."""

    def measure(self, name: str) -> list[Row]:
        """Clear one scene, or reach each goal in it; return one row per run."""
        scene, _ = open_scene(name)
        labels = self.drawn(name, list(scene.object_bodies), self.goals) if self.goals else [None]
        rows = [self.cleared(name, scene, label) for label in labels]
        print(*rows, sep="\n", file=sys.stderr, flush=True)
        return rows

    def cleared(self, name: str, scene: SimulatedScene, goal: int | None) -> Row:
        """Clear a scene, or reach the body with the goal's label."""
        config, wanted = read_settings(None, self.set), None if goal is None else f"o{goal}"
        camera, explorer = self.start(scene, config)
        hands, done = SimulatedHands(scene, config), list[Taken]()
        grasps, ways = list[tuple[list[str], bool]](), list[float]()

        def take(step: TakeStep) -> bool:
            before, bodies = hands.state, hands.bodies(explorer.scene.graph)
            body = bodies.get(step.object_id)
            if step.grasp is not None and body in hands.left:
                grasps.append(grasped(scene, before, step.grasp, body, config.gripper))
            done.append(hands.take(step, bodies))
            if body in hands.names:
                ways.append(translation([before, *done[-1].film], hands.names.index(body)))
            camera.scene = hands.scene
            return done[-1].body is not None

        if self.order:
            steps = [explorer.look()]
            while len(steps) < self.order and explorer.plan().decision is not None:
                explorer.go()
                steps.append(explorer.look())
            order = plan_order(explorer.scene.graph, config, goal=wanted, hands=self.hands, seed=self.seed)
            for step in takewhile(lambda step: step.safe, order.steps):
                take(step)
        else:
            steps = list(clear(explorer, take, goal=wanted, hands=self.hands))
        lifted = [t for t in done if t.body is not None]
        harm = [f"{t.step.object_id}: {', '.join(t.disturbed)}" for t in lifted if not t.ok]
        row = {"scene": name, "objects": len(scene.object_bodies), "lifts": len(lifted), "views": len(steps)}
        row |= {"missed": len(done) - len(lifted), "harmed": len(harm), "harm": harm}
        row["way"] = sum(ways)
        row |= {"stop": steps[-1].stop, "grasps": len(grasps), "clear": sum(not t for t, _ in grasps)}
        row |= {"held": sum(held for _, held in grasps), "touched": [t for t, _ in grasps if t]}
        if goal is None:
            return row | {"cleared": float(not hands.left)}
        body = scene.object_bodies[goal]
        row |= {"goal": wanted, "cleared": float(any(t.body == body for t in lifted))}
        return row | {"fewest": fewest(scene, body, config)}

    def summary(self, rows: pd.DataFrame) -> dict[str, float]:
        """Return shares of scenes, and figures per lift."""
        unharmed = rows["harmed"] == 0
        found = {"runs": len(rows), "unharmed": unharmed.mean(), "cleared": rows["cleared"].mean()}
        found |= {"both": (unharmed & (rows["cleared"] == 1.0)).mean()}
        found |= {"lifts unharmed": 1.0 - rows["harmed"].sum() / rows["lifts"].sum()}
        found |= {"harmful lifts": rows["harmed"].sum()}
        found |= {"moved per lift, cm": 100.0 * rows["way"].sum() / rows["lifts"].sum()}
        found |= {"views per lift": rows["views"].sum() / rows["lifts"].sum(), "missed": rows["missed"].sum()}
        if rows["grasps"].sum():
            found |= {f"grasps {name}": rows[name].sum() / rows["grasps"].sum() for name in ("clear", "held")}
        if "fewest" in rows:
            known = rows[(rows["cleared"] == 1.0) & (rows["fewest"] > 0)]
            found |= {"a way exists": (rows["fewest"] > 0).mean()}
            found |= {"lifts": known["lifts"].sum(), "fewest": known["fewest"].sum()}
            found |= {"of the fewest": known["lifts"].sum() / max(known["fewest"].sum(), 1)}
        return found

    def remark(self, row: Row) -> str:
        """Say what went wrong in a run."""
        if row["cleared"] and not row["harmed"]:
            return ""
        return f"{row['scene']}: {row['harm']}; {row['stop']}"


def grasped(
    scene: SimulatedScene, state: Array, grasp: Grasp, body: str, gripper: GripperConfig
) -> tuple[list[str], bool]:
    """Simulate a grasp; return the other bodies it touches, and whether it lifts its own."""
    spec, T = scene.spec.copy(), grasp.T_world_gripper @ invert(turn_of(gripper))
    # MuJoCo's documentation recommends elliptic cones with stiff friction for grasps.
    spec.option.timestep, spec.option.cone, spec.option.impratio = 0.002, mujoco.mjtCone.mjCONE_ELLIPTIC, 10.0
    start, R = T[:3, 3] - grasp.travel * T[:3, 2], T[:3, :3]
    spec.worldbody.add_body(name="goal", mocap=True, pos=start, quat=quaternion(R))
    hand = spec.worldbody.add_body(name="gripper", pos=start, quat=quaternion(R), gravcomp=1.0)
    hand.add_freejoint()
    # A mocap body has no velocity. A body welded to one does, so its friction can drag objects.
    weld = spec.add_equality(name1="goal", name2="gripper", type=mujoco.mjtEq.mjEQ_WELD, solref=[0.005, 1.0])
    weld.objtype, weld.data = mujoco.mjtObj.mjOBJ_BODY, [*[0.0] * 6, 1.0, *[0.0] * 3, 1.0, 0.0]
    parts, closing = gripper_boxes(gripper, grasp.width), gripper.kind == "parallel"
    for number, (low, high) in enumerate(parts):
        part = hand
        if number < len(parts) - 1 and closing:
            part = hand.add_body(name=f"finger{number}", gravcomp=1.0)
            inwards = [-1.0, 0.0, 0.0] if number == 0 else [1.0, 0.0, 0.0]
            slide = {"type": mujoco.mjtJoint.mjJNT_SLIDE, "axis": inwards, "range": [0.0, gripper.opening]}
            part.add_joint(name=f"finger{number}", limited=True, damping=50.0, **slide)
            motor = spec.add_actuator(name=f"finger{number}", target=f"finger{number}")
            motor.trntype = mujoco.mjtTrn.mjTRN_JOINT
        shape = {"type": mujoco.mjtGeom.mjGEOM_BOX, "pos": (low + high) / 2.0, "size": (high - low) / 2.0}
        shape |= {"density": 5000.0, "solref": [0.005, 1.0], "friction": [1.0, 0.005, 0.0001], "condim": 4}
        part.add_geom(name=f"gripper{number}", **shape)
    model = spec.compile()
    data = mujoco.MjData(model)
    qpos = {name: model.jnt_qposadr[model.body(name).jntadr[0]] for name in scene.object_bodies.values()}
    for at, pose in zip(qpos.values(), state, strict=True):
        data.qpos[at : at + 7] = pose
    own, root = model.body("gripper").id, model.body_rootid[model.geom_bodyid]
    target, touched = model.body(body).id, set[str]()
    height, reach = data.qpos[qpos[body] + 2], np.inf
    for phase, seconds in (("approach", 1.0), ("close", 0.5), ("lift", 1.0)):
        for step in range(round(seconds / 0.002)):
            share = (step + 1) * 0.002 / seconds
            if phase == "approach":
                data.mocap_pos[0] = start + share * grasp.travel * T[:3, 2]
                if closing:
                    data.ctrl[:] = -2.0
            elif phase == "close":
                data.ctrl[:] = -2.0 + 32.0 * share if closing else 0.0
            else:
                data.mocap_pos[0] = T[:3, 3] + [0.0, 0.0, share * grasp.travel]
            if phase == "lift" and not closing:
                break
            mujoco.mj_step(model, data)
            for a, b in data.contact.geom[: data.ncon]:
                pair = {root[a], root[b]}
                if own in pair and len(pair) == 2 and not (pair & {target}):
                    touched.add(model.body((pair - {own}).pop()).name)
        if phase == "approach" and not closing:
            disc = model.geom("gripper0").id
            solid = np.flatnonzero((root == target) & (model.geom_contype != 0))
            reach = min(mujoco.mj_geomDistance(model, data, disc, int(g), 0.1, None) for g in solid)
    rise = data.qpos[qpos[body] + 2] - height
    return sorted(touched), bool(rise > grasp.travel / 2.0 if closing else reach < 0.005)


def translation(film: Sequence[Array], lifted: int) -> float:
    """Sum of the ways [m] of all objects but the lifted one and those removed before.

    This is the sum of translations of SafePicking (Wada et al., ICRA 2022). The film holds the states (N, 7)
    before and during the lift.
    """
    places = np.array(film)[:, :, :3]
    others = places[0, :, 2] < ASIDE / 2.0
    others[lifted] = False
    return float(np.linalg.norm(np.diff(places[:, others], axis=0), axis=-1).sum())


def fewest(scene: SimulatedScene, goal: str, config: Config) -> int:
    """Return the fewest lifts that reach a body and disturb nothing; 0 if 200 searched states show no way."""
    names = list(scene.object_bodies.values())
    lifting, target = Lifting(scene.spec, names), names.index(goal)
    queue = deque[tuple[tuple[int, ...], Array]]([((), poses_of(scene))])
    reached = set[frozenset[int]]()
    while queue:
        taken, state = queue.popleft()
        wanted = [target]
        for index in wanted:
            lift = lifting.lift(state, index, config.lift)
            if not lift.disturbed.any():
                if index == target:
                    return len(taken) + 1
                following = frozenset((*taken, index))
                if following not in reached and len(reached) < 200:
                    reached.add(following)
                    queue.append(((*taken, index), lift.film[-1]))
            else:
                wanted += [k for k in np.flatnonzero(lift.disturbed).tolist() if k not in wanted]
    return 0


if __name__ == "__main__":
    run_main(Clear)
