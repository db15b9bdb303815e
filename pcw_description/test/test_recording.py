"""Recordings: what is written is read back, whatever happened to the file, and what is wrong is named.

One synthetic drive (`Drive`) serves all: a robot that accelerates, turns, stands still, with sensor noise, encoder
steps, jittered stamps and lost messages. Healthy, it must pass without a warning; each fault then has a warning.
"""

from __future__ import annotations

import dataclasses
import functools
import io
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import Writer as McapWriter
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Reader as RosbagsReader
from rosbags.rosbag2 import Writer as RosbagsWriter

from pcw_description import DRIVE, STEER, RobotDescription, inverse_kinematics, load_robot, ros_messages
from pcw_description.cdr_columns import decode_columns
from pcw_description.errors import RecordingError
from pcw_description.recording import Recording
from pcw_description.recording_checks import find_gaps, order_stamps, position_scale, units_of
from pcw_description.recording_writer import OfferedQos, RecordingWriter
from pcw_description.ros_messages import joint_state

SECOND = 1_000_000_000
T0 = 1_700_000_000 * SECOND
RATE = 250
DEGREES = 180.0 / np.pi


@pytest.fixture(scope="module")
def robot() -> RobotDescription:
    return load_robot("thesis")


# --- A synthetic drive ----------------------------------------------------------------------------------


@dataclasses.dataclass
class Drive:
    """Arrays of a drive, to be spoilt by a test and written; stamps in ns, (T,), joints (T, n, 2)."""

    names: list[str]
    stamp_ns: np.ndarray
    position: np.ndarray | None
    velocity: np.ndarray | None
    effort: np.ndarray | None
    pose: np.ndarray
    twist: np.ndarray
    gyro: np.ndarray
    acceleration: np.ndarray

    def keep(self, rows: np.ndarray) -> Drive:
        """The same drive with some messages only, or with messages in another order."""
        arrays = {
            field.name: value[rows]
            for field in dataclasses.fields(self)
            if isinstance(value := getattr(self, field.name), np.ndarray)
        }
        return dataclasses.replace(self, **arrays)

    def copy(self) -> Drive:
        return self.keep(np.arange(len(self.stamp_ns)))

    def write(self, path: Path, prefix: str = "/", **options: object) -> Path:
        """Write all topics, IMU and truth at half and a fifth of the rate."""
        with RecordingWriter(path, **options) as writer:  # type: ignore[arg-type]
            for row, stamp_ns in enumerate(self.stamp_ns.tolist()):
                fields = [None if a is None else a[row] for a in (self.position, self.velocity, self.effort)]
                log_time_ns = T0 + row * SECOND // RATE
                writer.write(prefix + "joint_states", joint_state(stamp_ns, self.names, *fields), log_time_ns)
                if row % 2 == 0:
                    message = ros_messages.imu(stamp_ns, self.gyro[row], self.acceleration[row])
                    writer.write(prefix + "imu/data", message, log_time_ns)
                if row % 5 == 0:
                    message = ros_messages.odometry(stamp_ns, self.pose[row], self.twist[row])
                    writer.write(prefix + "ground_truth/odom", message, log_time_ns)
        return path


def drive(robot: RobotDescription, seed: int = 0) -> Drive:
    """A healthy drive with noise; it starts and ends at rest."""
    return _drive(robot.name, seed).copy()


@functools.cache
def _drive(name: str, seed: int) -> Drive:
    robot, seconds = load_robot(name), 12.0
    rng = np.random.default_rng(seed)
    steps = int(seconds * RATE)
    time = np.arange(steps) / RATE
    phase = rng.uniform(0.0, 2.0 * np.pi, 3)
    moving = np.clip((time - 1.0) / 0.5, 0.0, 1.0) * np.clip((seconds - 1.0 - time) / 0.5, 0.0, 1.0)
    twist = moving[:, None] * np.stack(
        [
            0.4 * np.sin(0.9 * time + phase[0]),
            0.3 * np.sin(0.7 * time + phase[1]),
            0.8 * np.sin(1.1 * time + phase[2]),
        ],
        axis=1,
    )
    position, velocity = np.zeros((steps, robot.n, 2)), np.zeros((steps, robot.n, 2))
    position[0] = rng.uniform(-3.0, 3.0, (robot.n, 2))
    pose = np.zeros((steps, 3))
    for row in range(steps):
        velocity[row] = inverse_kinematics(robot, position[row, :, STEER], twist[row])
        if row + 1 < steps:
            position[row + 1] = position[row] + velocity[row] / RATE
            c, s = np.cos(pose[row, 2]), np.sin(pose[row, 2])
            forward, left, rotation = twist[row]
            pose[row + 1] = pose[row] + np.array([c * forward - s * left, s * forward + c * left, rotation]) / RATE
    encoder_step = 2.0 * np.pi / 4096
    return Drive(
        names=list(robot.joint_names),
        stamp_ns=T0 + (time * SECOND).astype(np.int64) + rng.integers(-300_000, 300_000, steps),
        position=np.round(position / encoder_step) * encoder_step,
        velocity=velocity + rng.normal(0.0, 0.05, velocity.shape),
        effort=rng.normal(0.0, 0.5, velocity.shape),
        pose=pose + rng.normal(0.0, 0.001, pose.shape),
        twist=twist,
        gyro=np.column_stack([np.zeros((steps, 2)), twist[:, 2]]) + rng.normal(0.0, 0.01, (steps, 3)),
        acceleration=np.array([0.0, 0.0, 9.81]) + rng.normal(0.0, 0.05, (steps, 3)),
    )


def codes(recording: Recording) -> list[str]:
    return [warning.code for warning in recording.warnings]


def text_of(recording: Recording, code: str) -> str:
    """The text of the one warning of this kind."""
    (warning,) = (warning for warning in recording.warnings if warning.code == code)
    return str(warning)


# --- Writing and reading back ---------------------------------------------------------------------------


def test_what_is_written_is_read_back_in_the_order_of_the_robot(robot: RobotDescription, tmp_path: Path) -> None:
    """Messages name their joints in another order, with a foreign joint among them."""
    healthy = drive(robot)
    shuffled = healthy.copy()
    order = np.random.default_rng(1).permutation(len(healthy.names))
    shuffled.names = ["gripper", *(healthy.names[i] for i in order)]
    for field in ("position", "velocity", "effort"):
        flat = getattr(healthy, field).reshape(-1, len(healthy.names))[:, order]
        setattr(shuffled, field, np.column_stack([np.full(len(flat), 7.0), flat]))
    recording = Recording.open(shuffled.write(tmp_path / "bag"), robot)

    states = recording.joint_states
    assert recording.warnings == []
    np.testing.assert_array_equal(states.position, healthy.position)
    np.testing.assert_array_equal(states.velocity, healthy.velocity)
    np.testing.assert_array_equal(states.effort, healthy.effort)
    np.testing.assert_array_equal(states.stamp_ns, healthy.stamp_ns)
    np.testing.assert_allclose(states.stamp, (healthy.stamp_ns - healthy.stamp_ns[0]) * 1e-9, atol=1e-12)
    assert recording.t0_ns == healthy.stamp_ns[0]
    assert recording.duration == pytest.approx((healthy.stamp_ns[-1] - healthy.stamp_ns[0]) * 1e-9, abs=1e-12)
    trace = states["front_left_steer"]
    np.testing.assert_array_equal(trace.position, healthy.position[:, 0, STEER])

    assert recording.imu is not None and recording.ground_truth is not None
    np.testing.assert_array_equal(recording.imu.gyro, healthy.gyro[::2])
    np.testing.assert_array_equal(recording.imu.acceleration, healthy.acceleration[::2])
    np.testing.assert_allclose(recording.ground_truth.pose, healthy.pose[::5], atol=1e-9)
    np.testing.assert_array_equal(recording.ground_truth.twist, healthy.twist[::5])
    assert recording.ground_truth.frame_id == "odom"
    assert recording.joint_commands is None and recording.odom is None and recording.cmd_vel is None
    assert recording.topics["/imu/data"].count == len(healthy.stamp_ns[::2])


