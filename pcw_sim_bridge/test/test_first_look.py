"""Where and when something is at work that can be in too many places to be tried one by one."""

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest

from pcw_control.excitation import make_excitation
from pcw_description import load_robot
from pcw_description.effects.registry import read_physics
from pcw_description.recording import Recording
from pcw_sim_bridge.mismatch.analysis import analyse
from pcw_sim_bridge.mismatch.regression.regression_problem import SizedTerm
from pcw_sim_bridge.mismatch.regression.whitened_regression import Instance
from pcw_sim_bridge.mismatch.robot.first_look import Looked, common_orders, orders, patches, waves, windows
from pcw_sim_bridge.mismatch.robot.robot_channels import RobotProblemBuilder
from pcw_sim_bridge.mismatch.search.evidence_selection import EffectSearch
from pcw_sim_bridge.mismatch.search.shape_search import shape_interval
from pcw_sim_bridge.mismatch.subjects.robot_subject import RobotSubject
from pcw_sim_bridge.simulated_run import record_run

THESIS = load_robot("thesis")
RATE = 20.0


def looked(left: np.ndarray, seed: int = 0) -> Looked:
    """Return a residual as seen along a winding path of four wheels over a few square metres."""
    count = len(left)
    time = np.arange(count) / RATE
    centre = np.stack([1.5 * np.sin(0.31 * time), 1.2 * np.sin(0.43 * time + 1.0)], axis=1)
    corners = 0.2 * np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, -1.0], [-1.0, 1.0]])
    heading = np.arctan2(np.gradient(centre[:, 1]), np.gradient(centre[:, 0]))
    noisy = left + np.random.default_rng(seed).standard_normal(left.shape)
    return Looked(
        left=noisy, deviation=np.ones(left.shape[1]), valid=np.ones(left.shape, dtype=bool), time=time, rate=RATE,
        recording=np.zeros(count, dtype=np.int64), angle=np.zeros((count, 4, 2)), places=centre[:, None] + corners,
        heading=np.repeat(heading[:, None], 4, axis=1),
    )


def test_a_push_in_one_of_two_recordings_is_found_there() -> None:
    """Something as strong, the other way, was at work in the other one at that time: in both together there is nothing."""
    left = np.zeros((1600, 1))
    left[246:280], left[1046:1080] = 4.0, -4.0
    both = looked(left)
    both = dataclasses.replace(both, time=both.time % (800 / RATE), recording=np.repeat([0, 1], 800))
    columns = np.ones((1600, 1, 1))
    held, _ = both.only(1).held_against(columns)
    assert not held[:800].any() and held[1046:1080].sum() < -50.0
    assert windows(both.only(1), columns).shapes[0]["start"] == pytest.approx(246 / RATE, abs=0.1)
    assert windows(both, columns).shapes[0]["start"] != pytest.approx(246 / RATE, abs=0.1)


def test_the_time_of_a_push_is_found() -> None:
    left = np.zeros((800, 2))
    left[246:280] = [2.0, -1.0]
    columns = np.zeros((800, 2, 2))
    columns[:, 0, 0] = columns[:, 1, 1] = 1.0
    found = windows(looked(left), columns)
    assert found.shapes[0]["start"] == pytest.approx(246 / RATE, abs=0.1)
    assert found.shapes[0]["duration"] == pytest.approx(34 / RATE, abs=0.15)
    assert found.among > 10_000, "a choice among so many is paid for"


@pytest.mark.parametrize("radius", [0.3, 0.08])
def test_the_place_of_a_patch_is_found(radius: float) -> None:
    view = looked(np.zeros((1200, 4)))
    inside = np.linalg.norm(view.places - view.places[400, 1], axis=2) < radius
    view = looked(3.0 * inside)
    columns = np.zeros((1200, 4, 4))
    columns[:, range(4), range(4)] = 1.0
    best = patches(view, columns).shapes[0]
    assert np.hypot(best["x"] - view.places[400, 1, 0], best["y"] - view.places[400, 1, 1]) < 0.5 * radius
    assert best["length"] == pytest.approx(2.0 * radius, rel=0.4)


