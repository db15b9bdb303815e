"""The vocabulary of physical effects: what simulators add, the analyser fits and the report says must be one thing."""

from __future__ import annotations

import importlib
import importlib.metadata
import math
import os
import pkgutil
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import pcw_description.effects
from pcw_description import DescriptionError, load_robot
from pcw_description.effects import registry
from pcw_description.effects.effect import Effect, EffectParameter
from pcw_description.effects.kinds import DescriptionEffect, JointTorqueEffect
from pcw_description.effects.registry import all_effects, get, read_physics

# INTERFACES, section 5, and in the last line what it has grown by: every name here has a file, and every file a name.
VOCABULARY = set(
    """
    drive_coulomb_friction drive_viscous_friction drive_stribeck_friction steer_coulomb_friction steer_viscous_friction
    load_dependent_friction rolling_resistance scrub_torque tyre_longitudinal_stiffness tyre_lateral_stiffness tyre_relaxation
    low_friction_patch ground_slope payload_mass payload_offset wheel_radius_error caster_offset_error steer_zero_offset
    wheel_eccentricity motor_cogging torque_constant_error actuator_lag actuator_delay torque_saturation gear_backlash
    gear_elasticity aerodynamic_drag constant_load external_push imu_bias imu_scale imu_lever_arm clock_offset
    uneven_ground tyre_radial_compliance encoder_eccentricity
    """.split()
)
DISSIPATIVE = re.compile(r"_friction$|^rolling_resistance$|^scrub_torque$|^aerodynamic_drag$")
TOPICS = {"joint_states", "joint_commands", "imu/data", "ground_truth/odom", "cmd_vel"}

EFFECTS = list(all_effects().values())
JOINT_EFFECTS = [effect for effect in EFFECTS if isinstance(effect, JointTorqueEffect)]

each_effect = pytest.mark.parametrize("effect", EFFECTS, ids=lambda effect: effect.name)
each_joint_effect = pytest.mark.parametrize("effect", JOINT_EFFECTS, ids=lambda effect: effect.name)


