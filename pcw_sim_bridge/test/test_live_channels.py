"""The live watch without ROS: a healthy robot stays near one deviation, a fault that begins is seen soon and in its place."""

import copy
import dataclasses
import json
import pickle
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from pcw_control.excitation import make_excitation
from pcw_description import load_robot, ros_messages
from pcw_description.recording import Recording
from pcw_description.recording_files import RawMessage
from pcw_sim_bridge.mismatch.errors import MismatchError
from pcw_sim_bridge.mismatch.live.departure_keeper import DepartureKeeper, KeepParameters
from pcw_sim_bridge.mismatch.live.live_channels import (
    Level,
    LiveChannels,
    LiveParameters,
    header_stamp,
    onset,
)
from pcw_sim_bridge.mismatch.live.live_rows import RowReader
from pcw_sim_bridge.mismatch.live.live_trials import (
    faults,
    judgements,
    messages,
    with_effects,
    within_tolerance,
)
from pcw_sim_bridge.mismatch.live.live_tuning import UNSTEADY, Tuning
from pcw_sim_bridge.mismatch.live.message_ring import OVERHEAD, MessageRing

THESIS = load_robot("thesis")
PARAMETERS = LiveParameters(learning=10.0)
# From the livelier part of the chirps on; the fault begins well after the learning [s].
CHIRPS_FROM = 18.0
FAULT_TIME, DURATION = 14.0, 18.0
FAULTS = {fault.name: fault for fault in faults(THESIS)}


def drive(*fault_names: str) -> list[RawMessage]:
    """Messages of a robot within tolerance, healthy until FAULT_TIME."""
    healthy = within_tolerance(THESIS, np.random.default_rng(5))
    faulty = with_effects(healthy, [FAULTS[name].physics for name in fault_names])
    twist = make_excitation("chirps", THESIS, 60.0).twist
    return list(messages(THESIS, [(healthy, FAULT_TIME), (faulty, DURATION)], lambda t: twist(t + CHIRPS_FROM), 3))


@pytest.fixture(scope="module")
def friction() -> list[RawMessage]:
    return drive("dry friction in a drive")


@pytest.fixture(scope="module")
def learned(friction: list[RawMessage]) -> Tuning:
    """What the watch knows after the healthy beginning."""
    live = LiveChannels(THESIS, PARAMETERS)
    for _, judgement, _ in judgements(live, iter(friction)):
        if judgement.ready:
            break
    assert live.tuning is not None
    return live.tuning


def after(sent: list[RawMessage], start: float) -> list[RawMessage]:
    return [message for message in sent if message.log_time_ns >= (start + 1.0) * 1e9]


def test_a_healthy_robot_stays_near_one_and_a_fault_is_seen_where_it_is(friction: list[RawMessage]) -> None:
    live = LiveChannels(THESIS, PARAMETERS)
    seen = [(now - 1.0, judgement) for now, judgement, _ in judgements(live, iter(friction))]
    before = [judgement for now, judgement in seen if now < FAULT_TIME and judgement.channels]
    assert before and all(judgement.level is Level.OK for judgement in before)
    values = [(state.name, state.normalised) for judgement in before for state in judgement.channels]
    slips = [value for name, value in values if name.startswith("rolling_consistency")]
    assert 0.4 < np.median([value for name, value in values if not name.startswith("rolling_consistency")]) < 1.6
    assert np.median(slips) < 1.6  # and far below: encoders tell slips better than the numbers of any robot are steady
    later = [(now, judgement) for now, judgement in seen if now >= FAULT_TIME]
    first = next(now for now, judgement in later if judgement.level is not Level.OK)
    assert first - FAULT_TIME < 1.5
    last = later[-1][1]
    begun = min(state.since for state in last.channels if state.since is not None) - 1.0
    assert abs(begun - FAULT_TIME) < 0.25
    assert last.suspect is not None and last.suspect.told
    assert (last.suspect.place, last.suspect.cause) == (THESIS.caster_names[0], "friction in the drive")
    # The torques feel it, and the slip that is foretold from them: not what the IMU and the tracker measure.
    departed = {state.name.partition("/")[0] for state in last.channels if state.level is not Level.OK}
    assert "chassis_force" in departed and departed <= {"chassis_force", "chassis_torque", "rolling_consistency"}


