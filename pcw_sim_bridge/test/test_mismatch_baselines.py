"""The baselines do what their methods can: a comparison with one that was set up to fail would say nothing."""

import dataclasses
import importlib
import json
import os
from pathlib import Path

import numpy as np
import pytest

import pcw_sim_bridge
from pcw_control.excitation import make_excitation
from pcw_description import load_robot
from pcw_description.axis_recording import AxisDescription, load_axis_description, parse_axis_description
from pcw_description.effects.registry import read_physics
from pcw_sim_bridge.mismatch.analysis import analyse
from pcw_sim_bridge.mismatch.baselines import BaselineResult, require_packages, run_baselines
from pcw_sim_bridge.mismatch.baselines.baseline_result import inverse_error, joined_targets
from pcw_sim_bridge.mismatch.baselines.candidate_columns import (
    column_in,
    effect_columns,
    number_as_effect,
    variable_columns,
)
from pcw_sim_bridge.mismatch.baselines.identified_axis import axis_spec
from pcw_sim_bridge.mismatch.baselines.identified_robot import free_numbers, identified_robot, with_numbers
from pcw_sim_bridge.mismatch.baselines.null_table import (
    MARK,
    NullCase,
    healthy_robot,
    table,
    wilson_interval,
    write,
)
from pcw_sim_bridge.mismatch.baselines.sparse_regression import by_effects, by_variables, sparse_weights
from pcw_sim_bridge.mismatch.errors import MismatchError
from pcw_sim_bridge.mismatch.subjects.axis_subject import AxisSubject
from pcw_sim_bridge.mismatch.subjects.robot_subject import RobotSubject
from pcw_sim_bridge.simulated_run import record_run

THESIS = load_robot("thesis")
COULOMB = 0.5
SLED = {
    "format": "pcw_axis/1",
    "name": "sled",
    "kind": "linear",
    "provenance": {"all": "made up for this test"},
    "columns": {"time": "time", "position": "position", "force": "force"},
    "inertia": 20.0,
    "tolerances": {"inertia": "1 %"},
}


@pytest.fixture
def packages() -> None:
    """Skip where the comparison's packages are missing, which no ordinary set-up installs."""
    try:
        require_packages()
    except MismatchError as error:
        pytest.skip(str(error))


def sled(path: Path, friction: float, phase: float, seed: int) -> Path:
    """Write a CSV of a 20 kg sled on a path of sines, with dry friction and noise."""
    rng = np.random.default_rng(seed)
    time = np.arange(0.0, 12.0, 0.004)
    slow, fast = 1.7 * time + phase, 5.3 * time + 2.0 * phase
    position = 0.2 * np.sin(slow) + 0.05 * np.sin(fast)
    velocity = 0.34 * np.cos(slow) + 0.265 * np.cos(fast)
    acceleration = -0.578 * np.sin(slow) - 1.4045 * np.sin(fast)
    force = 20.0 * acceleration + friction * np.tanh(velocity / 1e-3) + 0.3 * rng.standard_normal(len(time))
    position = position + 1e-6 * rng.standard_normal(len(time))
    np.savetxt(path, np.column_stack([time, position, force]), delimiter=",", header="time,position,force", comments="")
    return path


def axis() -> AxisDescription:
    return parse_axis_description(SLED)


def data_folders() -> list[Path]:
    """Folders that may hold the real recordings."""
    named = [Path(os.environ["PCW_DATA"])] if "PCW_DATA" in os.environ else []
    return named + [parent / "shared" / "data" for parent in (*Path.cwd().parents, *Path(__file__).parents)]


