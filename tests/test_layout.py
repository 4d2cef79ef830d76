"""Scenes in the style of other projects: where they start, what is an object, and what is held still."""

from __future__ import annotations

import logging

import mujoco
import numpy as np
import pytest
from conftest import SMALL, SMALL_SENSOR, run_command

from caryatid.errors import InputError
from caryatid.geometry.transforms import look_at
from caryatid.simulation import SimulatedCamera, ground_truth, load_scene, static_boxes
from caryatid.steps import read_run

FLOOR = '<geom name="floor" type="plane" size="5 5 0.1"/>'
TABLE = '<body name="table" pos="0 0 0.4"><geom type="box" size="0.3 0.45 0.02"/></body>'
SLIDES = "".join(f'<joint type="slide" axis="{axis}" damping="1"/>' for axis in ("1 0 0", "0 1 0", "0 0 1"))
BALL = '<joint type="ball"/>'
HINGES = SLIDES.replace("slide", "hinge")


def cube(name: str, pos: str, joints: str = "<freejoint/>") -> str:
    return f'<body name="{name}" pos="{pos}">{joints}<geom type="box" size="0.03 0.03 0.03"/></body>'


def arm(prefix: str, pos: str, tool: str = "") -> str:
    """An arm of two links that lies along −x if both its joints are at 0, and its tool."""
    link = '<geom type="capsule" fromto="0 0 0 -0.3 0 0" size="0.02"/>'
    return (
        f'<body name="{prefix}base" pos="{pos}"><geom type="cylinder" size="0.05 0.05" pos="0 0 -0.05"/>'
        f'<body name="{prefix}upper"><joint name="{prefix}j0" axis="0 1 0"/>{link}'
        f'<body name="{prefix}lower" pos="-0.3 0 0"><joint name="{prefix}j1" axis="0 1 0"/>{link}{tool}'
        "</body></body></body>"
    )


def motors(*joints: str) -> str:
    return f"<actuator>{''.join(f'<position joint={joint!r}/>' for joint in joints)}</actuator>"


def fingers(prefix: str) -> str:
    """Two fingers at the end of a link, with a slide each."""
    slide = '<joint name="{0}" type="slide" axis="0 {1} 0" range="0 0.04"/>'
    pad = '<geom type="box" size="0.02 0.005 0.01" pos="-0.32 {0} 0"/>'
    return "".join(
        f'<body name="{prefix}{side}">{slide.format(prefix + side, sign)}{pad.format(0.01 * sign)}</body>'
        for side, sign in (("left", 1), ("right", -1))
    )


