"""The channels of a robot: a healthy one is silent, a changed number and an effect show up where and as large as they are."""

import copy
import dataclasses
import math
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from pcw_control.excitation import make_excitation
from pcw_description import RobotDescription, load_robot
from pcw_description.contact.contact_model import LENGTH, slip_under_load, tyre_step
from pcw_description.effect_instance import EffectInstance
from pcw_description.effects.registry import read_physics
from pcw_description.recording import Recording
from pcw_description.robot_description import AXIS_NAMES, DRIVE, STEER
from pcw_sim_bridge.mismatch.challenge.simulated_case import Run, World, simulate
from pcw_sim_bridge.mismatch.regression.regression_problem import SizedTerm, term_key
from pcw_sim_bridge.mismatch.regression.slow_drifts import beside, drifting_columns
from pcw_sim_bridge.mismatch.regression.whitened_regression import Instance
from pcw_sim_bridge.mismatch.robot import robot_channels
from pcw_sim_bridge.mismatch.robot.chassis_sway import ChassisSway
from pcw_sim_bridge.mismatch.robot.robot_channels import (
    RobotProblemBuilder,
    disturbed,
    sliding,
    used_friction,
)
from pcw_sim_bridge.mismatch.robot.robot_motion import RobotMotion
from pcw_sim_bridge.mismatch.robot.robot_nuisances import varied_numbers
from pcw_sim_bridge.mismatch.robot.rolling_model import (
    ChannelLayout,
    ModelNumbers,
    Surroundings,
    _scaled_by_motors,
    channel_sides,
    normal_forces,
    slips,
    wheel_motion,
)
from pcw_sim_bridge.mismatch.search.evidence_selection import EffectSearch
from pcw_sim_bridge.simulated_run import record_run
from pcw_sim_bridge.stamping import HEALTHY

DURATION = 16.0
THESIS = load_robot("thesis")


def wandering(time: float) -> np.ndarray:
    """Return a twist that moves all three axes at speeds of no common period."""
    ramp = min(time, 1.0)
    return ramp * np.array(
        [0.5 * np.sin(1.3 * time), 0.4 * np.sin(0.9 * time + 1.0), 0.7 * np.sin(0.7 * time)]
    )


def shaking(time: float) -> np.ndarray:
    """The same with accelerations of some hertz besides, by which slow tyres are known."""
    fast = np.array([0.1 * np.sin(14.0 * time), 0.1 * np.sin(19.0 * time), 0.3 * np.sin(23.0 * time)])
    return wandering(time) + min(time, 1.0) * fast


def record(
    folder: Path, robot: RobotDescription, seed: int, plant: str = "reduced", twist: Callable[[float], np.ndarray] = wandering
) -> Recording:
    """Drive `robot` under a controller that knows only the nominal one."""
    path = folder / f"run{seed}"
    described = load_robot(robot.name)
    record_run(robot, twist, DURATION, seed, path, plant, controlled_as=described)
    return Recording.open(path, described)