def axis_file(name: str) -> Path:
    """Return a shipped axis description, in the source tree or in an installation."""
    module = Path(pcw_sim_bridge.__file__).resolve()
    places = [module.parents[1] / "config", module.parents[4] / "share" / "pcw_sim_bridge" / "config"]
    return next(place / "axes" / name for place in places if (place / "axes" / name).exists())


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Two runs of a robot with dry friction in one drive, along different paths."""
    folder = tmp_path_factory.mktemp("runs")
    entry = {"name": "drive_coulomb_friction", "target": ["front_left"], "coulomb": COULOMB}
    robot = dataclasses.replace(THESIS, physics=read_physics([entry], THESIS.caster_names))
    for name, kind in (("fit", "identification"), ("holdout", "random_goals")):
        excitation = make_excitation(kind, THESIS, 15.0, 3)
        record_run(robot, excitation.twist, excitation.duration, 5, folder / name, controlled_as=THESIS)
    return folder / "fit", folder / "holdout"


@pytest.mark.usefixtures("packages")
def test_every_method_finds_the_dry_friction_of_a_sled(tmp_path: Path) -> None:
    fit, holdout = sled(tmp_path / "fit.csv", 6.0, 0.0, 1), sled(tmp_path / "holdout.csv", 6.0, 0.7, 2)
    floor = {"axis_force": 0.05}
    results = {result.name: result for result in run_baselines(axis(), [fit], [holdout], floor)}
    assert len(results) == 6
    for result in results.values():
        assert result.inverse_nrmse is not None, result.remark
        before, after = result.inverse_nrmse
        print(result)
        assert after < 0.5 * before
        assert result.gap_closed is not None and result.gap_closed > 0.5
        json.dumps(dataclasses.asdict(result))
    for name in ("PySINDy 0.3, variables", "PySINDy 0.3, effect columns", "mujoco.sysid"):
        assert "drive_coulomb_friction/axis" in results[name].names
    assert "axis_force: velocity" in results["gradient boosting"].names


@pytest.mark.usefixtures("packages")
def test_on_a_real_drive_they_find_what_was_published() -> None:
    """EMPS (Janot, Gautier, Brunot 2019): viscous and Coulomb friction and an offset; held out with force pulses."""
    data = next((place for place in data_folders() if (place / "emps" / "DATA_EMPS.mat").exists()), None)
    if data is None:
        pytest.skip("the EMPS recordings are not here; set PCW_DATA to the folder that holds emps/DATA_EMPS.mat")
    described = load_axis_description(axis_file("emps.yaml"))
    fit, holdout = data / "emps" / "DATA_EMPS.mat", data / "emps" / "DATA_EMPS_PULSES.mat"
    results = {result.name: result for result in run_baselines(described, [fit], [holdout])}
    for result in results.values():
        assert result.inverse_nrmse is not None, result.remark
        errors = " -> ".join(f"{error:.4f}" for error in result.inverse_nrmse)
        print(f"{result.name}: {', '.join(result.names)}; {errors}; {result.seconds:.1f} s; {result.remark}")
        assert result.inverse_nrmse[1] < 0.1
    both = {"drive_viscous_friction/axis", "drive_coulomb_friction/axis"}
    assert both <= set(results["PySINDy 0.3, variables"].names)
    assert {*both, "constant_load/axis"} == set(results["mujoco.sysid"].names)


@pytest.mark.usefixtures("packages")
def test_the_error_before_is_the_analysers_own(tmp_path: Path) -> None:
    """Otherwise the figures of the table would not compare."""
    fit, holdout = sled(tmp_path / "fit.csv", 6.0, 0.0, 1), sled(tmp_path / "holdout.csv", 6.0, 0.7, 2)
    findings = analyse(AxisSubject(axis()), [fit], [holdout], {}, 0, lambda message: None).findings
    assert findings.fit is not None
    results = run_baselines(axis(), [fit], [holdout], identification_seconds=0.0)
    assert [result.inverse_nrmse[0] for result in results if result.inverse_nrmse] == pytest.approx(
        [findings.fit.inverse_nrmse[0]] * 5, rel=1e-12
    )


def test_the_joint_given_to_mujoco_is_the_axis_of_the_description() -> None:
    """Its acceleration is (force - moment sin(q - hanging)) / inertia, and -friction / inertia where it coasts."""
    mujoco = pytest.importorskip("mujoco")
    arm = {"gravity_arm": {"moment": 2.0, "hanging_position": 0.4}, "kind": "rotary", "inertia": 0.05}
    for described in (axis(), parse_axis_description(SLED | {"kind": "rotary"}), parse_axis_description(SLED | arm)):
        moment = described.gravity_arm.moment if described.gravity_arm else 0.0
        spec = axis_spec(described, 1e-3)
        model = spec.compile()
        data = mujoco.MjData(model)
        for position, force in ((0.0, 0.0), (1.1, 0.3), (-2.0, -0.7)):
            data.qpos[0], data.qvel[0], data.ctrl[0] = position, 0.0, force
            mujoco.mj_forward(model, data)
            expected = (force - moment * np.sin(position - 0.4)) / described.inertia
            # The arm's own mass is a hundredth of the inertia, and MuJoCo bounds inertias from below.
            assert data.qacc[0] == pytest.approx(expected, rel=1e-3, abs=1e-9)
        spec.joint("axis").frictionloss = 0.5
        model = spec.compile()
        data = mujoco.MjData(model)
        data.qpos[0], data.qvel[0] = 0.4, 1.0
        mujoco.mj_forward(model, data)
        assert data.qacc[0] == pytest.approx(-0.5 / described.inertia, rel=1e-3)


@pytest.mark.usefixtures("packages")
def test_pysindy_names_a_robots_friction_and_nothing_else(runs: tuple[Path, Path]) -> None:
    """With one strong effect it is as good as anything: the comparison is about the rest."""
    subject = RobotSubject(THESIS)
    fitted, proof = (subject.problem([subject.open(path, "fit", {})]) for path in runs)
    for method in (by_variables, by_effects):
        explained = method(fitted, proof, THESIS.caster_names, 0.3, 0)
        print(method.__name__, explained.names)
        assert explained.names == ("drive_coulomb_friction/front_left",)
        assert inverse_error(proof, proof.residual - explained.predicted) < 0.5 * inverse_error(proof, proof.residual)


@pytest.mark.usefixtures("packages")
def test_mujoco_sysid_finds_a_robots_friction(runs: tuple[Path, Path]) -> None:
    """Of a few numbers only, for the time that it takes."""
    pytest.importorskip("mujoco")
    wanted = ("chassis.mass", "drive_coulomb_friction/front_left", "drive_coulomb_friction/rear_right")
    numbers = [number for number in free_numbers(THESIS) if number.name in wanted]
    subject = RobotSubject(THESIS)
    recordings = [subject.open(path, "fit", {}) for path in runs]
    proof = subject.problem(recordings[1:])
    explained = identified_robot(THESIS, [recordings[0].recording], [recordings[1].recording], proof, 1.0, numbers)
    print(explained.names, explained.remark)
    assert "drive_coulomb_friction/front_left" in explained.names
    assert "drive_coulomb_friction/rear_right" not in explained.names
    assert inverse_error(proof, proof.residual - explained.predicted) < 0.5 * inverse_error(proof, proof.residual)


@pytest.mark.usefixtures("packages")
def test_without_anything_to_find_pysindy_keeps_nothing() -> None:
    """White noise on unrelated columns: no ridge predicts left-out blocks."""
    rng = np.random.default_rng(0)
    columns, target = rng.standard_normal((400, 10)), rng.standard_normal(400)
    weights = sparse_weights(columns, target, np.arange(400) // 80, 0.1, 0)
    assert np.count_nonzero(weights) <= 2
    target = 3.0 * columns[:, 4] + 0.1 * rng.standard_normal(400)
    weights = sparse_weights(columns, target, np.arange(400) // 80, 0.1, 0)
    assert np.flatnonzero(weights).tolist() == [4]
    assert weights[4] == pytest.approx(3.0, rel=0.02)


def test_a_missing_package_is_named_with_what_installs_it(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    real = importlib.import_module

    def without(name: str) -> object:
        if name == "pysindy":
            raise ImportError(f"No module named {name!r}")
        return real(name)

    monkeypatch.setattr(importlib, "import_module", without)
    with pytest.raises(MismatchError, match=r"pysindy.*requirements/baselines\.txt"):
        run_baselines(axis(), [tmp_path / "fit.csv"], [tmp_path / "holdout.csv"])


def test_without_a_held_out_recording_there_is_nothing_to_judge(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="holdouts is empty"):
        run_baselines(axis(), [tmp_path / "fit.csv"], [])


def test_libraries_hold_what_the_analyser_offers(runs: tuple[Path, Path]) -> None:
    subject = RobotSubject(THESIS)
    problem = subject.problem([subject.open(runs[0], "fit", {})])
    effects = effect_columns(problem)
    offered = {candidate.effect for candidate in effects}
    for term in problem.terms:
        if len(term.target) == 1 and term.effect in ("drive_coulomb_friction", "torque_constant_error", "payload_mass"):
            assert term.key in offered
    for candidate in effects:
        np.testing.assert_array_equal(column_in(problem, candidate), candidate.column)
    labels = {candidate.label for candidate in variable_columns(problem)}
    assert "sign(drive_velocity/rear_left) cos(steer_angle/rear_left)" in labels
    assert len(labels) > 100


def test_numbers_of_the_description_read_as_effects() -> None:
    assert number_as_effect("wheel_radius/front_left") == "wheel_radius_error/front_left"
    assert number_as_effect("torque_constant/rear_left_steer") == "torque_constant_error/rear_left"
    assert number_as_effect("chassis.mass") == "payload_mass/chassis"
    assert number_as_effect("rotors.drive") == "rotors.drive"
    known = {effect for name in (n.name for n in free_numbers(THESIS)) for effect in [number_as_effect(name)]}
    assert {"steer_zero_offset/front_right", "drive_viscous_friction/rear_left", "ground_slope/chassis"} <= known


def test_freed_numbers_go_into_the_robot() -> None:
    same = with_numbers(THESIS, {number.name: number.nominal for number in free_numbers(THESIS)})
    assert dataclasses.replace(same, physics=()) == dataclasses.replace(THESIS, physics=())
    values = {"chassis.mass": 80.0, "wheel_radius/rear_left": 0.07, "module.inertia_zz": 0.013}
    changed = with_numbers(THESIS, values | {"torque_constant/rear_left_steer": 1.1})
    assert changed.chassis.mass == 80.0
    assert changed.casters[THESIS.caster_index("rear_left")].wheel_radius == 0.07
    assert [caster.module.inertia_zz for caster in changed.casters] == pytest.approx([0.013] * 4)
    [gain] = [i for i in changed.physics if i.name == "torque_constant_error" and i.parameters["error"] != 0.0]
    assert (gain.target, gain.axis, gain.parameters["error"]) == (("rear_left",), "steer", pytest.approx(0.1))


def test_a_healthy_robot_stays_within_twice_its_tolerances() -> None:
    for seed in range(20):
        robot = healthy_robot(THESIS, np.random.default_rng(seed))
        assert abs(robot.chassis.mass / THESIS.chassis.mass - 1.0) <= 0.02 + 1e-12
        assert np.abs(robot.wheel_radius / THESIS.wheel_radius - 1.0).max() <= 0.002 + 1e-12
        for instance in robot.physics:
            if "friction" in instance.name:
                assert max(instance.parameters.get("coulomb", 0.0), instance.parameters.get("viscous", 0.0)) == 0.0


def test_the_same_effect_on_all_casters_is_one_name() -> None:
    names = [f"drive_coulomb_friction/{caster}" for caster in THESIS.caster_names]
    assert joined_targets([*names, "gyro: speed"], THESIS.caster_names) == (
        "gyro: speed", "drive_coulomb_friction/front_left+front_right+rear_left+rear_right",
    )  # fmt: skip
    assert joined_targets(names[:2], THESIS.caster_names) == tuple(names[:2])


def test_wilson_interval() -> None:
    """Against figures of a statistics package (statsmodels 0.14, method "wilson")."""
    assert wilson_interval(0, 150) == pytest.approx((0.0, 0.02497), abs=1e-4)
    assert wilson_interval(8, 10) == pytest.approx((0.49016, 0.94332), abs=1e-4)
    with pytest.raises(ValueError, match="count = 3 of total = 2"):
        wilson_interval(3, 2)


def test_the_table_replaces_what_follows_its_mark(tmp_path: Path) -> None:
    named = BaselineResult("A", ("x", "y"), (0.1, 0.2), None, 2.0)
    silent = BaselineResult("A", (), (0.1, 0.1), None, 4.0)
    unable = BaselineResult("B", (), None, None, 0.0, "could not run: no torques")
    cases = [NullCase("thesis", (named, unable)), NullCase("thesis", (silent, unable))]
    assert "| A | 2 | 1 (50 %) | 9 to 91 % | 1 (2) | 0.1000 -> 0.1500 | 1 | 3.0 s |" in table(cases)
    assert "| B | 0 of 2 | | | | | | could not run: no torques |" in table(cases)
    page = tmp_path / "page.md"
    page.write_text(f"# Title\n\n{MARK}\n\nold\n")
    write(page, cases, "How.")
    text = page.read_text()
    assert text.startswith(f"# Title\n\n{MARK}\n\nHow.\n\n| method |")
    assert "old" not in text
