"""Cases of the challenge: drawn from a seed, concealed well, and as large as they are said to be."""

import dataclasses
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from pcw_description import RobotDescription, load_robot
from pcw_description.effect_instance import EffectInstance
from pcw_description.effects.kinds import ActuatorEffect
from pcw_description.effects.registry import all_effects
from pcw_description.errors import DescriptionError
from pcw_description.recording import Recording
from pcw_sim_bridge.mismatch.challenge import cases, effect_size
from pcw_sim_bridge.mismatch.challenge.cases import (
    KINDS,
    MASKINGS,
    PLAIN_EXCITATIONS,
    effects_of,
    find_factor,
    order_cases,
    prepare_case,
    runs_of,
    world_of,
)
from pcw_sim_bridge.mismatch.challenge.concealed_effects import (
    CANCELLING,
    HIDDEN_BY_CONTROL,
    NEEDS_IMU,
    NEEDS_TORQUE_COMMANDS,
    RECIPES,
    SILENT_IN,
    Scene,
    draw_effect,
    first_on_patch,
    wheel_paths,
)
from pcw_sim_bridge.mismatch.challenge.effect_size import HealthyChannels
from pcw_sim_bridge.mismatch.challenge.healthy_deviations import (
    draw_deviations,
    effect_instance,
    healthy_numbers,
    tolerated_cost,
    tuned_within,
    with_deviations,
)
from pcw_sim_bridge.mismatch.challenge.outside_effects import OUTSIDE_EFFECTS, CrossJointLaw
from pcw_sim_bridge.mismatch.challenge.random_robots import draw_robot
from pcw_sim_bridge.mismatch.challenge.simulated_case import Run, SimulatedRecording, World, record, simulate
from pcw_sim_bridge.mismatch.errors import MismatchError
from pcw_sim_bridge.mismatch.regression.regression_problem import RegressionProblem
from pcw_sim_bridge.stamping import StampingParameters

THESIS = load_robot("thesis")
RUN = Run("recordings/run_1", "identification", 12.0, 5)


def world(**changes: object) -> World:
    return dataclasses.replace(World(THESIS, THESIS, "reduced"), **changes)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def healthy() -> SimulatedRecording:
    return simulate(world(), RUN, ())


@pytest.fixture(scope="module")
def channels(healthy: SimulatedRecording) -> HealthyChannels:
    return HealthyChannels(THESIS, [healthy], [simulate(world().quiet(), RUN, ())])


@pytest.fixture
def scene(healthy: SimulatedRecording) -> Scene:
    return Scene(THESIS, healthy, np.random.default_rng(3))


# -- healthy robots -----------------------------------------------------------------------------------------------


def test_a_healthy_robot_differs_in_all_that_the_analyser_may_retune(channels: HealthyChannels) -> None:
    """But for what no description holds: when in its cycle a drive takes torque and angles, how rubber and springs give."""
    nuisances = {nuisance.name for nuisance in channels.problem.nuisances}
    described = (name for name in nuisances if name not in ("torque_lag", "heading_lead", "contact.damping_time"))
    analysed = {name for name in described if not name.startswith(("suspension.", "imu.lean."))}
    assert analysed <= {number.name for number in healthy_numbers(THESIS)}


def test_every_number_with_a_tolerance_is_moved() -> None:
    for number in healthy_numbers(THESIS):
        assert number.deviation > 0.0
        moved = with_deviations(THESIS, {number.name: number.deviation})
        assert moved != THESIS, number.name
        is_gain = number.name.startswith(("torque_constant", "contact.stiffness/"))
        assert number.described == (moved.physics == ()) or is_gain, number.name


def test_deviations_have_the_size_of_their_tolerances() -> None:
    rng = np.random.default_rng(0)
    drawn = [draw_deviations(THESIS, rng) for _ in range(200)]
    for number in healthy_numbers(THESIS):
        spread = np.std([deviations[number.name] for deviations in drawn]) / number.deviation
        assert 0.7 < spread < 1.15, number.name  # cut at 2.5 deviations, the tyre's at 1.4


