"""Loads what is analysed by the format of its description."""

from __future__ import annotations

from pathlib import Path

from pcw_description.axis_recording import FORMAT as AXIS_FORMAT
from pcw_description.description_fields import load_yaml_mapping
from pcw_description.recording import Recording
from pcw_description.robot_description import FORMAT as ROBOT_FORMAT
from pcw_description.robot_file import robot_path, shipped_robots

from ..errors import MismatchError
from .axis_subject import AxisSubject
from .robot_subject import Reader, RobotSubject
from .subject import Subject


def load_subject(description: str, read: Reader = Recording.open) -> Subject:
    """Load a description of either kind.

    Args:
        description: path of a `pcw_robot/1` or `pcw_axis/1` file, or the name of a shipped robot.
        read: opens recordings of a robot.

    Raises:
        PcwError: no such file, or it is not valid.
    """
    path = Path(description)
    if description in shipped_robots() or not path.is_file():
        path = robot_path(description)
    found = load_yaml_mapping(path).get("format")
    if found == AXIS_FORMAT:
        return AxisSubject.load(path)
    if found == ROBOT_FORMAT:
        return RobotSubject.load(path, read)
    raise MismatchError(f"{path}: format is {found!r}; allowed: {ROBOT_FORMAT} or {AXIS_FORMAT}")
