"""A lifecycle node that lets go of the robot at its end, and outlives a request that its state does not have."""

from __future__ import annotations

import abc

from lifecycle_msgs.srv import ChangeState
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import LifecycleNode, State, TransitionCallbackReturn


class RobustLifecycleNode(LifecycleNode, abc.ABC):
    """A lifecycle node for hardware: `ros2 lifecycle set NODE activate` a second time is refused, and no more.

    In rclpy of Jazzy such a request raises out of the service, and the node ends. `close` is called on the transition
    `shutdown` and after a transition that failed.
    """

    @abc.abstractmethod
    def close(self) -> None:
        """Let go of the robot for good: no torque is left when this returns."""

    def on_shutdown(self, state: State) -> TransitionCallbackReturn:
        """Let go of the robot for good."""
        self.close()
        return super().on_shutdown(state)

    def on_error(self, state: State) -> TransitionCallbackReturn:
        """Let go of the robot after a failed transition."""
        self.close()
        return super().on_error(state)

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