def test_an_unknown_number_is_refused() -> None:
    with pytest.raises(DescriptionError, match="wheel_width"):
        with_deviations(THESIS, {"wheel_width": 0.1})


def test_random_robots_are_many_and_can_be_driven() -> None:
    rng = np.random.default_rng(1)
    robots = [draw_robot(rng) for _ in range(30)]
    assert {robot.n for robot in robots} >= {3, 4, 5}
    assert len({robot.total_mass for robot in robots}) > 12
    assert all(draw_robot(rng, needs_imu=True).sensors.imu is not None for _ in range(10))


# -- runs ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("controller", ["computed_torque", "velocity_loops"])
def test_in_memory_is_what_the_recording_holds(controller: str, tmp_path: Path) -> None:
    effects = [effect_instance("clock_offset", ("clock",), {"offset": 0.02})]
    own, run = world(controller=controller), dataclasses.replace(RUN, duration=10.0)
    kept = simulate(own, run, effects)
    record(own, run, effects, tmp_path / "bag", StampingParameters())
    read = Recording.open(tmp_path / "bag", THESIS)
    for series in ("joint_states", "joint_commands", "imu", "ground_truth", "cmd_vel"):
        one, other = getattr(kept, series), getattr(read, series)
        for field in dataclasses.fields(one):
            a, b = getattr(one, field.name), getattr(other, field.name)
            if isinstance(a, np.ndarray):
                np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12, err_msg=f"{series}.{field.name}")
            else:
                assert a == b, f"{series}.{field.name}"


def torque_change(healthy: SimulatedRecording, effects: list[EffectInstance]) -> float:
    """Relative change of the motor torques by effects."""
    run = simulate(world(), RUN, effects)
    before, after = healthy.joint_states.effort, run.joint_states.effort
    return float(np.sqrt(np.mean((after - before) ** 2)) / np.std(before))


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=pytest.mark.nightly if k % 3 else ()) for k, name in enumerate(sorted(OUTSIDE_EFFECTS))],
)
def test_what_is_outside_the_library_is_at_work_and_not_in_it(name: str, healthy: SimulatedRecording, scene: Scene) -> None:
    effect = draw_effect(name, scene, 1.0).instance()
    assert torque_change(healthy, [effect]) > 0.01
    assert name not in all_effects()


def test_a_law_across_joints_is_behind_the_torque_sensor() -> None:
    """A drive that loses half its torque reports what the motor was told to give, and moves less."""
    [fading] = [entry.effect for name, entry in OUTSIDE_EFFECTS.items() if name == "fading_torque"]
    assert isinstance(fading, CrossJointLaw)
    effect = EffectInstance(fading.name, THESIS.caster_names, {"size": 0.5, "time_constant": 1e-3})
    own = world()
    plants = [own.make(THESIS, effects) for effects in ([], [effect])]
    torque = np.column_stack([np.full(4, 0.5), np.zeros(4)])
    for plant in plants:
        plant.step(torque, 300)
    speeds = [plant.state().twist[0] for plant in plants]
    assert speeds[1] == pytest.approx(0.5 * speeds[0], rel=0.02)
    np.testing.assert_allclose(plants[1].state().motor_torque, torque)


# -- effects ------------------------------------------------------------------------------------------------------


def test_every_effect_of_the_vocabulary_can_be_concealed() -> None:
    assert set(RECIPES) == set(all_effects()) | set(OUTSIDE_EFFECTS)
    named = {*HIDDEN_BY_CONTROL, *SILENT_IN, *NEEDS_IMU, *(c.first for c in CANCELLING), *(c.second for c in CANCELLING)}
    assert named <= set(all_effects())


@pytest.mark.parametrize("name", sorted(RECIPES))
def test_parameters_are_allowed_at_every_magnitude(name: str, scene: Scene) -> None:
    for strength in (0.0, 0.5, 1.0):
        draft = draw_effect(name, scene, strength)
        instances = [draft.scaled(factor).instance() for factor in (0.1, 1.0, 1e6)]
        assert instances[0] != instances[2]
        assert set(instances[0].target) <= {*THESIS.caster_names, "chassis", "imu", "clock"}


