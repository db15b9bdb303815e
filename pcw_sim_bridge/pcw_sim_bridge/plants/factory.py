"""Makes a plant by its name."""

from __future__ import annotations

import math

from pcw_description.robot_description import RobotDescription

from .plant import PLANT_NAMES, Plant, PlantError
from .reduced import ReducedPlant

LONGEST_STEP, SHORTEST_STEP = 1e-3, 1e-4  # [s], by default


def fitting_step(rate: float) -> float:
    """Return the longest step [s] up to 1 ms of which the period of a control loop at `rate` [Hz] is a whole number.

    Periods of three steps and of four in turn would shake a robot, in step with its sensors: an accelerometer that is read
    at every tenth step shows less than there is.
    """
    return max(1.0 / (rate * max(math.ceil(1.0 / (rate * LONGEST_STEP) - 1e-9), 1)), SHORTEST_STEP)


def make_plant(
    name: str, robot: RobotDescription, dt: float | None = None, gui: bool = False, lifted: bool = False
) -> Plant:
    """Make a plant of the robot.

    Args:
        name: "reduced" (planar, compiled), "pybullet" or "mujoco" (three-dimensional).
        robot: the robot, with the effects of its `physics` at work.
        dt: step [s]; None: what fits the robot's encoders, see `fitting_step`.
        gui: show a window (not of the reduced plant).
        lifted: on a jack, the wheels off the ground.

    Raises:
        PlantError: unknown name, an engine that is not installed, or a step that is not in 0.0001 to 0.005 s.
        KinematicsError: the robot cannot be torque controlled.
    """
    if name not in PLANT_NAMES:
        raise PlantError(f"plant {name!r} is not allowed; allowed: {', '.join(PLANT_NAMES)}")
    if dt is None:
        dt = fitting_step(robot.sensors.encoders.rate)
    if not 1e-4 <= dt <= 5e-3:
        raise PlantError(f"dt = {dt!r} s is not allowed; allowed: 0.0001 to 0.005 s")
    robot.require_torque_control()
    if name == "reduced":
        return ReducedPlant(robot, dt, lifted)
    # An engine takes a while to load, and not every machine has both.
    if name == "pybullet":
        from .pybullet_plant import PybulletPlant

        return PybulletPlant(robot, dt, gui, lifted)
    try:
        from .mujoco_plant import MujocoPlant
    except ImportError as error:
        raise PlantError(f"the plant 'mujoco' needs MuJoCo, which cannot be loaded ({error}): pip install mujoco") from error
    return MujocoPlant(robot, dt, gui, lifted)
