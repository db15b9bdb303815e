"""Frames of the links against an independent reader of the URDF; poses against homogeneous matrices."""

from __future__ import annotations

import io
from collections.abc import Callable

import numpy as np
import pytest
import yourdfpy
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from pcw_description import DRIVE, STEER, RobotDescription, load_robot, shipped_robots
from pcw_description.frame_tree import Frame, PoseTrack, drift_of_odometry, planar_frame, robot_frames
from pcw_description.urdf import robot_urdf

ROUNDING = 1e-12


def matrix(frame: Frame) -> np.ndarray:
    result = np.eye(4)
    result[:3, :3] = Rotation.from_quat(frame.quaternion).as_matrix()
    result[:3, 3] = frame.position
    return result


def planar(pose: np.ndarray) -> np.ndarray:
    return matrix(planar_frame("a", "b", pose))


@pytest.mark.parametrize("which", [*shipped_robots(), 2, 5])
def test_links_stand_where_the_urdf_has_them(which: str | int, random_robot: Callable[..., RobotDescription]) -> None:
    rng = np.random.default_rng(3)
    robot = load_robot(which) if isinstance(which, str) else random_robot(rng, which)
    urdf = yourdfpy.URDF.load(io.BytesIO(robot_urdf(robot).encode()), load_meshes=False)
    for _ in range(5):
        position = rng.uniform(-20.0, 20.0, (robot.n, 2))
        urdf.update_cfg(
            {f"{name}_drive": angles[DRIVE] for name, angles in zip(robot.caster_names, position, strict=True)}
            | {f"{name}_steer": angles[STEER] for name, angles in zip(robot.caster_names, position, strict=True)}
        )
        frames = robot_frames(robot, position)
        assert {frame.child for frame in frames} | {"base_link"} == {link.name for link in urdf.robot.links}
        for frame in frames:
            np.testing.assert_allclose(matrix(frame), urdf.get_transform(frame.child, frame.parent), atol=ROUNDING)


def test_an_unknown_joint_hides_its_own_frame_only() -> None:
    robot = load_robot("thesis")
    position = np.zeros((robot.n, 2))
    position[1, STEER], position[2, DRIVE] = np.nan, np.inf
    children = {frame.child for frame in robot_frames(robot, position)}
    everything = {frame.child for frame in robot_frames(robot, np.zeros((robot.n, 2)))}
    assert everything - children == {"front_right_fork", f"{robot.caster_names[2]}_wheel"}


poses = st.tuples(st.floats(-50.0, 50.0), st.floats(-50.0, 50.0), st.floats(-20.0, 20.0)).map(np.array)


@given(poses, poses)
def test_map_to_odom_to_base_link_is_map_to_base_link(base_in_map: np.ndarray, base_in_odom: np.ndarray) -> None:
    odom_in_map = drift_of_odometry(base_in_map, base_in_odom)
    np.testing.assert_allclose(planar(odom_in_map) @ planar(base_in_odom), planar(base_in_map), atol=1e-11)


def test_a_track_is_linear_between_its_poses_and_silent_outside() -> None:
    track = PoseTrack()
    assert track.newest is None and track.at(0) is None
    start = 1_700_000_000_000_000_000  # a stamp of today: too long a number for a float64 to hold
    track.add(start, np.array([0.0, 1.0, 3.1]))
    track.add(start + 1_000_000, np.array([0.2, 1.0, -3.1]))  # on through pi, the short way
    middle = track.at(start + 250_000)
    assert middle is not None
    np.testing.assert_allclose(middle, [0.05, 1.0, 3.1 + 0.25 * (2.0 * np.pi - 6.2)], atol=1e-9)
    assert track.newest == start + 1_000_000
    assert track.at(start - 1) is None and track.at(start + 1_000_001) is None


def test_a_track_forgets_when_time_goes_back() -> None:
    track = PoseTrack()
    for time_ns in (100, 200, 50):
        track.add(time_ns, np.full(3, float(time_ns)))
    assert track.newest == 50 and track.at(150) is None
    found = track.at(50)
    assert found is not None and found.tolist() == [50.0] * 3
