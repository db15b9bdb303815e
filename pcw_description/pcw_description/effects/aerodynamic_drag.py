"""Resistance of the air, or of anything else that grows with the square of the speed."""

import math

from ..compiled import compiled_array_kernel
from .effect import EffectParameter
from .kinds import COM_X, COM_Y, COM_Z, TWIST_X, TWIST_Y, TWIST_YAW, ChassisForceEffect


@compiled_array_kernel
def drag(at, parameters, result):  # type: ignore[no-untyped-def]
    """Add -coefficient |v| v at the centre of mass, v being its velocity."""
    v_x = at[TWIST_X] - at[TWIST_YAW] * at[COM_Y]
    v_y = at[TWIST_Y] + at[TWIST_YAW] * at[COM_X]
    size = -parameters[0] * math.sqrt(v_x * v_x + v_y * v_y)
    force_x, force_y = size * v_x, size * v_y
    result[0] += force_x
    result[1] += force_y
    result[3] -= at[COM_Z] * force_y
    result[4] += at[COM_Z] * force_x
    result[5] += at[COM_X] * force_y - at[COM_Y] * force_x


EFFECT = ChassisForceEffect(
    name="aerodynamic_drag",
    target_kind="chassis",
    axis="chassis",
    summary="A force against the motion that grows with the square of the speed.",
    sentence="A drag of {coefficient:.3g} N s^2/m^2 on the chassis.",
    parameters=(EffectParameter("coefficient", "N s^2/m^2", "force per speed squared", 0.0, 1e4, 1.0, linear=True),),
    sensors=("joint_states", "imu/data"),
    look_alikes=("drive_viscous_friction", "drive_coulomb_friction"),
    separating_experiment="hold several constant speeds up to the fastest, or let the robot coast down",
    wrench=drag,
)