def test_stamps_that_never_change_are_told(friction: list[RawMessage]) -> None:
    """The reader said "live holds no messages; record it again"."""
    live, told = LiveChannels(THESIS, PARAMETERS), []
    for k, message in enumerate(friction[:2000]):
        states = ros_messages.typestore().deserialize_cdr(message.cdr, message.type_name)
        states.header.stamp.sec = states.header.stamp.nanosec = 0
        live.receive(message.topic, message.type_name, ros_messages.serialise(states))
        if k % 300 == 299:
            told.append(live.update().problems)
    assert len(told) == 6
    assert set(told[1:]) == {("all joint_states have the stamp 0.000000000 s; allowed: the time of each measurement",)}


def test_a_missing_joint_is_told_also_when_there_would_be_enough_to_learn_from(friction: list[RawMessage]) -> None:
    live = LiveChannels(THESIS, LiveParameters(learning=5.0))
    lacking = THESIS.joint_names[-1]
    sent = []
    for message in friction:
        if message.topic == "/joint_states" and message.log_time_ns < 9e9:
            states = ros_messages.typestore().deserialize_cdr(message.cdr, message.type_name)
            stamp, last = header_stamp(message.cdr), states.name.index(lacking)
            names = [name for name in states.name if name != lacking]
            values = (np.delete(getattr(states, field), last) for field in ("position", "velocity", "effort"))
            sent.append(message._replace(cdr=ros_messages.serialise(ros_messages.joint_state(stamp, names, *values))))
    judged = [judgement for _, judgement, _ in judgements(live, iter(sent))]
    assert judged[-1].learned > 5.0 and not judged[-1].ready
    assert any(f"{lacking} is in no message" in problem for problem in judged[-1].problems)


WARMED_UP = """
import gc, pickle, sys
from numba.core.dispatcher import Dispatcher
from pcw_description import load_robot
from pcw_description.recording_files import RawMessage
from pcw_sim_bridge.mismatch.live.live_channels import LiveChannels, LiveParameters
from pcw_sim_bridge.mismatch.live.live_trials import judgements

def kernels():
    found = [kernel for kernel in gc.get_objects() if isinstance(kernel, Dispatcher)]
    return {(kernel.__module__, kernel.__name__, str(signature)) for kernel in found for signature in kernel.signatures}

live = LiveChannels(load_robot("thesis"), LiveParameters(learning=10.0))
live.warm_up()
warm = kernels()
sent = [RawMessage(*message) for message in pickle.load(open(sys.argv[1], "rb"))]
judged = [judgement for _, judgement, _ in judgements(live, iter(sent))]
assert judged[-1].suspect is not None
print(len(warm), kernels() - warm)
"""


def test_nothing_is_left_to_compile_where_messages_wait(friction: list[RawMessage], tmp_path: Path) -> None:
    """The monitor compiled when it had learned, for half a minute in which it neither said anything nor ended on SIGINT."""
    pytest.importorskip("numba")
    sent = tmp_path / "sent.pickle"
    sent.write_bytes(pickle.dumps([tuple(message) for message in friction]))
    command = [sys.executable, "-c", WARMED_UP, str(sent)]
    result = subprocess.run(command, capture_output=True, text=True, timeout=300, check=True)
    warm, left = result.stdout.split(maxsplit=1)
    assert int(warm) > 10 and left.strip() == "set()"


def test_an_imu_without_accelerometer_is_watched_for_what_it_has(friction: list[RawMessage]) -> None:
    """Zeros were learned from; since nobody measured them, the watch must not wait for accelerations for ever."""
    sent = []
    for message in friction:
        if message.topic == "/imu/data":
            imu = ros_messages.typestore().deserialize_cdr(message.cdr, message.type_name)
            felt = ros_messages.imu(header_stamp(message.cdr), [0.0, 0.0, imu.angular_velocity.z], np.zeros(3))
            message = message._replace(cdr=ros_messages.serialise(felt))
        sent.append(message)
    live = LiveChannels(THESIS, PARAMETERS)
    last = [judgement for _, judgement, _ in judgements(live, iter(sent))][-1]
    names = {state.name for state in last.channels} | set(last.silent)
    assert live.tuning is not None
    assert "gyro" in names and not any(name.startswith("accelerometer") for name in names)
    assert last.level is not Level.OK