@pytest.fixture(scope="module")
def healthy(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """The robot as it is described; a test that changes the recording takes a copy."""
    return record(tmp_path_factory.mktemp("healthy"), THESIS, 5)


def column_fit(builder: RobotProblemBuilder, column: np.ndarray) -> tuple[float, float]:
    """Return the least-squares coefficient of one column (T, C) in the wrench, and the share of power it explains there."""
    problem = builder.build(with_terms=False)
    scale = np.sqrt(np.mean(problem.measured[:, :3] ** 2, axis=0))
    target = np.where(problem.valid[:, :3], problem.residual[:, :3] / scale, 0.0)
    explaining = np.where(problem.valid[:, :3], column[:, :3] / scale, 0.0)
    coefficient = float(np.sum(target * explaining) / np.sum(explaining**2))
    left = target - coefficient * explaining
    return coefficient, float(1.0 - np.sum(left**2) / np.sum(target**2))


def test_the_candidates_of_some_keys_are_those_of_the_whole_problem(healthy: Recording) -> None:
    """What nothing was found of has no part in a proof, and its candidates are not made for it."""
    whole, builder = RobotProblemBuilder(THESIS, [healthy]).build(), RobotProblemBuilder(THESIS, [healthy])
    assert builder.build(keys=()).terms == ()
    wanted = ["drive_coulomb_friction/front_left", "payload_mass/chassis", "steer_zero_offset/front_left"]
    some = builder.build(keys=[*wanted, "payload_mass/nowhere"])
    places = {term.key: index for index, term in enumerate(whole.terms)}
    assert sorted(term.key for term in some.terms) == sorted(wanted)
    np.testing.assert_array_equal(some.residual, whole.residual)
    for index, term in enumerate(some.terms):
        place, shape = places[term.key], tuple(sorted(term.shapes[0].items()))
        np.testing.assert_array_equal(some.columns(index, shape), whole.columns(place, shape))
        sizes = [
            SizedTerm(k, shape, np.full(len(term.parameters), 0.01), term.base_indices())
            for k in (index, place)
        ]
        exact, other = some.exact_at({}, sizes[:1]), whole.exact_at({}, sizes[1:])
        np.testing.assert_array_equal(exact.residual, other.residual)


def test_zeros_as_numbers_and_as_effects_are_one_thing_also_where_nothing_tracks_the_robot(tmp_path: Path) -> None:
    """On a slope forces depend on the yaw that the wheels tell, and that on the zeros of their headings."""
    slope = read_physics([{"name": "ground_slope", "angle": 0.03, "direction": 0.4}], THESIS.caster_names)
    offset = 0.02
    zeros = read_physics([{"name": "steer_zero_offset", "target": "front_left", "offset": offset}], THESIS.caster_names)
    nominal = dataclasses.replace(THESIS, physics=slope)
    described = dataclasses.replace(THESIS, physics=(*slope, *zeros))
    recording = copy.copy(record(tmp_path, described, 1))
    recording.ground_truth = None
    problem, other = (RobotProblemBuilder(robot, [recording]).build(with_terms=False) for robot in (nominal, described))
    change = {"steer_zero/front_left": -offset}
    exact = problem.exact_at(change, ())
    [column] = [n.column for n in problem.nuisances if n.name in change]
    left = exact.residual + column * offset
    valid = problem.valid[:, 0] & other.valid[:, 0]
    sizes = [float(np.sqrt(np.mean(values[valid, :2] ** 2))) for values in (problem.residual, left, left - other.residual)]
    print(f"rms forces: undescribed {sizes[0]:.3g}, tuned {sizes[1]:.3g}, difference from described {sizes[2]:.3g} N")
    assert sizes[2] < 0.02 * sizes[1]


@pytest.mark.parametrize(
    ("effect", "size"),
    [("steer_zero_offset", 0.002), ("wheel_radius_error", 5e-5), ("caster_offset_error", 1e-4), ("payload_offset", 1e-3)],
)
def test_the_column_of_what_changes_numbers_alone_is_theirs_and_what_the_model_does(
    healthy: Recording, effect: str, size: float
) -> None:
    """The exact residual of an effect of all casters is that of their numbers, and the numbers' columns lead there.

    So it is with a centre of mass: a secant beside its slope promised a thousand nats that were not there.
    """
    problem = RobotProblemBuilder(THESIS, [healthy]).build()
    targets = THESIS.caster_names, ("chassis",)
    index = next(k for k, t in enumerate(problem.terms) if t.effect == effect and t.target in targets)
    term, shape = problem.terms[index], tuple(sorted(problem.terms[index].shapes[0].items()))
    for k, parameter in enumerate(term.parameters):
        coefficients = np.zeros(len(term.parameters))
        coefficients[k] = size
        changes = {name: factor * size for name, factor in parameter.sum_of}
        if effect == "payload_offset":
            assert list(changes) == [f"chassis.com.{parameter.name}"]
        else:
            assert sorted(name.split("/")[1] for name in changes) == sorted(THESIS.caster_names)
        plain, numbers = (problem.exact(some, ())[0] for some in ({}, changes))
        worked = problem.exact({}, (SizedTerm(index, shape, coefficients, (k,)),))[0]
        np.testing.assert_allclose(worked, numbers, atol=1e-9 * float(np.abs(numbers).max()))
        valid, column = problem.valid, problem.columns(index, shape)[:, :, k]
        assert np.linalg.norm((plain - worked - size * column)[valid]) < 0.02 * np.linalg.norm((plain - worked)[valid])
        np.testing.assert_allclose(column, sum(f * dict(zip(
            [n.name for n in problem.nuisances], np.moveaxis(problem.nuisance_columns(), 2, 0), strict=True
        ))[name] for name, f in parameter.sum_of))


def test_wheels_that_spin_all_together_are_told_by_what_else_feels_the_motion(healthy: Recording) -> None:
    """No wheel contradicted the others when all of them turned about at once: half a second was all of the error."""
    builder = RobotProblemBuilder(THESIS, [healthy])
    [motion] = builder.motions
    before = sliding(builder.numbers, motion, builder.layout)
    spinning = (motion.time > 8.0) & (motion.time < 8.4)
    assert not before[spinning].any()
    for name, column, size in (("imu", 0, 1.2), ("tracked_twist", 2, 1.2), ("tracked_twist", 0, 0.5)):
        felt = getattr(motion, name).copy()
        felt[spinning, column] += size
        found = sliding(builder.numbers, dataclasses.replace(motion, **{name: felt}), builder.layout)
        assert found[spinning].mean() > 0.9
        assert np.mean(found[~spinning] & ~before[~spinning]) < 0.01
    # A gyro with an offset, or that is off by a tenth, parts from the wheels all the time.
    felt = motion.imu * np.array([1.1, 1.0, 1.0]) + np.array([0.1, 0.0, 0.0])
    np.testing.assert_array_equal(sliding(builder.numbers, dataclasses.replace(motion, imu=felt), builder.layout), before)


@pytest.mark.parametrize("plant", ["reduced", "pybullet"])
def test_a_healthy_robot_leaves_next_to_nothing(tmp_path: Path, plant: str) -> None:
    """Wrench residuals below 4 % of the wrench in the plane, below 12 % on springs that pitch."""
    problem = RobotProblemBuilder(
        load_robot("thesis"), [record(tmp_path, load_robot("thesis"), 1, plant)]
    ).build()
    consistency = [f"rolling_consistency/{c}_{d}" for c in THESIS.caster_names for d in ("longitudinal", "lateral")]
    assert [channel.name for channel in problem.channels] == [
        "chassis_force/x", "chassis_force/y", "chassis_torque/z", *consistency,
        "gyro", "accelerometer/x", "accelerometer/y", "pose/x", "pose/y", "pose/yaw",
    ]  # fmt: skip
    assert problem.valid.mean() > 0.85
    residual = np.sqrt(np.mean(np.where(problem.valid, problem.residual, 0.0) ** 2, axis=0))
    measured = np.sqrt(np.mean(problem.measured**2, axis=0))
    assert np.all(residual[:3] < (0.04 if plant == "reduced" else 0.12) * measured[:3])
    # What the wheels contradict one another by is the slip of their tyres, to a tenth, or to six tenths on springs.
    assert np.all(residual[3:11] < (0.1 if plant == "reduced" else 0.6) * measured[3:11])
    assert residual[11] < 2e-3
    # The tracker's noise of 1 mm at 100 Hz, differentiated and cut at the channels' cut-off.
    assert np.all(residual[-3:] < 8e-3)


@pytest.mark.parametrize(
    ("sensor", "pause"),
    [("imu", 0.06), pytest.param("imu", 0.5, marks=pytest.mark.nightly), ("ground_truth", 0.3)],
)
def test_a_pause_of_a_sensor_reaches_nothing_beside_it(tmp_path: Path, sensor: str, pause: float) -> None:
    """In its place stood zeros: a turning robot's gyro was off by tenths of its speed for half a second on either side."""
    whole = record(tmp_path, THESIS, 1, twist=lambda time: min(time, 1.0) * np.array([0.3, 0.0, 0.6]))
    paused = copy.copy(whole)
    series = getattr(whole, sensor)
    kept = (series.stamp < 8.0) | (series.stamp > 8.0 + pause)
    here = {f.name: getattr(series, f.name) for f in dataclasses.fields(series)}
    cut = {name: value[kept] for name, value in here.items() if isinstance(value, np.ndarray) and len(value) == len(kept)}
    setattr(paused, sensor, dataclasses.replace(series, **cut))
    plain, problem = (RobotProblemBuilder(THESIS, [run]).build(with_terms=False) for run in (whole, paused))
    felt = slice(11, 14) if sensor == "imu" else slice(14, 17)
    judged = problem.valid[:, felt]
    assert judged.any(axis=0).all() and not judged.all()
    sizes = [np.abs(np.where(judged, own.residual[:, felt], 0.0)).max(axis=0) for own in (plain, problem)]
    np.testing.assert_array_less(sizes[1], 2.0 * sizes[0])


def test_a_piece_too_short_for_the_filter_is_left_out(healthy: Recording) -> None:
    """Between two pauses of the joints lies less than the filter needs: ``mismatch analyze`` ended with a traceback."""
    recording = copy.copy(healthy)
    joints = recording.joint_states
    kept = ~((joints.stamp > 8.0) & (joints.stamp < 8.3)) & ~((joints.stamp > 9.5) & (joints.stamp < 9.8))
    fields = {name: getattr(joints, name)[kept] for name in ("stamp", "stamp_ns", "position", "velocity", "effort")}
    recording.joint_states = dataclasses.replace(joints, **fields)
    builder = RobotProblemBuilder(THESIS, [recording], 3.0)
    problem = builder.build()
    assert [len(f.decimate(m.time)) > 0 for f, m in zip(builder.filters, builder.motions, strict=True)] == [True, False, True]
    assert problem.valid.any() and np.isfinite(problem.residual).all()


def test_a_changed_number_is_its_nuisance(tmp_path: Path) -> None:
    """3 kg more chassis and a wheel heading read 20 mrad wrong come out with their size, through their own columns."""
    nominal = load_robot("thesis")
    heavier = dataclasses.replace(
        nominal, chassis=dataclasses.replace(nominal.chassis, mass=nominal.chassis.mass + 3.0)
    )
    builder = RobotProblemBuilder(nominal, [record(tmp_path, heavier, 2)])
    columns = {nuisance.name: nuisance.column for nuisance in builder.build().nuisances}
    coefficient, explained = column_fit(builder, columns["chassis.mass"])
    assert coefficient == pytest.approx(3.0, abs=0.6)
    assert explained > 0.5
    # The same column applied to a problem whose numbers are varied on purpose: the difference quotient is consistent.
    builder.numbers.steer_zero[1] += 0.02
    varied = builder.build(with_terms=False)
    builder.numbers.steer_zero[1] -= 0.02
    plain = builder.build(with_terms=False)
    assert plain.terms == () and len(plain.nuisances) == len(columns)
    moved = (plain.residual - varied.residual) / 0.02
    steer_zero = columns["steer_zero/front_right"]
    assert np.sqrt(np.mean((moved - steer_zero) ** 2)) < 0.05 * np.sqrt(np.mean(steer_zero**2))


def test_a_moment_between_two_slips_is_not_calm() -> None:
    bad = np.zeros(100, dtype=bool)
    bad[[30, 50]] = True
    felt = np.zeros(100, dtype=bool)
    felt[25:56] = True  # five before the first and after the last, and the nine between them that are free of both
    assert np.array_equal(disturbed(bad, 5), felt)
    felt[36:49] = False
    bad[50], bad[54], felt[56:60] = False, True, True  # thirteen between them are enough
    assert np.array_equal(disturbed(bad, 5), felt)
    assert not disturbed(np.zeros(100, dtype=bool), 5).any()


@pytest.mark.parametrize("rotor", ["drive", "steer"])
def test_rotors_of_coupled_gears_are_wrong_at_both_joints(rotor: str) -> None:
    """A tenth more of their inertia is the same in the numbers of the model as in a description that holds it."""
    robot = load_robot("xr4000")
    assert robot.armature[0, 0, 1] != 0.0
    differences = SimpleNamespace(
        model=SimpleNamespace(layout=ChannelLayout(robot.caster_names, True, False, True), numbers=ModelNumbers.of(robot)),
        motions=[SimpleNamespace(sampling=0.004, loops=np.zeros((1, robot.n, 2, 2)))],
    )
    [number] = [n for n in varied_numbers(robot, differences) if n.label == f"rotors.{rotor}"]  # type: ignore[arg-type]
    varied = ModelNumbers.of(robot)
    number.vary(varied, 0.1 * number.nominal)
    larger = [
        dataclasses.replace(caster, rotors=dataclasses.replace(caster.rotors, **{rotor: 1.1 * getattr(caster.rotors, rotor)}))
        for caster in robot.casters
    ]
    described = ModelNumbers.of(dataclasses.replace(robot, casters=tuple(larger)))
    assert np.abs(described.modules - ModelNumbers.of(robot).modules).max() > 1e-5
    assert varied.modules == pytest.approx(described.modules, rel=1e-12)


@pytest.mark.parametrize(
    "changed",
    [
        pytest.param("wheel.inertia_axle", marks=pytest.mark.nightly),
        pytest.param("module.mass", marks=pytest.mark.nightly),
        pytest.param("contact.stiffness", marks=pytest.mark.nightly),
        "drive_coulomb_friction",
    ],
)
def test_columns_are_slopes_also_where_numbers_have_moved_far(healthy: Recording, changed: str) -> None:
    """An inertia that was scaled, not added to, lost 57 % of its column with 57 % of itself, and what a torque does to the
    slips of a soft tyre was that of the described one: a search that made its problem exact there ran from its own optimum.
    """
    problem = RobotProblemBuilder(THESIS, [healthy]).build()
    numbers = {nuisance.name: nuisance for nuisance in problem.nuisances}
    [index] = [k for k, t in enumerate(problem.terms) if (t.effect, t.target) == ("drive_coulomb_friction", ("rear_left",))]
    shape = tuple(sorted(problem.terms[index].shapes[0].items()))
    moved = {"wheel.inertia_axle": -0.5, "module.mass": 0.3, "contact.stiffness": 0.4}
    changes = {name: part * numbers[name].nominal for name, part in moved.items()}

    def sizes(friction: float) -> list[SizedTerm]:
        coefficients = np.zeros(len(problem.terms[index].parameters))
        coefficients[0] = friction
        return [SizedTerm(index, shape, coefficients, (0,))]

    here = problem.exact_at(changes, sizes(0.3)).with_soft_tyres().derived()

    def left(changes: dict[str, float], friction: float) -> np.ndarray:
        there = here.exact_at(changes, sizes(friction))
        columns = {nuisance.name: nuisance.column for nuisance in there.nuisances}
        explained = sum(columns[name] * change for name, change in changes.items())
        return there.residual - explained - there.columns(index, shape)[:, :, 0] * friction

    if changed in numbers:
        step = 0.02 * numbers[changed].nominal
        column = next(nuisance.column for nuisance in here.nuisances if nuisance.name == changed)
        slope = (left(changes, 0.3) - left(changes | {changed: changes[changed] + step}, 0.3)) / step
    else:
        column = here.columns(index, shape)[:, :, 0]
        slope = (left(changes, 0.3) - left(changes, 0.32)) / 0.02
    # What torques do follows tyres that are softer by 40 % as a whole, not the curve of each.
    most = 0.05 if changed in numbers else 0.1
    for channel in range(column.shape[1]):
        size, off = np.linalg.norm(slope[:, channel]), np.linalg.norm(column[:, channel] - slope[:, channel])
        assert off <= most * size, problem.channels[channel].name


def test_how_wheels_move_is_taken_over_only_where_they_move_so(healthy: Recording) -> None:
    """Of every number of the model and all that surroundings hold: channels are those that nothing known before makes."""
    builder = RobotProblemBuilder(THESIS, [healthy], 5.0)
    motion, numbers, layout = builder.motions[0], builder.numbers, builder.layout
    known = Surroundings(wheels=wheel_motion(motion, numbers))
    shape = motion.position.shape
    cases = [(dataclasses.replace(motion, velocity=1.1 * motion.velocity), numbers, known)]
    for name, value in vars(numbers).items():
        other = numbers.copy()
        if isinstance(value, ChassisSway):
            value = dataclasses.replace(value, frequency=1.1 * value.frequency)
        else:
            value = 1.01 * value + 0.001
        setattr(other, name, value)
        cases.append((motion, other, known))
    for name, size in (("torque", shape), ("radius", shape[:2]), ("grip", shape[:2]), ("climb", shape), ("height", shape[:2]),
                       ("pull", (shape[0], 2))):  # fmt: skip
        changed = np.abs(np.random.default_rng(1).normal(0.0, 0.01, size))
        cases.append((motion, numbers, dataclasses.replace(known, **{name: changed})))
    for moved, other, around in cases:
        anew = channel_sides(moved, other, layout, dataclasses.replace(around, wheels=None))
        assert all(np.array_equal(a, b) for a, b in zip(channel_sides(moved, other, layout, around), anew, strict=True))


def test_a_law_does_where_tyres_are_softer_what_an_effect_of_the_same_torque_does(healthy: Recording) -> None:
    """Its slips stayed those of the described tyres: friction by the angle of all steerings passed for a Coulomb friction."""
    problem = RobotProblemBuilder(THESIS, [healthy]).build()
    [tyres] = [number for number in problem.nuisances if number.name == "contact.stiffness"]
    softer = problem.exact_at({tyres.name: 0.4 * tyres.nominal}, ()).with_soft_tyres()
    assert softer.sites is not None
    [term] = [t for t in softer.terms if (t.effect, t.target) == ("drive_coulomb_friction", ("rear_left",))]
    speed = softer.sites.variables["drive_velocity/rear_left"]
    torque = np.zeros((len(speed), len(softer.sites.names), 1))
    torque[:, softer.sites.names.index("drive_torque/rear_left"), 0] = -np.tanh(speed / softer.sites.smoothing)
    assert softer.sites.columns(torque)[:, :, 0] == pytest.approx(term.columns(term.shapes[0])[:, :, 0], rel=1e-9, abs=1e-12)


@pytest.mark.parametrize(("name", "step"), [("chassis.com.x", 1e-3), ("chassis.mass", 0.1), ("module.mass", 0.01)])
def test_what_shifts_loads_is_felt_by_wheels_that_resist_by_them(healthy: Recording, name: str, step: float):
    """Without it a payload's place was told from the chassis' centre of mass, with intervals that held neither."""
    problem = RobotProblemBuilder(THESIS, [healthy]).build()
    resistance = term_key("rolling_resistance", THESIS.caster_names)
    [k] = [k for k, term in enumerate(problem.terms) if term.key == resistance]
    there = problem.exact_at({}, (SizedTerm(k, (), np.array([2e-3]), (0,)),)).derived()
    assert there.exact is not None and there.point is not None
    less, more = (there.exact({name: side * step}, there.point.sizes)[0] for side in (-1.0, 1.0))
    [number] = [number for number in there.nuisances if number.name == name]
    balance = there.valid[:, :3]
    expected, column = ((less - more) / (2.0 * step))[:, :3][balance], number.column[:, :3][balance]
    assert np.linalg.norm(column - expected) < 1e-3 * np.linalg.norm(expected)


def test_a_centre_of_mass_is_felt_as_a_moment_on_a_floor_that_leans(healthy: Recording) -> None:
    """Without it a payload's place was told from the chassis' centre of mass, with intervals that held neither."""
    problem = RobotProblemBuilder(THESIS, [healthy]).build()
    [moment] = [k for k, channel in enumerate(problem.channels) if channel.name == "chassis_torque/z"]
    angle, valid = 0.02, problem.valid[:, moment]

    def column(slope: float) -> np.ndarray:
        there = problem.exact_at({"ground.slope.x": slope, "chassis.com.x": 0.0}, ()).derived()
        [number] = [number for number in there.nuisances if number.name == "chassis.com.x"]
        return number.column[valid, moment]

    pulled = THESIS.chassis.mass * 9.81 * angle * np.sin(problem.variables["yaw"][valid])
    felt = column(angle) - column(1e-9)
    assert min(np.linalg.norm(felt - pulled), np.linalg.norm(felt + pulled)) < 0.1 * np.linalg.norm(pulled)


def test_shapes_go_by_the_slopes_of_the_model_to_where_it_costs_least(tmp_path: Path) -> None:
    """A payload that a search left a decimetre too far out stayed there, and so was too light."""
    payload = {"mass": 25.0, "x": -0.18, "y": 0.15}
    loaded = dataclasses.replace(THESIS, physics=(EffectInstance("payload_mass", ("chassis",), payload | {"z": 0.5}),))
    problem = RobotProblemBuilder(THESIS, [record(tmp_path, loaded, 5)]).build()
    [term] = [k for k, t in enumerate(problem.terms) if t.effect == "payload_mass"]
    shape = {**problem.terms[term].shapes[0], "x": payload["x"] - 0.08, "y": payload["y"] + 0.06}
    search = EffectSearch(problem, np.random.default_rng(0))
    found = search.polished(search.conclude([Instance(term, tuple(sorted(shape.items())), (0,))], 9.0))
    [instance] = found.fit.instances
    reached = dict(instance.shape)
    assert abs(reached["x"] - payload["x"]) < 0.03 and abs(reached["y"] - payload["y"]) < 0.03
    assert found.fit.mean[-1] == pytest.approx(payload["mass"], rel=0.1)


def test_scales_of_an_imu_are_numbers_too(healthy: Recording) -> None:
    """Accelerometers half a percent off were parts of a gyroscope's error, with intervals as if nobody allowed them any."""
    problem = RobotProblemBuilder(THESIS, [healthy]).build()
    numbers = {nuisance.name: nuisance for nuisance in problem.nuisances}
    [term] = [term for term in problem.terms if term.effect == "imu_scale"]
    for k, name in enumerate(("imu.gyro_scale", "imu.accelerometer_scale.x", "imu.accelerometer_scale.y")):
        assert numbers[name].deviation == THESIS.tolerance("imu.scale").value
        effect, number = term.columns(term.shapes[0])[:, :, k], numbers[name].column
        assert np.linalg.norm(effect - number) < 0.05 * np.linalg.norm(effect)


def test_an_imu_elsewhere_is_no_chassis_that_leans(healthy: Recording) -> None:
    """One 17 cm ahead of its place was silent with 40 nats: smaller than what a chassis leans, and nothing like it."""
    problem = RobotProblemBuilder(THESIS, [healthy]).build()
    terms = {term.effect: term for term in problem.terms if term.target == ("imu",)}
    assert [name for name, term in terms.items() if term.unlike_errors] == ["imu_lever_arm"]
    drifting = drifting_columns(problem)[problem.valid]
    left = {}
    for name, term in terms.items():
        columns = term.columns(term.shapes[0])
        seen = [column[problem.valid] for column in np.moveaxis(columns, 2, 0)]
        left[name] = [beside(drifting, column) / float(column @ column) for column in seen]
    assert max(left["imu_bias"]) < 1e-9 and min(left["imu_lever_arm"]) > 0.5


def test_slips_lag_as_torques_do(healthy: Recording) -> None:
    """All torques told a cycle later: what that does is the column of their lag, in the slips of the wheels, too."""
    recording = healthy
    later = copy.copy(recording)
    joints, commands = recording.joint_states, recording.joint_commands
    assert joints.effort is not None and commands is not None and commands.effort is not None
    later.joint_states = dataclasses.replace(joints, effort=np.concatenate([joints.effort[:1], joints.effort[:-1]]))
    later.joint_commands = dataclasses.replace(commands, effort=np.concatenate([commands.effort[:1], commands.effort[:-1]]))
    cycle = float(np.median(np.diff(joints.stamp)))
    before, after = (RobotProblemBuilder(THESIS, [one]).build(with_terms=False) for one in (recording, later))
    [column] = [nuisance.column for nuisance in before.nuisances if nuisance.name == "torque_lag"]
    both = before.valid.all(axis=1) & after.valid.all(axis=1)
    for channel in range(3, 11):
        change = (after.residual - before.residual)[both, channel]
        told = cycle * column[both, channel]
        assert np.linalg.norm(change) > 0.0
        assert np.linalg.norm(change - told) < 0.1 * np.linalg.norm(change), before.channels[channel].name


@pytest.mark.parametrize("plant", ["reduced", pytest.param("pybullet", marks=pytest.mark.nightly)])
def test_an_effect_is_its_own_column(tmp_path: Path, plant: str) -> None:
    """Coulomb friction on one drive: its column gives the torque within 5 %, those of the other drives explain less."""
    nominal = load_robot("thesis")
    friction = EffectInstance(
        "drive_coulomb_friction", ("rear_right",), {"coulomb": 0.6, "asymmetry": 0.0, "smoothing_speed": 0.05}
    )
    builder = RobotProblemBuilder(
        nominal, [record(tmp_path, dataclasses.replace(nominal, physics=(friction,)), 3, plant)]
    )
    problem = builder.build()
    explained = {}
    for index, term in enumerate(problem.terms):
        if term.effect == "drive_coulomb_friction":
            instance = Instance(index, tuple(sorted(term.shapes[0].items())), (0,))
            column = term.columns(dict(instance.shape))[:, :, 0]
            explained[term.target] = column_fit(builder, column)
    coefficient, share = explained["rear_right",]
    assert coefficient == pytest.approx(0.6, rel=0.05)
    assert share == max(part for _, part in explained.values()) > 0.7


def test_an_effect_that_the_description_holds_is_not_left_over(tmp_path: Path) -> None:
    """With the friction in the robot file the residual is that of a healthy robot again: a patched file is nominal."""
    nominal = load_robot("thesis")
    friction = EffectInstance(
        "drive_coulomb_friction", ("rear_right",), {"coulomb": 0.6, "asymmetry": 0.0, "smoothing_speed": 0.05}
    )
    patched = dataclasses.replace(nominal, physics=(friction,))
    recording = record(tmp_path, patched, 4)
    before = RobotProblemBuilder(nominal, [recording]).build()
    after = RobotProblemBuilder(patched, [recording]).build()
    rms = [np.sqrt(np.mean(np.where(p.valid, p.residual, 0.0)[:, :3] ** 2, axis=0)) for p in (before, after)]
    assert np.all(rms[1][:2] < 0.3 * rms[0][:2])


@pytest.mark.parametrize(
    "entry",
    [
        {"name": "torque_constant_error", "error": -0.2},
        {"name": "motor_cogging", "cosine": 0.6, "sine": 0.3, "order": 5.0},
    ],
    ids=lambda entry: entry["name"],
)
def test_what_a_motor_does_is_found_at_both_joints_of_coupled_gears(tmp_path: Path, entry: dict[str, object]) -> None:
    """With the effect in its file the robot leaves what a healthy one does, and the candidate's columns are what it does."""
    nominal = load_robot("xr4000")
    physics = read_physics([{**entry, "target": ["left"], "axis": "drive"}], nominal.caster_names)
    true = dataclasses.replace(nominal, physics=physics)
    recording, healthy = record(tmp_path / "true", true, 5), record(tmp_path / "healthy", nominal, 5)
    problems = [RobotProblemBuilder(*of).build() for of in ((nominal, [recording]), (true, [recording]), (nominal, [healthy]))]
    left = [np.sqrt(np.mean(np.where(p.valid, p.residual, 0.0)[:, :3] ** 2, axis=0)) for p in problems]
    assert np.all(left[0] > 1.5 * left[2])
    assert np.all(left[1] < 1.2 * left[2])
    term = next(t for t in problems[0].terms if t.key == f"{entry['name']}/drive of left")
    shape = {name: entry[name] for name in ("order",) if name in entry}
    told = term.columns(shape) @ np.array([entry[p.name] for p in term.parameters])  # type: ignore[arg-type]
    both = problems[0].valid & problems[1].valid
    works = problems[0].residual - problems[1].residual
    for channel in range(3):
        error = np.linalg.norm((told - works)[both[:, channel], channel])
        assert error < 0.01 * np.linalg.norm(works[both[:, channel], channel])


def test_torques_that_were_calibrated_joint_by_joint_are_errors_of_motors_and_a_crosstalk() -> None:
    """Whichever a healthy robot's drives were calibrated by, within tolerance it has nothing missing."""
    robot = load_robot("tidybot2")
    numbers = ModelNumbers.of(robot)
    torque = np.random.default_rng(0).standard_normal((20, robot.n, 2))
    numbers.gain[1] = [1.02, 0.97]
    of_motors = _scaled_by_motors(torque, numbers)
    shafts = torque[:, 1] @ np.linalg.inv(robot.gear_coupling[1])
    np.testing.assert_allclose(of_motors[:, 1], (shafts * [0.02, -0.03]) @ robot.gear_coupling[1])
    assert not of_motors[:, [0, 2, 3]].any()
    numbers.crosstalk[1] = -0.05 * robot.gear_coupling[1, DRIVE, STEER]
    np.testing.assert_allclose(_scaled_by_motors(torque, numbers)[:, 1], torque[:, 1] * [0.02, -0.03])


@pytest.mark.nightly
def test_effects_of_every_kind_that_the_description_holds_are_not_left_over(tmp_path: Path) -> None:
    """Slope, drag, a wrong zero, and an IMU that is wrong in every way, all in the file: what is left is a healthy robot's."""
    nominal = load_robot("thesis")
    entries = [
        {"name": "ground_slope", "angle": 0.03, "direction": 1.0},
        {"name": "aerodynamic_drag", "coefficient": 10.0},
        {"name": "steer_zero_offset", "target": ["front_left"], "offset": 0.04},
        {"name": "wheel_radius_error", "target": ["rear_left"], "error": 1e-3},
        {"name": "imu_bias", "gyro": 0.05, "accelerometer_y": 0.3},
        {"name": "imu_scale", "gyro": 0.1},
        {"name": "imu_lever_arm", "x": 0.1},
        {"name": "clock_offset", "offset": 0.02, "tracker_offset": 0.1},
    ]
    robot = dataclasses.replace(nominal, physics=read_physics(entries, nominal.caster_names))
    wrong, healthy = record(tmp_path / "wrong", robot, 6), record(tmp_path / "healthy", nominal, 6)
    left = []
    for described, recording in ((nominal, wrong), (robot, wrong), (nominal, healthy)):
        problem = RobotProblemBuilder(described, [recording]).build()
        left.append(np.sqrt(np.mean(np.where(problem.valid, problem.residual, 0.0) ** 2, axis=0)))
    assert np.all(left[0] > 1.5 * left[2]), "every channel shows something"
    assert np.all(left[1] < 1.5 * left[2])


@pytest.mark.nightly
def test_wheels_that_climb_slip_no_more_for_it(tmp_path: Path) -> None:
    """Waves of the floor, in the file too: the wrench they push with is accounted for, and no slip is predicted from it."""
    nominal = load_robot("thesis")
    waves = {"name": "uneven_ground", "amplitude": 4e-3, "wavelength": 1.3, "direction": 0.4}
    robot = dataclasses.replace(
        nominal, physics=read_physics([{**waves, "target": list(nominal.caster_names)}], nominal.caster_names)
    )
    wavy, level = record(tmp_path / "wavy", robot, 7), record(tmp_path / "level", nominal, 7)
    left = []
    for described, recording in ((nominal, wavy), (robot, wavy), (nominal, level)):
        problem = RobotProblemBuilder(described, [recording]).build(with_terms=False)
        left.append(np.sqrt(np.mean(np.where(problem.valid, problem.residual, 0.0) ** 2, axis=0)))
    assert np.all(left[0][:3] > 5.0 * left[2][:3])
    assert np.all(left[1][:3] < 1.5 * left[2][:3])
    assert np.all(left[1][3:11] < left[0][3:11] / 3.0), "0.4 to 0.9 of it if the push were a tyre's"


@pytest.mark.nightly  # two runs in an engine of three dimensions
@pytest.mark.parametrize(
    "entry",
    [
        {"name": "uneven_ground", "target": [*THESIS.caster_names], "amplitude": 0.0015, "wavelength": 1.3, "direction": 0.7},
        {"name": "tyre_radial_compliance", "target": ["front_left"], "stiffness": 6e4},
    ],
    ids=lambda entry: str(entry["name"]),
)
@pytest.mark.parametrize("plant", ["pybullet", "reduced"])
def test_a_chassis_that_stands_askew_leans_its_steerings(tmp_path: Path, plant: str, entry: dict[str, object]) -> None:
    """And its IMU, told where it does: twice what a healthy robot leaves was left, and more."""
    robot = dataclasses.replace(THESIS, physics=read_physics([entry], THESIS.caster_names))
    askew, level = record(tmp_path / "askew", robot, 6, plant), record(tmp_path / "level", THESIS, 6, plant)
    left = []
    for described, recording in ((THESIS, askew), (robot, askew), (THESIS, level)):
        problem = RobotProblemBuilder(described, [recording]).build(with_terms=False)
        left.append(np.sqrt(np.mean(np.where(problem.valid, problem.residual, 0.0) ** 2, axis=0)))
    wrong, right = left[0] / left[2], left[1] / left[2]
    print(wrong, right, sep="\n")
    names = [channel.name for channel in problem.channels]
    assert np.all(wrong[:3] > 1.5)
    assert np.all(wrong[[names.index("accelerometer/x"), names.index("accelerometer/y")]] > 1.2)
    # Of a healthy robot in the plane wheels contradict each other by next to nothing, that is no measure of what may be left.
    judged = [plant != "reduced" or not name.startswith("rolling_consistency") for name in names]
    assert np.all(right[judged] < 1.4)


def test_a_robot_without_offset_is_judged_by_its_inertial_sensor_alone(healthy: Recording) -> None:
    """b_x = 0 leaves no torque balance; the channels say so by their names, and no candidate is a torque."""
    recording = healthy
    swerve = load_robot("thesis")
    swerve = dataclasses.replace(
        swerve,
        casters=tuple(dataclasses.replace(caster, caster_offset=(0.0, 0.0)) for caster in swerve.casters),
    )
    problem = RobotProblemBuilder(swerve, [recording]).build()
    names = [channel.name for channel in problem.channels]
    assert "gyro" in names
    assert "pose/x" in names
    assert not any(name.startswith("chassis") for name in names)
    effects = {term.effect for term in problem.terms}
    assert {"wheel_radius_error", "imu_bias", "clock_offset"} <= effects
    assert not {"drive_coulomb_friction", "torque_constant_error"} & effects


def test_a_cogging_turns_with_the_wheel_and_not_with_what_is_read_of_it(tmp_path: Path) -> None:
    """With a steering zero 20 mrad off a ripple of order 34 is read 0.7 rad away from where it is; the numbers say both."""
    cogging = {"cosine": 0.3, "sine": 0.1, "order": 34.0}
    entries = [
        {"name": "motor_cogging", "target": ["rear_left"], "axis": "steer", **cogging},
        {"name": "steer_zero_offset", "target": ["rear_left"], "offset": 0.02},
    ]
    true = dataclasses.replace(THESIS, physics=read_physics(entries, THESIS.caster_names))
    problem = RobotProblemBuilder(THESIS, [record(tmp_path, true, 9)]).build()
    place = [term.key for term in problem.terms].index("motor_cogging/steer of rear_left")
    size = SizedTerm(place, (("order", 34.0),), np.array([0.3, 0.1]), (0, 1))
    left = {}
    for zero in (0.0, -0.02):
        assert problem.exact is not None
        residual, _ = problem.exact({"steer_zero/rear_left": zero}, [size])
        left[zero] = float(np.sqrt(np.mean(residual[problem.valid[:, 2], 2] ** 2)))
    assert left[-0.02] < 0.5 * left[0.0]
    # And so do its columns once the zero is known: four drives with zeros of their own had four coggings, or none.
    turned = {"steer_zero/rear_left": -0.02}
    (without, _), (with_it, _) = (problem.exact(turned, sizes) for sizes in ([], [size]))  # type: ignore[misc]
    works = np.where(problem.valid, without - with_it, 0.0)
    apart = []
    for headed in (problem, problem.with_headings(turned)):
        columns = headed.columns(place, size.shape) @ size.coefficients
        apart.append(np.linalg.norm(np.where(problem.valid, columns, 0.0) - works) / np.linalg.norm(works))
    assert apart[0] > 0.5
    assert apart[1] < 0.1
    assert problem.with_headings({"steer_zero/rear_left": 1e-3, "steer_zero/rear_right": 0.02}).terms[place].columns(
        dict(size.shape)
    ) == pytest.approx(problem.columns(place, size.shape))


def test_an_order_is_searched_as_far_as_its_own_joint_leaves_it_open(tmp_path: Path) -> None:
    """By drives that turn fifty times as far as a steering, its spring of order 1 stayed two coggings of 1.03 and 1.06."""
    recording = record(tmp_path, THESIS, 9)
    travel = np.ptp(recording.joint_states.position, axis=0)
    for term in RobotProblemBuilder(THESIS, [recording]).build().terms:
        if term.effect == "motor_cogging":
            turned = max(travel[THESIS.caster_index(name), AXIS_NAMES.index(str(term.axis))] for name in term.target)
            assert term.resolution["order"] == ("linear", pytest.approx(0.25 * math.tau / turned, rel=0.2))


def test_an_imu_that_reads_too_much_reads_too_much_of_a_leaning_floor_too(tmp_path: Path) -> None:
    """A slow robot felt little else: what its floor added went for slow noise, in which the error was lost."""

    def slow(time: float) -> np.ndarray:
        return np.array([0.3, 0.3, 1.0]) * wandering(time)

    record_run(THESIS, slow, DURATION, 3, tmp_path / "run")
    problem = RobotProblemBuilder(THESIS, [Recording.open(tmp_path / "run", THESIS)]).build()
    place = [term.key for term in problem.terms].index("imu_scale/imu")
    names = [parameter.name for parameter in problem.terms[place].parameters]
    size = SizedTerm(place, (), np.array([0.8 * (name == "accelerometer_y") for name in names]), (0, 1, 2))
    leaning = {"ground.slope.x": 0.003, "ground.slope.y": -0.002}
    assert problem.exact is not None
    (without, _), (with_it, _) = (problem.exact(leaning, sizes) for sizes in ([], [size]))  # type: ignore[misc]
    works = np.where(problem.valid, without - with_it, 0.0)
    apart = []
    for level in (problem, problem.with_headings(leaning)):
        columns = level.columns(place, ()) @ size.coefficients
        apart.append(np.linalg.norm(np.where(problem.valid, columns, 0.0) - works) / np.linalg.norm(works))
    print("apart", apart)
    assert apart[0] > 0.1
    assert apart[1] < 0.02
    assert problem.with_headings({"ground.slope.x": 1e-4}).terms[place] is problem.terms[place]


def test_a_tyre_near_its_peak_is_not_asked_how_much_it_slips() -> None:
    """Of four wheels one uses nine tenths of what it can; of a floor that gives more it uses less."""
    numbers = ModelNumbers.of(THESIS)
    mu = THESIS.contact.mu_p
    force = np.full((2, THESIS.n, 2), [0.1 * mu * 200.0, 0.0])
    force[1, 2] = [0.0, 0.9 * mu * 200.0]
    state = SimpleNamespace(force=force, grip=np.full((2, THESIS.n), 200.0))
    assert used_friction(numbers, state) == pytest.approx([0.1, 0.9])  # type: ignore[arg-type]
    assert used_friction(numbers, SimpleNamespace(force=force, grip=1.5 * state.grip)) == pytest.approx(  # type: ignore[arg-type]
        [0.1 / 1.5, 0.6]
    )


@pytest.mark.parametrize("own", [pytest.param(None, marks=pytest.mark.nightly), 0.04])
def test_a_tyre_relaxes_from_its_own_length_on(tmp_path: Path, own: float | None) -> None:
    """Of casters with tyres of their own the column was taken from the floor's length on, and was of the wrong sign."""
    names = THESIS.caster_names
    robot = THESIS if own is None else THESIS.with_tyres(names, lambda tyre: dataclasses.replace(tyre, relaxation_length=own))
    problem = RobotProblemBuilder(robot, [record(tmp_path, robot, 3)]).build()
    term = [term.key for term in problem.terms].index(f"tyre_relaxation/{names[1]}")
    column, longer = problem.columns(term, ())[:, :, 0], 0.1
    assert problem.exact is not None
    exact = problem.exact({}, [SizedTerm(term, (), np.array([longer]), (0,))])
    assert exact is not None
    taken, first_order = (np.where(problem.valid, values, 0.0) for values in (problem.residual - exact[0], column * longer))
    slips = slice(3, 3 + 2 * THESIS.n)
    assert np.sum(taken[:, slips] * first_order[:, slips]) / np.sum(first_order[:, slips] ** 2) == pytest.approx(1.0, abs=0.1)


def test_slips_are_those_that_the_tyre_itself_takes_to_its_forces() -> None:
    """Under a load that rises and falls by a third twice a second; without what more load takes up they are 3 % apart."""
    step, tread, load_before = 1e-4, 0.5, 200.0
    time = np.arange(0.0, 4.0, step)
    wanted = 0.02 * np.sin(8.0 * time) + 0.01 * np.sin(11.0 * time)
    load = 200.0 + 60.0 * np.sin(12.0 * time + 1.0)
    numbers = ModelNumbers.of(THESIS)
    numbers.tyres[:, LENGTH] = 0.2
    z, force = [0.0, 0.0], np.zeros((len(time), THESIS.n, 2))
    speed = np.maximum(tread, np.hypot(tread - wanted, wanted))
    for k in range(len(time)):
        z = [slip_under_load(value, load_before, load[k]) for value in z]
        *z, force_x, force_y = tyre_step(numbers.tyres[0], *z, wanted[k], -wanted[k], speed[k], load[k], step)
        force[k], load_before = (force_x, force_y), load[k]
    carried = np.repeat(load[:, None], THESIS.n, axis=1)
    wheels = SimpleNamespace(speed=np.full_like(carried, tread), tread=np.full_like(carried, tread), normal=carried)
    found = slips(numbers, 1.0 / step, wheels, force, carried)[5000:-5000, 0]  # type: ignore[arg-type]
    true = np.stack([wanted, -wanted], axis=1)[5000:-5000]
    assert np.linalg.norm(found - true) < 0.01 * np.linalg.norm(true)


def test_a_wheel_that_brakes_is_faster_than_its_tread() -> None:
    """Its slip was too small by itself: of healthy robots that stop hard that made a friction three tolerances too small."""
    step, tread, numbers = 1e-3, 0.5, ModelNumbers.of(THESIS)
    load = np.full((2000, THESIS.n), 200.0)
    wheels = SimpleNamespace(speed=np.full_like(load, tread), tread=np.full_like(load, tread), normal=load)
    for wanted in (-0.02, 0.02):
        z = [0.0, 0.0]
        for _ in range(len(load)):
            *z, force_x, force_y = tyre_step(numbers.tyres[0], *z, wanted, 0.0, max(tread, tread - wanted), 200.0, step)
        force = np.tile([force_x, force_y], (*load.shape, 1))
        found = slips(numbers, 1.0 / step, wheels, force, load)[1000, 0]  # type: ignore[arg-type]
        assert found == pytest.approx([wanted, 0.0], rel=0.01)


def test_loads_that_come_and_go_within_a_cycle_take_up_slip() -> None:
    """Torques that leap every 5 ms: slips that stayed where a robot stopped hard were those of a smaller friction."""
    step, tread, wanted, ripple = 1e-4, 0.1, 0.005, 0.005
    numbers, time = ModelNumbers.of(THESIS), np.arange(0.0, 4.0, step)
    numbers.tyres[:, LENGTH] = 0.05
    direction = np.tile([1.0, 0.0], (len(time), THESIS.n, 1))
    at_rest = normal_forces(numbers, direction, np.zeros((len(time), 2)))
    mean = 1.2 * at_rest
    load = mean[:, 0] * (1.0 + ripple * np.sin(2.0 * np.pi * 200.0 * time))
    z, before, forces = [0.0, 0.0], load[0], np.zeros((len(time), 2))
    for k in range(len(time)):
        z = [slip_under_load(value, before, load[k]) for value in z]
        *z, forces[k, 0], forces[k, 1] = tyre_step(numbers.tyres[0], *z, wanted, 0.0, tread, load[k], step)
        before = load[k]
    force = np.tile(forces[-5000:].mean(axis=0), (*mean.shape, 1))
    wheels = SimpleNamespace(
        speed=np.full_like(mean, tread), tread=np.full_like(mean, tread), normal=mean, direction=direction, height=None
    )
    found = []
    for unrest in (0.0, 2.0 * ripple * 200.0 / (0.2 / 1.2)):
        numbers.load_unrest = unrest
        found.append(slips(numbers, 1.0 / step, wheels, force, mean)[2000, 0, 0])  # type: ignore[arg-type]
    assert found[0] < 0.7 * wanted
    assert found[1] == pytest.approx(wanted, rel=0.03)


def test_samples_that_feel_more_of_a_slip_than_of_all_else_are_not_judged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """How far a filter is felt depends on how large the slip is: one that is far larger than all others is felt farther."""
    builder = RobotProblemBuilder(THESIS, [record(tmp_path, THESIS, 3)])
    problem = builder.build(with_terms=False)
    differences = builder._as_read()[0]
    whole = differences.left_by([np.ones(len(motion.time), dtype=bool) for motion in builder.motions])
    np.testing.assert_allclose(whole, problem.residual, atol=1e-9)

    def in_the_middle(numbers: object, motion: RobotMotion, layout: object) -> np.ndarray:
        middle = len(motion.time) // 2
        return np.abs(np.arange(len(motion.time)) - middle) < 5

    monkeypatch.setattr(robot_channels, "slipping", in_the_middle)
    judged = []
    for size in (0.0, 1e3, 1e6):
        for (measured, _), motion in zip(differences._sides, builder.motions, strict=True):
            measured[in_the_middle(None, motion, None)] += size
        judged.append(int(builder._valid(differences).any(axis=1).sum()))
    assert judged[0] > judged[1] >= judged[2] > 0.5 * judged[0]


def test_how_long_a_tyre_is_comes_out_of_slips_that_lag_by_a_part_of_a_step(tmp_path: Path) -> None:
    """Forces of a simulation act half a step before its slips: with damping to re-tune, a soft tyre is not too short."""
    sensors = THESIS.sensors
    assert sensors.encoders is not None
    fine = dataclasses.replace(sensors.encoders, drive_counts=2.0**20, steer_counts=2.0**20)
    exact = dataclasses.replace(fine, velocity_noise=0.0, torque_noise=0.0)
    quiet = dataclasses.replace(THESIS, sensors=dataclasses.replace(sensors, encoders=exact))
    true, longer = (
        quiet.with_tyres(["rear_left"], lambda tyre, length=length: dataclasses.replace(tyre, relaxation_length=length))
        for length in (0.1, 0.102)
    )
    recording = record(tmp_path, true, 5, twist=shaking)
    problem, other = (RobotProblemBuilder(robot, [recording]).build(with_terms=False) for robot in (true, longer))
    valid = problem.valid & other.valid
    weight = np.where(valid, 1.0 / np.std(problem.residual, axis=0), 0.0)
    column = (other.residual - problem.residual)[..., None] / 0.02

    def misjudged(names: set[str]) -> float:
        """By how much of itself that length is off, all numbers with these names re-tuned."""
        nuisances = [nuisance for nuisance in problem.nuisances if nuisance.name in names]
        deviations = np.array([*(nuisance.deviation for nuisance in nuisances), 1e3])
        columns = np.concatenate([*(nuisance.column[..., None] for nuisance in nuisances), column], axis=2) * weight[..., None]
        rows = np.vstack([columns.reshape(-1, len(deviations)) * deviations, np.eye(len(deviations))])
        target = np.r_[(problem.residual * weight).ravel(), np.zeros(len(deviations))]
        return float(abs(np.linalg.lstsq(rows, target, rcond=None)[0][-1] * 1e3))

    names = {nuisance.name for nuisance in problem.nuisances}
    assert misjudged(names) < 0.02
    assert misjudged(names - {"contact.damping_time"}) > 0.03


@pytest.mark.nightly
def test_an_effect_counts_by_the_slopes_of_where_it_is_not(tmp_path: Path) -> None:
    """By those where a tyre takes twenty times as long to relax, softer tyres do the same, and it was dropped, twice."""
    soft = THESIS.with_tyres(["rear_left"], lambda tyre: dataclasses.replace(tyre, relaxation_length=0.4))
    excitation = make_excitation("identification", THESIS, 24.0, 5)
    record_run(
        soft, excitation.twist, excitation.duration, 5, tmp_path / "run", "reduced", controlled_as=THESIS, stamping=HEALTHY
    )
    problem = RobotProblemBuilder(THESIS, [Recording.open(tmp_path / "run", THESIS)]).build()
    search = EffectSearch(problem, np.random.default_rng(0))
    found = search.run()
    assert [search.label(instance) for instance in found.fit.instances] == ["tyre_relaxation/rear_left"]
    assert not [step for step in found.ladder if step.description == "drop tyre_relaxation/rear_left"]


def test_tyres_that_differ_are_not_said_to_relax_alike(tmp_path: Path) -> None:
    robot = THESIS.with_tyres([THESIS.caster_names[0]], lambda tyre: dataclasses.replace(tyre, relaxation_length=0.05))
    problem = RobotProblemBuilder(robot, [record(tmp_path, robot, 3)]).build()
    relaxing = [term.target for term in problem.terms if term.effect == "tyre_relaxation"]
    assert sorted(relaxing) == sorted((name,) for name in THESIS.caster_names)


@pytest.mark.nightly
def test_a_push_may_have_come_in_one_recording_alone(tmp_path: Path, healthy: Recording) -> None:
    """Exact where it was at work in the second, the model leaves the first as it was, and less of the second."""
    push = {"name": "external_push", "target": ["chassis"], "force_x": 40.0, "start": 5.0, "duration": 2.0}
    pushed = dataclasses.replace(THESIS, physics=read_physics([push], THESIS.caster_names))
    recordings = [healthy, record(tmp_path, pushed, 12)]
    problem = RobotProblemBuilder(THESIS, recordings).build()
    keys = [term.key for term in problem.terms]
    assert keys.count("external_push/chassis") == 1
    term = keys.index("external_push/chassis in recording 2")
    assert problem.terms[term].recording == 1
    shape = {**problem.terms[term].shapes[0], "start": 5.0, "duration": 2.0}
    second = problem.recording == 1
    columns = problem.terms[term].columns(shape)
    assert not columns[~second].any() and columns[second].any()
    assert problem.exact is not None
    sizes = np.array([40.0 * (parameter.name == "force_x") for parameter in problem.terms[term].parameters])
    left = {}
    for name, own in (("without", []), ("with", [SizedTerm(term, tuple(shape.items()), sizes, tuple(range(len(sizes))))])):
        residual, _ = problem.exact({}, own)
        left[name] = [np.sqrt(np.mean(residual[problem.valid[:, 0] & rows, 0] ** 2)) for rows in (~second, second)]
    assert left["with"][0] == pytest.approx(left["without"][0])
    assert left["with"][1] < 0.5 * left["without"][1]


def identified(*effects):
    """What a robot with some effects records while it is excited as for an identification."""
    return simulate(World(THESIS, THESIS, "reduced"), Run("run", "identification", 15.0, 3), effects)


def test_steerings_that_rub_leave_tyres_off_the_peak_of_their_friction():
    """As forces of the ground their torques would use up its friction, and six samples of ten not be judged."""
    rubbing = EffectInstance("steer_coulomb_friction", THESIS.caster_names, {"coulomb": 4.5})
    recording = identified(rubbing)
    problem = RobotProblemBuilder(THESIS, [recording]).build(keys={term_key(rubbing.name, rubbing.target, None, None)})
    assert np.mean(problem.valid[:, 0]) > 0.8
    # With it in the description they are the ground's, and as far from the peak.
    described = dataclasses.replace(THESIS, physics=(rubbing,))
    told = RobotProblemBuilder(described, [dataclasses.replace(recording, robot=described)]).build(with_terms=False)
    assert np.mean(told.valid[:, 0]) > 0.8
    # Up to the peak slips are those of the curves' slopes: what the effect takes away is all in proportion to it.
    [term] = problem.terms
    column = term.columns(term.shapes[0])[:, :, 0]
    exact, _ = problem.exact({}, [SizedTerm(0, term.shapes[0], np.array([4.5, 0.0]), (0,))])
    here = problem.valid[:, 0]
    assert np.linalg.norm((problem.residual - 4.5 * column - exact)[here]) < 0.02 * np.linalg.norm(problem.residual[here])
    assert np.linalg.norm(exact[here, :3]) < 0.1 * np.linalg.norm(problem.residual[here, :3])


def test_a_steering_that_is_turned_is_no_slide():
    """By the description its wheel would slide in every sample, and none was judged."""
    turned = EffectInstance("steer_zero_offset", (THESIS.caster_names[1],), {"offset": -0.5})
    problem = RobotProblemBuilder(THESIS, [identified(turned)]).build(with_terms=False)
    assert np.mean(problem.valid[:, 0]) > 0.8


def test_wheels_that_slide_are_no_other_geometry():
    """On a slippery floor they do in a third of the samples, and no number of the description undoes it."""
    floor = {"factor": 0.1, "x": 0.3, "y": 0.0, "length": 1.0, "width": 1.0}
    slippery = EffectInstance("low_friction_patch", THESIS.caster_names, floor)
    problem = RobotProblemBuilder(THESIS, [identified(slippery)]).build(with_terms=False)
    here = problem.valid[:, 0]
    assert 0.5 < np.mean(here) < 0.8
    assert np.max(np.abs(problem.residual[here, 3:11])) < 0.03


def test_it_is_said_when_torques_use_up_the_friction():
    recording = identified()
    joints = recording.joint_states
    loud = dataclasses.replace(recording, joint_states=dataclasses.replace(joints, effort=20.0 * joints.effort))
    said, silent = (RobotProblemBuilder(THESIS, [one]).build(with_terms=False).remarks for one in (loud, recording))
    assert len(said) == 1 and "of a wheel's friction" in said[0] and not silent