def test_length_and_direction_of_waves_are_found() -> None:
    view = looked(np.zeros((1200, 4)))
    k, direction = 2.0 * np.pi / 0.8, 0.5
    c, s = np.cos(direction), np.sin(direction)
    along = k * (c * view.places[..., 0] + s * view.places[..., 1])
    across = k * (-s * view.places[..., 0] + c * view.places[..., 1])
    slope = np.cos(along) * np.cos(across) * np.cos(view.heading - direction)
    slope -= np.sin(along) * np.sin(across) * np.sin(view.heading - direction)
    columns = np.zeros((1200, 4, 4))
    columns[:, range(4), range(4)] = 1.0
    best = waves(looked(2.0 * slope), columns).shapes[0]
    assert best["wavelength"] == pytest.approx(0.8, rel=0.05)
    assert best["direction"] == pytest.approx(direction, abs=0.15)


CASTERS = list(THESIS.caster_names)
CONCEALED = [
    {"name": "external_push", "target": ["chassis"], "force_x": 20.0, "force_y": -8.0, "start": 12.3003, "duration": 1.5},
    {"name": "low_friction_patch", "target": CASTERS, "factor": 0.3, "x": 0.5, "y": 0.3, "length": 0.6, "width": 0.4},
]


@pytest.mark.nightly  # a whole analysis, like that of others here
@pytest.mark.parametrize("entry", CONCEALED, ids=lambda entry: str(entry["name"]))
def test_what_comes_once_is_named_with_its_time_or_place(entry: dict[str, object], tmp_path: Path) -> None:
    excitation = make_excitation("identification", THESIS, 25.0, 11)
    true = dataclasses.replace(THESIS, physics=read_physics([entry], THESIS.caster_names))
    record_run(true, excitation.twist, excitation.duration, 11, tmp_path / "run", "reduced", controlled_as=THESIS)
    findings = analyse(RobotSubject(THESIS), [tmp_path / "run"], [], {}, 0, lambda message: None).findings
    [effect] = findings.effects
    assert effect.name == entry["name"] and effect.probability > 0.95
    values = {name: parameter.value for name, parameter in effect.parameters.items()}
    if effect.name == "external_push":
        for name in ("start", "duration"):  # which the simulator begins with the next step of its own
            low, high = effect.parameters[name].low, effect.parameters[name].high
            assert low < float(str(entry[name])) < high < low + 0.05, (low, high)
        assert (values["force_x"], values["force_y"]) == pytest.approx((20.0, -8.0), rel=0.05)
    else:
        assert np.hypot(values["x"] - 0.5, values["y"] - 0.3) < 0.15
        assert values["factor"] == pytest.approx(0.3, rel=0.2)
        recording = Recording.open(tmp_path / "run", THESIS)
        builder = RobotProblemBuilder(THESIS, [recording])
        problem = builder.build(with_terms=False)
        inside = np.linalg.norm((problem.wheel_places - [0.5, 0.3]) / [0.3, 0.2], axis=2) < 1.0
        [place] = [location for location in findings.locations if location.place is not None]
        assert place.intervals[0][0] == pytest.approx(problem.time[inside.any(axis=1)][0], abs=0.1)


@pytest.mark.nightly  # a whole analysis, like that of others here
def test_other_waves_are_asked_beside_what_was_found(tmp_path: Path) -> None:
    """From waves that do nearly as well no search leads to those that are there: other ones have to be tried again."""
    entry = {"name": "uneven_ground", "target": CASTERS, "amplitude": 0.001, "wavelength": 1.9, "direction": 2.6}
    true = dataclasses.replace(THESIS, physics=read_physics([entry], THESIS.caster_names))
    excitation = make_excitation("chirps", THESIS, 30.0, 4)
    record_run(true, excitation.twist, excitation.duration, 4, tmp_path / "run", "reduced", controlled_as=THESIS)
    problem = RobotProblemBuilder(THESIS, [Recording.open(tmp_path / "run", THESIS)]).build()
    search = EffectSearch(problem, np.random.default_rng(0))
    term = next(k for k, term in enumerate(problem.terms) if term.effect == "uneven_ground")
    elsewhere = dict(problem.terms[term].shapes[0]) | {"wavelength": 0.8, "direction": 0.5}
    wrong = search.conclude((Instance(term, tuple(sorted(elsewhere.items())), (0,)),), 5.0)
    [found] = search.with_best_waves(wrong).fit.instances
    assert dict(found.shape)["wavelength"] == pytest.approx(1.9, rel=0.1)
    assert math.cos(2.0 * (dict(found.shape)["direction"] - 2.6)) > 0.98  # half a turn on the floor is the same