def test_messages_in_memory_are_read_like_a_file(robot: RobotDescription, tmp_path: Path) -> None:
    written = drive(robot)
    written.gyro = written.gyro * DEGREES
    path = tmp_path / "bag"
    written.write(path)
    from_file = Recording.open(path, robot)
    messages = list(from_file.messages())
    in_memory = Recording.of_messages(messages, robot, "the robot")
    assert in_memory.topic_names == from_file.topic_names and in_memory.t0_ns == from_file.t0_ns
    for field in ("stamp_ns", "position", "velocity", "effort"):
        np.testing.assert_array_equal(getattr(in_memory.joint_states, field), getattr(from_file.joint_states, field))
    assert in_memory.imu is not None and from_file.imu is not None
    np.testing.assert_array_equal(in_memory.imu.gyro, from_file.imu.gyro)
    assert codes(in_memory) == codes(from_file) == ["wrong_unit"]
    assert list(in_memory.messages()) == messages and len(in_memory.sha256) == 64
    assert in_memory.sha256 != Recording.of_messages(messages[:-1], robot).sha256
    with pytest.raises(RecordingError, match="the robot has no joint_states"):
        Recording.of_messages([m for m in messages if "joint" not in m.topic], robot, "the robot")
    with pytest.raises(RecordingError, match="holds no messages"):
        Recording.of_messages([], robot)


def test_yaw_is_unwrapped(robot: RobotDescription, tmp_path: Path) -> None:
    spinning = drive(robot)
    spinning.pose[:, 2] = np.linspace(0.0, 20.0, len(spinning.pose))
    ground_truth = Recording.open(spinning.write(tmp_path / "bag"), robot).ground_truth
    assert ground_truth is not None
    np.testing.assert_allclose(ground_truth.pose[:, 2], spinning.pose[::5, 2], atol=1e-9)


def test_without_a_robot_joints_come_by_name(robot: RobotDescription, tmp_path: Path) -> None:
    healthy = drive(robot)
    states = Recording.open(healthy.write(tmp_path / "bag")).joint_states
    assert states.position.shape == (len(healthy.stamp_ns), 2 * robot.n)
    assert list(states) == healthy.names
    np.testing.assert_array_equal(states["rear_right_drive"].velocity, healthy.velocity[:, -1, DRIVE])
    with pytest.raises(RecordingError, match="did you mean 'rear_left_drive'"):
        states["rear_left_driv"]


def test_commands_contact_and_all_kinds_of_cmd_vel(robot: RobotDescription, tmp_path: Path) -> None:
    """A Twist, and a TwistStamped without a stamp, are placed in header time, here 5 s before the time of recording."""
    twist = np.array([0.1, -0.2, 0.3])
    for kind in ("stamped", "zero", "plain"):
        path = tmp_path / kind
        with RecordingWriter(path) as writer:
            for row in range(100):
                stamp_ns, log_time_ns = T0 + row * SECOND // 100, T0 + 5 * SECOND + row * SECOND // 100
                torque = np.full((robot.n, 2), float(row))
                writer.write("/joint_states", joint_state(stamp_ns, robot.joint_names, torque / 7), log_time_ns)
                writer.write("/joint_commands", joint_state(stamp_ns, robot.joint_names, effort=torque), log_time_ns)
                wrench = ros_messages.wrench_stamped(stamp_ns, (1.0, 2.0, row), (0.0, 0.0, 0.0), "front_left_wheel")
                writer.write("/contact/front_left/wrench", wrench, log_time_ns)
                message = ros_messages.twist_stamped(0 if kind == "zero" else stamp_ns, twist * row)
                writer.write("/cmd_vel", message.twist if kind == "plain" else message, log_time_ns)
        recording = Recording.open(path, robot)
        assert recording.joint_commands is not None and recording.cmd_vel is not None
        np.testing.assert_array_equal(recording.joint_commands.effort[:, 0, 0], np.arange(100.0))
        assert np.isnan(recording.joint_commands.velocity).all()
        np.testing.assert_allclose(recording.cmd_vel.twist, np.outer(np.arange(100), twist))
        np.testing.assert_allclose(recording.cmd_vel.stamp, np.arange(100) / 100, atol=1e-9)
        np.testing.assert_array_equal(recording.contact["front_left"].force[:, 2], np.arange(100.0))
        assert recording.contact["front_left"].frame_id == "front_left_wheel"
        # No velocity and no effort was measured here.
        assert set(codes(recording)) == {"missing_field"} | ({"unstamped"} if kind == "zero" else set())


def test_any_topic_is_there_raw_and_as_columns(robot: RobotDescription, tmp_path: Path) -> None:
    path = tmp_path / "bag"
    with RecordingWriter(path) as writer:
        for row in range(10):
            writer.write("/joint_states", joint_state(T0 + row, ["a"], [float(row)]))
            writer.write("/clock", ros_messages.clock(T0 + row))
    recording = Recording.open(path)
    (clock,) = recording.columns("/clock")
    np.testing.assert_array_equal(clock.numbers["clock.nanosec"], np.arange(10))
    raw = list(recording.messages(["/clock"]))
    assert [message.log_time_ns for message in raw] == [T0 + row for row in range(10)]
    assert raw[3].cdr == ros_messages.serialise(ros_messages.clock(T0 + 3))
    with pytest.raises(RecordingError, match=r"no topic '/clok'.*/clock \(rosgraph_msgs/msg/Clock, 10\)"):
        recording.columns("/clok")


