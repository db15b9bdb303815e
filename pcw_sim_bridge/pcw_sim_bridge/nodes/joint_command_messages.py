"""A joint_commands message as a command, by the same rules for simulated and real drives."""

from __future__ import annotations

from collections.abc import Mapping

from sensor_msgs.msg import JointState

from pcw_description.nodes.node_tools import joint_state_arrays

from ..plants.plant import PlantError
from ..simulated_robot import JointCommand


def read_joint_command(message: JointState, joint_index: Mapping[str, int], shape: tuple[int, int]) -> JointCommand:
    """Return the command of a message.

    Raises:
        PlantError: a joint missing, unknown or named twice, a field of another length, both or none of effort and velocity,
            NaN or infinity.
    """
    if set(message.name) != set(joint_index) or len(message.name) != len(joint_index):
        raise PlantError(f"joint command for {list(message.name)}; allowed: each of {list(joint_index)} once")
    for field in ("velocity", "effort"):
        count = len(getattr(message, field))
        if count not in (0, len(message.name)):
            raise PlantError(f"joint command: {count} values of {field}; allowed: one a joint, or none")
    _, velocity, effort = joint_state_arrays(message, joint_index, shape)
    return JointCommand(effort=effort if len(message.effort) else None, velocity=velocity if len(message.velocity) else None)
