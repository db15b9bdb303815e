"""ROS 2 Jazzy messages without ROS: types, definitions, constructors and CDR bytes.

The definitions come with the `rosbags` package, so a recording is the same whether or not ROS is installed.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

NANOSECONDS = 1_000_000_000

JOINT_STATE = "sensor_msgs/msg/JointState"
IMU = "sensor_msgs/msg/Imu"
ODOMETRY = "nav_msgs/msg/Odometry"
TWIST = "geometry_msgs/msg/Twist"
TWIST_STAMPED = "geometry_msgs/msg/TwistStamped"
WRENCH_STAMPED = "geometry_msgs/msg/WrenchStamped"
CLOCK = "rosgraph_msgs/msg/Clock"

# Where (x, y, yaw) stand in the 6 x 6 covariance of a pose or twist (x, y, z, roll, pitch, yaw).
PLANAR_ROWS = np.array([0, 1, 5])


@lru_cache(maxsize=1)
def typestore() -> Typestore:
    """All message types of a ROS 2 Jazzy desktop installation."""
    return get_typestore(Stores.ROS2_JAZZY)


def message_definition(type_name: str) -> str | None:
    """The .msg text of a type followed by those of the types it uses, as MCAP wants it; None if unknown."""
    if type_name not in typestore().fielddefs:
        return None
    return typestore().generate_msgdef(type_name, ros_version=2)[0]


def type_hash(type_name: str) -> str:
    """The type description hash (REP-2016) that Jazzy writes into a bag; empty if the type is unknown."""
    return typestore().hash_rihs01(type_name) if type_name in typestore().fielddefs else ""


def type_name_of(message: Any) -> str:
    """The type's name, e.g. "sensor_msgs/msg/JointState"."""
    return str(message.__msgtype__)


def serialise(message: Any) -> bytes:
    """CDR bytes of a message, little endian, the encapsulation header included."""
    return bytes(typestore().serialize_cdr(message, message.__msgtype__))


def stamp_of(message: Any) -> int | None:
    """The message's own time in nanoseconds: header stamp or clock; None for a message without one."""
    if hasattr(message, "header"):
        stamp = message.header.stamp
    elif hasattr(message, "clock"):
        stamp = message.clock
    else:
        return None
    return int(stamp.sec) * NANOSECONDS + int(stamp.nanosec)


# --- Constructors ---------------------------------------------------------------------------------------


def joint_state(
    stamp_ns: int,
    names: tuple[str, ...] | list[str],
    position: ArrayLike | None = None,
    velocity: ArrayLike | None = None,
    effort: ArrayLike | None = None,
    frame_id: str = "",
) -> Any:
    """JointState of (n, 2) or flat arrays in the order of `names`; a field that is None is left empty."""
    return _make(
        JOINT_STATE,
        header=_header(stamp_ns, frame_id),
        name=list(names),
        position=_values(position),
        velocity=_values(velocity),
        effort=_values(effort),
    )


def imu(
    stamp_ns: int,
    gyro: ArrayLike,
    acceleration: ArrayLike,
    gyro_variance: float = 0.0,
    acceleration_variance: float = 0.0,
    frame_id: str = "imu_link",
) -> Any:
    """Imu with angular velocity (3,) [rad/s] and specific force (3,) [m/s^2]; no orientation, and it says so."""
    orientation_covariance = np.zeros(9)
    orientation_covariance[0] = -1.0  # sensor_msgs/Imu: "no estimate of the orientation"
    return _make(
        IMU,
        header=_header(stamp_ns, frame_id),
        orientation=_quaternion(0.0),
        orientation_covariance=orientation_covariance,
        angular_velocity=_vector(gyro),
        angular_velocity_covariance=np.eye(3).ravel() * gyro_variance,
        linear_acceleration=_vector(acceleration),
        linear_acceleration_covariance=np.eye(3).ravel() * acceleration_variance,
    )


def odometry(
    stamp_ns: int,
    pose: ArrayLike,
    twist: ArrayLike,
    pose_covariance: ArrayLike | None = None,
    twist_covariance: ArrayLike | None = None,
    frame_id: str = "odom",
    child_frame_id: str = "base_link",
) -> Any:
    """Odometry of a planar pose (x, y, yaw) in `frame_id` and a twist (v_x, v_y, omega) in `child_frame_id`.

    Covariances are (3, 3) in the same order.
    """
    x, y, yaw = np.asarray(pose, dtype=np.float64)
    return _make(
        ODOMETRY,
        header=_header(stamp_ns, frame_id),
        child_frame_id=child_frame_id,
        pose=_make(
            "geometry_msgs/msg/PoseWithCovariance",
            pose=_make(
                "geometry_msgs/msg/Pose",
                position=_make("geometry_msgs/msg/Point", x=float(x), y=float(y), z=0.0),
                orientation=_quaternion(yaw),
            ),
            covariance=_covariance(pose_covariance),
        ),
        twist=_make(
            "geometry_msgs/msg/TwistWithCovariance",
            twist=_twist(twist),
            covariance=_covariance(twist_covariance),
        ),
    )


def twist_stamped(stamp_ns: int, twist: ArrayLike, frame_id: str = "base_link") -> Any:
    """TwistStamped of (v_x, v_y, omega) [m/s, m/s, rad/s]."""
    return _make(TWIST_STAMPED, header=_header(stamp_ns, frame_id), twist=_twist(twist))


def wrench_stamped(stamp_ns: int, force: ArrayLike, torque: ArrayLike, frame_id: str) -> Any:
    """WrenchStamped of force (3,) [N] and torque (3,) [N m]."""
    wrench = _make("geometry_msgs/msg/Wrench", force=_vector(force), torque=_vector(torque))
    return _make(WRENCH_STAMPED, header=_header(stamp_ns, frame_id), wrench=wrench)


def clock(stamp_ns: int) -> Any:
    """Clock of a simulated time."""
    return _make(CLOCK, clock=_stamp(stamp_ns))


def _make(type_name: str, **fields: Any) -> Any:
    return typestore().types[type_name](**fields)


def _stamp(stamp_ns: int) -> Any:
    seconds, rest = divmod(int(stamp_ns), NANOSECONDS)
    return _make("builtin_interfaces/msg/Time", sec=seconds, nanosec=rest)


def _header(stamp_ns: int, frame_id: str) -> Any:
    return _make("std_msgs/msg/Header", stamp=_stamp(stamp_ns), frame_id=frame_id)


def _values(values: ArrayLike | None) -> np.ndarray:
    return np.zeros(0) if values is None else np.array(values, dtype=np.float64).ravel()


def _vector(values: ArrayLike) -> Any:
    x, y, z = np.asarray(values, dtype=np.float64)
    return _make("geometry_msgs/msg/Vector3", x=float(x), y=float(y), z=float(z))


def _quaternion(yaw: float) -> Any:
    half = 0.5 * float(yaw)
    return _make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=float(np.sin(half)), w=float(np.cos(half)))


def _twist(twist: ArrayLike) -> Any:
    forward, left, rotation = np.asarray(twist, dtype=np.float64)
    return _make(
        "geometry_msgs/msg/Twist", linear=_vector((forward, left, 0.0)), angular=_vector((0.0, 0.0, rotation))
    )


def _covariance(planar: ArrayLike | None) -> np.ndarray:
    full = np.zeros((6, 6))
    if planar is not None:
        full[np.ix_(PLANAR_ROWS, PLANAR_ROWS)] = np.asarray(planar, dtype=np.float64)
    return full.ravel()
