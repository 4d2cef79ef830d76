"""The client of MoveIt, `examples/franka_moveit.py`, on real ROS 2 with a stand-in for MoveIt."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import HERE, Process, wait_for
from planner import Arm
from scipy.spatial.transform import Rotation

from caryatid.benchmark.episodes import open_scene
from caryatid.config import GRIPPERS, Config
from caryatid.geometry.transforms import invert, rigid
from caryatid.simulation.setup import make_simulation

EXAMPLE = HERE.parents[1] / "examples/franka_moveit.py"
T_MAP_BASE = rigid(Rotation.from_euler("z", 0.5).as_matrix(), (-0.6, 0.1, 0.0))
T_HAND_CAMERA = rigid(Rotation.from_euler("zyx", (0.8, 0.1, -0.2)).as_matrix(), (0.05, -0.03, 0.02))
T_HAND_TCP = rigid(np.eye(3), (0.0, 0.0, 0.1034))


@pytest.fixture
def arm(client):
    """An arm that holds the camera of the table where it is first."""
    scene, _ = open_scene("tower")
    first = make_simulation(scene, Config(), noise="none", seed=0).robot.T_world_camera
    T_base_hand = invert(T_MAP_BASE) @ first @ invert(T_HAND_CAMERA)
    found = Arm(client, T_MAP_BASE, T_base_hand, T_HAND_CAMERA)
    client.set_table(carried=True, frame="camera_color_optical_frame", follow=False)
    yield found
    client.run(found.destroy)


def test_the_client_looks_through_moveit_and_lifts_an_object(start_ready, client, arm):
    start_ready(world_frame="panda_link0", planning_scene="/planning_scene")
    arm.refused = 0, 2  # the first view, and the first grasp, which is then turned by 180°
    lifting = Process(EXAMPLE, max_views=2)
    wait_for(lambda: lifting.process.poll() is not None, 120.0, "the end of the client")
    assert lifting.process.returncode == 0, lifting.text

    assert "asks for another view: MoveIt answers NO_IK_SOLUTION" in lifting.text
    assert "2 views: maximum of 2 views reached" in lifting.text
    steps = ["move", "grip", "move", "line", "grip", "attach", "line", "move", "grip", "detach"]
    assert [what for what, _ in arm.done] == steps
    _, opened, before, at, closed, name, above, dropped, _, _ = (where for _, where in arm.done)
    before, at, above, dropped = (T @ T_HAND_TCP for T in (before, at, above, dropped))
    travel = GRIPPERS["franka"].travel
    assert np.allclose(invert(at) @ before, rigid(np.eye(3), (0.0, 0.0, -travel)), atol=1e-6)
    assert np.allclose(above @ invert(at), rigid(np.eye(3), (0.0, 0.0, travel)), atol=1e-6)
    assert np.allclose(dropped[:3, 2], (0.0, 0.0, -1.0), atol=1e-6)
    p = next(o for graph in client.graphs for o in graph.objects if o.id == name).pose.position
    assert np.linalg.norm((invert(at) @ (p.x, p.y, p.z, 1.0))[:2]) < 0.01, "it is not between the fingers"
    assert opened == 0.039
    assert abs(2.0 * closed - 0.06) < 0.005  # its diameter

    wait_for(lambda: name not in arm.world, what="that MoveIt forgets the object")
    assert not arm.held
    assert frozenset(("o0", "panda_link0")) in arm.touching
    assert name not in {o.id for o in client.graphs[-1].objects}


def test_what_is_missing_is_one_sentence(client, arm):
    lifting = Process(EXAMPLE, camera_frame="nowhere")
    assert lifting.process.wait(60.0) == 1
    wait_for(lambda: "error: tf has no panda_hand ← nowhere; publish the hand-eye" in lifting.text)
    assert "Traceback" not in lifting.text
