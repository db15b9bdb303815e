"""A sensor whose stamps come from another clock than those of the joints."""

from collections.abc import Mapping

from .effect import EffectParameter
from .kinds import ClockEffect


def offset_of_topic(topic: str, parameters: Mapping[str, float]) -> float:
    """Return what is added to the stamps of a topic [s]."""
    return {"imu/data": parameters["offset"], "ground_truth/odom": parameters["tracker_offset"]}.get(topic, 0.0)


EFFECT = ClockEffect(
    name="clock_offset",
    target_kind="clock",
    axis="clock",
    summary="The stamps of a sensor come from a clock ahead of, or behind, that of the joints.",
    sentence="The IMU's stamps are {offset:+.3g} s ahead of the joints' clock, the tracker's {tracker_offset:+.3g} s.",
    parameters=(
        EffectParameter("offset", "s", "stamp of the IMU minus true time", -1.0, 1.0, 0.005, near_linear=True),
        EffectParameter("tracker_offset", "s", "stamp of the tracker minus true time", -1.0, 1.0, 0.02, default=0.0),
    ),
    sensors=("imu/data", "ground_truth/odom"),
    look_alikes=("actuator_delay", "imu_lever_arm"),
    separating_experiment="change the motion quickly, by chirps or steps; on a circle a late stamp cannot be seen",
    offset=offset_of_topic,
)
