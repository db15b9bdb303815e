"""A CAN file to begin with, for any robot: node ids in the order of the joints, and motors that reach the robot's limits."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from pcw_description.robot_description import RobotDescription

TORQUE_CONSTANT = 0.05  # [N m/A], of a motor of some 100 W


def starting_content(robot: RobotDescription, protocol: str = "cia402", **changes: Any) -> dict[str, Any]:
    """Return what such a file holds, on one bus; `changes` replace keys at the top.

    Torque constant, rated torque and current limit are no more than consistent: those of the drives are to replace them.
    """
    inverse_transposed = np.transpose(np.linalg.inv(robot.gear_matrix), (0, 2, 1))
    most = float((np.abs(inverse_transposed) @ robot.torque_limit[:, :, None]).max())
    defaults: dict[str, Any] = {
        "bus": "can0", "protocol": protocol, "torque_constant": TORQUE_CONSTANT,
        "current_limit": round(1.05 * most / TORQUE_CONSTANT, 2),
    }  # fmt: skip
    if protocol == "cia402":
        defaults["rated_torque"] = round(0.6 * most, 3)
    return {
        "format": "pcw_can/1",
        "name": f"{robot.name}_{protocol}",
        "robot": robot.name,
        "buses": [{"name": "can0", "interface": "virtual", "channel": "can0"}],
        "joint_defaults": defaults,
        "joints": [{"name": name, "node_id": i + 1} for i, name in enumerate(robot.joint_names)],
        **changes,
    }


def with_joints(content: Mapping[str, Any], names: Iterable[str], **changes: Any) -> dict[str, Any]:
    """Return a file's content with keys of some joints changed."""
    changed, chosen = copy.deepcopy(dict(content)), set(names)
    for joint in changed["joints"]:
        if joint["name"] in chosen:
            joint.update(changes)
    return changed
