"""Which frames become views: sharp ones, apart from each other, no more than wanted."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter

from caryatid.config import RecordingConfig
from caryatid.geometry import transforms
from caryatid.io.importing import apart, choose_views, sharpness_of_colour

CONFIG = RecordingConfig()


def along_a_line(positions):
    return np.stack([transforms.rigid(np.eye(3), (x, 0.0, 0.0)) for x in positions])


def test_a_camera_at_rest_gives_one_view_the_sharpest():
    times = np.arange(10) / 30.0
    sharpness = np.full(10, 1.0)
    sharpness[6] = 1.2
    choice = choose_views(times, sharpness, along_a_line(np.zeros(10)), CONFIG)
    assert (choice.kept, choice.alike) == ((6,), 9)


def test_blurred_frames_are_left_out_and_sharp_ones_beside_them_taken():
    times = np.arange(40) * 0.1
    sharpness = np.where(np.arange(40) % 3 == 0, 10.0, 5.0)
    choice = choose_views(times, sharpness, along_a_line(times), CONFIG)
    assert len(choice.kept) > 8
    assert all(k % 3 == 0 for k in choice.kept)
    assert choice.blurred == 26


def test_a_dull_part_of_a_recording_is_not_taken_for_a_blurred_one():
    times = np.arange(20) * 1.0
    sharpness = np.where(np.arange(20) < 10, 100.0, 1.0)
    choice = choose_views(times, sharpness, along_a_line(times), CONFIG)
    assert choice.kept == tuple(range(20))


def test_a_turn_without_a_step_is_another_view_and_coming_back_is_not():
    turns = np.radians([0.0, 4.0, 12.0, 4.0, 0.0])
    poses = np.stack(
        [transforms.rigid(transforms.rotation_from_vector((0.0, a, 0.0)), np.zeros(3)) for a in turns]
    )
    choice = choose_views(np.arange(5) * 1.0, np.ones(5), poses, CONFIG)
    assert choice.kept == (0, 2)


def test_of_too_many_those_farthest_apart_stay():
    positions = np.concatenate([np.linspace(0.0, 2.0, 11), [10.0, 20.0]])
    config = RecordingConfig(max_views=3)
    choice = choose_views(np.arange(13) * 1.0, np.ones(13), along_a_line(positions), config)
    assert (choice.kept, choice.spare) == ((0, 11, 12), 10)


def test_without_poses_the_sharpest_frame_is_taken_alone():
    choice = choose_views(np.arange(5) * 1.0, np.array([1.0, 2.0, 9.0, 3.0, 9.0]), None, CONFIG)
    assert (choice.kept, choice.spare) == ((2,), 4)


@given(st.integers(0, 2**32 - 1), st.integers(0, 60), st.integers(1, 12))
@settings(max_examples=50, deadline=None)
def test_views_are_few_apart_and_every_frame_is_accounted_for(seed, count, most):
    rng = np.random.default_rng(seed)
    times = np.sort(rng.uniform(0.0, 10.0, count))
    walk = np.cumsum(rng.normal(0.0, 0.05, (count, 3)), axis=0)
    poses = np.array([transforms.rigid(transforms.random_rotation(rng), p) for p in walk]).reshape(-1, 4, 4)
    if seed % 2:
        poses[:, :3, :3] = np.eye(3)
    config = RecordingConfig(max_views=most)
    choice = choose_views(times, rng.uniform(0.5, 1.0, count), poses, config)
    assert len(choice.kept) + choice.blurred + choice.alike + choice.spare == count
    assert (count == 0) == (len(choice.kept) == 0)
    assert len(choice.kept) <= most
    assert list(choice.kept) == sorted(set(choice.kept))
    for k in choice.kept:
        others = [j for j in choice.kept if j != k]
        assert (apart(poses[others], poses[k], config) > 1.0).all()


def test_a_blurred_image_is_less_sharp_and_a_grey_wall_is_not_sharp_at_all():
    rng = np.random.default_rng(0)
    image = rng.integers(0, 256, (60, 80, 3), dtype=np.uint8)
    blurred = gaussian_filter(image, (1.5, 1.5, 0)).astype(np.uint8)
    assert sharpness_of_colour(blurred) < 0.2 * sharpness_of_colour(image)
    assert sharpness_of_colour(np.full((60, 80, 3), 128, dtype=np.uint8)) == 0.0