@pytest.mark.nightly
@pytest.mark.parametrize("robot", ["thesis", "tidybot2"])
def test_a_healthy_robot_that_goes_on_to_what_it_never_did_is_not_unwell(robot: str) -> None:
    """With stamps that tremble, too; what comes after the learning is faster, slides, or steers while it hardly moves."""
    nominal = load_robot(robot)
    twist = make_excitation("identification", nominal, 60.0).twist
    live = LiveChannels(nominal, LiveParameters())
    judged = [judgement for _, judgement, _ in judgements(live, messages(nominal, [(nominal, 60.0)], twist, 3))]
    assert len([judgement for judgement in judged if judgement.channels]) > 60
    assert max(state.normalised for judgement in judged for state in judgement.channels) < 3.0
    assert not [problem for judgement in judged for problem in judgement.problems if "gap" not in problem]


def test_no_number_is_known_better_than_it_is_steady(learned: Tuning, friction: list[RawMessage]) -> None:
    tuning = copy.deepcopy(learned)
    reader = RowReader(THESIS, tuning.cutoff)
    rows = reader.read([message for message in friction if 4e9 < message.log_time_ns < 8e9]).rows
    for _ in range(200):
        tuning.include(rows)
    deviations = tuning.layout.deviations
    assert np.any(np.sqrt(np.diag(tuning.covariance)) < 0.1 * UNSTEADY * deviations)  # after 800 s of the same motion
    least = np.sqrt(tuning.noise**2 + np.sum((UNSTEADY * rows.columns * deviations) ** 2, axis=2))
    assert np.all(tuning.deviation(rows) >= least)


def test_a_push_is_told_from_casters(learned: Tuning) -> None:
    live = LiveChannels(THESIS, PARAMETERS, learned)
    sent = after(drive("a push"), FAULT_TIME - 3.0)
    last = [judgement for _, judgement, _ in judgements(live, iter(sent))][-1]
    assert last.level is Level.ERROR
    assert last.suspect is not None and last.suspect.told and last.suspect.place == "chassis"


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_a_window_in_which_nothing_can_be_judged_says_nothing(friction: list[RawMessage]) -> None:
    reader = RowReader(THESIS, 3.0)  # its filter settles for 0.8 s at either end
    window = reader.read([message for message in friction if 4.0e9 < message.log_time_ns < 5.2e9])
    assert not len(window.rows)


def test_a_saved_calibration_judges_from_the_start(learned: Tuning, friction: list[RawMessage], tmp_path: Path) -> None:
    path = tmp_path / "calibration.json"
    learned.save(path)
    again = Tuning.load(path, THESIS)
    place = np.array([name.startswith("ground.slope") for name in again.layout.nuisances])
    assert place.sum() == 2
    # The floor is another one, the rest stays as known as it was.
    deviation = np.sqrt(np.diag(again.covariance))
    np.testing.assert_allclose(deviation[place], again.layout.deviations[place], rtol=1e-6)
    np.testing.assert_allclose(again.mean[place], 0.0, atol=1e-12)
    # Against how well a number is known: one that happens to be near zero has no digits of its own.
    np.testing.assert_allclose(((again.mean - learned.mean) / deviation)[~place], 0.0, atol=1e-4)
    np.testing.assert_allclose(deviation[~place], np.sqrt(np.diag(learned.covariance))[~place], rtol=1e-5)
    live = LiveChannels(THESIS, PARAMETERS, again)
    early = [m for m in after(friction, 2.0) if m.log_time_ns < 6e9]
    judged = [judgement for _, judgement, _ in judgements(live, iter(early))]
    assert len([judgement for judgement in judged if judgement.channels]) > 5
    assert all(judgement.level is Level.OK for judgement in judged)

    with pytest.raises(MismatchError, match="exists already"):
        learned.save(path)
    with pytest.raises(MismatchError, match="another robot, or the description has changed"):
        heavier = dataclasses.replace(THESIS, chassis=dataclasses.replace(THESIS.chassis, mass=THESIS.chassis.mass + 0.1))
        Tuning.load(path, heavier)
    content = json.loads(path.read_text())
    for change, reason in (
        ({"format": "other"}, "allowed: pcw_live_calibration/1"),
        ({"information": [[1.0]]}, "damaged"),
        ({"channels": []}, "damaged"),
    ):
        path.write_text(json.dumps({**content, **change}))
        with pytest.raises(MismatchError, match=reason):
            Tuning.load(path, THESIS)
    path.write_text("{")
    with pytest.raises(MismatchError, match="no JSON"):
        Tuning.load(path, THESIS)
    with pytest.raises(MismatchError, match="cannot be read"):
        Tuning.load(tmp_path / "none.json", THESIS)


