"""A robot with its own software asks a service for the next best view; here, the robot is simulated."""

import json
import subprocess
import sys
from itertools import takewhile
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

import caryatid as ct
from caryatid.simulation import load_scene
from caryatid.simulation.setup import Simulation, make_simulation

sys.path.append(str(Path(sys.argv[0]).parent))
from robot_client import RobotClient, png16


def image(values: NDArray[Any]) -> bytes:
    """Encode an image as a 16-bit PNG."""
    return png16(values.shape[1], values.shape[0], values.astype(">u2").tobytes())


def main() -> None:
    """Start a service, and drive the robot to the views it asks for."""
    stage = make_simulation(load_scene("tower"), ct.Config(), noise="carmine", seed=0)
    with TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "caryatid", "serve", folder, "--port", "0", "--json"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as service:
            try:
                printed = "".join(takewhile(lambda line: line != "}\n", service.stdout or ()))
                assert printed, "the service ended; see its error above"
                graph = drive(RobotClient(json.loads(printed + "}")["address"]), stage)
            finally:
                service.terminate()
    print(*(f"{s['supporter']} supports {s['supported']} ({s['kind']})" for s in graph["supports"]), sep="\n")
    assert len(graph["supports"]) >= 3
    assert service.returncode == 0


def drive(robot: RobotClient, stage: Simulation) -> dict[str, Any]:
    """Look, send the view, ask for the next one, and go there."""
    robot.begin("table", segmentation="labels")
    while True:
        view = stage.camera.capture(stage.robot.T_world_camera)
        depth, labels = image(1e3 * view.depth), image(np.asarray(view.labels))
        added = robot.add("table", depth, view.K.tolist(), view.pose.tolist(), labels=labels)
        following = robot.next("table")
        print(f"{len(added['graph']['objects']) - 1} objects; {following['stop'] or following['why']}")
        if following["stop"]:
            return dict(added["graph"])
        stage.robot.move_to(np.array(following["T_world_camera"]))


if __name__ == "__main__":
    main()
