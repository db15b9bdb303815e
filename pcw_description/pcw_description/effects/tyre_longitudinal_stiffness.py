"""A tyre stiffer or softer along than described: the slope of its friction curve at zero slip."""

import dataclasses
from collections.abc import Mapping, Sequence

from ..robot_description import ContactDescription, RobotDescription
from .effect import EffectParameter
from .kinds import DescriptionEffect


def with_other_stiffness(robot: RobotDescription, target: Sequence[str], parameters: Mapping[str, float]) -> RobotDescription:
    """Return the robot whose targets reach the peak of friction at 1 / (1 + error) of the described slip."""

    def change(tyre: ContactDescription) -> ContactDescription:
        return dataclasses.replace(tyre, lambda_p=tyre.lambda_p / (1.0 + parameters["error"]))

    return robot.with_tyres(target, change)


EFFECT = DescriptionEffect(
    name="tyre_longitudinal_stiffness",
    target_kind="caster",
    axis="drive",
    summary="The tyre is stiffer or softer along than described; its peak friction is the same, at another slip.",
    sentence="The stiffness of the tyre of {target} along the wheel differs by {error:+.3g} of the described one.",
    # What a tyre slips is in proportion to the inverse of its stiffness.
    parameters=(
        EffectParameter(
            "error", "1", "relative error of the stiffness", -0.9, 10.0, 0.3, reciprocal=True, pole=-1.0, neutral=0.0
        ),
    ),
    sensors=("joint_states", "imu/data", "ground_truth/odom"),
    look_alikes=("tyre_lateral_stiffness", "tyre_relaxation", "wheel_radius_error"),
    separating_experiment="accelerate and brake hard at several speeds",
    apply=with_other_stiffness,
)