def test_other_readers_read_what_the_writer_writes(robot: RobotDescription, tmp_path: Path) -> None:
    """rosbags reads the folder, mcap the file through its index, yaml the metadata in the words of Jazzy's rosbag2."""
    path = tmp_path / "bag"
    with RecordingWriter(path) as writer:
        writer.add_topic("/joint_states", ros_messages.JOINT_STATE, [OfferedQos(depth=5, reliability="best_effort")])
        for row in range(1000):
            writer.write("/joint_states", joint_state(T0 + row * SECOND, ["a"], [float(row)]))
    with RosbagsReader(path) as reader:
        assert reader.message_count == 1000
        (connection,) = reader.connections
        assert connection.ext.offered_qos_profiles[0].reliability.name == "BEST_EFFORT"
        values = [
            ros_messages.typestore().deserialize_cdr(data, connection.msgtype).position[0]
            for _, _, data in reader.messages()
        ]
    assert values == list(range(1000))

    with writer.data_path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        assert reader.get_header().profile == "ros2"
        (schema,) = summary.schemas.values()
        assert (schema.name, schema.encoding) == (ros_messages.JOINT_STATE, "ros2msg")
        assert schema.data.decode().startswith("std_msgs/Header header\nstring[] name\n")
        assert "MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec" in schema.data.decode()
        assert summary.statistics.message_count == 1000
        assert sum(sum(1 for _ in index.message_index_offsets) for index in summary.chunk_indexes) >= 1
        late = [message.log_time for _, _, message in reader.iter_messages(log_time_order=True, reverse=True)][:2]
        assert late == [T0 + 999 * SECOND, T0 + 998 * SECOND]

    information = yaml.safe_load((path / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert information["version"] == 9 and information["storage_identifier"] == "mcap"
    assert information["duration"]["nanoseconds"] == 999 * SECOND
    assert information["starting_time"]["nanoseconds_since_epoch"] == T0
    (topic,) = information["topics_with_message_count"]
    assert topic["message_count"] == 1000
    assert topic["topic_metadata"]["type_description_hash"].startswith("RIHS01_")
    profile = topic["topic_metadata"]["offered_qos_profiles"][0]
    assert profile["history"] == "keep_last" and profile["deadline"] == {"sec": 9223372036, "nsec": 854775807}


def test_an_independent_decoder_agrees(tmp_path: Path, robot: RobotDescription) -> None:
    """mcap-ros2-support decodes by the schema text that the writer put into the file."""
    decoder = pytest.importorskip("mcap_ros2.decoder")
    short = drive(robot).keep(np.arange(20))
    path = short.write(tmp_path / "bag")
    with (path / "bag_0.mcap").open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[decoder.DecoderFactory()])
        states = [message for _, _, _, message in reader.iter_decoded_messages(topics=["/joint_states"])]
    assert len(states) == 20
    np.testing.assert_array_equal(states[7].velocity, short.velocity[7].ravel())
    assert list(states[7].name) == short.names


@pytest.mark.parametrize("compression", ["zstd", "lz4", "none"])
def test_same_input_gives_the_same_file(robot: RobotDescription, tmp_path: Path, compression: str) -> None:
    short = drive(robot).keep(np.arange(500))
    files = []
    for name in ("one", "two"):
        path = short.write(tmp_path / name / "bag", compression=compression, flush_interval=None)
        files.append([(path / file).read_bytes() for file in ("bag_0.mcap", "metadata.yaml")])
    assert files[0] == files[1]
    recording = Recording.open(tmp_path / "one" / "bag", robot)
    assert len(recording.joint_states) == 500
    digest = subprocess.run(
        [sys.executable, "-c", "import hashlib, sys; print(hashlib.sha256(open(sys.argv[1], 'rb').read()).hexdigest())"]
        + [str(tmp_path / "one" / "bag" / "bag_0.mcap")],
        capture_output=True,
        text=True,
        check=True,
    )
    assert recording.sha256 == digest.stdout.strip()


def test_the_writer_leaves_an_existing_path_alone(tmp_path: Path) -> None:
    (tmp_path / "kept").mkdir()
    (tmp_path / "kept" / "notes.txt").write_text("mine")
    (tmp_path / "file").write_text("mine too")
    for name in ("kept", "file"):
        with pytest.raises(RecordingError, match=f"{name} exists already and is left as it is"):
            RecordingWriter(tmp_path / name)
    assert [entry.name for entry in (tmp_path / "kept").iterdir()] == ["notes.txt"]
    assert (tmp_path / "file").read_text() == "mine too"


def test_the_writer_refuses_what_it_cannot_write(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="did you mean 'zstd'"):
        RecordingWriter(tmp_path / "a", compression="zst")
    with RecordingWriter(tmp_path / "b") as writer:
        writer.write("/clock", ros_messages.clock(T0))
        with pytest.raises(RecordingError, match="/clock is recorded as rosgraph_msgs/msg/Clock and cannot also be"):
            writer.add_topic("/clock", ros_messages.IMU)
        with pytest.raises(RecordingError, match="Twist has no stamp of its own; give log_time_ns"):
            writer.write("/cmd_vel", ros_messages.twist_stamped(T0, (0.0, 0.0, 0.0)).twist)
    assert writer.counts == {"/clock": 1}


# --- Killed, cut off, damaged ---------------------------------------------------------------------------


def write_unfinished(robot: RobotDescription, path: Path, flush_every: int = 50) -> tuple[Drive, bytes]:
    """A recording whose writer never got to close; returns what was on disk, all of it flushed."""
    short = drive(robot).keep(np.arange(1000))
    writer = RecordingWriter(path, flush_interval=None)
    for row, stamp_ns in enumerate(short.stamp_ns.tolist()):
        state = joint_state(stamp_ns, short.names, short.position[row], short.velocity[row], short.effort[row])
        writer.write("/joint_states", state)
        if row % flush_every == flush_every - 1:
            writer.flush()
    return short, writer.data_path.read_bytes()


def test_an_unfinished_recording_is_read_in_full(robot: RobotDescription, tmp_path: Path) -> None:
    short, _ = write_unfinished(robot, tmp_path / "bag")
    recording = Recording.open(tmp_path / "bag", robot)
    np.testing.assert_array_equal(recording.joint_states.position, short.position)
    assert "bag_0.mcap has no footer: its recorder was stopped while writing; 1000 whole messages over 3.996 s" in text_of(
        recording, "unfinished"
    )
    assert "metadata.yaml counts 0 messages, the files hold 1000" in text_of(recording, "stale_metadata")


@settings(max_examples=60, deadline=None)
@given(share=st.floats(0.0, 1.0))
def test_a_file_cut_off_anywhere_gives_every_whole_chunk(share: float) -> None:
    """Whatever byte the file ends at, the messages are the first ones, and all of those whose chunk is whole."""
    whole, ends = _CUT
    size = int(share * len(whole))
    cut = _CUT_FOLDER / "cut.mcap"
    cut.write_bytes(whole[:size])
    expected = sum(1 for end in ends if end <= size) * 50
    if expected == 0:
        with pytest.raises(RecordingError, match="holds no messages|neither MCAP|is empty"):
            Recording.open(cut)
        return
    recording = Recording.open(cut)
    assert len(recording.joint_states) == expected
    assert "unfinished" in codes(recording)


_CUT: tuple[bytes, list[int]]
_CUT_FOLDER: Path


@pytest.fixture(autouse=True, scope="module")
def _unfinished_file(robot: RobotDescription, tmp_path_factory: pytest.TempPathFactory) -> None:
    global _CUT, _CUT_FOLDER
    _CUT_FOLDER = tmp_path_factory.mktemp("cut")
    _, whole = write_unfinished(robot, _CUT_FOLDER / "bag")
    ends, position = [], 8
    while position < len(whole):
        opcode, length = whole[position], int.from_bytes(whole[position + 1 : position + 9], "little")
        position += 9 + length
        if opcode == 6:
            ends.append(position)
    _CUT = whole, ends


def test_a_damaged_chunk_costs_only_itself(robot: RobotDescription, tmp_path: Path) -> None:
    whole, ends = _CUT
    spoilt = bytearray(whole)
    spoilt[ends[3] - 100] ^= 0xFF
    (tmp_path / "spoilt.mcap").write_bytes(spoilt)
    recording = Recording.open(tmp_path / "spoilt.mcap", robot)
    assert len(recording.joint_states) == 950
    assert "spoilt.mcap: 1 damaged chunks of messages were left out" in text_of(recording, "damaged_file")


def test_zeros_at_the_end_are_not_messages(robot: RobotDescription, tmp_path: Path) -> None:
    """A file system that lost power leaves a file of the right length whose last blocks are zero."""
    (tmp_path / "zeros.mcap").write_bytes(_CUT[0] + bytes(4096))
    recording = Recording.open(tmp_path / "zeros.mcap", robot)
    assert len(recording.joint_states) == 1000
    assert "4096 bytes of an incomplete one at the end were not" in text_of(recording, "unfinished")


@pytest.mark.parametrize("content", [None, "", "not: a bag", "{broken", "rosbag2_bagfile_information: 3"])
def test_broken_metadata_is_not_needed(robot: RobotDescription, tmp_path: Path, content: str | None) -> None:
    path = drive(robot).keep(np.arange(200)).write(tmp_path / "bag")
    metadata = path / "metadata.yaml"
    metadata.unlink() if content is None else metadata.write_text(content)
    recording = Recording.open(path, robot)
    assert len(recording.joint_states) == 200
    expected = "there is no metadata.yaml" if content is None else "metadata.yaml cannot be read"
    assert expected in text_of(recording, "unfinished")


def test_metadata_that_lists_a_missing_file_says_so(robot: RobotDescription, tmp_path: Path) -> None:
    path = drive(robot).keep(np.arange(200)).write(tmp_path / "bag")
    metadata = path / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace("  - bag_0.mcap\n", "  - bag_0.mcap\n  - bag_1.mcap\n"))
    recording = Recording.open(path, robot)
    assert "metadata.yaml lists bag_1.mcap, not there; the rest is read" in text_of(recording, "missing_file")


# --- Other writers' formats -----------------------------------------------------------------------------