MENAGERIE = (
    f"<worldbody>{FLOOR}{arm('', '0.55 0 0.6', fingers('finger_'))}{TABLE}"
    f"{cube('red', '0 0 2')}{cube('blue', '0 0 1')}</worldbody>"
    '<tendon><fixed name="grip"><joint joint="finger_left" coef="0.5"/>'
    '<joint joint="finger_right" coef="0.5"/></fixed></tendon>'
    '<equality><joint joint1="finger_left" joint2="finger_right"/></equality>'
    '<actuator><position joint="j0" kp="5"/><position joint="j1" kp="5"/><position tendon="grip"/></actuator>'
    '<sensor><jointpos joint="j0"/></sensor>'
    '<keyframe><key name="home" qpos="1.57 -1 0.04 0.04 0 0 0.45 1 0 0 0 0 0 0.51 1 0 0 0"/>'
    '<key name="spread" qpos="1.57 -1 0.04 0.04 0 0.2 0.45 1 0 0 0 0 -0.2 0.45 1 0 0 0"/></keyframe>'
)
ROBOSUITE = (
    f"<worldbody>{FLOOR}"
    '<body name="main_table" pos="0 0 0.8">'
    '<geom name="main_table_collision" type="box" size="0.4 0.4 0.025"/>'
    '<geom name="main_table_visual" type="box" size="0.4 0.4 0.025" contype="0" conaffinity="0" group="1"/>'
    "</body>"
    f"{arm('robot0_', '-0.6 0 0.9').replace('-0.3', '0.15')}"
    '<body name="cube_main" pos="0 0 0.86"><joint name="cube_joint0" type="free" damping="0.0005"/>'
    '<geom name="cube_g0" type="box" size="0.02 0.02 0.02" rgba="0.5 0 0 0"/>'
    '<geom name="cube_g0_vis" type="box" size="0.02 0.02 0.02" contype="0" conaffinity="0" group="1"/></body>'
    f"</worldbody>{motors('robot0_j0', 'robot0_j1')}"
)
DRAWER = (
    '<joint name="drawer{0}" type="slide" axis="-1 0 0" range="0 0.1"/><geom type="box" size="0.1 0.1 0.01"/>'
)
LIBERO = (
    f"<worldbody>{FLOOR}{TABLE.replace('table', 'living_room_table')}"
    '<body name="cabinet_1_main" pos="0.1 0.2 0.52"><geom type="box" size="0.1 0.1 0.1"/>'
    f'<body name="cabinet_1_top" pos="0 0 0.05">{DRAWER.format(0)}</body>'
    f'<body name="cabinet_1_bottom" pos="0 0 -0.05">{DRAWER.format(1)}</body></body>'
    f"{cube('bowl_1_main', '0.1 0.2 0.65')}{cube('plate_1_main', '0 -0.2 0.45')}"
    f"{cube('soup_1_main', '0 0 0.45')}</worldbody>"
)
PYMJCF = (
    '<compiler angle="degree"/><worldbody><geom name="//unnamed_geom_0" type="plane" size="5 5 0.1"/>'
    '<frame pos="0 0 0.4" euler="0 0 90"><body name="table/">'
    '<geom name="table/top" type="box" size="0.4 0.3 0.02"/>'
    '</body></frame><frame pos="0 0 0.45" euler="0 0 30"><body name="duplo/"><freejoint name="duplo/"/>'
    '<geom type="box" size="0.03 0.03 0.03"/></body></frame>'
    '<body pos="0 0 0.505"><freejoint/><geom type="sphere" size="0.025"/></body>'
    f"{arm('jaco_arm/', '0.8 0 0.5')}</worldbody>{motors('jaco_arm/j0', 'jaco_arm/j1')}"
)
INSERTION = '<site name="insertion" pos="-0.2 0 0.02"/>'
MYOSUITE = (
    f"<worldbody>{FLOOR}{TABLE}<site name='origin' pos='0.6 0 0.8'/>"
    f"{arm('myo_', '0.6 0 0.6', INSERTION)}"
    f"{cube('Object', '0 0 0.6', SLIDES + HINGES)}</worldbody>"
    '<tendon><spatial name="biceps"><site site="origin"/><site site="insertion"/></spatial></tendon>'
    '<actuator><muscle tendon="biceps"/></actuator>'
    '<keyframe><key name="up" qpos="1 0 0 0 0 0 0 0"/>'
    '<key name="low" qpos="1 0 0.1 0.2 -0.15 0 0 1"/></keyframe>'
)
ADROIT = (
    f"<worldbody>{FLOOR}{TABLE}"
    f'<body name="forearm" pos="0.2 0 0.7">{SLIDES}{HINGES.replace("joint ", "joint name=x ", 1)}'
    '<geom type="capsule" fromto="0 0 0 0.2 0 0" size="0.03"/></body>'
    '<body name="nail_board" pos="0 0.2 0.45"><joint type="slide" axis="0 0 1"/>'
    '<geom type="cylinder" size="0.01 0.03"/></body>'
    f"{cube('Object', '0 -0.1 0.45', SLIDES + BALL)}</worldbody>"
    '<actuator><motor joint="x"/></actuator>'
).replace("name=x", 'name="x"')
FETCH = (
    f'<worldbody>{FLOOR}<body pos="0 0 0.2"><geom type="box" size="0.3 0.4 0.2"/></body>'
    '<body name="robot0:mocap" mocap="true" pos="-0.3 0 0.7"/>'
    f"{arm('robot0:', '0.4 0 0.7')}{cube('object0', '0 0.1 0.43')}</worldbody>"
    '<equality><weld body1="robot0:mocap" body2="robot0:lower"/></equality>'
)
ROVER = (
    f"<worldbody>{FLOOR}{TABLE}{cube('parcel', '0 0 0.45')}"
    '<body name="chassis" pos="0.8 0 0.1"><freejoint/><geom type="box" size="0.2 0.15 0.04" mass="20"/>'
    + "".join(
        f'<body name="wheel{k}" pos="0 {y} -0.05"><joint name="w{k}" axis="0 1 0"/>'
        '<geom type="cylinder" size="0.05 0.02" euler="90 0 0"/></body>'
        for k, y in enumerate((-0.2, 0.2))
    )
    + '</body></worldbody><actuator><velocity joint="w0"/><velocity joint="w1"/></actuator>'
)
DRONE = (
    f"<worldbody>{FLOOR}{TABLE}{cube('parcel', '0 0 0.45')}"
    '<body name="drone" pos="0 0 1"><freejoint/><geom type="box" size="0.1 0.1 0.02"/><site name="thrust"/>'
    '</body></worldbody><actuator><motor site="thrust" gear="0 0 1 0 0 0"/></actuator>'
)
HAND = (
    f"<worldbody>{FLOOR}{TABLE}{cube('object', '0 0 0.45')}"
    '<body name="target" pos="0 0.2 0.6"><freejoint/>'
    '<geom type="box" size="0.03 0.03 0.03" contype="0" conaffinity="0"/></body>'
    f"<body name='room'>{cube('painting', '1 1 1', SLIDES + HINGES)}</body></worldbody>"
)
NEEDS = "an object has a free joint, or three slides and three hinges, no other joints, and no body around it"

