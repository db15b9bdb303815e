"""Singularity analysis for full and selective actuation, section 3.2.4 [Li2009].

With all joints locked that are actuated, the twists V that remain possible are the null space of the actuated rows of
B^-1 A. A configuration is singular where those rows have a rank below three (fig. 3.6): the robot then cannot resist a
wrench in that direction although every motor holds.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import numpy.typing as npt

from .differential_kinematics import wheel_centres, wheel_jacobian
from .errors import KinematicsError
from .robot_description import FloatArray, RobotDescription


@dataclasses.dataclass(frozen=True)
class SingularityAnalysis:
    """How well the actuated joints hold the robot in one configuration.

    Attributes:
        rank: number of directions that are held.
        smallest_singular_value: of the actuated rows, scaled by the size of the robot [1]; 0 where singular.
        free_twists: twists that remain possible, (3 - rank, 3), unit length in scaled coordinates.
    """

    rank: int
    smallest_singular_value: float
    free_twists: FloatArray

    @property
    def singular(self) -> bool:
        """Whether a direction is free."""
        return self.rank < 3


def full_actuation_determinant(robot: RobotDescription, steer_angle: FloatArray) -> float:
    """Return det(A^T A) = n (n sum |p|^2 - |sum p|^2), (3.34); positive for any two distinct wheels."""
    p = wheel_centres(robot, steer_angle)
    return float(robot.n * (robot.n * np.sum(p**2) - np.sum(np.sum(p, axis=0) ** 2)))


def analyse(
    robot: RobotDescription, steer_angle: FloatArray, actuated: npt.NDArray[np.bool_], tolerance: float = 1e-9
) -> SingularityAnalysis:
    """Analyse one configuration.

    Args:
        robot: the robot.
        steer_angle: headings (n,) [rad].
        actuated: which joints hold, (n, 2) bool, in the order (drive, steer).
        tolerance: singular values below this, relative to the largest possible one, count as zero.

    Raises:
        KinematicsError: `actuated` has another shape, or the robot has fixed wheels.
    """
    rows = _actuated_rows(robot, steer_angle, actuated)
    if rows.size == 0:
        return SingularityAnalysis(0, 0.0, np.eye(3))
    _, values, directions = np.linalg.svd(rows, full_matrices=True)
    padded = np.zeros(3)
    padded[: len(values)] = values
    rank = int(np.sum(padded > tolerance * np.sqrt(2 * robot.n)))
    return SingularityAnalysis(rank, float(padded[2]), directions[rank:])


def find_singular_configuration(
    robot: RobotDescription, actuated: npt.NDArray[np.bool_], seed: int = 0, starts: int = 20
) -> tuple[FloatArray, SingularityAnalysis]:
    """Search the headings for the configuration that is held worst.

    Returns:
        Headings (n,) [rad] and their analysis; it is singular wherever the actuation has singular configurations.
    """
    # Here, since it takes half a second, for which every node that starts would wait.
    from scipy.optimize import minimize

    rng = np.random.default_rng(seed)

    def held(angles: FloatArray) -> float:
        return analyse(robot, angles, actuated).smallest_singular_value

    best = min(
        (
            minimize(
                held, rng.uniform(-np.pi, np.pi, robot.n), method="Nelder-Mead",
                options={"xatol": 1e-13, "fatol": 1e-13, "maxiter": 4000},
            )
            for _ in range(starts)
        ),
        key=lambda result: float(result.fun),
    )
    return best.x, analyse(robot, best.x, actuated, tolerance=1e-6)


def _actuated_rows(robot: RobotDescription, steer_angle: FloatArray, actuated: npt.NDArray[np.bool_]) -> FloatArray:
    """Return the actuated rows, lengths scaled by the robot's radius so that singular values are comparable."""
    robot.require_casters_only("singularities of selective actuation")
    actuated = np.asarray(actuated, dtype=bool)
    if actuated.shape != (robot.n, 2):
        raise KinematicsError(f"actuated has the shape {actuated.shape}; allowed: ({robot.n}, 2), drive and steer per caster")
    rows = wheel_jacobian(robot, steer_angle).reshape(robot.n, 2, 3).copy()
    held = actuated.copy()
    for i, (b_x, b_y) in enumerate(robot.caster_offset):
        if b_x != 0.0:
            # Locking only the drive of a wheel with lateral offset mixes the rows: rho_dot = (u.v - b_y phi_dot) / r.
            rows[i, 0] += b_y / b_x * rows[i, 1]
        else:
            # Without b_x no joint moves the wheel across its heading, locked or not; and beside its axis (b_y) a wheel with
            # a locked drive still follows the robot by steering.
            held[i, 1] = True
            held[i, 0] = actuated[i, 0] and (actuated[i, 1] or b_y == 0.0)
    size = float(np.max(np.linalg.norm(robot.steer_axis - robot.steer_axis.mean(axis=0), axis=1)))
    rows[:, :, 2] /= size
    selected: FloatArray = rows[held]
    return selected