def test_size_is_in_proportion_and_nothing_is_no_size(channels: HealthyChannels) -> None:
    assert channels.size([simulate(world().quiet(), RUN, ())]).size == 0.0
    sizes = []
    for coulomb in (0.02, 0.06):  # larger ones are counted as outliers are
        effect = effect_instance("drive_coulomb_friction", ("rear_left",), {"coulomb": coulomb})
        sizes.append(channels.size([simulate(world().quiet(), RUN, [effect])]))
    assert sizes[1].size == pytest.approx(3.0 * sizes[0].size, rel=0.15)
    assert sizes[1].evidence > 5.0 * sizes[0].evidence
    low, high = sizes[1].region["drive_velocity/rear_left"]
    assert low < 0.0 < high


def test_another_motion_is_no_size_of_an_effect(channels: HealthyChannels) -> None:
    """Of a gain uneven by 0.02 % a run on PyBullet had 27 noise floors, all of them of wheels that slipped otherwise."""
    tiny = EffectInstance("uneven_gain", THESIS.caster_names, {"size": 1e-4}, None)
    # What slips otherwise, and in the same run nothing else.
    other = effect_instance("drive_coulomb_friction", ("rear_left",), {"coulomb": 0.06})
    runs = [simulate(world().quiet(), RUN, [tiny, other])]
    assert channels.size(runs, [tiny]).size < 0.1
    assert channels.size(runs, [other]).size == pytest.approx(channels.size(runs, [tiny, other]).size, rel=0.01)
    assert channels.size(runs).size > 3.0
    seen = EffectInstance("uneven_gain", THESIS.caster_names, {"size": 0.1}, None)
    assert channels.size([simulate(world().quiet(), RUN, [seen])], [seen]).size > 3.0


@pytest.mark.parametrize(
    ("name", "tiny", "seen"),
    [
        ("gear_elasticity", {"stiffness": 1e6, "damping": 0.5}, {"stiffness": 100.0, "damping": 0.5}),
        ("gear_backlash", {"play": 2e-6, "tooth_stiffness": 1e6, "tooth_damping": 1.0},
         {"play": 0.005, "tooth_stiffness": 5e3, "tooth_damping": 1.0}),
    ],
)  # fmt: skip
def test_gears_too_are_as_large_as_what_they_do_in_one_run(
    channels: HealthyChannels, name: str, tiny: dict[str, float], seen: dict[str, float]
) -> None:
    """By two runs a gear whose wind-up is a ten-thousandth of what the model misjudges of slips had 53 noise floors."""
    other = effect_instance("drive_coulomb_friction", ("rear_left",), {"coulomb": 0.06})  # what slips otherwise
    found = []
    for parameters in (tiny, seen):
        gear = EffectInstance(name, ("front_right",), parameters, "drive")
        found.append(channels.size([simulate(world().quiet(), RUN, [gear, other])], [gear]))
    assert found[0].size < 0.1
    assert found[1].size > 3.0 and found[1].evidence > 18.0
    assert found[1].channel.startswith("rolling_consistency/front_right")


def test_what_the_description_with_the_effect_does_not_explain_is_no_evidence(channels: HealthyChannels) -> None:
    """Two runs differ also in where the model is wrong: only what goes with the effect in the description counts."""
    effect = effect_instance("drive_coulomb_friction", ("rear_left",), {"coulomb": 0.02})
    other = effect_instance("aerodynamic_drag", ("chassis",), {"coefficient": 1e-3})
    runs = [simulate(world().quiet(), RUN, [effect])]
    plain, told, wrong = (channels.size(runs, effects).evidence for effects in ((), [effect], [other]))
    assert plain > 18.0
    assert told == pytest.approx(plain, rel=0.1)
    assert wrong < 0.05 * plain
    assert channels.evidence(THESIS, runs, [effect]) == pytest.approx(told, rel=1e-6)


