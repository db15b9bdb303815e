"""What makes the robot stop: faults by name, found in what the drives say and do not say.

    missing_node      no position, speed or torque for longer than `timeouts.feedback`; no word of its state for longer than
                      that or 2.5 heartbeats; no temperature for 1 s, where the drive reports one
    node_reset        a drive has started anew, or left the operational state
    drive_disabled    a drive has no torque though nobody took it away
    over_temperature, over_current, drive_watchdog, ...   what a drive says of itself
    over_temperature  a reported temperature above `temperature_limit`
    over_current      a torque above CURRENT_MARGIN times torque constant times `current_limit`, twice running
    torque_limit      a measured joint torque above TORQUE_MARGIN times the limit of the joint, twice running
    encoder_jump      a step of position that the speed does not explain, within one period
    encoder_stuck     a position that stands while the speed of the same drive, or the other joints (`encoder_watch`), say that
                      the joint turns; or position and speed that part slowly: a step of position over several periods

A step of position of a motor is explained if it is within `encoder_jump` times the gear, plus what the speed makes of the
uncertainty of when it was read, of the mean of the speeds before and after times the time between. A position that stands
needs no such allowance: it is a fault once the joint should have turned by `encoder_still`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from .drive import Drive, DriveState, Feedback

CURRENT_MARGIN = 1.2
TORQUE_MARGIN = 1.25
# What the computer does not know of when a position was read [s]; more when positions come at uneven times, as to a computer
# that is busy.
TIME_UNCERTAINTY = 0.010
# Of `encoder_jump`, what may stand between position and integrated speed: it grows slowly, so that less of it is by chance.
DRIFT_SHARE = 0.2
# Time constant over which position and integrated speed are held against each other [s].
DRIFT_TIME = 0.2
STILL = 0.05  # below this every joint stands still [rad/s]
# Readings and counts that a position must have stood for, and been overdue by, at the least.
FEWEST_STILL, FEWEST_COUNTS = 4, 5
HEARTBEATS_MISSED = 2.5
TEMPERATURE_SILENCE = 1.0  # [s]


class Fault(NamedTuple):
    """Something that stops the robot.

    Attributes:
        name: as in the table above.
        where: joint or bus.
        detail: numbers.
    """

    name: str
    where: str
    detail: str

    def __str__(self) -> str:
        return f"{self.name} at {self.where}: {self.detail}"


class DriveWatch:
    """Watches one drive.

    Args:
        drive: the drive.
        gear: turns of the motor per turn of its joint, its own.
        joint_torque: largest torque of the joint [N m].
        feedback_timeout: [s].
        resolution: of its count, as a turn of the motor [rad].
    """

    def __init__(
        self, drive: Drive, gear: float, joint_torque: float, feedback_timeout: float, resolution: float
    ) -> None:
        joint = drive.joint
        self.drive = drive
        self._gear = abs(gear)
        self._jump = joint.encoder_jump * self._gear
        self._current_torque = joint.torque_constant * joint.current_limit * CURRENT_MARGIN
        self._joint_torque = joint_torque * TORQUE_MARGIN
        self._timeout = feedback_timeout
        self._state_timeout = max(feedback_timeout, HEARTBEATS_MISSED * drive.heartbeat)
        self._resolution = resolution
        self._still_turn = max(joint.encoder_still * self._gear, FEWEST_COUNTS * resolution)
        self.forget()

    def forget(self) -> None:
        """Start afresh, as after homing: the next position is compared with none."""
        self._drift, self._seen, self._too_much, self._too_strong = 0.0, -math.inf, 0, 0
        self._late = 0.0  # by how much positions came at other times than each period, of late [s]
        self._anchor, self._still_for, self._overdue = math.inf, 0, 0.0  # where the count stood, for how long, what is due
        self._last = math.nan, math.nan, -math.inf  # position, speed and time
        self._fresh = True

    def look(self, now: float, armed: bool, joint_torque: float, watch_encoder: bool = True) -> list[Fault]:
        """Return what is wrong with the drive now.

        Args:
            now: time [s].
            armed: the drive should give torque.
            joint_torque: measured torque of the joint [N m].
            watch_encoder: whether jumps count; not while a drive looks for its mark.
        """
        drive, feedback = self.drive, self.drive.feedback
        found: list[Fault] = []
        missing = self._missing(now)
        if missing:
            return [Fault("missing_node", drive.name, missing)]
        if feedback.restarted:
            return [Fault("node_reset", drive.name, "the drive has started anew or is no longer operational")]
        if feedback.state is DriveState.FAULT or (armed and feedback.error_names):
            found += [Fault(name, drive.name, "the drive says so") for name in feedback.error_names or ("drive_fault",)]
        elif armed and feedback.state is not DriveState.ENABLED:
            found.append(Fault("drive_disabled", drive.name, f"the drive is {feedback.state.value} and should have torque"))
        limit = drive.joint.temperature_limit
        if feedback.temperature > limit:
            found.append(Fault("over_temperature", drive.name, f"{feedback.temperature:.0f} degC, allowed {limit:g} degC"))
        if feedback.position_time > self._seen:
            found += self._look_at_torque(feedback, joint_torque)
            if watch_encoder:
                found += self._look_at_position(feedback)
            else:
                self._fresh = True
            self._seen = feedback.position_time
        return found

    def _missing(self, now: float) -> str:
        """Return what the drive has not said for too long; "" if nothing."""
        feedback = self.drive.feedback
        if feedback.heard_time == -math.inf:
            return "never heard"
        for what, time, allowed in (
            ("position", feedback.position_time, self._timeout), ("speed", feedback.velocity_time, self._timeout),
            ("torque", feedback.torque_time, self._timeout), ("word of its state", feedback.state_time, self._state_timeout),
        ):  # fmt: skip
            if now - time > allowed:
                ago = f"for {(now - time) * 1000:.0f} ms" if time > -math.inf else "at all"
                return f"no {what} {ago}, allowed {allowed * 1000:.0f} ms"
        if -math.inf < feedback.temperature_time < now - TEMPERATURE_SILENCE:
            return f"no temperature for {now - feedback.temperature_time:.1f} s, allowed {TEMPERATURE_SILENCE:g} s"
        return ""

    def _look_at_torque(self, feedback: Feedback, joint_torque: float) -> list[Fault]:
        torque = abs(feedback.torque)
        self._too_much = self._too_much + 1 if torque > self._current_torque else 0
        self._too_strong = self._too_strong + 1 if abs(joint_torque) > self._joint_torque else 0
        name, constant = self.drive.name, self.drive.joint.torque_constant
        if self._too_much >= 2:
            return [Fault("over_current", name, f"{torque / constant:.1f} A, allowed {self._current_torque / constant:.1f} A")]
        if self._too_strong >= 2:
            return [Fault("torque_limit", name, f"{joint_torque:.2f} N m, allowed {self._joint_torque:.2f} N m")]
        return []

    def _look_at_position(self, feedback: Feedback) -> list[Fault]:
        # Against what was seen here last: of a drive without SYNC two positions may have come since.
        position, velocity, time = self._last
        self._last = feedback.position, feedback.velocity, feedback.position_time
        dt = feedback.position_time - time
        if self._fresh or not 0.0 < dt < 1.0 or not math.isfinite(velocity):
            self._fresh, self._drift, self._late = False, 0.0, 0.0
            return []
        speed = 0.5 * (feedback.velocity + velocity)
        step = feedback.position - position - speed * dt
        fastest = max(abs(feedback.velocity), abs(velocity))
        decay = math.exp(-dt / DRIFT_TIME)
        self._late = max(self._late * decay, abs(dt - 1.0 / self.drive.rate))
        uncertain = TIME_UNCERTAINTY + self._late
        allowed = self._jump + fastest * uncertain
        name, to_joint = self.drive.name, 1.0 / self._gear
        if abs(step) > allowed:
            detail = f"a step of {step * to_joint:.3f} rad beyond what the speed makes, allowed {allowed * to_joint:.3f} rad"
            return [Fault("encoder_jump", name, detail)]
        self._look_at_standing(feedback, speed, dt)
        if self._still_for >= FEWEST_STILL and abs(self._overdue) > self._still_turn:
            detail = f"its position stands and its speed makes {self._overdue * to_joint:.3f} rad"
            return [Fault("encoder_stuck", name, detail)]
        self._drift = self._drift * decay + step
        allowed = DRIFT_SHARE * self._jump + 2.0 * fastest * uncertain
        if abs(self._drift) > allowed:
            detail = f"{self._drift * to_joint:.3f} rad between position and speed, allowed {allowed * to_joint:.3f} rad"
            return [Fault("encoder_stuck", name, detail)]
        return []

    def _look_at_standing(self, feedback: Feedback, speed: float, dt: float) -> None:
        """Sum what the speed makes while the position stands; noise about zero sums to nothing."""
        if abs(feedback.position - self._anchor) >= 0.5 * self._resolution:
            self._anchor, self._still_for, self._overdue = feedback.position, 0, 0.0
        elif abs(speed) < STILL * self._gear or speed * self._overdue < 0.0:
            self._still_for, self._overdue = 0, 0.0
        else:
            self._still_for, self._overdue = self._still_for + 1, self._overdue + speed * dt
