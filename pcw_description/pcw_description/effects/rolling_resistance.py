"""Rolling resistance of the tyre: a torque proportional to the load on the wheel, against rolling."""

from ..compiled import compiled_joint_torque
from .drive_coulomb_friction import SMOOTHING_SPEED, smooth_sign
from .effect import EffectParameter
from .kinds import JointTorqueEffect


@compiled_joint_torque
def rolling_resistance_torque(position, velocity, motor_torque, normal_force, parameters):  # type: ignore[no-untyped-def]
    """Return -arm F_z sgn(v), with a smoothed sign [N m]."""
    sign, level = smooth_sign(velocity, parameters[1]), parameters[0] * normal_force
    return -level * sign, level * (1.0 - sign * sign) / parameters[1]


EFFECT = JointTorqueEffect(
    name="rolling_resistance",
    target_kind="caster",
    axis="drive",
    summary="The tyre's deformation moves the normal force ahead of the axle by a small arm.",
    sentence="Rolling resistance with an arm of {arm:.3g} m at {target}.",
    parameters=(
        EffectParameter("arm", "m", "distance of the normal force ahead of the axle", 0.0, 0.05, 1e-3, linear=True),
        SMOOTHING_SPEED,
    ),
    sensors=("joint_states",),
    look_alikes=("drive_coulomb_friction",),
    separating_experiment=(
        "load the wheels unevenly (shift a payload): rolling resistance follows the load, drive friction does not"
    ),
    # Tyres of one set roll alike: one that alone resists is rarer than a drive with friction.
    log_prior=-0.5,
    torque=rolling_resistance_torque,
)