def motion(samples: int = 200) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Position, velocity, motor torque and normal force of a joint that goes fast and slow, both ways, and stands."""
    rng = np.random.default_rng(5)
    velocity = np.concatenate([rng.normal(0.0, 5.0, samples), rng.normal(0.0, 0.05, samples), np.zeros(3)])
    count = len(velocity)
    return rng.uniform(-20.0, 20.0, count), velocity, rng.normal(0.0, 5.0, count), rng.uniform(0.0, 400.0, count)


def typical(effect: Effect) -> dict[str, float]:
    return {p.name: p.typical if p.default is None else p.default for p in effect.parameters}


def test_there_are_effects_and_the_names_are_public() -> None:
    assert {effect.name for effect in EFFECTS} == VOCABULARY
    assert list(all_effects()) == sorted(all_effects())


def test_file_is_named_like_its_effect() -> None:
    names = {info.name for info in pkgutil.iter_modules(pcw_description.effects.__path__)} - {"effect", "kinds", "registry"}
    for name in names:
        assert importlib.import_module(f"pcw_description.effects.{name}").EFFECT.name == name
    assert names <= set(all_effects())


@each_effect
def test_effect_says_what_it_is(effect: Effect) -> None:
    assert effect.target_kind in ("caster", "chassis", "imu", "clock")
    assert effect.axis in ("drive", "steer", "chassis", "imu", "clock")
    assert effect.summary.endswith(".") and effect.sentence.endswith(".")
    assert effect.sensors and set(effect.sensors) <= TOPICS
    assert effect.look_alikes and set(effect.look_alikes) <= VOCABULARY - {effect.name}
    assert effect.separating_experiment
    for parameter in effect.parameters:
        assert parameter.help and parameter.unit
        assert parameter.lower < parameter.upper
        assert parameter.lower <= parameter.typical <= parameter.upper
        assert parameter.default is None or parameter.lower <= parameter.default <= parameter.upper


@each_effect
def test_statement_is_one_sentence_with_its_numbers(effect: Effect) -> None:
    parameters = {p.name: 0.5 * (max(p.lower, -2.0) + min(p.upper, 3.0)) for p in effect.parameters}
    statement = effect.statement(["front_left", "rear_right"], parameters)
    if "{target}" in effect.sentence:
        assert "front_left and rear_right" in statement
    assert statement.count(". ") == 0 and statement.endswith(".")
    main = effect.parameters[0]
    numbers = [float(number) for number in re.findall(r"-?\d+\.?\d*(?:e-?\d+)?", statement)]
    assert any(math.isclose(number, parameters[main.name], rel_tol=0.01) for number in numbers), statement


@each_effect
def test_number_out_of_range_is_refused(effect: Effect) -> None:
    good = typical(effect)
    assert effect.check(good, "physics[0]") == good
    for parameter in effect.parameters:
        for bad in (math.nan, math.inf, "1", True, None, parameter.upper + abs(parameter.upper), parameter.lower - 1.0):
            if bad is None and parameter.default is not None:
                continue
            with pytest.raises(DescriptionError) as caught:
                effect.check({**good, parameter.name: bad}, "physics[0]")
            message = str(caught.value)
            assert f"physics[0].{parameter.name}" in message
            assert f"allowed: {parameter.lower:g} to {parameter.upper:g}" in message and parameter.help in message


@each_effect
def test_effect_can_stand_in_a_description(effect: Effect) -> None:
    robot = load_robot("thesis")
    [instance] = read_physics([{"name": effect.name, **typical(effect)}], robot.caster_names)
    everything = robot.caster_names if effect.target_kind == "caster" else (effect.target_kind,)
    assert instance.target == everything, "without a target it is everywhere"
    assert read_physics([instance.to_mapping()], robot.caster_names) == (instance,)


@each_joint_effect
def test_regressor_is_the_derivative_of_the_contribution(effect: JointTorqueEffect) -> None:
    """Central differences over each linear parameter, at several values; and the linear parts add up to the whole."""
    at = motion()
    rng = np.random.default_rng(11)
    for _ in range(5):
        bounds = {p.name: (max(p.lower, -3.0 * p.typical), min(p.upper, 3.0 * p.typical)) for p in effect.parameters}
        parameters = {name: float(rng.uniform(*bound)) for name, bound in bounds.items()}
        regressor = effect.regressor(*at, parameters)
        assert set(regressor) == {parameter.name for parameter in effect.linear_parameters}
        total = np.zeros(len(at[0]))
        for name, column in regressor.items():
            step = 1e-3 * effect.parameter(name).typical
            above = effect.contribution(*at, parameters | {name: parameters[name] + step})
            below = effect.contribution(*at, parameters | {name: parameters[name] - step})
            scale = max(1.0, np.abs(column).max())
            np.testing.assert_allclose((above - below) / (2.0 * step), column, atol=1e-9 * scale)
            total += parameters[name] * column
        whole = effect.contribution(*at, parameters)
        np.testing.assert_allclose(whole, total, atol=1e-12 * max(1.0, np.abs(whole).max()))
        assert np.abs(whole).max() > 0.0, "an effect that does nothing"


@each_joint_effect
def test_slope_is_the_derivative_over_velocity(effect: JointTorqueEffect) -> None:
    """What the kernel returns beside its torque, against central differences, on both sides of every sign change."""
    position, velocity, motor_torque, normal_force = motion()
    numbers = effect.values(typical(effect) | {p.name: 0.3 * p.typical for p in effect.parameters if p.linear})
    step = 1e-7
    for at in zip(position, velocity[velocity != 0.0], motor_torque, normal_force):
        _, slope = effect.torque(*at, numbers)
        above, below = (effect.torque(at[0], at[1] + sign * step, *at[2:], numbers)[0] for sign in (1.0, -1.0))
        scale = abs(slope) + abs(above) + 1e-3
        assert slope == pytest.approx(-(above - below) / (2.0 * step), abs=1e-5 * scale), at


@each_joint_effect
def test_contribution_is_finite_even_far_out(effect: JointTorqueEffect) -> None:
    extreme = np.array([-1e6, -1.0, 0.0, 1.0, 1e6])
    zero = np.zeros(5)
    lowest = {parameter.name: parameter.lower for parameter in effect.parameters}
    highest = {parameter.name: parameter.upper for parameter in effect.parameters}
    for parameters in (typical(effect), lowest, highest):
        assert np.isfinite(effect.contribution(extreme, extreme, extreme, np.abs(extreme), parameters)).all()
        assert np.isfinite(effect.contribution(zero, zero, zero, zero, parameters)).all()


@pytest.mark.parametrize(
    "effect", [effect for effect in JOINT_EFFECTS if DISSIPATIVE.search(effect.name)], ids=lambda effect: effect.name
)
@given(data=st.data())
def test_friction_never_adds_power(effect: JointTorqueEffect, data: st.DataObject) -> None:
    """For all numbers it may have; of an asymmetry, as long as neither direction is left with negative friction."""
    parameters = {
        p.name: data.draw(st.floats(max(p.lower, -10.0 * p.typical), min(p.upper, 10.0 * p.typical)), label=p.name)
        for p in effect.parameters
    }
    if "asymmetry" in parameters:
        [friction] = [name for name in parameters if name in ("coulomb", "viscous")]
        parameters["asymmetry"] = parameters[friction] * data.draw(st.floats(-1.0, 1.0), label="asymmetry ratio")
    position, velocity, motor_torque, normal_force = motion(50)
    power = effect.contribution(position, velocity, motor_torque, normal_force, parameters) * velocity
    assert np.all(power <= 1e-12 * max(1.0, np.abs(power).max()))


@pytest.mark.parametrize("axis", ["drive", "steer"])
@pytest.mark.parametrize("size", ["coulomb", "viscous"])
def test_asymmetry_is_half_the_difference_of_the_directions(axis: str, size: str) -> None:
    effect = get(f"{axis}_{size}_friction")
    assert isinstance(effect, JointTorqueEffect)
    forwards, backwards = effect.contribution(
        np.zeros(2), np.array([2.0, -2.0]), np.zeros(2), np.zeros(2), typical(effect) | {size: 1.0, "asymmetry": 0.25}
    ) / (2.0 if size == "viscous" else 1.0)
    assert (-forwards, backwards) == pytest.approx((1.25, 0.75))


@pytest.mark.parametrize(
    ("name", "parameters"), [("caster_offset_error", {"x": 0.3, "y": 0.4}), ("wheel_radius_error", {"error": -0.06})]
)
def test_a_wheel_that_is_far_from_its_description_is_one_that_can_be(name: str, parameters: dict[str, float]) -> None:
    """It is refused as a description where its inertias are those of the wheel before."""
    robot = load_robot("thesis")
    effect = get(name)
    assert isinstance(effect, DescriptionEffect)
    [changed, *others] = effect.apply(robot, robot.caster_names[:1], parameters).casters
    assert changed.module.inertia_zz >= robot.casters[0].module.inertia_zz
    assert changed.wheel.inertia_axle <= changed.wheel.mass * changed.wheel_radius**2
    assert others == list(robot.casters[1:])
    little = effect.apply(robot, robot.caster_names[:1], {key: 1e-3 * value for key, value in parameters.items()}).casters[0]
    assert (little.module, little.wheel) == (robot.casters[0].module, robot.casters[0].wheel)


def test_unknown_effect_suggests_the_nearest() -> None:
    with pytest.raises(DescriptionError, match=r"'drive_viscose_friction' .* did you mean 'drive_viscous_friction'\?"):
        get("drive_viscose_friction")
    with pytest.raises(DescriptionError, match=r"effect constant_load: 'lode' .* did you mean 'load'\?"):
        get("constant_load").parameter("lode")


# --- Effects of other packages ----------------------------------------------------------------------------


class ThirdPartyEntryPoint:
    """Stands for an entry point of an installed package."""

    value = "other_package.spring:EFFECT"

    def __init__(self, effect: object) -> None:
        self.effect = effect

    def load(self) -> object:
        return self.effect


def third_party_effect(name: str) -> JointTorqueEffect:
    return JointTorqueEffect(
        name=name,
        target_kind="caster",
        axis="steer",
        summary="A spring pulls the steering to zero.",
        sentence="A spring of {stiffness:.3g} N m/rad on the steering of {target}.",
        parameters=(EffectParameter("stiffness", "N m/rad", "torque per angle", 0.0, 100.0, 1.0, linear=True),),
        sensors=("joint_states",),
    )


@pytest.fixture
def install(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Return a function that makes an effect look installed by another package."""

    def make(effect: object) -> None:
        def entry_points(*, group: str) -> list[ThirdPartyEntryPoint]:
            assert group == "pcw_description.effects"
            return [ThirdPartyEntryPoint(effect)]

        monkeypatch.setattr(importlib.metadata, "entry_points", entry_points)
        registry.all_effects.cache_clear()

    yield make
    registry.all_effects.cache_clear()