SCENES = {
    "menagerie": (
        MENAGERIE,
        {("table", "red"), ("red", "blue")},
        ["starts from its keyframe 'home'", "robot 'base' (4 joints) is held still and is no object"],
    ),
    "robosuite": (ROBOSUITE, {("main_table", "cube_main")}, ["robot 'robot0_base' (2 joints) is held still"]),
    "libero": (
        LIBERO,
        {("living_room_table", "plate_1_main"), ("living_room_table", "soup_1_main")}
        | {("cabinet_1_main", "bowl_1_main")},
        [
            "body 'cabinet_1_top' (1 joint) and body 'cabinet_1_bottom' (1 joint) are held still and are no "
            f"objects: {NEEDS}"
        ],
    ),
    "pymjcf": (
        PYMJCF,
        {("table/", "duplo/"), ("duplo/", "body 3")},
        ["robot 'jaco_arm/base' (2 joints) is held still"],
    ),
    "myosuite": (
        MYOSUITE,
        {("table", "Object")},
        [
            "starts from none of its keyframes up, low; --keyframe chooses",
            "body 'Object' is free: a free joint replaces its slides and hinges",
            "robot 'myo_base' (2 joints)",
        ],
    ),
    "adroit": (
        ADROIT,
        {("table", "Object")},
        [
            "body 'Object' is free: a free joint replaces its slides and hinges",
            "robot 'forearm' (6 joints) and body 'nail_board' (1 joint) are held still and are no objects: "
            f"{NEEDS}",
        ],
    ),
    "fetch": (
        FETCH,
        {("geom 1", "object0")},
        ["body 'robot0:base' (2 joints) is held still and is no object"],
    ),
    "rover": (ROVER, {("table", "parcel")}, ["robot 'chassis' (3 joints) is held still"]),
    "drone": (DRONE, {("table", "parcel")}, ["robot 'drone' (1 joint) is held still"]),
    "hand": (
        HAND,
        {("table", "object")},
        [
            "body 'target' (touches nothing) and body 'room' (6 joints) are held still and are no objects: "
            f"{NEEDS}"
        ],
    ),
}
"""Scene → its MJCF, what supports what in it, and what is said about it."""


@pytest.fixture
def write(tmp_path):
    def written(text: str):
        (tmp_path / "table.xml").write_text(f"<mujoco>{text}</mujoco>", encoding="utf-8")
        return tmp_path / "table.xml"

    return written


@pytest.mark.parametrize("style", SCENES)
def test_a_scene_in_the_style_of_another_project(write, caplog, style):
    text, pairs, said = SCENES[style]
    caplog.set_level(logging.INFO)
    scene = load_scene(write(text))
    assert ground_truth(scene).pairs == pairs
    assert (scene.model.jnt_type == mujoco.mjtJoint.mjJNT_FREE).all()
    lines = [line.partition("table.xml: ")[2] for line in caplog.messages]
    assert len(lines) == len(said)
    assert all(line.startswith(start) for line, start in zip(lines, said, strict=True))


