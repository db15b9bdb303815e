"""The controller node that can test the ground on request: one caster after another is made to slip on purpose.

The torques that make a wheel slip have to come from the controller's own process, within the cycle: through a topic they would
come too late. The node lies here, beside the core that it steps (`pcw_sim_bridge.ground_test`).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from rclpy.lifecycle import State, TransitionCallbackReturn
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from pcw_control import handover
from pcw_control.controller_interface import Reference, TwistReference
from pcw_control.nodes.controller import ControllerNode
from pcw_control.quintic_trajectory import TrajectoryPoint
from pcw_control.safety import HAZARDS
from pcw_control.steady_path import SteadyPath
from pcw_description import PcwError
from pcw_description.nodes.diagnostics import Diagnostics, Status
from pcw_description.nodes.node_tools import LATCHED, declare, fill_joint_state, ns_to_stamp, run_node
from pcw_estimation.sliding_mode_observer import MEASURED
from pcw_estimation.slip_estimate import JointMeasurement
from pcw_terrain.active_identification import ActiveParameters, Phase

from ..ground_test import BUSY, WORKS_WITH, Forecast, GroundTest, GroundTestParameters, shifted
from .ground_test_messages import caster_parts, test_status

# Within which a cmd_vel is still the one that was followed as the test began, and is reached [m/s], [m/s], [rad/s].
SAME_TWIST = np.array([0.01, 0.01, 0.02])
# Times `ground_test.greatest_path` off its path, by odometry, at which a test is cancelled [1].
STRAYED = 2.0
# So many joint_states in a row are answered late before a test is cancelled for it.
LATE = 5
# Stamps that are further from the node's clock are of another one [s].
OTHER_CLOCK = 1.0
# For which the path is held after the last test, so that the robot is back on it [s].
AFTERWARDS = 0.4


class GroundTestControllerNode(ControllerNode):
    """`ControllerNode` with the services `identify_ground` and `cancel_identification`, and `terrain/tested`.

    While the ground is tested the robot is held on the path on which cmd_vel leads it, by the pose of its odometry. What is
    added to the controller's torques passes the same gate; where the gate lets go nothing is added, and the test is over.
    """

    def __init__(self) -> None:
        self._test: GroundTest | None = None
        super().__init__("ground_test_controller")
        self._report = Diagnostics(self, self.robot.name, self._test_status, "ground test", parts=self._test_parts)

    def _declare_more(self) -> None:
        active = ActiveParameters()
        declare(
            self, "ground_test.measured", MEASURED[0], "speeds of the drives, or from joint angles, for a test of the ground",
            read_only=True, choices=MEASURED,
        )
        declare(
            self, "ground_test.greatest_path", active.greatest_path,
            "a caster is not tested where the base would leave its path further", "m", (0.001, 0.1),
        )
        declare(
            self, "ground_test.greatest_delay", 0.006,
            "a test is cancelled where five joint_states in a row are older as they are answered", "s", (0.001, 0.1),
        )
        declare(
            self, "ground_test.replay", 2, "readings of a finished test that are gone over in one cycle", "1", (1, 10000)
        )

    def _adopt_parameters(self) -> None:
        super()._adopt_parameters()
        self._greatest_path: float = self.get_parameter("ground_test.greatest_path").value
        self._greatest_delay: float = self.get_parameter("ground_test.greatest_delay").value
        active = ActiveParameters(
            stiffness=float(getattr(self._controller.parameters, "position_gain", 0.0)), greatest_path=self._greatest_path
        )
        parameters = GroundTestParameters(
            self.get_parameter("ground_test.measured").value, self.get_parameter("ground_test.replay").value, active
        )
        if self._test is None or parameters != self._test.parameters:
            self._test = GroundTest(self.robot, parameters)

    def _take_over(self) -> None:
        self._drop("the controller was changed")
        super()._take_over()
        if self._driving:  # what was added to the old controller's torque is not handed over
            self._handover = handover.begin_handover(self._passed.torque - self._added)

    def _forget(self) -> None:
        super()._forget()
        assert self._test is not None
        self._state_of_test = self._test.initial_state()
        self._asked = self._added = np.zeros((self.robot.n, 2))
        self._held: SteadyPath | None = None
        self._held_ns = self._ended_ns = self._slipped_ns = self._late = 0
        self._ended, self._unusable = "", "there were no joint_states"
        self._forecast: Forecast | None = None
        self._disturbance = np.zeros(2)  # way [m] and turn [rad] off the path, by odometry

    # --- Lifecycle --------------------------------------------------------------------------------------

    def on_configure(self, state: State) -> TransitionCallbackReturn:
        """Create the topic and the services as well, and compile what a test needs."""
        assert self._test is not None
        self._test.warm_up()
        self._tested = self.create_publisher(JointState, "terrain/tested", LATCHED)
        self._request_services = [
            self.create_service(Trigger, "identify_ground", self._on_identify),
            self.create_service(Trigger, "cancel_identification", self._on_cancel),
        ]
        return super().on_configure(state)

    def on_cleanup(self, state: State) -> TransitionCallbackReturn:
        """Remove them."""
        for service in self._request_services:
            self.destroy_service(service)
        self.destroy_publisher(self._tested)
        return super().on_cleanup(state)

    # --- Requests ---------------------------------------------------------------------------------------

    def _on_identify(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        reason, forecast = self._reason_against_test()
        response.success, response.message = not reason, reason
        if forecast is not None and not reason:
            self._begin(forecast)
            names = self.robot.caster_names
            said = f"{', '.join(names[i] for i in forecast.begins)} will slip one after another"
            said += f"; the base is expected to leave its path by up to {1e3 * forecast.path:.1f} mm"
            left_out = (f"; {names[i]} may be left out: {why.value}" for i, why in forecast.left_out)
            response.message = said + "".join(left_out)
        return response

    def _reason_against_test(self) -> tuple[str, Forecast | None]:
        """Say why no test can begin now, "" where it can; and what it would lead to, as far as that is known."""
        assert self._test is not None
        if not self._active:
            return "not active", None
        if self._state_of_test.busy or self._held is not None:
            return "a test of the ground goes on", None
        if self._name not in WORKS_WITH:
            return f"controller = {self._name!r} is not allowed; allowed: {', '.join(WORKS_WITH)}", None
        if not self._driving or self._twist is None:
            return "the robot follows no cmd_vel; allowed: while it follows a steady one", None
        if np.any(np.abs(self._twist - self._reference_twist) > SAME_TWIST):
            return f"cmd_vel {self._twist.tolist()} is not reached yet; allowed: while a steady one is followed", None
        forecast = None if self._unusable else self._test.forecast(self._state_of_test)
        if forecast is None:
            return f"the joints cannot be observed: {self._unusable or 'there was a gap'}", None
        left_out = "; ".join(f"{self.robot.caster_names[i]}: {why.value}" for i, why in forecast.left_out)
        return "" if forecast.begins else f"no caster can be tested now: {left_out}", forecast

    def _begin(self, forecast: Forecast) -> None:
        assert self._test is not None and self._twist is not None
        self._state_of_test = self._test.request(self._state_of_test)
        self._held, self._held_ns = SteadyPath(self._odometry.pose.copy(), self._twist.copy()), self._now_ns
        self._forecast, self._ended, self._ended_ns, self._disturbance = forecast, "", 0, np.zeros(2)

    def _on_cancel(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success = self._state_of_test.testing.phase in BUSY
        response.message = "no other caster follows" if response.success else "no caster is being tested"
        self._cancel("cancelled")
        return response

    # --- The test ---------------------------------------------------------------------------------------

    def _cancel(self, reason: str) -> None:
        """Bring a wheel that slips back, and let no other follow."""
        assert self._test is not None
        if self._state_of_test.testing.phase in BUSY:
            self._ended = self._ended or reason
            self._state_of_test = self._test.cancel(self._state_of_test)

    def _drop(self, reason: str) -> None:
        """Add nothing from now on."""
        assert self._test is not None
        if self._state_of_test.busy:
            self._ended = self._ended or reason
            self._state_of_test = self._test.drop(self._state_of_test)
            self._say_ended()
        self._held = None

    def _seen(
        self, position: np.ndarray, velocity: np.ndarray, effort: np.ndarray, dt: float | None
    ) -> tuple[np.ndarray, np.ndarray]:
        assert self._test is not None
        self._added = np.zeros_like(position)
        if dt is None:
            self._drop(HAZARDS["no_time_step"].said)
            self._state_of_test = self._test.drop(self._state_of_test)
            return self._test.seen(self._state_of_test, position), velocity
        try:
            before, joints = self._state_of_test, JointMeasurement(position, velocity, effort)
            self._state_of_test, output = self._test.step(before, joints, self._asked, dt)
        except PcwError as error:
            self._unusable = str(error)
            self._drop(f"the joints cannot be observed: {error}")
            self._state_of_test = self._test.drop(self._state_of_test)
            return self._test.seen(self._state_of_test, position), velocity
        self._unusable, self._added = "", output.torque
        self._note_delay()
        if before.under_test >= 0:
            self._slipped_ns = self._now_ns
        if output.found >= 0:
            self._odometry = shifted(self._odometry, output.missed)
            if self._state_of_test.ground.valid[output.found]:
                self._publish_tested()
        if before.busy and not self._state_of_test.busy:
            self._say_ended()
        return output.position, output.velocity

    def _note_delay(self) -> None:
        """Cancel where answers come too late, so that controller, tyres and observer would shake each other."""
        delay = (self.get_clock().now().nanoseconds - self._now_ns) * 1e-9
        self._late = self._late + 1 if self._greatest_delay < delay < OTHER_CLOCK else 0
        if self._late >= LATE:
            self._cancel(f"joint_states are {1e3 * delay:.0f} ms old as they are answered")

    def _reference(self, hazards: set[str]) -> Reference | None:
        """Return the path on which the robot is held while it is tested, as long as the same cmd_vel is followed."""
        motion = super()._reference(hazards)
        if self._held is None or motion is None:
            return motion
        same = isinstance(motion, TwistReference) and np.all(np.abs(motion.twist - self._held.twist) <= SAME_TWIST)
        if not same:
            self._cancel("something else is commanded")
        if not same or (not self._state_of_test.busy and self._now_ns - self._ended_ns > AFTERWARDS * 1e9):
            self._held = None
            return motion
        point = self._held.sample((self._now_ns - self._held_ns) * 1e-9)
        self._note_disturbance(point)
        return point

    def _note_disturbance(self, point: TrajectoryPoint) -> None:
        x, y, yaw = self._odometry.pose - point.pose
        self._disturbance = np.maximum(self._disturbance, [np.hypot(x, y), abs(yaw)])
        if self._disturbance[0] > STRAYED * self._greatest_path:
            self._cancel(f"the base has left its path by {1e3 * self._disturbance[0]:.1f} mm")

    def _with_more(self, torque: np.ndarray) -> np.ndarray:
        self._asked = torque
        return torque + self._added

    def _send(
        self, hazards: set[str], torque: np.ndarray | None = None, velocity: np.ndarray | None = None, dt: float | None = None
    ) -> None:
        super()._send(hazards, torque, velocity, dt)
        if not self._driving:
            self._asked = self._added = np.zeros((self.robot.n, 2))
            self._drop("; ".join(HAZARDS[name].said for name in sorted(hazards)) or "the torque is zero")

    # --- What is told -----------------------------------------------------------------------------------

    def _publish_tested(self) -> None:
        """Publish what tests have told so far, with the stamp of the last reading of the last test."""
        ground = self._state_of_test.ground
        message = JointState(name=[name for name, valid in zip(self.robot.caster_names, ground.valid, strict=True) if valid])
        message.header.stamp = ns_to_stamp(self._slipped_ns)
        fill_joint_state(message, position=ground.lambda_p[ground.valid], effort=ground.mu_p[ground.valid])
        self._tested.publish(message)

    def _say_ended(self) -> None:
        """Say at once that nothing goes on any more."""
        self._ended_ns = self._now_ns
        testing = self._state_of_test.testing
        self._ended = self._ended or (testing.refusal.value if testing.phase is Phase.REFUSED else "")
        self._report.report()

    def _test_status(self) -> Status:
        path = 0.0 if self._forecast is None else self._forecast.path
        return test_status(self.robot.caster_names, self._state_of_test, self._ended, path, self._disturbance)

    def _test_parts(self) -> dict[str, Status]:
        return {} if self._forecast is None else caster_parts(self.robot.caster_names, self._state_of_test)


def main(args: Sequence[str] | None = None) -> int:
    """Run the controller."""
    return run_node(GroundTestControllerNode, args)


if __name__ == "__main__":
    raise SystemExit(main())
