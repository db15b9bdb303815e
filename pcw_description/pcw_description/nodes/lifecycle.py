"""A lifecycle node that outlives a request for a transition which its state does not have."""

from __future__ import annotations

from lifecycle_msgs.srv import ChangeState
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import LifecycleNode


class RobustLifecycleNode(LifecycleNode):
    """A lifecycle node for hardware: `ros2 lifecycle set NODE activate` a second time is refused, and no more.

    In rclpy of Jazzy such a request raises out of the service, and the node ends.
    """

    def _LifecycleNodeMixin__on_change_state(  # noqa: N802 - the name that rclpy calls
        self, request: ChangeState.Request, response: ChangeState.Response
    ) -> ChangeState.Response:
        """Carry out a transition, or refuse it and say so in the log."""
        try:
            return super()._LifecycleNodeMixin__on_change_state(request, response)
        except rclpy_implementation.RCLError as error:
            self.get_logger().error(f"transition refused: {error}")
            response.success = False
            return response
