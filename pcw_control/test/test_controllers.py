"""The registry: every name makes a controller that keeps the contract's shape, and the README tells of each."""

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from pcw_control import (
    CONTROLLERS,
    ComputedTorqueParameters,
    ControlError,
    ControllerMeasurement,
    ForceReference,
    TrajectoryPoint,
    TwistReference,
    make_controller,
)
from pcw_control.controller_interface import (
    ControllerParameters,
    internal_forces,
    replaced,
    settable_fields,
    with_values,
)
from pcw_control.delay_margin import DELAY, delay_margin, effective_mass
from pcw_control.slip_ratio_limit import SlipRatioLimitParameters
from pcw_description import inverse_kinematics, load_robot
from pcw_description.differential_kinematics import joint_matrix_blocks

README = Path(__file__).resolve().parents[1] / "README.md"


@pytest.mark.parametrize("name", sorted(CONTROLLERS))
def test_every_controller_is_made_by_name_and_steps(name):
    robot, entry = load_robot("thesis"), CONTROLLERS[name]
    controller = make_controller(name, robot, entry.parameters())
    zero = np.zeros((4, 2))
    measurement = ControllerMeasurement(
        zero, zero, np.zeros(3), slip=zero, slip_valid=np.ones((4, 2), dtype=bool), friction=np.full(4, 0.5),
        critical_slip=np.full(4, 0.1), external_wrench=np.zeros(3),
    )
    motion = TwistReference(np.array([0.2, 0.0, 0.0]))
    reference = ForceReference(np.zeros(3), motion) if "external_wrench" in entry.parameters.uses else motion
    state, output = controller.step(controller.initial_state(), measurement, reference, 0.002)
    assert output.torque.shape == output.contact_force.shape == (4, 2)
    assert output.internal_force.shape == (6,) and np.isfinite(output.torque).all()
    assert entry.parameters.uses <= {"slip", "friction", "external_wrench"}


@pytest.mark.parametrize("name", sorted(CONTROLLERS))
def test_what_a_controller_says_of_forces_is_what_its_torques_are(name):
    """tau = B^T F_con, and the internal forces are those of F_con; also where slip ratios are held, whose torques are changed
    after the forces were shared.
    """
    robot, rng = load_robot("thesis"), np.random.default_rng(3)
    controller = make_controller(name, robot)
    state, output = controller.initial_state(np.array([0.5, 0.0, 0.0])), None
    angle = rng.uniform(-0.3, 0.3, 4)
    rates = inverse_kinematics(robot, angle, np.array([0.5, 0.0, 0.0]))
    slip = np.column_stack([np.full(4, 0.15), np.zeros(4)])
    measurement = ControllerMeasurement(
        np.column_stack([np.zeros(4), angle]), rates, np.zeros(3), slip=slip, friction=np.full(4, 0.5),
        external_wrench=np.array([20.0, 5.0, 1.0]),
    )  # fmt: skip
    for _ in range(40):
        state, output = controller.step(state, measurement, TwistReference(np.array([1.0, 0.0, 0.0])), 0.002)
    force = output.contact_force
    torque = np.einsum("nji,nj->ni", joint_matrix_blocks(robot), force)
    np.testing.assert_allclose(output.torque, torque, atol=1e-9)
    internal = internal_forces(robot.steer_axis, robot.caster_offset, angle, force)
    np.testing.assert_allclose(output.internal_force, internal, atol=1e-9)


@pytest.mark.parametrize("name", sorted(CONTROLLERS))
def test_arrays_need_not_lie_as_compiled_code_likes_them(name):
    """Columns of a larger table, and whole numbers: the torques are those of tidy copies."""
    robot, rng = load_robot("thesis"), np.random.default_rng(4)
    controller = make_controller(name, robot)
    table = rng.integers(-2, 3, (4, 8))
    tidy = [np.ascontiguousarray(table[:, k : k + 2], dtype=float) for k in (0, 2, 4)]
    outputs = []
    for position, velocity, slip in ([table[:, 0:2], table[:, 2:4], table[:, 4:6]], tidy):
        measurement = ControllerMeasurement(position, velocity, np.zeros(3), slip=slip, friction=np.full(4, 0.5))
        reference = TwistReference(np.array([0.2, 0.0, 0.1]))
        outputs.append(controller.step(controller.initial_state(), measurement, reference, 0.002)[1].torque)
    np.testing.assert_array_equal(*outputs)