def test_a_lost_sensor_is_said_and_the_others_go_on(learned: Tuning, friction: list[RawMessage]) -> None:
    live = LiveChannels(THESIS, PARAMETERS, learned)
    sent = [m for m in after(friction, 2.0) if m.log_time_ns < 5e9 or m.topic != "/imu/data"]
    last = [j for now, j, _ in judgements(live, iter(sent)) if now < FAULT_TIME][-1]
    kinds = {state.name.partition("/")[0] for state in last.channels}
    assert kinds >= {"chassis_force", "chassis_torque"} and not kinds & {"gyro", "accelerometer"}
    assert last.silent == ("gyro", "accelerometer/x", "accelerometer/y")
    assert "gyro has no sensor now" in last.problems
    assert last.level is Level.OK


@pytest.mark.parametrize(
    ("topic", "gap"), [("joint_states", 0.03), ("joint_states", 0.3), ("imu/data", 0.3), ("ground_truth/odom", 0.2)]
)
def test_lost_messages_are_no_departure(learned: Tuning, friction: list[RawMessage], topic: str, gap: float) -> None:
    begins = FAULT_TIME + 1.0 - np.array([3.1, 1.7, 0.9])

    def lost(message: RawMessage) -> bool:
        age = message.log_time_ns * 1e-9 - begins
        return message.topic.strip("/") == topic and bool(np.any((age > 0.0) & (age < gap)))

    healthy = [m for m in after(friction, FAULT_TIME - 6.0) if m.log_time_ns < (FAULT_TIME + 1.0) * 1e9]
    live = LiveChannels(THESIS, PARAMETERS, copy.deepcopy(learned))
    seen = [judgement for _, judgement, _ in judgements(live, (m for m in healthy if not lost(m)))]
    assert sum(bool(judgement.channels) for judgement in seen) > 5
    assert all(judgement.level is Level.OK for judgement in seen)


