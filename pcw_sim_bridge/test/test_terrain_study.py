"""Ground that nobody knows, found from angles and torques by slip on purpose: robot, observer and plant together."""

import dataclasses

import numpy as np
import pytest

from pcw_control.controllers import make_controller
from pcw_description import load_robot
from pcw_sim_bridge import terrain_study, terrain_traction
from pcw_sim_bridge.closed_loop import run_closed_loop
from pcw_sim_bridge.split_friction import draw_manoeuvre
from pcw_sim_bridge.terrain_study import active_run, on_ground, random_ground, summarise
from pcw_terrain import Refusal

THESIS = load_robot("thesis")


def check(run, mu_p, lambda_p, slip_error=0.12):
    assert run.refusal == "" and run.valid.all()
    assert np.abs(run.mu_p / mu_p - 1.0).max() < 0.06
    assert np.median(np.abs(run.lambda_p / lambda_p - 1.0)) < slip_error
    assert run.duration <= 4.0


def test_the_ground_is_found_from_angles_and_torques_and_the_path_is_kept():
    """The robot file says 0.8 and 0.1; the ground is another one."""
    run = active_run(on_ground(THESIS, 0.55, 0.08), THESIS, "reduced", 3, "angle")
    check(run, 0.55, 0.08)
    assert max(run.along, run.across) < 0.005


@pytest.mark.nightly
def test_the_path_is_kept_where_the_others_creep_far_more_than_believed():
    """Four times the creep of the robot file's ground: the first test learns it, and odometry takes back what it missed.

    What it took back was once reckoned from the creep that was believed before and not from the one in use: 10 mm of path.
    """
    run = active_run(on_ground(THESIS, 0.38, 0.179), THESIS, "reduced", 1, "angle")
    check(run, 0.38, 0.179)
    assert np.hypot(run.trace[:, 1], run.trace[:, 2]).max() <= 0.005
    assert set(run.trace[:, 4]) == {-1.0, 0.0, 1.0, 2.0, 3.0}


@pytest.mark.nightly
@pytest.mark.parametrize("seed", [310, 301])
def test_soft_tyres_do_not_shake_the_robot_until_a_test_is_ended(seed):
    """mu_p 0.33 and 0.37, lambda_p 0.16 and 0.17, where 0.8 and 0.1 are believed: "another wheel slips", it said.

    It did: controller, tyres and observer shook each other, as the controller was given the velocity of the wheels' centres.
    """
    ground = random_ground(seed)
    run = active_run(on_ground(THESIS, *ground), THESIS, "reduced" if seed == 310 else "pybullet", seed, "angle")
    check(run, *ground)
    assert np.abs(run.lambda_p / ground[1] - 1.0).max() < 0.12
    assert np.hypot(run.along, run.across) < 0.005


def test_a_test_ends_before_the_path_is_lost_where_another_wheel_slips():
    """The wheel opposite of the first one tested stands on worse ground: it was let slip by 0.37, the path went by 8 mm."""
    opposite = THESIS.casters[2].name
    worse = on_ground(THESIS, 0.55, 0.15).with_tyres(
        [opposite], lambda tyre: on_ground(dataclasses.replace(THESIS, contact=tyre), 0.25, 0.15).contact
    )
    run = active_run(worse, THESIS, "reduced", 5, "angle")
    assert run.refusal == Refusal.OTHERS_SLIP.value and not run.valid.any()
    assert np.hypot(run.along, run.across) < 0.005


@pytest.mark.nightly
@pytest.mark.parametrize("measured", ["angle", "speed"])
@pytest.mark.parametrize("seed", [2, 4])
def test_another_engine_gives_the_same(seed, measured):
    ground = random_ground(seed)
    check(active_run(on_ground(THESIS, *ground), THESIS, "pybullet", seed, measured), *ground)


def test_drives_that_are_too_weak_to_slip_are_told_and_the_robot_drives_on():
    tidybot = load_robot("tidybot2")
    run = active_run(tidybot, tidybot, "reduced", 0, "speed")
    assert "not enough torque" in run.refusal and not run.valid.any()
    assert max(run.along, run.across) < 0.002


@pytest.mark.parametrize(
    "heading", [0.79, *(pytest.param(h, marks=pytest.mark.nightly) for h in (0.4, 0.5, 1.2, 1.57, 2.0, 2.4))]
)
def test_the_direction_makes_no_difference(heading):
    """Of four casters two to three were tested at these: the others would have come too near what they hold."""
    run = active_run(on_ground(THESIS, 0.55, 0.08), THESIS, "reduced", 1, "speed", heading=heading)
    check(run, 0.55, 0.08)
    assert np.hypot(run.along, run.across) < 0.005