@pytest.mark.parametrize(
    ("text", "keyframe", "number"),
    [
        (MENAGERIE, None, 0),
        (MENAGERIE, "spread", 1),
        (MENAGERIE, "1", 1),
        (MYOSUITE, None, None),
        (MYOSUITE, "low", 1),
    ],
)
def test_everything_starts_where_the_keyframe_has_it(write, text, keyframe, number):
    path = write(text)
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    if number is not None:
        mujoco.mj_resetDataKeyframe(model, data, number)
    mujoco.mj_kinematics(model, data)
    laid_out = load_scene(path, keyframe=keyframe).model
    start = mujoco.MjData(laid_out)
    mujoco.mj_kinematics(laid_out, start)
    np.testing.assert_allclose(start.geom_xpos, data.geom_xpos, atol=1e-12)
    np.testing.assert_allclose(start.geom_xmat, data.geom_xmat, atol=1e-12)


@pytest.mark.parametrize(
    ("source", "keyframe", "says"),
    [
        (MENAGERIE, "stack", "has no keyframe 'stack'; its keyframes: home, spread"),
        (MENAGERIE, "2", "has no keyframe '2'"),
        (HAND, "0", "it has none: omit --keyframe"),
        ("tower", "home", "tower: has no keyframe 'home'; it has none: omit --keyframe"),
    ],
)
def test_a_keyframe_that_is_not_there(write, source, keyframe, says):
    with pytest.raises(InputError, match=says):
        load_scene(source if source == "tower" else write(source), keyframe=keyframe)


def test_a_recording_has_no_keyframe(refused, recording):
    refused("explore", recording, "--keyframe", "home", says="--keyframe is for scenes")


def test_a_body_too_heavy_for_a_table_is_pointed_out(write, caplog):
    caplog.set_level(logging.INFO)
    crate = cube("crate", "1 0 0.2").replace("0.03 0.03 0.03", "0.2 0.2 0.2")
    load_scene(write(f"<worldbody>{FLOOR}{TABLE}{cube('cup', '0 0 0.45')}{crate}</worldbody>"))
    assert [line.partition(": ")[2] for line in caplog.messages] == [
        "crate (64 kg) counts as an object; if it is none, remove its joint"
    ]


def test_a_geom_that_is_no_solid_is_named(write):
    hill = '<asset><hfield name="hill" nrow="3" ncol="3" size="0.1 0.1 0.1 0.1"/></asset>'
    body = cube("ground", "0 0 0.5").replace('type="box"', 'name="soil" type="hfield" hfield="hill"')
    body = body.replace("</body>", '<geom type="box" size="0.1 0.1 0.1"/></body>')
    with pytest.raises(InputError, match=r"table\.xml: geom 'soil' of body 'ground' is of the type hfield"):
        load_scene(write(f"{hill}<worldbody>{FLOOR}{TABLE}{body}</worldbody>"))


def test_a_robot_is_an_obstacle_and_hides_what_is_behind_it(write):
    scene = load_scene(write(DRONE))
    drone = scene.data.body("drone").xpos
    view = SimulatedCamera(scene, sensor=SMALL_SENSOR).capture(look_at(drone + (-0.8, 0.1, 0.4), drone))
    seen = np.zeros(view.depth.shape, dtype=bool)
    seen[55:65, 70:90] = True
    assert view.ignored[seen].all()
    assert not view.depth[seen].any()
    assert any(np.allclose(box.T_world_object[:3, 3], drone) for box in static_boxes(scene))


def test_explore_and_evaluate_start_from_the_same_keyframe(write, tmp_path, capsys):
    run, options = tmp_path / "run", ("--no-report", "--noise", "none", "--views", "2", *SMALL)
    assert (
        run_command(
            "explore",
            write(MENAGERIE.replace('"base"', '"robot"')),
            "--keyframe",
            "spread",
            *options,
            "--out",
            run,
        )
        == 0
    )
    assert "robot 'robot' (4 joints) is held still and is no object" in capsys.readouterr().err
    assert {s.pair for s in read_run(run).graph.supports} == {("o0", "o1"), ("o0", "o2")}
    assert run_command("evaluate", run, "--json") == 0
    assert '"f1": 1.0' in capsys.readouterr().out