@pytest.mark.parametrize(("faint_below", "too_much_above"), [(0.0, 0.02), (1.5, 2.5), (3.0, 1e9), (100.0, 400.0)])
def test_a_strength_is_found_between_too_faint_and_too_much(faint_below: float, too_much_above: float) -> None:
    def strength(factor: float) -> float:
        if factor > too_much_above:
            raise MismatchError("the robot turns over")
        return 5.0 if factor > faint_below else 1e-6

    factor = find_factor(strength, 5.0)
    assert factor is not None and faint_below < factor <= too_much_above


def test_the_strength_nearest_to_a_sensible_one_is_kept() -> None:
    def strength(factor: float) -> float:
        if factor > 1.0:
            raise MismatchError("the robot turns over")
        return 0.5 * factor  # never above the floor

    assert find_factor(strength, 5.0) == 1.0
    with pytest.raises(MismatchError, match="turns over"):
        strength(2.0)


def test_an_effect_that_is_too_much_at_any_size_is_not_found() -> None:
    def strength(factor: float) -> float:
        raise MismatchError("the robot turns over")

    assert find_factor(strength, 5.0) is None


def test_what_is_within_tolerance_has_hardly_any_evidence(channels: HealthyChannels) -> None:
    """One deviation of a radius shows in the channels, and re-tuning explains it; fifteen do not pass for healthy."""
    radius = 1e-3 * THESIS.wheel_radius[0]
    found = []
    for deviations in (1.0, 15.0):
        effect = effect_instance("wheel_radius_error", ("front_left",), {"error": deviations * radius})
        found.append(channels.size([simulate(world().quiet(), RUN, [effect])]))
    assert found[0].evidence < 5.0
    assert found[1].evidence > 18.0