def test_effect_of_another_package_is_found(install: Any) -> None:
    """The list grows without an edit: its name stands in a description, and its numbers are checked."""
    install(third_party_effect("steering_spring"))
    [instance] = read_physics([{"name": "steering_spring", "target": "left", "stiffness": 2.0}], ["left", "right"])
    assert (instance.name, instance.target, dict(instance.parameters)) == ("steering_spring", ("left",), {"stiffness": 2.0})
    assert get("steering_spring").statement(["left"], {"stiffness": 2.0}) == "A spring of 2 N m/rad on the steering of left."
    with pytest.raises(DescriptionError, match="0 to 100 N m/rad"):
        read_physics([{"name": "steering_spring", "stiffness": -2.0}], ["left", "right"])
    assert "drive_coulomb_friction" in all_effects()


EFFECT_FILE = '''
from pcw_description.compiled import compiled, compiled_joint_torque
from pcw_description.effects.effect import EffectParameter
from pcw_description.effects.kinds import JointTorqueEffect


@compiled
def pull(position, stiffness):
    return -stiffness * position


@compiled_joint_torque
def spring(position, velocity, motor_torque, normal_force, parameters):
    return pull(position, parameters[0]), 0.0


EFFECT = JointTorqueEffect(
    name="file_spring", target_kind="caster", axis="steer", summary="A spring.", sentence="A spring at {target}.",
    parameters=(EffectParameter("stiffness", "N m/rad", "torque per angle", 0.0, 100.0, 1.0, linear=True),),
    sensors=("joint_states",), torque=spring,
)
'''


