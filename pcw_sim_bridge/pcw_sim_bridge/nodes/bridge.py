"""The simulated robot on the topics of a real one."""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool, Trigger

from pcw_description import PcwError, load_robot
from pcw_description.nodes.diagnostics import ERROR, OK, WARN, Diagnostics, Problems, Status
from pcw_description.nodes.node_tools import COMMAND, all_declared, declare, run_node, stamp_to_ns

from ..plants.factory import make_plant
from ..plants.plant import PLANT_NAMES, PlantError
from ..sensors import VELOCITY_SOURCES
from ..simulated_robot import SimulatedRobot
from ..stamping import LARGEST_JITTER, LARGEST_LOSS, StampingParameters, TopicStamps
from .bridge_messages import BridgePublishers
from .joint_command_messages import read_joint_command

# As fast as possible means this much work between two looks at the executor [s].
WORK_SLICE = 0.005
# The simulation gives up catching up with real time once it is this far behind [s].
LARGEST_LAG = 0.1


class BridgeNode(Node):
    """Reads joint_commands, advances the plant and publishes what the robot's sensors report, in simulated time.

    A refused command (NaN, both or none of effort and velocity, other joints) is zero torque until the next good one.
    With `lockstep` the simulation waits after each joint_states for a joint_commands with at least its stamp, so that
    a controller in another process gives the same result however long it takes. A joint_states that is lost is not waited for:
    nobody can answer it.
    """

    def __init__(self) -> None:
        super().__init__("bridge")
        robot = load_robot(declare(self, "robot", "thesis", "robot file, or the name of a shipped robot", read_only=True))
        plant = declare(self, "plant", "reduced", "what computes the motion", read_only=True, choices=PLANT_NAMES)
        dt = declare(
            self, "dt", 0.0, "step of the plant; 0: the longest up to 1 ms that fits the encoders", "s", (0.0, 5e-3),
            read_only=True,
        )
        seed = declare(self, "seed", 0, "seed of the sensor noise", range=(0, 2**31 - 1), read_only=True)
        lifted = declare(self, "lifted", False, "the robot is on a jack, its wheels off the ground", read_only=True)
        gui = declare(self, "gui", False, "show the plant's window (pybullet, mujoco)", read_only=True)
        source = declare(
            self, "velocity_source", "drive", "where measured joint speeds come from", read_only=True, choices=VELOCITY_SOURCES
        )
        bandwidth = declare(
            self, "velocity_bandwidth", 30.0, "bandwidth of the drives' velocity loops", "rad/s", (1.0, 300.0), read_only=True
        )
        jitter = declare(
            self, "stamp_jitter", 0.0, "standard deviation of the stamps", "s", (0.0, LARGEST_JITTER), read_only=True
        )
        loss = declare(self, "loss", 0.0, "fraction of the messages lost, in bursts", "1", (0.0, LARGEST_LOSS), read_only=True)
        timeout = declare(self, "command_timeout", 0.1, "zero torque after so long without a command", "s", (0.002, 10.0))
        declare(self, "real_time_factor", 1.0, "simulated per real time; 0 is as fast as possible", "1", (0.0, 1000.0))
        declare(self, "lockstep", False, "wait for a command after each joint_states", read_only=True)
        declare(self, "lockstep_timeout", 1.0, "go on without a command after so long, real time", "s", (0.01, 3600.0))
        declare(self, "step_duration", 0.0, "what ~/step advances; 0 is one control period", "s", (0.0, 3600.0))
        clock_rate = declare(
            self, "clock_rate", 100.0, "rate of /clock, at most that of joint_states", "Hz", (1.0, 1e4), read_only=True
        )
        declare(self, "start_paused", False, "wait for ~/pause with false, or ~/step", read_only=True)

        all_declared(self)
        self.robot = robot
        self._simulated = SimulatedRobot(make_plant(plant, robot, dt or None, gui, lifted), seed, source, timeout, bandwidth)
        for _ in range(3):  # compiles everything before the clock starts
            list(self._simulated.advance())
        self._simulated.reset()
        self._joint_index = {name: i for i, name in enumerate(robot.joint_names)}
        self._outputs = BridgePublishers(self, robot, clock_rate, TopicStamps(StampingParameters(jitter, loss), seed, robot))
        self.create_subscription(JointState, "joint_commands", self._on_command, COMMAND)
        self.create_service(SetBool, "~/pause", self._on_pause)
        self.create_service(Trigger, "~/reset", self._on_reset)
        self.create_service(Trigger, "~/step", self._on_step)
        self._lockstep: bool = self.get_parameter("lockstep").value
        self._paused: bool = self.get_parameter("start_paused").value
        self._fault = ""
        self._begun = False  # the readings at time zero are out
        self._problems = Problems(self)
        self._refused_commands = 0
        self._overruns = self._unanswered = 0
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._timer = None
        self.add_post_set_parameters_callback(lambda _: self._start_pacing())
        self._start_pacing()
        self._reported = (time.monotonic(), 0)
        self._diagnostics = Diagnostics(self, robot.name, self._status, aspect="simulation")

    # --- Time -------------------------------------------------------------------------------------------

    def _start_pacing(self) -> None:
        """Set the timer for the parameters as they are now."""
        self._simulated.command_timeout = self.get_parameter("command_timeout").value
        self._lockstep_timeout: float = self.get_parameter("lockstep_timeout").value
        self._factor: float = self.get_parameter("real_time_factor").value
        if self._factor > 0.0:
            period = min(max(self._simulated.control_period / self._factor, 5e-4), 0.02)
        else:
            # In lock-step the commands drive the simulation and the timer only looks after a missing one.
            period = min(0.02, 0.25 * self._lockstep_timeout) if self._lockstep else 1e-4
        if self._timer is not None:
            self.destroy_timer(self._timer)
        self._timer = self.create_timer(period, self._go_on, clock=self._steady)
        self._anchor()

    def _anchor(self) -> None:
        """Let the simulated time of now belong to the real time of now."""
        self._anchor_real, self._anchor_ns = time.monotonic(), self._simulated.time_ns
        self._last_published = self._anchor_real

    def _go_on(self) -> None:
        """Advance as far as the pace, the lock-step and a slice of work allow."""
        slice_end = time.monotonic() + WORK_SLICE
        while self._may_advance():
            self._advance()
            if time.monotonic() > slice_end:
                return

    def _may_advance(self) -> bool:
        if self._paused or self._fault:
            return False
        now = time.monotonic()
        if not self._begun:
            return not self._lockstep or (
                self.count_publishers("joint_commands") > 0 and self._outputs.joint_states.get_subscription_count() > 0
            )
        waits = self._lockstep and not self._answered
        # Before the pace, which begins anew when it lags: a reading that nobody got would be waited for without an end.
        if waits and now - self._last_published < self._lockstep_timeout:
            return False
        if self._factor > 0.0:
            lag = (now - self._anchor_real) - (self._simulated.time_ns - self._anchor_ns) * 1e-9 / self._factor
            if lag < 0.0:
                return False
            if lag > LARGEST_LAG:
                self._overruns += 1
                self._anchor()
        self._unanswered += waits
        return True

    def _advance(self) -> None:
        """Publish the readings of one control period; those of time zero the first time."""
        try:
            for sample in self._simulated.advance():
                self._outputs.publish(sample)
        except PlantError as error:
            self._fault = str(error)
            self.get_logger().error(f"the simulation stands still: {error}")
            self._diagnostics.report()
        self._begun = True
        self._answered = self._outputs.joint_states_lost
        self._last_published = time.monotonic()

    # --- Commands ---------------------------------------------------------------------------------------

    def _on_command(self, message: JointState) -> None:
        try:
            self._simulated.command(read_joint_command(message, self._joint_index, (self.robot.n, 2)))
        except PcwError as error:
            self._simulated.command(None)
            self._refused_commands += 1
            if self._problems.add(f"{error}; the torque is zero"):
                self._diagnostics.report()
        if self._lockstep and stamp_to_ns(message.header.stamp) >= self._outputs.joint_states_stamp_ns:
            self._answered = True
            self._go_on()

    # --- Services ---------------------------------------------------------------------------------------

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self._paused = request.data
        self._anchor()
        response.success, response.message = True, "paused" if self._paused else "running"
        return response

    def _on_reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._simulated.reset()
        self._outputs.reset()
        self._fault, self._begun = "", False
        self._reported = (time.monotonic(), 0)
        self._anchor()
        self._advance()
        response.success, response.message = True, "at the start, time 0"
        return response

    def _on_step(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if not self._paused or self._fault:
            response.success = False
            response.message = self._fault or "the simulation is running; pause it first (~/pause)"
            return response
        if not self._begun:
            self._advance()
        duration = self.get_parameter("step_duration").value
        for _ in range(max(1, round(duration / self._simulated.control_period))):
            if self._fault:
                break
            self._advance()
        response.success, response.message = not self._fault, self._fault or f"time {self._simulated.time_ns * 1e-9:.6f} s"
        return response

    # --- Diagnostics ------------------------------------------------------------------------------------

    def _status(self) -> Status:
        now, then = (time.monotonic(), self._simulated.time_ns), self._reported
        self._reported = now
        factor = (now[1] - then[1]) * 1e-9 / max(now[0] - then[0], 1e-9)
        problems = self._problems.take()
        level, message = OK, "paused" if self._paused else "running"
        if self._fault:
            level, message = ERROR, self._fault
        elif problems:
            level, message = WARN, problems
        elif not self._begun and self._lockstep:
            level, message = WARN, "lock-step waits for a controller"
        elif self._simulated.timed_out:
            level, message = WARN, "no command within command_timeout; the torque is zero"
        return Status(
            level, message,
            {
                "real_time_factor": float(np.round(factor, 4)), "simulated_time": now[1] * 1e-9, "overruns": self._overruns,
                "unanswered_in_lockstep": self._unanswered, "refused_commands": self._refused_commands,
            },
        )

    def close(self) -> None:
        """Free the plant."""
        self._simulated.close()


def main(args: Sequence[str] | None = None) -> int:
    """Run the bridge."""
    return run_node(BridgeNode, args)


if __name__ == "__main__":
    raise SystemExit(main())