@pytest.mark.parametrize("field", ["slip", "friction", "critical_slip", "normal_force", "external_wrench"])
def test_what_is_optional_is_refused_by_name_where_it_is_no_number_or_of_another_shape(field):
    robot = load_robot("thesis")
    controller, zero = make_controller("computed_torque", robot), np.zeros((4, 2))
    shape = {"slip": (4, 2), "external_wrench": (3,)}.get(field, (4,))
    for bad in (np.full(shape, np.nan), np.zeros((5, 2)), np.zeros((1, *shape)), np.zeros(0)):
        measurement = ControllerMeasurement(zero, zero, np.zeros(3), **{field: bad})
        with pytest.raises(ControlError, match=field):
            controller.step(controller.initial_state(), measurement, TwistReference(np.zeros(3)), 0.002)


@pytest.mark.parametrize("bad", [np.array([0.0, np.nan, 0.0]), np.zeros(0), np.zeros(4), np.zeros((1, 3))], ids=str)
def test_what_is_to_be_followed_and_felt_is_refused_by_name_where_it_is_no_number_or_of_another_shape(bad):
    controller, zero = make_controller("force_guided", load_robot("thesis")), np.zeros((4, 2))
    good, state = np.zeros(3), controller.initial_state()
    for name, pose, reference in (
        ("reference twist", good, TwistReference(bad)),
        ("reference wrench", good, ForceReference(bad)),
        ("reference twist", good, ForceReference(good, TwistReference(bad))),
        ("reference pose", good, ForceReference(good, TrajectoryPoint(bad))),
        ("reference velocity", good, TrajectoryPoint(good, velocity=bad)),
        ("reference acceleration", good, TrajectoryPoint(good, acceleration=bad)),
        ("pose", bad, TrajectoryPoint(good)),
    ):  # fmt: skip
        with pytest.raises(ControlError, match=f"^{name} = "):
            controller.step(state, ControllerMeasurement(zero, zero, pose), reference, 0.002)


# Torques of every controller in cycles of every kind of reference, with and without what is optional.
ALL_TORQUES = """
import json
import numpy as np
from pcw_control import CONTROLLERS, ControllerMeasurement, TrajectoryPoint, TwistReference, make_controller
from pcw_description import load_robot

robot, torques = load_robot("thesis"), {}
for name in CONTROLLERS:
    rng, controller = np.random.default_rng(6), make_controller(name, robot)
    state, torques[name] = controller.initial_state(np.array([0.2, 0.1, 0.1])), []
    for cycle in range(24):
        known = dict(
            slip=rng.normal(0.0, 0.1, (4, 2)), slip_valid=rng.random((4, 2)) < 0.8, friction=rng.uniform(0.1, 0.8, 4),
            critical_slip=rng.uniform(0.05, 0.2, 4), external_wrench=rng.normal(0.0, 20.0, 3),
        )
        measurement = ControllerMeasurement(
            rng.normal(0.0, 1.0, (4, 2)), rng.normal(0.0, 1.0, (4, 2)), rng.normal(0.0, 0.1, 3), cycle % 5 == 0,
            **(known if cycle % 4 else {}),
        )
        twist, point = TwistReference(rng.normal(0.0, 0.5, 3)), TrajectoryPoint(*rng.normal(0.0, 0.2, (3, 3)))
        state, output = controller.step(state, measurement, point if cycle % 6 == 5 else twist, 0.002)
        torques[name].append(output.torque.tolist())
print(json.dumps(torques))
"""