def test_effect_files_in_folders_of_the_path_are_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without an installation: the folder is named in the environment, also for compiled kernels a second time."""
    (tmp_path / "effects").mkdir()
    (tmp_path / "effects" / "file_spring.py").write_text(EFFECT_FILE)
    (tmp_path / "effects" / "robot_with_laws.yaml").write_text("no module\n")
    empty = tmp_path / "empty"
    empty.mkdir()
    monkeypatch.setenv("PCW_EFFECTS_PATH", os.pathsep.join([str(empty), str(tmp_path / "effects")]))
    code = """
import numpy as np
from pcw_description.effects.registry import get
one = np.ones(1)
print(get("file_spring").contribution(one, one, one, one, {"stiffness": 2.0})[0])
"""
    for _ in range(2):
        run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
        assert (run.stdout, run.stderr) == ("-2.0\n", "")


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("1 / 0\n", "division by zero"),
        ("x = 1\n", "no attribute 'EFFECT'"),
        ("EFFECT = 3\n", "an instance of Effect"),
        ("from pcw_description.effects.constant_load import EFFECT\n", "each name once"),
        (None, "allowed: folders of effect files"),
    ],
)
def test_a_path_that_holds_no_effects_is_refused(
    content: str | None, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> None:
    """The message names the folder or the file."""
    folder = tmp_path / "effects"
    if content is not None:
        folder.mkdir()
        (folder / "strange.py").write_text(content)
    monkeypatch.setenv("PCW_EFFECTS_PATH", str(folder))
    registry.all_effects.cache_clear()
    request.addfinalizer(registry.all_effects.cache_clear)
    with pytest.raises(DescriptionError) as caught:
        all_effects()
    assert said in str(caught.value) and str(folder if content is None else folder / "strange.py") in str(caught.value)


def test_an_effect_can_be_known_for_a_while() -> None:
    """Whoever conceals an effect in a simulator leaves the vocabulary as it was, also after an error."""
    before = dict(all_effects())
    with pytest.raises(RuntimeError), registry.also_known([third_party_effect("steering_spring")]):
        assert get("steering_spring").name == "steering_spring"
        raise RuntimeError
    assert all_effects() == before
    taken = third_party_effect("constant_load")
    with pytest.raises(DescriptionError, match="each name once"), registry.also_known([taken]):
        pass
    assert all_effects() == before


def test_effect_of_another_package_may_not_change_a_name(install: Any) -> None:
    install(third_party_effect("constant_load"))
    with pytest.raises(DescriptionError, match=r"other_package\.spring:EFFECT: 'constant_load' .* each name once"):
        all_effects()


def test_entry_point_that_is_no_effect_is_named(install: Any) -> None:
    install("a string")
    with pytest.raises(DescriptionError, match=r"effect other_package\.spring:EFFECT: 'a string' .* an instance of Effect"):
        all_effects()
