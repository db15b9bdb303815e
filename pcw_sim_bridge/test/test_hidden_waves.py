"""Waves of a floor that a first look was only next to, beside an effect that is named as another one while they hide."""

from pathlib import Path

import numpy as np
import pytest

from pcw_description import load_robot
from pcw_sim_bridge.mismatch.analysis import analyse
from pcw_sim_bridge.mismatch.search.evidence_selection import EffectSearch
from pcw_sim_bridge.mismatch.subjects.robot_subject import RobotSubject
from pcw_sim_bridge.simulate import main as simulate

WAVES = "{name: uneven_ground, target: [front_left, front_right, rear_left, rear_right], amplitude: 0.002, direction: 0.7}"
SCRUB = "{name: scrub_torque, target: [rear_right], radius: 0.01}"


@pytest.mark.nightly  # a whole analysis of a minute
def test_waves_next_to_a_grid_are_found_and_what_was_named_for_them_is_not(tmp_path: Path) -> None:
    """A wheel that scrubs was, surely, a steering that gives half of its torque, and of the waves a leftover was told."""
    drive = ["--robot", "thesis", "--plant", "mujoco", "--controller", "velocity_loops", "--excite", "figure8"]
    physics = ["--physics", f"[{SCRUB}, {WAVES}]"]
    assert simulate([*drive, "--duration", "40", "--seed", "841001", *physics, "--out", str(tmp_path / "run")]) == 0
    said: list[str] = []
    found = analyse(RobotSubject(load_robot("thesis")), [tmp_path / "run"], [], {}, 0, said.append).findings
    print("\n".join(said))
    effects = {effect.name: effect for effect in found.effects}
    assert sorted(effects) == ["scrub_torque", "uneven_ground"]
    assert effects["scrub_torque"].target == ("rear_right",)
    waves = effects["uneven_ground"].parameters
    assert waves["amplitude"].value == pytest.approx(0.002, rel=0.05)
    assert waves["wavelength"].value == pytest.approx(1.0, rel=0.01)
    assert waves["direction"].value == pytest.approx(0.7, abs=0.02)


@pytest.mark.parametrize(("physics", "found"), [(["--physics", f"[{WAVES}]"], True), ([], False)])
def test_a_wave_is_searched_from_what_a_first_look_saw(tmp_path: Path, physics: list[str], found: bool) -> None:
    """Where nothing else is named yet; and a floor that is even costs no search."""
    drive = ["--robot", "thesis", "--controller", "velocity_loops", "--excite", "figure8", "--duration", "29", "--seed", "7"]
    assert simulate([*drive, *physics, "--out", str(tmp_path / "run")]) == 0
    subject = RobotSubject(load_robot("thesis"))
    problem = subject.problem([subject.open(tmp_path / "run", "fit", {})])
    search = EffectSearch(problem, np.random.default_rng(0))
    nothing = search.conclude((), 9.0)
    selection = search.with_hidden_waves(nothing)
    if not found:
        assert selection is nothing
        return
    named = {problem.terms[instance.term].effect: dict(instance.shape) for instance in selection.fit.instances}
    assert list(named) == ["uneven_ground"]
    assert named["uneven_ground"]["wavelength"] == pytest.approx(1.0, rel=0.01)
    assert named["uneven_ground"]["direction"] == pytest.approx(0.7, abs=0.02)
