"""What the mismatch monitor says: the topic `mismatch`, and plain words for /diagnostics."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from sensor_msgs.msg import JointState

from pcw_description.nodes.diagnostics import ERROR, OK, WARN, Status
from pcw_description.nodes.node_tools import ns_to_stamp

from ..mismatch.live.live_channels import ChannelState, Judgement, Level
from ..mismatch.live.live_rows import NANOSECONDS

LEVELS = {Level.OK: OK, Level.WARN: WARN, Level.ERROR: ERROR}


def mismatch_message(channels: Sequence[ChannelState], stamp: float) -> JointState:
    """The channels that could be judged, at the stamp of the newest judged row [s]."""
    message = JointState(
        name=[channel.name for channel in channels],
        position=[channel.normalised for channel in channels],
        effort=[channel.residual for channel in channels],
    )
    message.header.stamp = ns_to_stamp(round(stamp * NANOSECONDS))
    return message


def departure_text(judgement: Judgement) -> str:
    """Say in one line what departs, by how much, since when and where."""
    departing = [channel for channel in judgement.channels if channel.level is not Level.OK]
    worst = max(departing, key=lambda channel: channel.normalised)
    text = f"{worst.name} {_said(worst, judgement.stamp)}"
    others = [channel.name for channel in departing if channel is not worst]
    if others:
        text += f", and {', '.join(others)} too"
    return text if judgement.suspect is None else f"{text}; {judgement.suspect}"


def channel_statuses(judgement: Judgement | None) -> Mapping[str, Status]:
    """One status per channel; none before there is something to hold it against."""
    if judgement is None or not judgement.ready:
        return {}
    found = {}
    for channel in judgement.channels:
        values = {"normalised": channel.normalised, f"residual [{channel.unit}]": channel.residual}
        found[channel.name] = Status(LEVELS[channel.level], _said(channel, judgement.stamp), values)
    for name in judgement.silent:
        found[name] = Status(OK, "not judged now: standing still, slipping, or its sensor is silent")
    return found


def _said(channel: ChannelState, stamp: float | None) -> str:
    if channel.since is None:
        return f"within {channel.normalised:.1f} deviations of a healthy robot"
    ago = "" if stamp is None else f", {max(stamp - channel.since, 0.0):.1f} s ago"
    size = max(channel.normalised, channel.lasting)
    return f"departs by {size:.1f} deviations, since stamp {channel.since:.3f} s{ago}"
