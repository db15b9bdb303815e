"""Makes a plant by its name."""

from __future__ import annotations

from pcw_description.robot_description import RobotDescription

from .plant import PLANT_NAMES, Plant, PlantError
from .reduced import ReducedPlant


def make_plant(name: str, robot: RobotDescription, dt: float = 1e-3, gui: bool = False, lifted: bool = False) -> Plant:
    """Make a plant of the robot.

    Args:
        name: "reduced" (planar, compiled), "pybullet" or "mujoco" (three-dimensional).
        robot: the robot, with the effects of its `physics` at work.
        dt: step [s].
        gui: show a window (not of the reduced plant).
        lifted: on a jack, the wheels off the ground.

    Raises:
        PlantError: unknown name, an engine that is not installed, or a step that is not in 0.0001 to 0.005 s.
        KinematicsError: the robot cannot be torque controlled.
    """
    if name not in PLANT_NAMES:
        raise PlantError(f"plant {name!r} is not allowed; allowed: {', '.join(PLANT_NAMES)}")
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