@pytest.mark.parametrize("storage", [StoragePlugin.SQLITE3, StoragePlugin.MCAP])
@pytest.mark.parametrize("compression", [CompressionMode.NONE, CompressionMode.FILE, CompressionMode.MESSAGE])
def test_bags_of_rosbag2_are_read_in_every_storage(
    robot: RobotDescription, tmp_path: Path, storage: StoragePlugin, compression: CompressionMode
) -> None:
    short = drive(robot).keep(np.arange(300))
    writer = RosbagsWriter(tmp_path / "bag", version=9, storage_plugin=storage)
    if compression != CompressionMode.NONE:
        writer.set_compression(compression, CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection("/joint_states", ros_messages.JOINT_STATE, typestore=ros_messages.typestore())
        for row, stamp_ns in enumerate(short.stamp_ns.tolist()):
            message = joint_state(stamp_ns, short.names, short.position[row], short.velocity[row], short.effort[row])
            writer.write(connection, stamp_ns, ros_messages.serialise(message))
    recording = Recording.open(tmp_path / "bag", robot)
    np.testing.assert_array_equal(recording.joint_states.position, short.position)
    assert recording.warnings == []
    if compression == CompressionMode.NONE:
        (file,) = (file for file in (tmp_path / "bag").iterdir() if file.suffix != ".yaml")
        assert len(Recording.open(file, robot).joint_states) == 300


def test_a_file_without_chunks_is_read(robot: RobotDescription, tmp_path: Path) -> None:
    """rosbag2's `fastwrite` preset writes no chunks, and a kill cuts the last message in two."""
    path = tmp_path / "fastwrite.mcap"
    writer = McapWriter(str(path), use_chunking=False)
    writer.start(profile="ros2")
    definition = ros_messages.message_definition(ros_messages.JOINT_STATE) or ""
    schema = writer.register_schema(ros_messages.JOINT_STATE, "ros2msg", definition.encode())
    channel = writer.register_channel("/joint_states", "cdr", schema)
    for row in range(100):
        data = ros_messages.serialise(joint_state(T0 + row * SECOND, robot.joint_names, np.full((robot.n, 2), row / 7)))
        writer.add_message(channel, T0 + row * SECOND, data, T0 + row * SECOND)
    writer.finish()
    assert len(Recording.open(path, robot).joint_states) == 100
    whole = path.read_bytes()
    last = whole.rindex(data)
    path.write_bytes(whole[: last + 40])
    assert len(Recording.open(path, robot).joint_states) == 99


def test_a_damaged_database_is_read_as_far_as_it_goes(robot: RobotDescription, tmp_path: Path) -> None:
    short = drive(robot).keep(np.arange(2000))
    with RosbagsWriter(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        connection = writer.add_connection("/joint_states", ros_messages.JOINT_STATE, typestore=ros_messages.typestore())
        for row, stamp_ns in enumerate(short.stamp_ns.tolist()):
            message = joint_state(stamp_ns, short.names, short.position[row], short.velocity[row], short.effort[row])
            writer.write(connection, stamp_ns, ros_messages.serialise(message))
    (file,) = (tmp_path / "bag").glob("*.db3")
    spoilt = bytearray(file.read_bytes())
    middle = len(spoilt) // 2
    spoilt[middle : middle + 8192] = bytes([0xA5]) * 8192
    (tmp_path / "spoilt.db3").write_bytes(spoilt)
    recording = Recording.open(tmp_path / "spoilt.db3", robot)
    assert 100 < len(recording.joint_states) < 2000
    assert "what comes after it in the file was not read" in text_of(recording, "damaged_file")


def test_big_endian_messages_are_read() -> None:
    (columns,), malformed = decode_columns(
        ros_messages.CLOCK, [b"\0\0\0\0" + (5).to_bytes(4, "big") + (6).to_bytes(4, "big")] * 3
    )
    assert not len(malformed)
    np.testing.assert_array_equal(columns.numbers["clock.sec"], [5, 5, 5])
    np.testing.assert_array_equal(columns.numbers["clock.nanosec"], [6, 6, 6])


@settings(max_examples=50, deadline=None)
@given(st.data())
def test_columns_agree_with_message_by_message_decoding(data: st.DataObject) -> None:
    """JointStates of any mixture of names and lengths, decoded at once and one by one."""
    text = st.text(st.characters(min_codepoint=97, max_codepoint=122), max_size=6)
    number = st.floats(allow_nan=False)
    messages = [
        joint_state(
            data.draw(st.integers(0, 2**60)),
            names,
            data.draw(st.lists(number, min_size=len(names), max_size=len(names))),
            frame_id=data.draw(text),
        )
        for names in data.draw(st.lists(st.lists(text, max_size=4), min_size=1, max_size=6))
    ]
    raw = [ros_messages.serialise(message) for message in messages]
    groups, malformed = decode_columns(ros_messages.JOINT_STATE, raw)
    assert not len(malformed)
    assert sorted(row for group in groups for row in group.rows) == list(range(len(raw)))
    for group in groups:
        for place, row in enumerate(group.rows):
            expected = messages[row]
            assert group.strings["name"] == tuple(expected.name)
            assert group.strings["header.frame_id"] == expected.header.frame_id
            assert group.numbers["header.stamp.sec"][place] == expected.header.stamp.sec
            np.testing.assert_array_equal(group.numbers["position"][place], expected.position)
            assert group.numbers["effort"].shape[1] == 0


# --- Topics ---------------------------------------------------------------------------------------------


def test_topics_are_found_under_a_namespace(robot: RobotDescription, tmp_path: Path) -> None:
    recording = Recording.open(drive(robot).keep(np.arange(100)).write(tmp_path / "bag", prefix="/robot1/"), robot)
    assert recording.topic_names["joint_states"] == "/robot1/joint_states"
    assert recording.imu is not None and recording.ground_truth is not None
    assert recording.odom is None  # /robot1/ground_truth/odom is not it
    assert recording.warnings == []


def test_two_namespaces_must_be_told_apart(robot: RobotDescription, tmp_path: Path) -> None:
    path = tmp_path / "bag"
    short = drive(robot)
    with RecordingWriter(path) as writer:
        for row in range(100):
            for prefix in ("/robot1", "/robot2"):
                writer.write(f"{prefix}/joint_states", joint_state(T0 + row * SECOND, short.names, short.position[row]))
                writer.write(f"{prefix}/imu/data", ros_messages.imu(T0 + row * SECOND, (0.0, 0.0, 0.1), (0.0, 0.0, 9.81)))
    with pytest.raises(RecordingError, match="could be any of /robot1/joint_states, /robot2/joint_states; name one"):
        Recording.open(path, robot)
    recording = Recording.open(path, robot, topics={"joint_states": "robot2/joint_states"})
    assert recording.topic_names["imu/data"] == "/robot2/imu/data"


def test_topics_are_remapped_and_the_mapping_is_checked(robot: RobotDescription, tmp_path: Path) -> None:
    path = tmp_path / "bag"
    short = drive(robot)
    with RecordingWriter(path) as writer:
        for row in range(100):
            writer.write("/wheels", joint_state(T0 + row * SECOND, short.names, short.position[row]))
            writer.write("/camera/imu/data", ros_messages.imu(T0 + row * SECOND, (0.0, 0.0, 0.1), (0.0, 0.0, 9.81)))
    with pytest.raises(RecordingError, match=r"has no joint_states.*/wheels \(sensor_msgs/msg/JointState, 100\)"):
        Recording.open(path, robot)
    with pytest.raises(RecordingError, match=r"no topic '/whels' to read as joint_states; topics there: .*/wheels"):
        Recording.open(path, robot, topics={"joint_states": "/whels"})
    with pytest.raises(RecordingError, match="'joint_state' is not a topic of a recording; did you mean 'joint_states'"):
        Recording.open(path, robot, topics={"joint_state": "/wheels"})
    with pytest.raises(RecordingError, match="/camera/imu/data is a sensor_msgs/msg/Imu and not a sensor_msgs/msg/JointState"):
        Recording.open(path, robot, topics={"joint_states": "/camera/imu/data"})
    recording = Recording.open(path, robot, topics={"joint_states": "/wheels"})
    assert len(recording.joint_states) == 100
    assert "imu/data: read from /camera/imu/data, the only topic that ends so" in text_of(recording, "other_namespace")


def test_a_topic_of_another_type_is_not_used(robot: RobotDescription, tmp_path: Path) -> None:
    path = tmp_path / "bag"
    with RecordingWriter(path) as writer:
        for row in range(100):
            writer.write("/joint_states", joint_state(T0 + row * SECOND, robot.joint_names, np.zeros((robot.n, 2))))
            writer.write("/imu/data", ros_messages.twist_stamped(T0 + row * SECOND, (0.0, 0.0, 0.0)))
    recording = Recording.open(path, robot)
    assert recording.imu is None
    assert "imu/data: /imu/data is a geometry_msgs/msg/TwistStamped and not a sensor_msgs/msg/Imu; not used" in text_of(
        recording, "wrong_type"
    )


# --- What is no recording -------------------------------------------------------------------------------


def test_what_is_no_recording_is_refused_with_a_remedy(robot: RobotDescription, tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"absent does not exist; give a rosbag2 folder, an \.mcap or a \.db3"):
        Recording.open(tmp_path / "absent")
    (tmp_path / "empty").mkdir()
    with pytest.raises(RecordingError, match=r"empty holds no recording: no \.mcap or \.db3 file in it"):
        Recording.open(tmp_path / "empty")
    (tmp_path / "picture.mcap").write_bytes(b"GIF89a" + bytes(100))
    with pytest.raises(RecordingError, match=r"picture\.mcap is neither MCAP nor a rosbag2 database"):
        Recording.open(tmp_path / "picture.mcap")
    (tmp_path / "nothing.mcap").write_bytes(b"")
    with pytest.raises(RecordingError, match=r"holds no messages: nothing\.mcap is empty"):
        Recording.open(tmp_path / "nothing.mcap")
    with RecordingWriter(tmp_path / "started"):
        pass
    with pytest.raises(RecordingError, match="started holds no messages; record it again"):
        Recording.open(tmp_path / "started")


def test_a_recording_of_another_robot_is_refused(robot: RobotDescription, tmp_path: Path) -> None:
    other = drive(robot).keep(np.arange(100))
    other.names = [f"wheel_{index}" for index in range(len(other.names))]
    with pytest.raises(RecordingError, match=r"not of this robot.*front_left_drive.*but wheel_0, wheel_1"):
        Recording.open(other.write(tmp_path / "bag"), robot)


# --- Healthy recordings ---------------------------------------------------------------------------------


def lose_messages(healthy: Drive, rng: np.random.Generator) -> Drive:
    return healthy.keep(np.flatnonzero(rng.random(len(healthy.stamp_ns)) > 0.01))


def stand_still(healthy: Drive, rng: np.random.Generator) -> Drive:
    """Noise on everything and no motion at all."""
    still = healthy.copy()
    still.position = healthy.position[:1] + rng.integers(0, 2, healthy.position.shape) * (2.0 * np.pi / 4096)
    still.velocity = rng.normal(0.0, 0.05, healthy.velocity.shape)
    still.gyro = rng.normal(0.002, 0.01, healthy.gyro.shape)
    still.pose = rng.normal(0.0, 0.001, healthy.pose.shape)
    still.twist = np.zeros_like(healthy.twist)
    return still


def coarse_encoders(healthy: Drive, rng: np.random.Generator) -> Drive:
    """A hundred counts a turn, and velocity by differences of them."""
    coarse = healthy.copy()
    step = 2.0 * np.pi / 100
    coarse.position = np.round(healthy.position / step) * step
    coarse.velocity = np.gradient(coarse.position, axis=0) * RATE
    return coarse


def late_velocity(healthy: Drive, rng: np.random.Generator) -> Drive:
    """Velocity through a slow filter: 60 ms behind the position."""
    late = healthy.copy()
    late.velocity = np.roll(healthy.velocity, 15, axis=0)
    return late


def wrapped_steering(healthy: Drive, rng: np.random.Generator) -> Drive:
    wrapped = healthy.copy()
    wrapped.position = (healthy.position + np.pi) % (2.0 * np.pi) - np.pi
    return wrapped


def sliding(healthy: Drive, rng: np.random.Generator) -> Drive:
    """One wheel spins half as fast again as it rolls, as on ice."""
    slipping = healthy.copy()
    slipping.velocity[:, 0, DRIVE] *= 1.5
    slipping.position[:, 0, DRIVE] *= 1.5
    return slipping


HEALTHY: list[Callable[[Drive, np.random.Generator], Drive]] = [
    lambda healthy, rng: healthy,
    lose_messages,
    stand_still,
    coarse_encoders,
    late_velocity,
    wrapped_steering,
    sliding,
]


SEEDS = [0, *(pytest.param(seed, marks=pytest.mark.nightly) for seed in (1, 2))]


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("variant", HEALTHY, ids=lambda f: getattr(f, "__name__", ""))
@pytest.mark.parametrize("name", ["thesis", "tidybot2"])
def test_a_healthy_recording_passes_without_a_warning(
    name: str, tmp_path: Path, variant: Callable[[Drive, np.random.Generator], Drive], seed: int
) -> None:
    robot = load_robot(name)
    recorded = variant(drive(robot, seed), np.random.default_rng(seed))
    path = recorded.write(tmp_path / "bag")
    assert [str(warning) for warning in Recording.open(path, robot).warnings] == []
    assert [str(warning) for warning in Recording.open(path).warnings] == []


def test_wrapped_angles_are_made_continuous(robot: RobotDescription, tmp_path: Path) -> None:
    healthy = drive(robot)
    recorded = wrapped_steering(healthy, np.random.default_rng(0)).write(tmp_path / "bag")
    position = Recording.open(recorded, robot).joint_states.position
    turns = (position - healthy.position) / (2.0 * np.pi)
    np.testing.assert_allclose(turns, np.broadcast_to(np.round(turns[0]), turns.shape), atol=1e-9)


# --- Stamps ---------------------------------------------------------------------------------------------


def test_gaps_are_named_with_time_and_length(robot: RobotDescription, tmp_path: Path) -> None:
    healthy = drive(robot)
    rows = np.arange(len(healthy.stamp_ns))
    recording = Recording.open(healthy.keep(rows[(rows < 1000) | (rows >= 1125)]).write(tmp_path / "bag"), robot)
    text = next(str(w) for w in recording.warnings if w.code == "gap" and w.topic == "joint_states")
    assert text.startswith("joint_states: 1 gap longer than 0.0")
    assert "3.996 s to 4.500 s (0.50" in text.replace("3.997 s", "3.996 s").replace("3.995 s", "3.996 s").replace(
        "4.499 s", "4.500 s"
    ).replace("4.501 s", "4.500 s")
    assert len(recording.joint_states) == len(rows) - 125
    assert [segment.start for segment in recording.joint_states.segments()] == [0, 1000]


def test_repeated_stamps_are_left_out(robot: RobotDescription, tmp_path: Path) -> None:
    healthy = drive(robot)
    repeated = healthy.keep(np.sort(np.append(np.arange(len(healthy.stamp_ns)), [500, 900, 900])))
    recording = Recording.open(repeated.write(tmp_path / "bag"), robot)
    text = next(str(w) for w in recording.warnings if w.code == "repeated_stamp" and w.topic == "joint_states")
    assert text.startswith("joint_states: 3 messages repeat the stamp of the one before, first at 2.0")
    np.testing.assert_array_equal(recording.joint_states.position, healthy.position)


def test_a_late_message_costs_only_itself(robot: RobotDescription, tmp_path: Path) -> None:
    healthy = drive(robot)
    rows = np.arange(len(healthy.stamp_ns))
    rows[[700, 701]] = rows[[701, 700]]
    recording = Recording.open(healthy.keep(rows).write(tmp_path / "bag"), robot)
    assert "joint_states: the stamps jump back in time once, by up to 0.00" in text_of(recording, "backward_jump")
    assert "1 messages that do not fit into one increasing time were left out" in text_of(recording, "backward_jump")
    assert len(recording.joint_states) == len(rows) - 1
    assert (np.diff(recording.joint_states.stamp_ns) > 0).all()


def test_after_a_reset_of_the_clock_the_longer_part_is_used(robot: RobotDescription, tmp_path: Path) -> None:
    healthy = drive(robot)
    reset = healthy.copy()
    reset.stamp_ns[1000:] -= 100 * SECOND
    recording = Recording.open(reset.write(tmp_path / "bag"), robot)
    text = next(str(w) for w in recording.warnings if w.code == "backward_jump" and w.topic == "joint_states")
    assert "jump back in time once, by up to 99.99" in text or "by up to 100.00" in text
    assert "1000 messages that do not fit into one increasing time were left out" in text
    np.testing.assert_array_equal(recording.joint_states.position, healthy.position[1000:])


def test_headers_without_stamps_fall_back_on_the_time_of_recording(robot: RobotDescription, tmp_path: Path) -> None:
    unstamped = drive(robot)
    unstamped.stamp_ns[:] = 0
    recording = Recording.open(unstamped.write(tmp_path / "bag"), robot)
    texts = [str(warning) for warning in recording.warnings if warning.code == "unstamped"]
    assert "joint_states: the headers carry no stamps; the times of recording are used" in texts
    assert recording.duration == pytest.approx((len(unstamped.stamp_ns) - 1) / RATE)


@settings(max_examples=200, deadline=None)
@given(st.lists(st.integers(0, 40), min_size=1, max_size=40))
def test_the_kept_stamps_are_a_longest_increasing_subsequence(stamps: list[int]) -> None:
    keep = order_stamps(np.array(stamps, dtype=np.int64)).keep
    kept = np.array(stamps)[keep]
    assert (np.diff(kept) > 0).all()
    best = [1] * len(stamps)  # the quadratic textbook solution
    for row in range(len(stamps)):
        best[row] += max((best[other] for other in range(row) if stamps[other] < stamps[row]), default=0)
    assert len(kept) == max(best)


def test_single_losses_and_bursts_are_no_gaps() -> None:
    rng = np.random.default_rng(0)
    regular = np.arange(5000) * 0.002
    assert not len(find_gaps(regular[rng.random(5000) > 0.02])[0])
    bursts = (np.arange(5000) // 10) * 0.02 + (np.arange(5000) % 10) * 1e-4
    assert not len(find_gaps(bursts)[0])


# --- Values ---------------------------------------------------------------------------------------------


def test_nan_and_infinite_values_are_left_out(robot: RobotDescription, tmp_path: Path) -> None:
    spoilt = drive(robot)
    spoilt.velocity[100:110, 1, DRIVE] = np.nan
    spoilt.effort[200, 0, STEER] = np.inf
    spoilt.gyro[400:404] = np.nan
    recording = Recording.open(spoilt.write(tmp_path / "bag"), robot)
    texts = [str(warning) for warning in recording.warnings if warning.code == "non_finite"]
    assert texts == [
        "joint_states: NaN or infinite values in 11 messages (velocity of front_right_drive, effort of front_left_steer); "
        "left out",
        "imu/data: NaN or infinite values in 2 messages; left out",
    ]
    assert len(recording.joint_states) == len(spoilt.stamp_ns) - 11
    assert np.isfinite(recording.joint_states.velocity).all()


def test_a_field_that_is_always_nan_was_not_measured(robot: RobotDescription, tmp_path: Path) -> None:
    """ros2_control sends NaN for an interface that a joint does not have; the rest of the message is good."""
    spoilt = drive(robot)
    spoilt.effort[:, :, STEER] = np.nan
    recording = Recording.open(spoilt.write(tmp_path / "bag"), robot)
    assert len(recording.joint_states) == len(spoilt.stamp_ns)
    assert text_of(recording, "missing_field").startswith("joint_states: no effort of front_left_steer, front_right_steer")


def test_an_empty_field_was_not_measured(robot: RobotDescription, tmp_path: Path) -> None:
    spoilt = drive(robot)
    spoilt.velocity = None
    recording = Recording.open(spoilt.write(tmp_path / "bag"), robot)
    assert text_of(recording, "missing_field") == "joint_states: no velocity of any joint was measured; it is NaN"
    assert np.isnan(recording.joint_states.velocity).all()


def test_zeros_for_a_velocity_that_nobody_measures_are_left_out(robot: RobotDescription, tmp_path: Path) -> None:
    spoilt = drive(robot)
    spoilt.velocity[:, :, STEER] = 0.0
    recording = Recording.open(spoilt.write(tmp_path / "bag"), robot)
    text = text_of(recording, "missing_field")
    assert text.startswith("joint_states: the velocity of front_left_steer, front_right_steer, rear_left_steer")
    assert text.endswith("is 0 throughout although the position moves: not measured; it is left out (NaN)")
    assert np.isnan(recording.joint_states.velocity[:, :, STEER]).all()
    np.testing.assert_array_equal(recording.joint_states.velocity[:, :, DRIVE], spoilt.velocity[:, :, DRIVE])


@pytest.mark.parametrize(("joints", "seconds", "measured"), [(0, 12.0, False), (1, 12.0, True), (0, 4.0, True)])
def test_zeros_for_efforts_that_nobody_measures_are_left_out(
    joints: int, seconds: float, measured: bool, robot: RobotDescription, tmp_path: Path
) -> None:
    """Hardware interfaces without torques send zeros; a joint alone may have none, one that is dragged along; or a robot."""
    whole = drive(robot)
    spoilt = whole.keep(np.arange(round(seconds * RATE)))
    spoilt.effort[:, joints:] = 0.0
    recording = Recording.open(spoilt.write(tmp_path / "bag"), robot)
    assert np.isnan(recording.joint_states.effort).all() != measured
    texts = [str(warning) for warning in recording.warnings if warning.code == "missing_field"]
    assert len(texts) == (not measured)
    assert all(text.startswith("joint_states: the effort of every joint is 0 throughout") for text in texts)


def test_arrays_of_another_length_than_the_names_are_damaged(robot: RobotDescription, tmp_path: Path) -> None:
    path = tmp_path / "bag"
    healthy = drive(robot).keep(np.arange(300))
    with RecordingWriter(path) as writer:
        for row, stamp_ns in enumerate(healthy.stamp_ns.tolist()):
            velocity = healthy.velocity[row].ravel()[: -1 if row == 7 else None]
            writer.write("/joint_states", joint_state(stamp_ns, healthy.names, healthy.position[row], velocity))
        writer.write_raw("/joint_states", ros_messages.JOINT_STATE, b"\0\1\0\0short", T0)
    recording = Recording.open(path, robot)
    texts = [str(warning) for warning in recording.warnings if warning.code == "damaged_message"]
    assert texts == [
        "joint_states: 1 messages are damaged; left out",
        "joint_states: 1 messages have arrays of another length than their names; left out",
    ]
    assert len(recording.joint_states) == 299


# --- Joints that are missing ----------------------------------------------------------------------------


def without(healthy: Drive, columns: list[int]) -> Drive:
    rest = [column for column in range(len(healthy.names)) if column not in columns]
    less = healthy.copy()
    less.names = [healthy.names[column] for column in rest]
    for field in ("position", "velocity", "effort"):
        setattr(less, field, getattr(healthy, field).reshape(len(healthy.stamp_ns), -1)[:, rest])
    return less


def test_a_missing_caster_is_named_and_nan(robot: RobotDescription, tmp_path: Path) -> None:
    healthy = drive(robot)
    recording = Recording.open(without(healthy, [2, 3]).write(tmp_path / "bag"), robot)
    assert codes(recording) == ["missing_caster"]
    assert text_of(recording, "missing_caster") == (
        "joint_states: caster front_right is missing: front_right_drive and front_right_steer are in no message; their "
        "values are NaN"
    )
    assert np.isnan(recording.joint_states.position[:, 1]).all()
    np.testing.assert_array_equal(recording.joint_states.position[:, [0, 2, 3]], healthy.position[:, [0, 2, 3]])


def test_a_missing_joint_is_named(robot: RobotDescription, tmp_path: Path) -> None:
    recording = Recording.open(without(drive(robot), [3]).write(tmp_path / "bag"), robot)
    assert codes(recording) == ["missing_joint"]
    assert text_of(recording, "missing_joint") == "joint_states: joint front_right_steer is in no message; its values are NaN"


def write_parts(path: Path, healthy: Drive, parts: Callable[[int], list[list[int]]]) -> Path:
    """Write each row as one message per list of joint columns."""
    flat = [getattr(healthy, field).reshape(len(healthy.stamp_ns), -1) for field in ("position", "velocity", "effort")]
    with RecordingWriter(path) as writer:
        for row, stamp_ns in enumerate(healthy.stamp_ns.tolist()):
            for place, columns in enumerate(parts(row)):
                names = [healthy.names[column] for column in columns]
                values = [array[row, columns] for array in flat]
                writer.write("/joint_states", joint_state(stamp_ns + 500_000 * place, names, *values))
    return path


def test_joints_in_separate_messages_are_brought_together(robot: RobotDescription, tmp_path: Path) -> None:
    """Each caster's driver publishes its own two joints, half a millisecond after the one before."""
    healthy = drive(robot)
    path = write_parts(tmp_path / "bag", healthy, lambda row: [[2 * i, 2 * i + 1] for i in range(robot.n)])
    recording = Recording.open(path, robot)
    assert codes(recording) == ["split_message"]
    assert "the joints come in 4 separate messages; brought to the stamps of one" in text_of(recording, "split_message")
    states = recording.joint_states
    assert states.position.shape == healthy.position.shape
    # interpolation errs by at most what the joint turns in the 1.5 ms between the messages, and one encoder step
    largest = np.abs(healthy.velocity).max() * 0.002 + 2.0 * np.pi / 4096
    np.testing.assert_allclose(states.position, healthy.position, atol=largest)


def test_efforts_in_separate_messages_are_those_of_the_nearest(robot: RobotDescription, tmp_path: Path) -> None:
    """Interpolated between two commands that a motor had held, they seemed to follow late: a dead time of all drives."""
    healthy = drive(robot)
    rng = np.random.default_rng(1)
    healthy = dataclasses.replace(healthy, effort=rng.standard_normal(healthy.effort.shape))
    path = write_parts(tmp_path / "bag", healthy, lambda row: [[2 * i, 2 * i + 1] for i in range(robot.n)])
    np.testing.assert_array_equal(Recording.open(path, robot).joint_states.effort[1:-1], healthy.effort[1:-1])


def test_a_few_incomplete_messages_are_left_out(robot: RobotDescription, tmp_path: Path) -> None:
    healthy = drive(robot)
    path = write_parts(
        tmp_path / "bag", healthy, lambda row: [[c for c in range(8) if row not in (50, 60) or c != 5]]
    )
    recording = Recording.open(path, robot)
    assert text_of(recording, "incomplete_message") == "joint_states: 2 messages lack some joints (rear_left_steer); left out"
    assert len(recording.joint_states) == len(healthy.stamp_ns) - 2


def test_a_caster_that_falls_silent_is_nan_from_then_on(robot: RobotDescription, tmp_path: Path) -> None:
    healthy = drive(robot)
    path = write_parts(tmp_path / "bag", healthy, lambda row: [[c for c in range(8) if row < 1500 or c < 6]])
    recording = Recording.open(path, robot)
    assert text_of(recording, "incomplete_message") == (
        "joint_states: 1500 of 3000 messages lack some joints (rear_right_drive, rear_right_steer); their values are NaN there"
    )
    assert np.isfinite(recording.joint_states.position[:1500]).all()
    assert np.isnan(recording.joint_states.position[1500:, 3]).all()
    np.testing.assert_array_equal(recording.joint_states.position[1500:, :3], healthy.position[1500:, :3])


def test_torque_and_velocity_commanded_at_once_are_named(robot: RobotDescription, tmp_path: Path) -> None:
    path = tmp_path / "bag"
    values = np.ones((robot.n, 2))
    with RecordingWriter(path) as writer:
        for row in range(100):
            writer.write("/joint_states", joint_state(T0 + row * SECOND, robot.joint_names, values, values, values))
            writer.write("/joint_commands", joint_state(T0 + row * SECOND, robot.joint_names, None, values, values))
    assert "joint_commands: 100 messages set velocity and effort of one joint; only one may be set" in text_of(
        Recording.open(path, robot), "both_commands"
    )


# --- Units ----------------------------------------------------------------------------------------------

STEP = 2.0 * np.pi / 4096
UNIT_FAULTS: dict[str, tuple[float, float, str]] = {
    # name: factor on position, factor on velocity, text
    "position in degrees": (DEGREES, 1.0, "the position is in degrees for"),
    "velocity in degrees/s": (1.0, DEGREES, "the velocity is in degrees/s for"),
    "velocity in rpm": (1.0, 60.0 / (2.0 * np.pi), "the velocity is in rpm for"),
    "position in revolutions": (1.0 / (2.0 * np.pi), 1.0, "the position is in revolutions for"),
    "degrees and rpm": (DEGREES, 60.0 / (2.0 * np.pi), "the position is in degrees and the velocity is in rpm for"),
}


@pytest.mark.parametrize("axes", [(DRIVE,), (STEER,), (DRIVE, STEER)], ids=["drive", "steer", "both"])
@pytest.mark.parametrize("fault", UNIT_FAULTS)
@pytest.mark.parametrize("seed", SEEDS)
def test_wrong_units_are_named_and_converted(
    robot: RobotDescription, tmp_path: Path, fault: str, axes: tuple[int, ...], seed: int
) -> None:
    position_factor, velocity_factor, text = UNIT_FAULTS[fault]
    healthy = drive(robot, seed)
    spoilt = healthy.copy()
    for axis in axes:
        spoilt.position[:, :, axis] *= position_factor
        spoilt.velocity[:, :, axis] *= velocity_factor
    path = spoilt.write(tmp_path / "bag")
    for opened in (Recording.open(path, robot), Recording.open(path)):
        assert codes(opened) == ["wrong_unit"]
        assert text in text_of(opened, "wrong_unit")
        assert "converted to rad and rad/s" in text_of(opened, "wrong_unit")
        for axis in (DRIVE, STEER):
            name = "front_left_" + ("drive", "steer")[axis]
            assert (name in text_of(opened, "wrong_unit")) == (axis in axes)
    states = Recording.open(path, robot).joint_states
    np.testing.assert_allclose(states.position, healthy.position, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(states.velocity, healthy.velocity, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("axes", [(STEER,), (DRIVE,), (DRIVE, STEER)], ids=["steer", "drive", "both"])
@pytest.mark.parametrize("seed", range(3))
def test_degrees_throughout_are_found_by_rolling(
    robot: RobotDescription, tmp_path: Path, axes: tuple[int, ...], seed: int
) -> None:
    """Position and velocity agree with each other; only the other wheels show that the unit is wrong."""
    healthy = drive(robot, seed)
    spoilt = healthy.copy()
    for axis in axes:
        spoilt.position[:, :, axis] *= DEGREES
        spoilt.velocity[:, :, axis] *= DEGREES
    recording = Recording.open(spoilt.write(tmp_path / "bag"), robot)
    texts = [str(warning) for warning in recording.warnings if warning.code == "wrong_unit"]
    assert len(texts) == len(axes)
    for axis, text in zip(axes, texts):
        joints = "the drive joints" if axis == DRIVE else "the steer joints"
        assert f"{joints} are in degrees and degrees/s: read so, the wheels roll together" in text
    np.testing.assert_allclose(recording.joint_states.position, healthy.position, rtol=1e-12, atol=1e-12)


def test_wheels_that_slide_a_little_while_they_go_straight_are_not_in_degrees(robot: RobotDescription, tmp_path: Path) -> None:
    """They contradict each other by more than what they steer, and slower drives would not."""
    healthy = drive(robot)
    time = np.arange(len(healthy.stamp_ns)) / RATE
    swing = 0.05 * np.sin(2.0 * time[:, None] + np.arange(robot.n))
    speed = 0.5 * robot.casters[0].limits.drive_speed
    healthy.position[:, :, STEER], healthy.velocity[:, :, STEER] = swing, np.gradient(swing, time, axis=0)
    healthy.position[:, :, DRIVE], healthy.velocity[:, :, DRIVE] = speed * time[:, None], speed
    recording = Recording.open(healthy.write(tmp_path / "bag"), robot)
    assert not [str(warning) for warning in recording.warnings if warning.code == "wrong_unit"]
    np.testing.assert_allclose(recording.joint_states.velocity[:, :, DRIVE], speed)


def test_encoder_counts_are_named_and_left_out(robot: RobotDescription, tmp_path: Path) -> None:
    healthy = drive(robot)
    spoilt = healthy.copy()
    spoilt.position = np.round(healthy.position / STEP)
    recording = Recording.open(spoilt.write(tmp_path / "bag"), robot)
    texts = [str(warning) for warning in recording.warnings if warning.code == "wrong_unit"]
    assert len(texts) == 1
    assert "the position of front_left_drive" in texts[0] and "is in encoder counts: whole numbers; it is left out" in texts[0]
    assert np.isnan(recording.joint_states.position).all()
    np.testing.assert_array_equal(recording.joint_states.velocity, healthy.velocity)

    spoilt.velocity = np.round(healthy.velocity / STEP)
    texts = [str(w) for w in Recording.open(spoilt.write(tmp_path / "both"), robot).warnings if w.code == "wrong_unit"]
    assert len(texts) == 1 and "position and velocity of front_left_drive" in texts[0]


def test_velocity_in_counts_or_of_another_sign_is_left_out(robot: RobotDescription, tmp_path: Path) -> None:
    healthy = drive(robot)
    for factor, text in ((1.0 / STEP, "is in counts/s"), (-1.0, "another sign or gear"), (25.0, "another sign or gear")):
        spoilt = healthy.copy()
        spoilt.velocity = healthy.velocity * factor
        recording = Recording.open(spoilt.write(tmp_path / f"bag{factor:.1f}"), robot)
        assert text in text_of(recording, "wrong_unit")
        assert np.isnan(recording.joint_states.velocity).all()
        np.testing.assert_array_equal(recording.joint_states.position, healthy.position)


def test_a_joint_that_cannot_be_so_fast_is_named(robot: RobotDescription, tmp_path: Path) -> None:
    """Drive in degrees with the steering at rest: the wheels still roll together, but above their limit."""
    healthy = drive(robot)
    time = np.arange(len(healthy.stamp_ns)) / RATE
    limit = robot.casters[0].limits.drive_speed
    healthy.position[:], healthy.velocity[:] = 0.0, 0.0
    healthy.velocity[:, :, DRIVE] = (3.0 * limit * np.sin(time))[:, None]
    healthy.position[:, :, DRIVE] = (3.0 * limit * (1.0 - np.cos(time)))[:, None]
    recording = Recording.open(healthy.write(tmp_path / "bag"), robot)
    text = text_of(recording, "implausible_speed")
    assert f"front_left_drive reaches {3.0 * limit:.3g} rad/s, its limit is {limit:.3g} rad/s" in text
    assert "the unit may be degrees, rpm or counts; left as it is" in text


def test_gyro_in_degrees_and_acceleration_in_g_are_converted(robot: RobotDescription, tmp_path: Path) -> None:
    healthy = drive(robot)
    spoilt = healthy.copy()
    spoilt.gyro = healthy.gyro * DEGREES
    spoilt.acceleration = healthy.acceleration / 9.81
    recording = Recording.open(spoilt.write(tmp_path / "bag"), robot)
    texts = [str(warning) for warning in recording.warnings]
    assert len(texts) == 2
    assert texts[0].startswith("imu/data: the gyro is in degrees/s: it turns 57.") and "converted to rad/s" in texts[0]
    assert texts[1].startswith("imu/data: the acceleration is in g: its vertical part is 1.00")
    assert recording.imu is not None
    np.testing.assert_allclose(recording.imu.gyro, healthy.gyro[::2])
    np.testing.assert_allclose(recording.imu.acceleration, healthy.acceleration[::2])


@pytest.mark.parametrize("name", ["gyro", "acceleration"])
def test_zeros_for_what_an_imu_does_not_measure_are_left_out(name: str, robot: RobotDescription, tmp_path: Path) -> None:
    """Many drivers leave at zero what their chip does not have; of a sensor of which nothing is left nothing was recorded."""
    spoilt = drive(robot)
    getattr(spoilt, name)[:] = 0.0
    recording = Recording.open(spoilt.write(tmp_path / "one"), robot)
    assert text_of(recording, "missing_field") == f"imu/data: the {name} is 0 throughout: not measured; it is NaN"
    assert recording.imu is not None
    assert np.isnan(getattr(recording.imu, name)).all()
    spoilt.gyro[:] = spoilt.acceleration[:] = 0.0
    assert Recording.open(spoilt.write(tmp_path / "both"), robot).imu is None


def test_a_gyro_that_cannot_be_so_fast_is_named(robot: RobotDescription, tmp_path: Path) -> None:
    """Without any pose to compare with."""
    path = tmp_path / "bag"
    with RecordingWriter(path) as writer:
        for row in range(500):
            stamp_ns = T0 + row * SECOND // 100
            writer.write("/joint_states", joint_state(stamp_ns, robot.joint_names, *[np.zeros((robot.n, 2))] * 3))
            writer.write("/imu/data", ros_messages.imu(stamp_ns, (0.0, 0.0, 60.0), (0.0, 0.0, 9.81)))
    text = text_of(Recording.open(path, robot), "implausible_speed")
    assert text == "imu/data: the gyro reaches 60 rad/s, which no such robot does; it may be in degrees/s; left as it is"


@pytest.mark.parametrize("seed", range(20))
def test_noise_alone_has_no_scale(seed: int) -> None:
    rng = np.random.default_rng(seed)
    time = np.arange(5000) * 0.002
    assert position_scale(time, rng.normal(0.0, 1e-3, 5000), time, rng.normal(0.01, 0.05, 5000)) is None
    steps = np.round(rng.normal(0.0, 0.4, 5000)) * STEP
    assert position_scale(time, steps, time, rng.normal(0.0, 0.05, 5000)) is None


def test_scale_and_units_of_clean_motion() -> None:
    time = np.arange(5000) * 0.002
    position, velocity = np.sin(time), np.cos(time)
    assert position_scale(time, position, time, velocity) == pytest.approx(1.0, rel=1e-3)
    assert units_of(1.0) == ("rad", "rad/s")
    assert units_of(57.3) == ("degrees", "rad/s")
    assert units_of(6.0) == ("degrees", "rpm") and units_of(6.28) == ("rad", "revolutions/s")
    assert units_of(652.0) is None and units_of(-1.0) is None


# --- Without ROS ----------------------------------------------------------------------------------------


def test_recordings_need_no_ros() -> None:
    program = (
        "import sys; sys.modules['rclpy'] = None; sys.modules['sensor_msgs'] = None\n"
        "import pcw_description.recording, pcw_description.recording_writer\n"
        "from pcw_description.ros_messages import message_definition\n"
        "print(len(message_definition('nav_msgs/msg/Odometry')))\n"
    )
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    assert int(result.stdout) > 500


def test_definitions_are_those_of_an_installation() -> None:
    """Field by field the same as the .msg files that a ROS installation brings, comments aside."""
    prefixes = [*os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep), sys.prefix]
    folders = [Path(prefix) / "share" / "sensor_msgs" / "msg" for prefix in prefixes if prefix]
    folder = next((folder for folder in folders if folder.is_dir()), None)
    if folder is None:
        pytest.skip("sensor_msgs is not installed")
    for name in ("JointState", "Imu"):
        installed = []
        for line in io.StringIO((folder / f"{name}.msg").read_text()):
            words = line.split("#")[0].split()
            if words:
                installed.append(" ".join(words))
        definition = ros_messages.message_definition(f"sensor_msgs/msg/{name}") or ""
        ours = definition.split("=" * 80)[0].strip().splitlines()
        # a type of the same package, or Header, may be named without its package
        assert [line.split("/")[-1] for line in ours] == [line.split("/")[-1] for line in installed]
