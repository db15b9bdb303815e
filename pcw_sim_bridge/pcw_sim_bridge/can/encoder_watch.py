"""An encoder that stands while its joint turns, found by what the other joints say.

An encoder that has died makes its drive report a position that stands and, as most drives take the speed from it, a speed
of zero: nothing that the drive says is wrong in itself. But n casters have 2 n joints and the robot moves in three ways. With
steps of the motors between two readings, each divided by its own gear,

    d = T A(phi) xi + e,     T_i = diag(1 / |N_jj|) N_i B_i^-1,

where A and B are those of the differential kinematics (3.24), N is the gear matrix and xi the motion of the robot, d is known
in 2 n places and xi has three. From all joints but j, weighted least squares foretell the step of j. With the residual e of
all joints and the leverage h_j of joint j (R. D. Cook and S. Weisberg, Residuals and Influence in Regression, 1982, 2.2),

    d_j foretold = d_j - e_j / (1 - h_j).

A count that stands is to blame once the joint should have turned by more than `allowed`, plus what unknown headings, radii and
slip may make of it, and if without this one joint the others agree: leaving it out takes away EXPLAINED of the sum of squares.

What this does not see: a joint that should not turn either; robots of two casters, whose other joints cannot disagree;
wheels that slip at the same time; and two encoders that died together. A wheel that slides with its brake closed looks the
same.
"""

from __future__ import annotations

import numpy as np

from pcw_description.differential_kinematics import joint_matrix_blocks, wheel_jacobian_kernel
from pcw_description.robot_description import MINIMUM_CASTER_OFFSET, STEER, FloatArray, RobotDescription

FEWEST_CASTERS = 3
# What may be wrong with the others without a fault: slip and radii, as a share of each step, and headings [rad].
SLIP_SHARE, HEADING_ERROR = 0.1, 0.05
EXPLAINED = 0.85
LARGEST_LEVERAGE = 0.9  # above, a joint's step is what its own encoder alone tells
FEWEST_STEPS = 4


class EncoderWatch:
    """Watches the encoders of one robot.

    Args:
        robot: the robot.
        allowed: turn of each joint while its count stands, (n, 2) [rad].
        resolution: of each count, as a turn of its joint, (n, 2) [rad].

    Attributes:
        usable: the robot has casters enough, all with an offset, and no fixed axle.
    """

    def __init__(self, robot: RobotDescription, allowed: FloatArray, resolution: FloatArray) -> None:
        n = robot.n
        self._robot = robot
        self.usable = bool(
            n >= FEWEST_CASTERS
            and (np.abs(robot.caster_offset[:, 0]) >= MINIMUM_CASTER_OFFSET).all()
            and len(robot.fixed_axle) == 0
        )
        own = np.abs(np.stack([robot.gear_matrix[:, 0, 0], robot.gear_matrix[:, 1, 1]], axis=1))
        self._to_motor = robot.gear_matrix / own[:, :, None]
        self._rows = self._to_motor @ np.linalg.inv(joint_matrix_blocks(robot)) if self.usable else np.zeros((n, 2, 2))
        self._resolution = resolution.ravel()
        self._allowed = allowed.ravel() + 3.0 * self._resolution
        self.forget()

    def forget(self) -> None:
        """Start afresh: the next reading is compared with none."""
        size = 2 * self._robot.n
        self._previous: FloatArray | None = None
        self._headings = np.zeros(self._robot.n)
        self._anchor = np.zeros(size)  # where each count last stood still
        self._steps = np.zeros(size)
        self._foretold = np.zeros(size)  # turn since then
        self._doubt = np.zeros(size)  # how much of it may be wrong
        self._residuals = np.zeros((size, size))  # of all joints, summed since then

    def look(self, position: FloatArray) -> list[tuple[int, float]]:
        """Take the joints' angles (n, 2) [rad], all of one instant; return the joints to blame and their foretold turns [rad].

        Joints are numbered as in `robot.joint_names`.
        """
        if not self.usable:
            return []
        motor = np.matmul(self._to_motor, position[:, :, None]).ravel()
        headings = position[:, STEER]
        if self._previous is None:
            self._previous, self._anchor, self._headings = motor, motor.copy(), headings.copy()
            return []
        step, middle = motor - self._previous, 0.5 * (headings + self._headings)
        self._previous, self._headings = motor, headings.copy()
        moved = np.abs(motor - self._anchor) >= 0.5 * self._resolution
        self._anchor[moved] = motor[moved]
        self._steps[moved] = self._foretold[moved] = self._doubt[moved] = 0.0
        self._residuals[moved] = 0.0
        if moved.all() or not moved.any():
            return []  # nothing stands, or the robot does
        rows = self._motion_rows(middle)
        turned = self._motion_rows(middle + HEADING_ERROR) - rows
        motion = np.linalg.inv(rows.T @ rows) @ (rows.T @ step)
        # One level of slip for all joints: by its own small step a dead encoder would seem the surest, and have its way.
        slip = SLIP_SHARE * float(np.sqrt(np.mean(step**2)))
        sigma = self._resolution + slip + np.abs(turned @ motion)
        scaled = rows / sigma[:, None]
        inverse = np.linalg.inv(scaled.T @ scaled)
        motion = inverse @ (scaled.T @ (step / sigma))
        residual = step - rows @ motion
        leverage = np.einsum("ij,jk,ik->i", scaled, inverse, scaled)
        left = np.maximum(1.0 - leverage, 1.0 - LARGEST_LEVERAGE)
        standing = ~moved
        foretold = (step - residual / left)[standing]
        self._steps[standing] += 1
        self._foretold[standing] += foretold
        self._doubt[standing] += SLIP_SHARE * np.abs(foretold) + np.abs(turned @ motion)[standing]
        self._residuals[standing] += residual
        suspects = (
            standing
            & (np.abs(self._foretold) - self._doubt > self._allowed)
            & (self._steps >= FEWEST_STEPS)
            & (leverage < LARGEST_LEVERAGE)
        )
        found = []
        for joint in np.flatnonzero(suspects):
            own = (self._residuals[joint, joint] / sigma[joint]) ** 2 / left[joint]
            # Positions of drives without SYNC are up to a period apart: a step of each other joint says nothing.
            others = np.maximum(np.abs(self._residuals[joint]) - np.abs(step), 0.0) / sigma
            others[joint] = 0.0
            if own >= EXPLAINED * (own * left[joint] + float(others @ others)):
                found.append((int(joint), float(self._foretold[joint])))
        return found

    def _motion_rows(self, headings: FloatArray) -> FloatArray:
        """Return T A (2n, 3) for headings (n,)."""
        jacobian = wheel_jacobian_kernel(self._robot.steer_axis, self._robot.caster_offset, headings)
        rows: FloatArray = np.matmul(self._rows, jacobian.reshape(self._robot.n, 2, 3)).reshape(-1, 3)
        return rows