def test_samples_that_one_description_alone_judges_are_no_evidence(
    channels: HealthyChannels, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A payload of a hundredth of the chassis had 547 nats, all of them of such samples."""
    effect = effect_instance("drive_coulomb_friction", ("front_left",), {"coulomb": 0.3})
    runs = [simulate(world().quiet(), RUN, [effect])]
    whole, build = channels.size(runs, [effect]).evidence, effect_size._build

    def judging_half(robot: RobotDescription, recordings: Sequence[SimulatedRecording], cutoff: float) -> RegressionProblem:
        problem = build(robot, recordings, cutoff)
        late = problem.time > 0.5 * RUN.duration
        return dataclasses.replace(problem, valid=problem.valid & ~late[:, None]) if robot.physics else problem

    monkeypatch.setattr(effect_size, "_build", judging_half)
    half = channels.size(runs, [effect]).evidence
    print(f"{whole:.0f} nats, of half of the samples {half:.0f}")
    assert 0.2 * whole < half < 0.8 * whole


def test_what_is_a_curved_number_has_no_more_evidence_than_its_tolerance_costs(channels: HealthyChannels) -> None:
    """First orders at the description led past the relaxation length, back, and past it again: 386 nats for 8 tolerances."""
    tolerance = THESIS.contact.relaxation_length * THESIS.tolerance("contact.relaxation_length").value
    for times in (3.0, 8.0):
        length = THESIS.contact.relaxation_length + times * tolerance
        effect = effect_instance("tyre_relaxation", THESIS.caster_names, {"length": length})
        found = channels.size([simulate(world().quiet(), RUN, [effect])], [effect])
        assert found.size > 10.0
        assert found.evidence < 0.5 * times**2 + 3.0


@pytest.mark.parametrize(
    ("name", "target", "parameters", "numbers"),
    [
        ("wheel_radius_error", ("front_left", "rear_left"), {"error": "wheel_radius/front_left"}, 2),
        ("torque_constant_error", ("rear_left",), {"error": "torque_constant/rear_left_drive"}, 1),
        ("payload_offset", ("chassis",), {"x": "chassis.com.x", "y": "chassis.com.y"}, 2),
        ("imu_scale", ("imu",), {"gyro": "imu.gyro_scale"}, 1),
    ],
)
def test_what_a_healthy_robot_may_differ_by_costs_what_its_tolerances_say(
    name: str, target: tuple[str, ...], parameters: dict[str, str], numbers: int
) -> None:
    deviations = {number.name: number.deviation for number in healthy_numbers(THESIS)}
    for times in (1.0, -8.0):
        effect = effect_instance(name, target, {key: times * deviations[moved] for key, moved in parameters.items()})
        assert tolerated_cost(THESIS, effect) == pytest.approx(0.5 * numbers * times**2)


def test_what_no_healthy_robot_has_costs_more_than_any_tolerance() -> None:
    assert tolerated_cost(THESIS, EffectInstance("fading_torque", THESIS.caster_names, {"size": 1e-4})) == np.inf
    assert tolerated_cost(THESIS, effect_instance("drive_coulomb_friction", ("rear_left",), {"coulomb": 1e-4})) == np.inf
    angle = 2.0 * THESIS.tolerance("ground.slope").value
    slope = effect_instance("ground_slope", ("chassis",), {"angle": angle, "direction": 2.0})
    assert tolerated_cost(THESIS, slope) == pytest.approx(2.0)


@pytest.mark.nightly
def test_what_moves_the_robot_otherwise_has_no_more_evidence_than_its_tolerances_cost() -> None:
    """All steering zeros 2.85 deviations off drive another way: what differs on the way is no evidence of anything."""
    robot = load_robot("tidybot2")
    run = dataclasses.replace(RUN, excitation="random_goals", duration=20.0)
    true = with_deviations(robot, draw_deviations(robot, np.random.default_rng(3)))
    there = World(robot, true, "reduced", "computed_torque")
    quiet = there.quiet()
    own = HealthyChannels(robot, [simulate(there, run, ())], [simulate(quiet, run, ())])
    found = []
    for deviations in (2.85, 20.0):
        offset = deviations * robot.tolerance("steer_zero").value
        effect = effect_instance("steer_zero_offset", robot.caster_names, {"offset": offset})
        found.append(own.size([simulate(quiet, run, [effect])]))
    assert found[0].size > 3.0
    assert found[0].evidence < 0.5 * robot.n * 2.85**2 + 10.0
    assert found[1].evidence > 100.0


def test_a_wheel_comes_onto_its_patch(scene: Scene, healthy: SimulatedRecording) -> None:
    for _ in range(5):
        patch = draw_effect("low_friction_patch", scene, 0.5).instance().parameters
        onset = first_on_patch(THESIS, healthy, patch)
        assert onset is not None and onset > 0.0
        row = np.searchsorted(healthy.ground_truth.stamp, onset)
        place = wheel_paths(THESIS, healthy)[row] - [patch["x"], patch["y"]]
        assert np.linalg.norm(place, axis=1).min() < 0.5 * np.hypot(patch["length"], patch["width"])
    assert first_on_patch(THESIS, healthy, {**patch, "x": 500.0}) is None


# -- cases --------------------------------------------------------------------------------------------------------


def test_shares_are_as_stated_and_every_effect_has_its_turn() -> None:
    orders = order_cases(400, 7)
    kinds = Counter(order.kind for order in orders)
    assert kinds == {kind: round(400 * share) for kind, share in KINDS.items()}
    assert kinds["none"] >= 150
    singles = Counter(name for order in orders if order.kind == "single" for name in order.effects)
    assert set(singles) == set(all_effects()) and max(singles.values()) - min(singles.values()) <= 1
    assert set(order.masking for order in orders if order.kind == "masked") == set(MASKINGS)
    assert all(len(set(order.effects)) == 2 for order in orders if order.kind == "pair")
    assert orders == order_cases(400, 7) != order_cases(400, 8)
    assert len({order.plant for order in orders}) == 3


@pytest.mark.parametrize(
    ("changes", "named"),
    [({"kinds": ("singel",)}, "singel"), ({"plants": ("ode",)}, "ode"), ({"durations": (5.0, 9.0)}, "15 to 600"),
     ({"count": 0}, "--cases 0"), ({"seed": -1}, "--seed -1")],
)  # fmt: skip
def test_what_is_not_allowed_is_named(changes: dict[str, object], named: str) -> None:
    with pytest.raises(MismatchError, match=named):
        order_cases(**{"count": 4, "seed": 0, **changes})  # type: ignore[arg-type]


@pytest.mark.parametrize(("failures", "drawn"), [(2, 2), (9, 9), (99, None)])
def test_a_case_is_drawn_until_a_robot_can_be_driven_so(
    failures: int, drawn: int | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One that never could be ended a whole challenge, as casters that were taken straight back turned either way."""
    seen = iter(range(1000))

    class Drawing:
        def __init__(self, order: cases.CaseOrder, rng: np.random.Generator) -> None:
            self.number = next(seen)

        def answer(self) -> dict[str, object]:
            if self.number < failures:
                raise MismatchError("at no size that the robot can be driven with")
            return {"effects": [{"size": 9.0, "evidence": 99.0}], "number": self.number}

    monkeypatch.setattr(cases, "_Drawing", Drawing)
    order = order_cases(1, 1)[0]
    if drawn is None:
        with pytest.raises(MismatchError, match="at no size"):
            prepare_case(order)
    else:
        assert prepare_case(order)["number"] == drawn


def test_a_payload_costs_what_it_moves_of_mass_and_its_centre() -> None:
    """One of a hundredth of the chassis, a metre above it, moves that by a centimetre: two tolerances."""
    chassis = THESIS.chassis
    payload = {"mass": 0.01 * chassis.mass, "x": chassis.com[0], "y": chassis.com[1], "z": chassis.com[2] + 1.0}
    cost = tolerated_cost(THESIS, effect_instance("payload_mass", ("chassis",), payload))
    assert cost == pytest.approx(0.5 * (1.0 + (1.0 / 1.01 / 100.0 / 0.005) ** 2))


def test_some_healthy_robots_do_one_plain_manoeuvre_by_their_own_loops() -> None:
    orders = order_cases(24, 2, kinds=("none",), plants=("reduced",), durations=(20.0, 21.0))
    drawn = [prepare_case(order) for order in orders]
    plain = [answer for answer in drawn if answer["controller"] == "velocity_loops"]
    assert 0 < len(plain) < len(drawn)
    assert {run["excitation"] for answer in plain for run in answer["runs"][:1]} <= {*PLAIN_EXCITATIONS, "identification"}
    assert len({answer["runs"][0]["excitation"] for answer in plain}) > 2


def test_what_torque_commands_alone_show_is_concealed_where_torques_are_commanded(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lags of motors behind loops of their drives, whose gains nobody describes, were counted as missed."""
    monkeypatch.setattr(cases, "PLAIN_SHARE", 1.0)
    order = order_cases(1, 2, kinds=("single",), plants=("reduced",), durations=(15.0, 16.0))[0]

    def controller(name: str) -> str:
        return cases._Drawing(dataclasses.replace(order, effects=(name,)), np.random.default_rng(1))._world.controller

    assert NEEDS_TORQUE_COMMANDS == {name for name, effect in all_effects().items() if isinstance(effect, ActuatorEffect)}
    assert {controller(name) for name in NEEDS_TORQUE_COMMANDS} == {"computed_torque"}
    assert controller("drive_coulomb_friction") == "velocity_loops"


def test_an_actuator_is_as_large_as_what_it_makes_of_its_commands() -> None:
    """Of two runs all that slips otherwise counted: a lag within a cycle, which re-tuning explains, was 18 floors large."""

    def sizes(controller: str, *times: float) -> list[effect_size.EffectSize]:
        own = world(controller=controller)
        channels = HealthyChannels(own.nominal, [simulate(own, RUN, ())], [simulate(own.quiet(), RUN, ())])
        lags = [[effect_instance("actuator_lag", ("rear_left",), {"time_constant": time}, "steer")] for time in times]
        return [channels.size([simulate(own.quiet(), RUN, lag)], lag) for lag in lags]

    large, small = sizes("computed_torque", 0.02, 0.0005)
    [unseen] = sizes("velocity_loops", 0.02)
    assert large.channel == "command_tracking/rear_left_steer" and large.size > 3.0 and large.evidence > 1000.0
    assert small.size < 0.2 and small.evidence < 18.0
    assert (unseen.size, unseen.evidence) == (0.0, 0.0)


def test_one_way_of_tyres_is_not_hidden_by_making_another_effect_of_it() -> None:
    """In a description in which all tyres are seven times stiffer, tyres softer along are right, and those across are not."""
    orders = order_cases(16, 2, kinds=("masked",), plants=("reduced",), durations=(15.0, 16.0))
    order = dataclasses.replace(next(o for o in orders if o.masking == "retuned"), effects=("tyre_lateral_stiffness",))
    retuned = prepare_case(order)["retuned"]
    assert retuned and "contact.stiffness" not in retuned


@pytest.mark.parametrize(
    ("name", "wanted", "own", "tuned"),
    [
        ("caster_offset.x", 2.0, 1.0, 2.0),  # as wanted
        ("caster_offset.x", 5.0, 1.0, 2.0),  # too far from the description
        ("caster_offset.x", 2.0, -2.0, 0.0),  # too far from the robot
        ("chassis.com.x", -1.5, 2.5, 0.5),
        ("module.mass", 2.0, -1.0, 1.0),
        ("contact.relaxation_length", -3.0, 1.0, None),
        ("contact.stiffness", 3.0, -1.4, None),
    ],
)
def test_what_is_tuned_stays_near_description_and_robot(name: str, wanted: float, own: float, tuned: float | None) -> None:
    """Of a relaxation length tuned to a quarter, half is a quarter of what it was: the robot itself would be another one."""
    robot = load_robot("flow_base")
    key = f"{name}/{robot.caster_names[0]}" if name.startswith("caster") else name
    deviation = next(number.deviation for number in healthy_numbers(robot) if number.name == key)
    found = tuned_within(robot, key, wanted * deviation, own * deviation)
    if tuned is not None:
        assert found / deviation == pytest.approx(tuned, abs=0.06)
        return
    described, true = with_deviations(robot, {key: found}).contact, with_deviations(robot, {key: own * deviation}).contact
    part = "relaxation_length" if name.endswith("length") else "lambda_p"
    apart = getattr(true, part) / getattr(described, part) - 1.0
    assert abs(apart) <= 1.41 * robot.tolerance(name).value
    assert (found - own * deviation) * (wanted - own) > 0.0


@pytest.mark.nightly
@pytest.mark.parametrize("masking", MASKINGS)
def test_masked_cases_are_masked(masking: str) -> None:
    orders = order_cases(16, 2, kinds=("masked",), plants=("reduced",), durations=(15.0, 16.0))
    answer = prepare_case(next(order for order in orders if order.masking == masking))
    own, runs = world_of(answer), runs_of(answer)
    assert answer["masking"] == masking
    assert all(effect["size"] > 0.0 for effect in answer["effects"])
    if masking == "retuned":
        assert answer["retuned"] and with_deviations(own.nominal, {}) != with_deviations(own.true, {})
        limits = {number.name: number.deviation for number in healthy_numbers(own.nominal)}
        assert max(abs(value) / limits[name] for name, value in answer["retuned"].items()) < 2.3  # of what is nominal now
        apart = {name: answer["deviations"][name] - value for name, value in answer["retuned"].items()}
        assert max(abs(value) / limits[name] for name, value in apart.items()) < 2.3
    elif masking == "closed_loop":
        assert own.controller == "velocity_loops"
    elif masking == "cancelling":
        assert len(effects_of(answer)) == 2
        costs = [tolerated_cost(own.nominal, effect) for effect in effects_of(answer)]
        assert all(effect["evidence"] <= min(costs) for effect in answer["effects"])
    else:
        assert len([run for run in runs if run.path.startswith("recordings")]) == 2
