"""Healthy robots on the manoeuvres of everyday, driven by the loops of their drives: nothing of them is named.

Such a recording says next to nothing of what the robot did not do, and holds the noise of it all the same.
"""

from pathlib import Path

import pytest

from pcw_description import load_robot
from pcw_sim_bridge.mismatch.analysis import analyse
from pcw_sim_bridge.mismatch.subjects.robot_subject import RobotSubject
from pcw_sim_bridge.simulate import main as simulate


@pytest.mark.parametrize(
    ("robot", "excitation", "duration", "seed"),
    [
        # Straight ahead the steerings report noise alone, which casters half as long again would make less of.
        ("thesis", "chirp_x", 20, 2002),
        # At 25 mm/s forces make wheels slip by micrometres, within the counts of their encoders and the noise of torques.
        ("dyros_pcv", "creep", 30, 101025),
        # Behind wheels that spin the robot is late.
        pytest.param("xr4000", "steps", 40, 101001, marks=pytest.mark.nightly),
        pytest.param("flow_base", "chirp_x", 21, 102021, marks=pytest.mark.nightly),
    ],
)
def test_nothing_is_named_of_a_healthy_robot(tmp_path: Path, robot: str, excitation: str, duration: int, seed: int) -> None:
    drive = ["--robot", robot, "--controller", "velocity_loops", "--excite", excitation, "--duration", str(duration)]
    assert simulate([*drive, "--seed", str(seed), "--out", str(tmp_path / "run")]) == 0
    found = analyse(RobotSubject(load_robot(robot)), [tmp_path / "run"], [], {}, 0, lambda message: None).findings
    assert [effect.name for effect in found.effects] == []
    assert found.verdict in ("no_mismatch", "insufficient_data")