@pytest.mark.nightly  # a whole analysis, like that of others here
@pytest.mark.parametrize("again", [True, False])
def test_a_push_is_proved_on_held_out_data_only_if_it_comes_there_too(again: bool, tmp_path: Path) -> None:
    """At the same time, as where somebody staged it; a recording without a push proves nothing, and is not made worse."""
    push = {"name": "external_push", "target": ["chassis"], "force_x": 20.0, "force_y": -8.0, "start": 6.3, "duration": 1.5}
    pushed = dataclasses.replace(THESIS, physics=read_physics([push], THESIS.caster_names))
    for seed, robot in ((1, pushed), (2, pushed if again else THESIS)):
        excitation = make_excitation("identification", THESIS, 16.0, seed)
        record_run(robot, excitation.twist, 16.0, seed, tmp_path / f"run_{seed}", "reduced", controlled_as=THESIS)
    findings = analyse(
        RobotSubject(THESIS), [tmp_path / "run_1"], [tmp_path / "run_2"], {}, 0, lambda message: None
    ).findings
    assert [effect.name for effect in findings.effects] == ["external_push"]
    assert findings.fit is not None
    closed = (findings.fit.gap_closed, findings.fit.rollout_gap_closed)
    notes = " ".join(findings.notes)
    if again:
        assert min(closed) > 0.9 and "comes at the same time in what was held out" in notes
    else:
        before, after = findings.fit.inverse_nrmse
        assert after < 1.01 * before and "is left out of the proof" in notes


@pytest.mark.parametrize(
    ("start", "found", "name", "true"),
    [(5.0, (5.0, 2.2), "duration", 4.0), (8.5, (9.9, 2.6), "start", 8.5), (8.5, (9.9, 2.6), "duration", 4.0)],
)
def test_a_push_may_begin_or_end_at_any_time_of_that_in_which_nothing_can_be_judged(
    tmp_path: Path, start: float, found: tuple[float, float], name: str, true: float
) -> None:
    """The robot stands from 7 to 10 s, and then the push ends or begins: its interval holds all that time.

    Where it begins earlier it would also end earlier, unless it lasts longer: so a start was told to milliseconds, and wrong.
    """

    def twist(time: float) -> np.ndarray:
        moving = np.clip(7.0 - time, 0.0, 1.0) + np.clip(time - 10.0, 0.0, 1.0)
        return moving * np.array([0.4 * np.sin(1.3 * time), 0.4 * np.cos(0.9 * time), 0.6 * np.sin(0.7 * time)])

    push = {"name": "external_push", "target": ["chassis"], "force_x": 20.0, "force_y": 10.0, "start": start, "duration": 4.0}
    robot = dataclasses.replace(THESIS, physics=read_physics([push], THESIS.caster_names))
    record_run(robot, twist, 16.0, 5, tmp_path / "run", "reduced", controlled_as=THESIS)
    problem = RobotProblemBuilder(THESIS, [Recording.open(tmp_path / "run", THESIS)]).build()
    number = next(k for k, term in enumerate(problem.terms) if term.effect == "external_push")
    term = problem.terms[number]
    shape = {**term.shapes[0], **dict(zip(("start", "duration"), found, strict=True))}
    instance = Instance(number, tuple(sorted(shape.items())), term.base_indices())
    search = EffectSearch(problem, np.random.default_rng(0))
    regression = search.whiten_at(search.residual_of((instance,)))
    low, high = shape_interval(regression, (), instance, name)
    value = shape[name]
    assert low < value < high and low < true < high
    assert max(abs(low - true), abs(high - true)) < 2.0


