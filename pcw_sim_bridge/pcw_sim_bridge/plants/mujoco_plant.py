"""The robot in MuJoCo: rigid bodies by MuJoCo, everything else by `spatial_plant`.

MuJoCo takes rotors as what they are, N^T J N on the joint rates: each is a fixed tendon over the joints that turn it, with
an armature. So nothing of `contact_wrench`'s corrections for PyBullet's rotors is in its results.
"""

from __future__ import annotations

import warnings

import mujoco
import numpy as np

from pcw_description.compiled import compiled
from pcw_description.robot_description import DRIVE, STEER, FloatArray, RobotDescription
from pcw_description.urdf import robot_urdf

from .plant import PlantError
from .spatial_contact import rotation_matrix
from .spatial_plant import SpatialPlant

# Pictures per simulated second in the viewer; more would cost more than the simulation.
PICTURE_RATE = 60.0


class MujocoPlant(SpatialPlant):
    """The MuJoCo plant of one robot; arguments and errors are those of `SpatialPlant`."""

    def __init__(self, robot: RobotDescription, dt: float = 1e-3, gui: bool = False, lifted: bool = False) -> None:
        super().__init__(MujocoEngine, robot, dt, gui, lifted)


def mujoco_spec(robot: RobotDescription, held: bool) -> mujoco.MjSpec:
    """Return the bodies and rotors of a robot, its base free or, if held, placed by `mocap_pos` and `mocap_quat`.

    Raises:
        DescriptionError: a module that no fork and wheel make up (a loaded description has none).
    """
    # A fixed base would be merged into the world, and what is only looked at would be left out.
    keep = '<mujoco><compiler fusestatic="false" discardvisual="false"/></mujoco></robot>'
    spec = mujoco.MjSpec.from_string(robot_urdf(robot).replace("</robot>", keep))
    base = spec.body("base_link")
    if held:
        base.mocap = True
    else:
        base.add_freejoint()
    for caster, gear in zip(robot.casters, robot.gear_matrix, strict=True):
        for axis, rotor in ((DRIVE, caster.rotors.drive), (STEER, caster.rotors.steer)):
            if rotor > 0.0:
                tendon = spec.add_tendon(name=f"{caster.name}_rotor_{axis}", armature=rotor)
                tendon.wrap_joint(f"{caster.name}_drive", gear[axis, DRIVE])
                tendon.wrap_joint(f"{caster.name}_steer", gear[axis, STEER])
    return spec