def test_plain_python_gives_the_same_torques_as_compiled_code():
    """A machine without numba runs the same controllers; 1e-12 of the largest torque is a few thousand roundings."""
    compiled, plain = (
        json.loads(
            subprocess.run(
                [sys.executable, "-P", "-c", ALL_TORQUES], env=os.environ | {"NUMBA_DISABLE_JIT": off}, check=True,
                capture_output=True, text=True, timeout=300,
            ).stdout
        )
        for off in ("0", "1")
    )
    assert compiled.keys() == plain.keys() == CONTROLLERS.keys()
    for name, torques in compiled.items():
        largest = np.max(np.abs(torques))
        assert largest > 1.0
        np.testing.assert_allclose(plain[name], torques, rtol=0.0, atol=1e-12 * largest, err_msg=name)


@pytest.mark.parametrize("name", sorted(CONTROLLERS))
def test_replaced_is_the_replace_of_dataclasses(name):
    """Of the state of every controller: `replaced` does without the class, which could set or check more than its fields."""
    state = make_controller(name, load_robot("thesis")).initial_state(np.array([0.3, 0.1, 0.2]))
    before, twist = dict(vars(state)), np.ones(3)
    found, wanted = replaced(state, reference_twist=twist), dataclasses.replace(state, reference_twist=twist)
    assert type(found) is type(wanted) and vars(found).keys() == vars(wanted).keys()
    assert all(vars(found)[field] is value for field, value in vars(wanted).items())
    assert vars(state) == before and state.reference_twist is not twist


def test_every_number_of_every_controller_has_unit_meaning_and_range():
    for entry in CONTROLLERS.values():
        assert issubclass(entry.parameters, ControllerParameters)
        for field in dataclasses.fields(entry.parameters):
            if isinstance(field.default, float):
                assert field.metadata["unit"] and field.metadata["description"], field.name
                low, high = field.metadata["range"]
                assert low <= field.default <= high


def test_the_readme_tells_of_every_controller_and_every_parameter():
    text = README.read_text(encoding="utf-8")
    for name, entry in CONTROLLERS.items():
        assert f"| `{name}` | {entry.summary} |" in text
        for path, _, _ in settable_fields(entry.parameters()):
            assert f"| `{path}` |" in text or f"| `{name}.{path}` |" in text, path


def test_values_go_by_name_into_parameters_within_parameters_and_are_checked_there():
    parameters = SlipRatioLimitParameters()
    names = {path: value for path, _, value in settable_fields(parameters)}
    assert names["slip.loop_delay"] == 0.002 and names["ratio.control.least_speed"] == 0.3
    assert with_values(parameters, names.__getitem__) == parameters
    names |= {"slip.loop_delay": 0.004, "ratio.control.gain": 30.0, "integral_limit": [0.5, 0.5, 1.0]}
    changed = with_values(parameters, names.__getitem__)
    assert changed.slip.loop_delay == 0.004 and changed.ratio.control.gain == 30.0
    assert changed.integral_limit == (0.5, 0.5, 1.0) and changed.slip.integral_ratio == parameters.slip.integral_ratio
    for path, bad in (("slip.loop_delay", -1.0), ("integral_limit", [1.0, 1.0]), ("ratio.share", 0.0)):
        with pytest.raises(ControlError, match=path.rpartition(".")[2]):
            with_values(parameters, (names | {path: bad}).__getitem__)


@pytest.mark.parametrize("name", sorted(CONTROLLERS))
@pytest.mark.parametrize("robot_name", ["thesis", "tidybot2", "xr4000", "dyros_pcv", "flow_base"])
def test_a_controller_that_is_given_no_gains_has_those_that_its_robot_bears(name, robot_name):
    """A user who names a robot gets the robot's gains; computed torque at 20 1/s was more than two of the robots bear."""
    robot = load_robot(robot_name)
    p = make_controller(name, robot).parameters
    assert p == CONTROLLERS[name].parameters.of_robot(robot)
    if isinstance(p, ComputedTorqueParameters):
        gain = max(p.velocity_gain, getattr(p, "tracking_gain", 0.0))
        assert delay_margin(robot, gain * effective_mass(robot)).min() >= DELAY * (1.0 - 1e-9)
        # Both poles of e_ddot + k_d e_dot + k_p e = 0 in one place.
        assert p.velocity_gain**2 == pytest.approx(4.0 * p.position_gain)