def test_nothing_to_compare_is_said(friction: list[RawMessage]) -> None:
    """Neither an IMU nor torques: the reason comes out, nothing is learned and nothing is judged."""
    live = LiveChannels(THESIS, LiveParameters(learning=5.0))
    problems = set()
    for message in friction[: len(friction) // 2]:
        if message.topic == "/joint_commands":  # joint states without measured torques, by their stamps and names alone
            live.receive("/joint_states", message.type_name, bytes(message.cdr))
    judgement = live.update()
    problems.update(judgement.problems)
    assert not judgement.ready and judgement.stamp is None and problems


def test_a_clock_that_begins_anew_is_no_fault(learned: Tuning, friction: list[RawMessage]) -> None:
    live = LiveChannels(THESIS, PARAMETERS, learned)
    healthy = [m for m in after(friction, 3.0) if m.log_time_ns < 7e9]
    levels, judged = [], 0
    for part in (healthy, healthy):
        for _, judgement, _ in judgements(live, iter(part)):
            levels.append(judgement.level)
            judged += bool(judgement.channels)
    assert live.restarts == 1
    assert set(levels) == {Level.OK} and judged > 8


def test_learning_again_forgets(learned: Tuning, friction: list[RawMessage]) -> None:
    live = LiveChannels(THESIS, PARAMETERS, learned)
    for message in after(friction, 10.0):
        live.receive(message.topic, message.type_name, bytes(message.cdr))
    assert live.update().ready
    live.learn_again()
    judgement = live.update()
    assert not judgement.ready and live.tuning is None and judgement.learned == 0.0


def test_onset_is_where_the_size_changes() -> None:
    rng = np.random.default_rng(1)
    time = np.arange(200) / 20.0
    standard = rng.normal(size=200)
    standard[150:] += 4.0
    assert onset(time, standard, 4.0) == pytest.approx(7.5, abs=0.11)


@pytest.mark.parametrize(
    ("field", "value"), [("learning", 1.0), ("memory", 0.0), ("horizon", float("nan")), ("warn", 0.5), ("error", 2.0)]
)
def test_parameters_out_of_range_are_refused(field: str, value: float) -> None:
    with pytest.raises(MismatchError, match=field):
        LiveParameters(**{field: value})


def test_stamps_of_both_byte_orders() -> None:
    for code, order in ((1, "<"), (0, ">")):
        assert header_stamp(bytes([0, code, 0, 0]) + struct.pack(f"{order}iI", 12, 345)) == 12_000_000_345


# --- The ring and the recordings ------------------------------------------------------------------------


def small(second: float) -> RawMessage:
    return RawMessage("/joint_states", "sensor_msgs/msg/JointState", round(second * 1e9), b"x" * 100)


def test_the_ring_is_bounded_in_time_and_in_size() -> None:
    ring = MessageRing(2.0, 10**6)
    for k in range(100):
        ring.append(small(0.1 * k))
    assert len(ring) == 21 and ring.size == 21 * (100 + OVERHEAD)
    assert [message.log_time_ns for message in ring.since(round(9.75e9))] == [round(9.8e9), round(9.9e9)]
    tight = MessageRing(1e6, 5 * (100 + OVERHEAD))
    for k in range(100):
        tight.append(small(k))
    assert len(tight) == 5 and tight.since(0)[0].log_time_ns == 95e9
    tight.clear()
    assert len(tight) == 0 and tight.size == 0


def keep(keeper: DepartureKeeper, sent: list[RawMessage], departs_at: float) -> list[Path]:
    """Hand over messages, say that something departs from a time on, and return what was finished."""
    finished = []
    for message in sent:
        keeper.receive(message)
        if message.log_time_ns >= (departs_at + 1.0) * 1e9:
            keeper.departs()
        path = keeper.work(20)
        if path is not None:
            finished.append(path)
    return finished


def test_the_last_minutes_are_kept_once(friction: list[RawMessage], tmp_path: Path) -> None:
    keeper = DepartureKeeper(KeepParameters(str(tmp_path / "kept"), pre_roll=3.0, post_roll=1.0, pause=100.0))
    [path] = keep(keeper, friction, 10.0)
    assert keeper.kept == [path] and keeper.writing is None and keeper.close() is None
    recording = Recording.open(path, THESIS)
    assert {warning.code for warning in recording.warnings} <= {"gap"}  # of what never came
    assert recording.t0_ns == pytest.approx(8e9, abs=3e6) and recording.duration == pytest.approx(4.0, abs=0.005)
    assert recording.imu is not None and recording.ground_truth is not None and recording.joint_commands is not None
    came = sum(message.topic == "/joint_states" and 8e9 <= message.log_time_ns <= 12e9 for message in friction)
    assert len(recording.joint_states) == pytest.approx(came, abs=3)


def test_pauses_numbers_and_a_stop_in_between(friction: list[RawMessage], tmp_path: Path) -> None:
    parameters = KeepParameters(str(tmp_path), pre_roll=1.0, post_roll=0.5, pause=2.0, most=2)
    keeper = DepartureKeeper(parameters)
    finished = keep(keeper, friction, 2.0)
    assert len(finished) == 2 and len({*finished}) == 2  # of the same second, each in a folder of its own
    starts = [Recording.open(path, THESIS).t0_ns * 1e-9 for path in finished]
    assert starts[1] - starts[0] == pytest.approx(0.5 + 2.0, abs=0.1)

    # Stopped in the post-roll: what there is, whole.
    other = DepartureKeeper(KeepParameters(str(tmp_path), pre_roll=1.0, post_roll=60.0))
    assert keep(other, friction[:3000], 1.0) == []
    path = other.close()
    assert path is not None and path not in finished
    assert {warning.code for warning in Recording.open(path, THESIS).warnings} <= {"gap"}


def test_a_keeper_without_messages_or_with_bad_numbers(tmp_path: Path) -> None:
    assert DepartureKeeper(KeepParameters(str(tmp_path / "none"))).departs() is None
    assert not (tmp_path / "none").exists()
    with pytest.raises(MismatchError, match="pre_roll"):
        KeepParameters("x", pre_roll=0.0)