class MujocoEngine:
    """The bodies of one robot in MuJoCo.

    Args:
        robot: the robot as it really is.
        gravity: (3,) [m/s^2].
        dt: step [s].
        gui: show MuJoCo's viewer.
        held: the base does not move.

    Raises:
        PlantError: the viewer finds no display.
    """

    def __init__(self, robot: RobotDescription, gravity: FloatArray, dt: float, gui: bool, held: bool) -> None:
        self.body_rotors = np.zeros((robot.n, 2, 2))
        self._held = held
        self._com_in_base = np.array(robot.chassis.com)
        self._model = mujoco_spec(robot, held).compile()
        option = self._model.opt
        option.gravity[:] = gravity
        option.timestep = dt
        # All forces come from outside.
        option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
        self._data = data = mujoco.MjData(self._model)
        # Views of MuJoCo's state, which stays where it is; asking for one takes longer than using it.
        self._position, self._velocity, self._torque = data.qpos, data.qvel, data.qfrc_applied
        self._wrench = data.xfrc_applied[self._model.body("base_link").id]
        # The free joint of the base: origin of the link and quaternion (w, x, y, z); velocity of the origin in world axes
        # and angular velocity in the axes of the link. A held base has none.
        self._frame = np.zeros(7) if held else self._position[:7]
        self._frame_velocity = np.zeros(6) if held else self._velocity[:6]
        joints = [self._model.joint(name).id for name in robot.joint_names]
        self._position_index = self._model.jnt_qposadr[joints].reshape(-1, 2)
        self._velocity_index = self._model.jnt_dofadr[joints].reshape(-1, 2)
        self._steps_per_picture = max(1, round(1.0 / (PICTURE_RATE * dt)))
        self._steps = 0
        self._viewer = _open_viewer(self._model, self._data) if gui else None

    def place(self, position: FloatArray, quaternion: FloatArray) -> None:
        """Put the base link's centre of mass (3,) [m] somewhere, at rest, turned by a quaternion (x, y, z, w)."""
        self._frame[:3] = position - rotation_matrix(quaternion) @ self._com_in_base
        self._frame[3:] = np.roll(quaternion, 1)
        self._frame_velocity[:] = 0.0
        if self._held:
            self._data.mocap_pos[0], self._data.mocap_quat[0] = self._frame[:3], self._frame[3:]

    def put_joints(self, position: FloatArray, velocity: FloatArray) -> None:
        """Give the joints angles and rates (n, 2)."""
        self._position[self._position_index] = position
        self._velocity[self._velocity_index] = velocity

    def set_velocity(self, linear: FloatArray, angular: FloatArray) -> None:
        """Give the base link's centre of mass velocities (3,) in world axes."""
        rotation = rotation_matrix(np.roll(self._frame[3:], -1))
        self._frame_velocity[:3] = linear - np.cross(angular, rotation @ self._com_in_base)
        self._frame_velocity[3:] = rotation.T @ angular

    def read(self, base: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Fill `base` (BASE_STATE,) and return joint angles and rates (n, 2)."""
        _motion_of_centre_of_mass(self._frame, self._frame_velocity, self._com_in_base, base)
        return self._position[self._position_index], self._velocity[self._velocity_index]

    def advance(self, wrench: FloatArray, joint_torque: FloatArray) -> None:
        """Make one step under a wrench (6,) at the base link's centre of mass, world axes, and joint torques (n, 2)."""
        self._wrench[:] = wrench
        self._torque[self._velocity_index] = joint_torque
        # Velocities first, positions from the new ones. The forces are held over a step, so a higher order has nothing to
        # gain; and a spring that acts explicitly, as those of the suspension, keeps its energy this way and gains some
        # under MuJoCo's Runge-Kutta. There is no damping in the model that an implicit scheme could take. `mj_step` would
        # do the same, but writes a file and starts anew where a state has left all bounds, instead of showing it.
        mujoco.mj_forward(self._model, self._data)
        mujoco.mj_Euler(self._model, self._data)
        self._steps += 1
        if self._viewer is not None and self._steps % self._steps_per_picture == 0:
            self._viewer.sync()

    def close(self) -> None:
        """Close the viewer; closing twice does nothing."""
        if self._viewer is not None:
            self._viewer.close()
            self._viewer = None


@compiled
def _motion_of_centre_of_mass(frame, frame_velocity, com_in_base, base):  # type: ignore[no-untyped-def]
    """Fill `base` (BASE_STATE,) from a free joint's state (7,) and velocity (6,)."""
    base[3:6], base[6] = frame[4:7], frame[3]
    rotation = rotation_matrix(base[3:7])
    arm = rotation @ com_in_base
    base[0:3] = frame[0:3] + arm
    angular = rotation @ frame_velocity[3:6]
    base[7] = frame_velocity[0] + angular[1] * arm[2] - angular[2] * arm[1]
    base[8] = frame_velocity[1] + angular[2] * arm[0] - angular[0] * arm[2]
    base[9] = frame_velocity[2] + angular[0] * arm[1] - angular[1] * arm[0]
    base[10:13] = angular


def _open_viewer(model: mujoco.MjModel, data: mujoco.MjData) -> mujoco.viewer.Handle:
    import mujoco.viewer as viewer  # needs libraries of a desktop, which a simulation without a window does not

    # Where no display is, the viewer would end the process.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        has_display = viewer.glfw.init()
    if not has_display:
        raise PlantError("MuJoCo could not start its window; is a display there?")
    return viewer.launch_passive(model, data, show_left_ui=False, show_right_ui=False)