def test_a_problem_is_exact_where_it_is_made_so(tmp_path: Path) -> None:
    """A wrong zero is no first-order matter at 0.05 rad; at its size the model leaves what a healthy robot does."""
    left = []
    for offset in (0.0, 0.05):
        entry = {"name": "steer_zero_offset", "target": ["front_left"], "offset": offset}
        true = dataclasses.replace(THESIS, physics=read_physics([entry], THESIS.caster_names))
        excitation = make_excitation("identification", THESIS, 12.0, 3)
        record_run(true, excitation.twist, 12.0, 3, tmp_path / str(offset), "reduced", controlled_as=THESIS)
        problem = RobotProblemBuilder(THESIS, [Recording.open(tmp_path / str(offset), THESIS)]).build()
        number = next(k for k, term in enumerate(problem.terms) if term.key == "steer_zero_offset/front_left")
        exact = problem.exact_at({}, [SizedTerm(number, (), np.array([offset]), (0,))])
        assert np.array_equal(exact.nominal_residual, problem.residual)
        slip = [k for k, channel in enumerate(problem.channels) if channel.name.startswith("rolling")]
        rows = problem.valid[:, slip].all(axis=1)
        for p in (problem, exact):
            explained = p.residual - offset * p.columns(number, ())[:, :, 0]
            left.append(float(np.std(explained[np.ix_(rows, slip)])))
    healthy, _, first_order, exactly = left
    assert exactly < 1.5 * healthy < first_order


@pytest.mark.parametrize(
    ("last", "wanted"),
    [([28.48, 29.54, 30.93], [26.0]), ([28.48, 26.01], [26.0]), ([], [26.0])],
    ids=["louder ones", "among others", "too little of a turn"],
)
def test_a_ripple_of_most_joints_is_one_of_all(last: list[float], wanted: list[float]) -> None:
    """Three drives had 26 a radian; the fourth was given 28.4, 29.5 and two more, and the four were coggings one by one."""
    found = [np.array(own) for own in ([26.0, 26.4], [25.99, 27.3], [26.02], last) if own]
    assert common_orders(found, [0.07] * len(found)) == [pytest.approx(order, abs=0.01) for order in wanted]


def test_a_ripple_of_half_of_the_joints_is_none_of_all() -> None:
    found = [np.array(own) for own in ([26.0], [26.0], [31.0], [33.0, 41.0])]
    assert common_orders(found, [0.07] * 4) == []
    assert common_orders(found[3:], [0.07]) == [33.0, 41.0]


@pytest.mark.parametrize("order", [14.0, 21.0, 40.0])
def test_a_ripple_is_found_though_it_passes_too_fast_to_be_seen_most_of_the_time(order: float) -> None:
    time = np.arange(2400) / 20.0
    is_slow = time % 10.0 < 2.5
    angle = np.cumsum(np.where(is_slow, 1.0, 6.0) * (1.0 + 0.3 * np.sin(time))) / 20.0
    rng = np.random.default_rng(int(order))
    signal = np.where(is_slow, np.cos(order * angle + 0.7), 0.0) + 0.5 * rng.standard_normal(len(angle))
    chosen = orders(signal, angle, 20.0)
    assert np.abs(chosen.values - order).min() < math.pi / np.ptp(angle)
    assert chosen.among > 100


def test_samples_that_are_not_judged_do_not_say_how_fast_a_joint_turns() -> None:
    time = np.arange(2400) / 20.0
    is_still = time % 10.0 < 9.0
    angle = np.cumsum(np.where(is_still, 0.0, 6.0)) / 20.0
    chosen = orders(np.where(is_still, 0.0, np.cos(5.0 * angle)), angle, 20.0)
    assert np.abs(chosen.values - 5.0).min() < math.pi / np.ptp(angle)


@pytest.mark.parametrize(("span", "order", "seen"), [(3.2, 14.0, True), (1.6, 24.0, True), (3.2, 4.0, False)])
def test_a_ripple_is_known_by_its_waves_where_a_joint_turns_by_less_than_a_turn(span: float, order: float, seen: bool) -> None:
    """Steerings that swing to and fro: 14 a turn with 10000 nats had no name, as none of them had made a whole turn."""
    time = np.arange(1200) / 20.0
    angle = 0.5 * span * np.sin(0.4 * time)
    signal = np.cos(order * angle + 0.7) + 0.5 * np.random.default_rng(1).standard_normal(len(angle))
    chosen = orders(signal, angle, 20.0)
    assert (np.abs(chosen.values - order).min() < math.pi / np.ptp(angle)) == seen
    assert chosen.values.min() >= 3.0 * math.tau / np.ptp(angle)


def test_a_joint_that_hardly_turns_has_no_orders() -> None:
    angle = np.linspace(0.0, 1.0, 500)
    assert len(orders(np.sin(30.0 * angle), angle, 20.0).values) == 0
    assert len(orders(np.zeros(500), 20.0 * angle, 20.0).values) == 0
