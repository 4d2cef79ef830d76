"""Messages of other packages on real ROS 2: MoveIt's planning scene, and vision_msgs."""

from __future__ import annotations

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from conftest import wait_for
from moveit_msgs.msg import PlanningScene
from planner import Planner
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Image
from vision_msgs.msg import (
    BoundingBox3D,
    Detection3D,
    Detection3DArray,
    ObjectHypothesis,
    ObjectHypothesisWithPose,
)

from caryatid.benchmark.episodes import open_scene
from caryatid_ros.messages import make_message, pose_message

GRIPPER = {"planning_scene": "/planning_scene", "gripper_links": "hand finger"}


@pytest.fixture
def planner(client):
    """A planner."""
    found = Planner(client)
    yield found
    client.run(found.destroy)


def test_moveit_knows_what_is_there_what_may_touch_and_what_is_held(start_ready, client, planner):
    start_ready(**GRIPPER)
    _, result = client.explore(max_views=1).result()
    wait_for(lambda: planner.scenes == 1)
    objects = {o.id: o for o in result.graph.objects}
    assert planner.world.keys() == objects.keys()
    for name, item in planner.world.items():
        assert item.pose == objects[name].pose
        assert item.header.frame_id == "map"
        if objects[name].shape == "box":
            e = objects[name].extents
            assert list(item.primitives[0].dimensions) == [e.x, e.y, e.z]
    supports = {frozenset((s.supporter, s.supported)) for s in result.graph.supports}
    assert planner.touching == supports | {frozenset(("hand", "finger"))}

    top, next_ = [step.object for step in client.call("order").lifts][:2]
    assert client.call("removed", object=top).success
    wait_for(lambda: planner.scenes == 2)
    assert planner.world.keys() == objects.keys() - {top}
    assert planner.held.keys() == {top}
    assert planner.held[top].link_name == "hand"
    assert planner.held[top].touch_links == ["hand", "finger"]
    assert client.call("removed", object=next_).success
    wait_for(lambda: planner.scenes == 3)
    assert planner.world.keys() == objects.keys() - {top, next_}
    assert planner.held.keys() == {next_}

    client.explore(max_views=1, restart=True).result()
    wait_for(lambda: planner.scenes == 4)
    assert planner.world.keys() == {o.id for o in client.graphs[-1].objects}
    assert not planner.held


def test_unseen_space_is_an_obstacle_for_the_gripper_only(start_ready, client, planner):
    start_ready(**GRIPPER, unseen_space=True)
    _, result = client.explore(max_views=1).result()
    wait_for(lambda: planner.scenes == 1)
    assert planner.world.keys() == {o.id for o in result.graph.objects} | {"unseen"}
    assert len(planner.world["unseen"].primitives) > 10
    assert {b for pair in planner.touching if "unseen" in pair for b in pair} == planner.world.keys()


def test_without_moveit_the_scene_is_published_all_the_same(start_ready, client):
    scenes = []
    topic = client.create_subscription(PlanningScene, "/elsewhere", scenes.append, 10)
    start_ready(planning_scene="/elsewhere")
    client.explore(max_views=1).result()
    wait_for(lambda: scenes)
    client.destroy_subscription(topic)
    assert not scenes[0].allowed_collision_matrix.entry_names
    assert len(scenes[0].world.collision_objects) == len(client.graphs[-1].objects)


@pytest.fixture
def boxes(client):
    """Boxes around the objects of the tower, published with the stamp of each depth image."""
    objects = open_scene("tower")[1].objects
    detections = []
    for name, shape in objects.items():
        pose = pose_message(make_message, shape.T_world_object)
        box = BoundingBox3D(center=pose)
        box.size.x, box.size.y, box.size.z = map(float, shape.extents)
        result = ObjectHypothesisWithPose(hypothesis=ObjectHypothesis(class_id=name, score=0.9))
        detections.append(Detection3D(results=[result], bbox=box))
    publisher = client.create_publisher(Detection3DArray, "/boxes", 10)

    def answer(image) -> None:
        message = Detection3DArray(header=image.header, detections=detections)
        message.header.frame_id = "map"
        publisher.publish(message)

    listener = client.create_subscription(Image, "/camera/depth", answer, qos_profile_sensor_data)
    yield objects
    client.destroy_subscription(listener)
    client.destroy_publisher(publisher)


def test_boxes_with_names_go_in_and_detections_with_names_come_out(start_ready, client, boxes):
    start_ready(masks="boxes:/boxes")
    status, result = client.explore(max_views=2).result()
    assert (status, result.views) == (GoalStatus.STATUS_SUCCEEDED, 2), result.message
    found = {o.id: o for o in result.graph.objects if o.role == "object"}
    assert sorted(o.name for o in found.values()) == sorted(boxes)
    detections = wait_for(lambda: client.detections)[-1]
    assert {d.id for d in detections.detections} == found.keys()
    for d in detections.detections:
        o = found[d.id]
        assert (d.bbox.center, d.bbox.size) == (o.pose, o.extents)
        assert (d.results[0].hypothesis.class_id, d.results[0].hypothesis.score) == (o.name, o.probability)
        true = boxes[o.name].T_world_object[:3, 3]
        assert np.allclose([o.pose.position.x, o.pose.position.y, o.pose.position.z], true, atol=0.01)


def test_label_images_are_masks(start_ready, client):
    client.set_table(topics=["depth", "colour", "info", "tf", "labels"])
    start_ready(masks="labels:/camera/labels")
    status, result = client.explore(max_views=1).result()
    assert status == GoalStatus.STATUS_SUCCEEDED
    assert len(result.graph.objects) == 1 + len(open_scene("tower")[1].objects)


def test_missing_masks_are_named(start_ready, client):
    start_ready(masks="labels:/nowhere", image_timeout=3.0)
    assert "/nowhere: no message arrived" in client.explore(max_views=1).result()[1].message