def test_traction_control_with_terrain_in_the_loop_needs_no_known_friction():
    """The bar is 1.3 of what the same controller does that is told the truth; seeds are not those of the document."""
    found = {way: [] for way in ("truth", "terrain", "file")}
    for seed in range(300, 304):
        manoeuvre = draw_manoeuvre(THESIS, "split", "beyond", seed)
        for way, slips in found.items():
            slips.append(terrain_traction.slip_when_told(THESIS, manoeuvre, way, seed))
    truth, terrain, file = (np.median(slips) for slips in found.values())
    assert terrain <= 1.3 * truth < file


def test_what_the_controller_is_told_begins_with_the_robot_file_and_ends_with_the_ice():
    manoeuvre = draw_manoeuvre(THESIS, "split", "beyond", 301)
    truth, loop = terrain_traction.true_friction(THESIS, manoeuvre), terrain_traction.TerrainInTheLoop(THESIS)
    np.testing.assert_array_equal(loop.friction().mu_p, 0.8)
    controller = make_controller(terrain_traction.CONTROLLER, THESIS)
    run_closed_loop(
        manoeuvre.robot, controller, manoeuvre.trajectory.sample, manoeuvre.trajectory.duration, "reduced", 301,
        manoeuvre.steer_angle, measure=loop.tell, observe=loop.observe,
    )  # fmt: skip
    told = loop.friction().mu_p
    assert np.argmin(told) == np.argmin(truth) and told.min() < 0.4 * np.median(told)


def test_the_study_of_traction_writes_data_and_page(tmp_path, monkeypatch):
    slips = {"truth": 0.005, "terrain": 0.006, "file": 0.011, "within 10 %": 0.0055}
    monkeypatch.setattr(terrain_traction, "slip_when_told", lambda robot, manoeuvre, way, seed, plant: slips[way])
    assert terrain_traction.main(["--seeds", "2", "--plants", "reduced", "--out", str(tmp_path)]) == 0
    text = (tmp_path / "terrain_traction.md").read_text()
    assert "| thesis, reduced | split | beyond | 2 | 5.0 | 6.0 | 11.0 | 5.5 | 1.20 | 1.20 | 1.20 | 2.20 | met |" in text
    assert len((tmp_path / "terrain_traction.csv").read_text().splitlines()) == 1 + 2 * 2 * 4


def test_a_summary_counts_what_was_found():
    run = terrain_study.ActiveRun(
        np.array([0.5, 0.6, np.nan, 0.5]), np.array([0.1, 0.1, np.nan, 0.12]), np.tile(0.01 * np.eye(2), (4, 1, 1)),
        np.array([True, True, False, True]), 3.0, "cancelled", 3e-3, 4e-3, 1e-3, 3e-3,
    )  # fmt: skip
    found = summarise([[(0.5, 0.1), (0.5, 0.1), (0.5, 0.1), (0.25, 0.1)]], [run])
    assert (found.tests, found.valid, found.refusals) == (4, 3, ("cancelled",))
    assert found.mu_median == pytest.approx(np.log(1.2)) and found.mu_worst == pytest.approx(np.log(2.0))
    assert found.path_worst == pytest.approx(5e-3) and found.covered == (pytest.approx(2 / 3), pytest.approx(1.0))


def test_the_study_writes_its_document(tmp_path, monkeypatch):
    run = terrain_study.ActiveRun(
        np.full(4, 0.5),
        np.full(4, 0.1),
        np.tile(0.01 * np.eye(2), (4, 1, 1)),
        np.ones(4, bool),
        3.0,
        "",
        1e-3,
        2e-3,
        1e-3,
        3e-3,
    )
    monkeypatch.setattr(terrain_study, "active_run", lambda *_: run)
    out = tmp_path / "robots.md"
    assert terrain_study.main(["--seeds", "2", "--plants", "reduced", "--out", str(out)]) == 0
    rows = [line for line in out.read_text().splitlines() if "| reduced |" in line]
    assert len(rows) == 5 and all("3.00 s" in row for row in rows)
    assert [row.split(" | ")[2] for row in rows] == ["one"] * 4 + ["one elsewhere"]


def test_one_wheel_stands_on_another_ground():
    real, grounds = terrain_study.with_one_elsewhere(THESIS, 3)
    assert [(tyre.mu_p, tyre.lambda_p) for tyre in real.tyres] == grounds
    assert sorted(grounds.count(ground) for ground in set(grounds)) == [1, 3]


def test_a_folder_to_write_to_is_refused_before_the_runs(tmp_path, monkeypatch, capsys):
    """It was found out after all runs, by a traceback, and they were lost."""
    monkeypatch.setattr(terrain_study, "active_run", lambda *_: pytest.fail("it ran"))
    with pytest.raises(SystemExit) as ended:
        terrain_study.main(["--seeds", "1", "--out", str(tmp_path)])
    assert ended.value.code == 2 and "is a folder" in capsys.readouterr().err
