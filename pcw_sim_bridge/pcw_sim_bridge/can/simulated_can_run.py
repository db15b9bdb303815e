"""A recording made over CAN without a graph: emulated drives, the driver's core and a controller in simulated time.

The twin of `simulated_run.record_run`: the same plant, sensors, noise and controller, but with every torque and every reading
as a frame on the way.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import numpy as np

from pcw_description.recording_writer import RecordingWriter
from pcw_description.robot_description import FloatArray, RobotDescription
from pcw_description.ros_messages import imu, odometry, twist_stamped

from ..plants.factory import make_plant
from ..plants.true_robot import as_it_really_is
from ..run_controllers import make_controller
from ..sensors import Imu, read_tracker
from .can_file import CanFile
from .can_robot import CanRobot, TimedReading
from .emulated_robot import EmulatedRobot, EmulatedTransport
from .errors import CanError
from .frame import Frame
from .frame_log import FrameDecoder, frames_of_file, write_joint_topics

START_NS = 1_000_000_000


def record_run_over_can(
    robot: RobotDescription,
    file: CanFile,
    commanded_twist: Callable[[float], FloatArray | None],
    duration: float,
    seed: int,
    path: str | Path,
    controlled_as: RobotDescription | None = None,
    controller_name: str = "computed_torque",
    log: str | Path | None = None,
) -> None:
    """Drive a robot over emulated CAN and write the recording; see `simulated_run.record_run` for the arguments.

    With `log` the frames are written to this file, .log, .asc or .blf, and the joints' topics are made of what it holds.

    Raises:
        CanError: a fault stopped the robot.
    """
    emulated = EmulatedRobot(make_plant("reduced", robot), file, seed)
    rng = np.random.default_rng([seed, 1])
    sensors, begun, samples = robot.sensors, [np.inf], []
    inertial = Imu(as_it_really_is(robot)) if sensors.imu else None
    steps_per = {
        "truth": round(1.0 / ((sensors.tracker.rate if sensors.tracker else 100.0) * emulated.plant.dt)),
        "imu": round(1.0 / (sensors.imu.rate * emulated.plant.dt)) if sensors.imu else 1,
    }

    def on_step(time: float) -> None:
        if time < begun[0]:
            return
        step, now = round(time / emulated.plant.dt), round(time * 1e9) + START_NS
        if step % steps_per["truth"] == 0:
            truth = emulated.plant.state()
            pose = read_tracker(sensors.tracker, truth, rng) if sensors.tracker else truth.pose
            samples.append(("/ground_truth/odom", odometry(now, pose, truth.twist), now))
        if inertial is not None and step % steps_per["imu"] == 0:
            reading = inertial.read(emulated.plant.state(), rng)
            samples.append(("/imu/data", imu(now, reading.angular_velocity, reading.linear_acceleration), now))

    transport = EmulatedTransport(emulated, on_step)
    believed = controlled_as or robot
    can, controller = CanRobot(believed, file, transport), make_controller(controller_name, believed)
    can.configure()
    can.enable()
    frames = transport.log()
    begun[0] = transport.now()
    last = [begun[0]]

    def answer(reading: TimedReading) -> None:
        twist = commanded_twist(reading.time - begun[0])
        can.command(controller.command(reading.joints, twist, max(reading.time - last[0], 1e-4)), reading.time)
        last[0] = reading.time
        if twist is not None:
            now = round(reading.time * 1e9) + START_NS
            samples.append(("/cmd_vel", twist_stamped(now, twist), now))

    while transport.now() < begun[0] + duration:
        can.cycle(answer)
        if can.faults:
            raise CanError("; ".join(map(str, can.faults)))
    heard: Iterable[tuple[str, Frame, float]] = ((bus, frame, time) for bus, frame, time, _ in frames)
    if log is not None:
        heard = _through_log(frames, file, log)
    with RecordingWriter(path, flush_interval=None) as writer:
        decoder = FrameDecoder(believed, file)
        for topic, message, now in samples:
            writer.write(topic, message, now)
        write_joint_topics(writer, believed, decoder, heard, START_NS)
    can.close()
    emulated.close()


def _through_log(
    frames: list[tuple[str, Frame, float, bool]], file: CanFile, log: str | Path
) -> Iterator[tuple[str, Frame, float]]:
    """Write frames to a log and yield what it holds, at the simulated time: a log may count from its own beginning."""
    from .python_can import FrameLogWriter, read_log

    written = FrameLogWriter(log, [bus.name for bus in file.buses])
    for bus, frame, time, sent in frames:
        written.write(bus, frame, time + START_NS * 1e-9, sent)
    written.close()
    if written.problem:
        raise CanError(written.problem)
    shift = None
    for bus, frame, time in frames_of_file(read_log(log), file):
        shift = frames[0][2] - time if shift is None else shift
        yield bus, frame, time + shift
