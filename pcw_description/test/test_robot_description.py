"""The format pcw_robot/1: every way to get a file wrong has a message that names the key, the value and what is allowed."""

from __future__ import annotations

import copy
import dataclasses
import datetime
import math
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from pcw_description import (
    AugmentedObjectModel,
    DescriptionError,
    KinematicsError,
    forward_kinematics,
    load_robot,
    parse_robot,
    save_robot,
    shipped_robots,
    wheel_jacobian,
)
from pcw_description.contact.contact_model import tyre_parameters
from pcw_description.robot_description import DEFAULT_TOLERANCES, DRIVE, STEER
from pcw_description.robot_file import robot_to_mapping, robots_directory

SHIPPED = ("dyros_pcv", "flow_base", "mpo700", "thesis", "tidybot2", "xr4000")
TORQUE_CONTROLLED = tuple(name for name in SHIPPED if name != "mpo700")
REMOVED = object()


def thesis() -> dict[str, Any]:
    """The thesis robot as a mapping, `caster_defaults` spelled out, so that each caster can be changed alone."""
    return copy.deepcopy(robot_to_mapping(load_robot("thesis")))


def changed(path: str, value: object) -> dict[str, Any]:
    """The thesis robot with one value replaced (or removed); path such as "casters.0.module.mass"."""
    data = thesis()
    *parents, last = (int(part) if part.isdigit() else part for part in path.split("/"))
    place: Any = data
    for part in parents:
        place = place[part]
    if value is REMOVED:
        del place[last]
    else:
        place[last] = value
    return data


def refusal(data: object) -> DescriptionError:
    """The error that a description raises."""
    with pytest.raises(DescriptionError) as caught:
        parse_robot(data)  # type: ignore[arg-type]
    return caught.value


# --- One message per mistake ------------------------------------------------------------------------------

# (what is wrong, path of the value, new value, words of the message in this order: key, value, what is allowed)
MISTAKES = [
    ("unknown key at the top", "chasis", {}, ["chasis", "{}", "unknown key", "did you mean 'chassis'?"]),
    ("unknown key", "chassis/mas", 74.0, ["chassis.mas", "74.0", "unknown key", "did you mean 'mass'?", "inertia_zz"]),
    ("unknown key in a caster", "casters/2/wheel_radus", 0.05,
     ["casters[2].wheel_radus", "0.05", "did you mean 'wheel_radius'?"]),
    ("unknown key, nothing near", "sensors/qqqq", 1.0,
     ["sensors.qqqq", "1.0", "unknown key; allowed: encoders, imu, tracker"]),
    ("millimetres, radius", "casters/0/wheel_radius", 75, ["casters[0].wheel_radius", "75", "in m, above 0, at most 1", "mm"]),
    ("millimetres, axis", "casters/1/steer_axis", [250, -200],
     ["casters[1].steer_axis[0]", "250", "in m", "at most 10", "mm"]),
    ("millimetres, offset", "casters/1/caster_offset", [-30, 0], ["casters[1].caster_offset[0]", "-30", "at least -1", "mm"]),
    ("rpm", "casters/0/limits/drive_speed", 3000, ["casters[0].limits.drive_speed", "3000", "in rad/s", "at most 300", "rpm"]),
    ("degrees", "casters/0/limits/steer_speed", 720,
     ["casters[0].limits.steer_speed", "720", "in rad/s", "at most 100", "deg/s"]),
    ("percent", "contact/lambda_p", 10, ["contact.lambda_p", "10", "at most 1", "percent"]),
    ("negative mass", "chassis/mass", -74.0, ["chassis.mass", "-74.0", "a number in kg, above 0"]),
    ("no mass", "casters/3/module/mass", 0, ["casters[3].module.mass", "0", "a number in kg, above 0"]),
    ("negative radius", "casters/0/wheel_radius", -0.075, ["casters[0].wheel_radius", "-0.075", "in m, above 0"]),
    ("negative friction", "contact/mu_p", -0.8, ["contact.mu_p", "-0.8", "above 0"]),
    ("negative noise", "sensors/encoders/torque_noise", -0.1, ["sensors.encoders.torque_noise", "-0.1", "at least 0"]),
    ("negative limit", "casters/0/limits/steer_torque", -1.0, ["casters[0].limits.steer_torque", "-1.0", "in N m, above 0"]),
    ("chassis wider than itself", "chassis/inertia_zz", 90.0, ["chassis.inertia_zz", "90.0", "non-physical", "at most 45.1"]),
    ("placeholder inertia", "chassis/inertia_zz", 0.001, ["chassis.inertia_zz", "0.001", "placeholder", "at least 0.0451"]),
    ("triangle inequality", "chassis/inertia_xx", 30.0,
     ["chassis.inertia_zz", "4.2", "I_xx = 30", "at most the sum of the two"]),
    ("wheel beyond a ring", "casters/1/wheel/inertia_axle", 0.0085,
     ["casters[1].wheel.inertia_axle", "0.0085", "1.5 kg", "at most m r^2 = 0.008438", "rotors"]),
    ("wheel heavier than module", "casters/0/wheel/mass", 4.0, ["casters[0].wheel.mass", "4.0", "below module.mass = 4 kg"]),
    ("module less than its wheel", "casters/0/module/inertia_zz", 0.001,
     ["casters[0].module.inertia_zz", "0.001", "non-physical", "0.002878 kg m^2", "allowed: above that"]),
    ("module wider than a caster", "casters/0/module/inertia_zz", 5.0,
     ["casters[0].module.inertia_zz", "5.0", "non-physical", "at most 0.468"]),
    ("two casters on one axis", "casters/1/steer_axis", [0.25, 0.195],
     ["casters[1].steer_axis", "[0.25, 0.195]", "two casters on one axis", "'front_left' is 0.005 m away", "at least 0.01 m"]),
    ("missing field", "chassis/mass", REMOVED,
     ["chassis.mass is missing", "mass without the caster modules", "in kg, above 0"]),
    ("missing field of a caster", "casters/2/gears/drive", REMOVED,
     ["casters[2].gears.drive is missing", "turns of the drive motor"]),
    ("missing section", "contact", REMOVED, ["contact is missing", "the nominal ground"]),
    ("null", "chassis/inertia_zz", None, ["chassis.inertia_zz is missing", "in kg m^2, above 0"]),
    ("no casters", "casters", [], ["casters", "0", "at least 2"]),
    ("casters are no list", "casters", {"name": "a"}, ["casters", "{'name': 'a'}", "allowed: a list of casters"]),
    ("casters missing", "casters", REMOVED, ["casters is missing", "a list of casters"]),
    ("a caster is no mapping", "casters/0", "front_left", ["casters[0]", "'front_left'", "a mapping"]),
    ("name twice", "casters/3/name", "front_left", ["casters[3].name", "'front_left'", "each name once", "casters[0] has it"]),
    ("name with a space", "casters/3/name", "rear right", ["casters[3].name", "'rear right'", "letters, digits and _"]),
    ("empty name", "name", " ", ["name", "' '", "allowed: text"]),
    ("gears that cannot turn", "casters/0/gears/drive", 0.0, ["casters[0].gears", "0.0", "gear matrix that can be inverted"]),
    ("tolerance without unit", "tolerances", {"chassis.mass": 0.01}, ["tolerances.chassis.mass", "0.01", "'1 %'", "unit kg"]),
    ("tolerance in another unit", "tolerances", {"steer_zero": "1 deg"}, ["tolerances.steer_zero", "'1 deg'", "0.002 rad"]),
    ("negative tolerance", "tolerances", {"wheel_radius": "-1 %"}, ["tolerances.wheel_radius", "'-1 %'", "positive"]),
    ("unknown tolerance", "tolerances", {"wheel_radii": "1 %"},
     ["tolerances.wheel_radii", "'1 %'", "did you mean 'wheel_radius'?"]),
    ("tolerances are a list", "tolerances", [], ["tolerances", "[]", "a mapping of names to tolerances"]),
    ("unknown effect", "physics", [{"name": "drive_coulomb_fricton"}],
     ["physics[0].name", "'drive_coulomb_fricton'", "unknown effect", "did you mean 'drive_coulomb_friction'?"]),
    ("effect without name", "physics", [{"target": "front_left"}],
     ["physics[0]", "front_left", "a mapping with name, target"]),
    ("effect's name is a list", "physics", [{"name": ["a"]}], ["physics[0].name", "['a']", "unknown effect"]),
    ("unknown target", "physics", [{"name": "constant_load", "load": 1.0, "target": "front_lft"}],
     ["physics[0].target", "'front_lft'", "did you mean 'front_left'?", "rear_right"]),
    ("target of another kind", "physics", [{"name": "payload_mass", "mass": 1.0, "target": ["front_left"]}],
     ["physics[0].target", "'front_left'", "allowed: chassis"]),
    ("target twice", "physics", [{"name": "constant_load", "load": 1.0, "target": ["rear_left", "rear_left"]}],
     ["physics[0].target", "['rear_left', 'rear_left']", "each target once"]),
    ("no target", "physics", [{"name": "constant_load", "load": 1.0, "target": []}],
     ["physics[0].target", "[]", "a list out of"]),
    ("effect without its number", "physics", [{"name": "constant_load"}],
     ["physics[0].load is missing", "-10000 to 10000 N m"]),
    ("effect out of range", "physics", [{"name": "drive_coulomb_friction", "coulomb": -1.0}],
     ["physics[0].coulomb", "-1.0", "allowed: 0 to 10000 N m"]),
    ("effect with text", "physics", [{"name": "constant_load", "load": "1 Nm"}], ["physics[0].load", "'1 Nm'", "N m"]),
    ("effect with NaN", "physics", [{"name": "constant_load", "load": math.nan}], ["physics[0].load", "nan", "N m"]),
    ("unknown parameter", "physics", [{"name": "constant_load", "load": 1.0, "lod": 2.0}],
     ["physics[0].lod", "2.0", "unknown parameter", "did you mean 'load'?"]),
    ("physics is a mapping", "physics", {}, ["physics", "{}", "a list of effects"]),
    ("NaN", "chassis/inertia_zz", math.nan, ["chassis.inertia_zz", "nan", "a number in kg m^2"]),
    ("infinity", "casters/0/rotors/drive", math.inf, ["casters[0].rotors.drive", "inf", "a number in kg m^2"]),
    ("an integer beyond floats", "chassis/mass", 10**400, ["chassis.mass", "1000", "a number in kg"]),
    ("text for a number", "chassis/mass", "74 kg", ["chassis.mass", "'74 kg'", "a number in kg"]),
    ("true for a number", "chassis/mass", True, ["chassis.mass", "True", "a number in kg"]),
    ("two numbers for three", "chassis/com", [0.0, 0.0], ["chassis.com", "[0.0, 0.0]", "a list of 3 numbers in m"]),
    ("a number for a list", "casters/0/steer_axis", 0.25, ["casters[0].steer_axis", "0.25", "a list of 2 numbers in m"]),
    ("text in a list", "casters/0/steer_axis", [0.25, "left"], ["casters[0].steer_axis[1]", "'left'", "numbers in m"]),
    ("a number for a section", "chassis", 74.0, ["chassis", "74.0", "a mapping with the keys mass, inertia_zz"]),
    ("another format", "format", "pcw_robot/2", ["format", "'pcw_robot/2'", "allowed: pcw_robot/1"]),
    ("no format", "format", REMOVED, ["format is missing", "allowed: pcw_robot/1"]),
    ("unknown friction curve", "contact/model", "kienke", ["contact.model", "'kienke'", "did you mean 'kiencke'?", "lugre"]),
    ("shape of another curve", "contact/shape", {"c1": 1.0}, ["contact.shape", "c1"]),
    ("shape is a list", "contact/shape", [1.0], ["contact.shape", "[1.0]", "a mapping of names to finite numbers"]),
    ("no provenance", "provenance", REMOVED, ["provenance is missing", "where each number comes from"]),
    ("empty provenance", "provenance", {}, ["provenance", "{}", "where each number comes from"]),
    ("provenance of blanks", "provenance", " ", ["provenance", "' '", "a text or a mapping"]),
    ("provenance without source", "provenance/chassis", None,
     ["provenance.chassis is missing", "text, a source or 'assumed'"]),
    ("provenance is a number", "provenance/chassis", 3, ["provenance.chassis", "3", "text, a source or 'assumed'"]),
]


def test_a_text_is_the_provenance_of_all_numbers() -> None:
    assert parse_robot(changed("provenance", "measured on a scale")).provenance == {"all": "measured on a scale"}
    dated = parse_robot(changed("provenance", {"chassis": datetime.date(2026, 5, 4)}))
    assert dated.provenance == {"chassis": "2026-05-04"}


@pytest.mark.parametrize(("path", "value", "words"), [case[1:] for case in MISTAKES], ids=[case[0] for case in MISTAKES])
def test_mistake_is_named_with_key_value_and_what_is_allowed(path: str, value: object, words: list[str]) -> None:
    error = refusal(changed(path, value))
    message = str(error)
    position = -1
    for word in words:
        position = message.find(word, position + 1)
        assert position >= 0, f"{word!r} is not in its place in {message!r}"
    assert message.startswith(error.key)
    assert "\n" not in message


def test_message_stays_short_for_a_long_value() -> None:
    assert len(str(refusal(changed("chassis/mass", "x" * 10_000)))) < 300


def test_one_caster_is_too_few() -> None:
    data = thesis()
    del data["casters"][1:]
    allowed = "at least 2 casters (thesis section 3.1), or 1 and fixed_wheels"
    assert str(refusal(data)) == f"casters: 1 is not allowed; allowed: {allowed}"


def test_description_that_is_no_mapping_is_refused() -> None:
    assert "a mapping of keys to values" in str(refusal([1, 2]))


# --- Files ------------------------------------------------------------------------------------------------


def message_of_file(path: Path) -> str:
    with pytest.raises(DescriptionError) as caught:
        load_robot(path)
    return str(caught.value)


def test_key_given_twice_is_refused_with_its_line(tmp_path: Path) -> None:
    """YAML keeps the last of two equal keys without a word."""
    text = (robots_directory() / "thesis.yaml").read_text(encoding="utf-8")
    path = tmp_path / "robot.yaml"
    path.write_text(text.replace("  mass: 74.0\n", "  mass: 74.0\n  mass: 47.0\n", 1), encoding="utf-8")
    line = text[: text.index("  mass: 74.0")].count("\n") + 2
    problem = "it stands there a second time; allowed: each key once"
    assert message_of_file(path) == f"{path}: line {line}: 'mass' is not allowed; {problem}"


def test_a_file_that_is_refused_is_named(tmp_path: Path) -> None:
    """Who gives several files is told which one."""
    path = tmp_path / "robot.yaml"
    path.write_text(yaml.safe_dump(changed("chassis/mass", -1.0)), encoding="utf-8")
    with pytest.raises(DescriptionError) as caught:
        load_robot(path)
    assert str(caught.value).startswith(f"{path}: chassis.mass: -1.0 is not allowed; ")
    assert (caught.value.file, caught.value.key) == (str(path), "chassis.mass")


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        (b"chassis: [1, 2", "it is not YAML (while parsing a flow sequence"),
        (b"", "it holds nothing; allowed: a mapping of keys to values"),
        (b"- a\n- b\n", "it holds one list; allowed: a mapping of keys to values"),
        (b"\xff\xfe\x00\x01", "it is not text; allowed: a YAML file"),
    ],
)
def test_file_that_is_no_description(tmp_path: Path, content: bytes, problem: str) -> None:
    path = tmp_path / "robot.yaml"
    path.write_bytes(content)
    message = message_of_file(path)
    assert message.startswith("file: ") and "robot.yaml" in message and problem in message


def test_absent_file(tmp_path: Path) -> None:
    message = message_of_file(tmp_path / "nowhere.yaml")
    assert "nowhere.yaml" in message and "No such file" in message and "a readable YAML file" in message


def test_unknown_shipped_robot_suggests_the_nearest() -> None:
    with pytest.raises(DescriptionError, match=r"robot: 'tidybot' .* did you mean 'tidybot2'\? allowed: dyros_pcv, .*xr4000"):
        load_robot("tidybot")


def test_numbers_in_exponent_form_are_numbers(tmp_path: Path) -> None:
    """YAML 1.1 reads `4e-5` as text."""
    text = (robots_directory() / "thesis.yaml").read_text(encoding="utf-8")
    path = tmp_path / "robot.yaml"
    path.write_text(text.replace("drive: 4.0e-5", "drive: 4e-5"), encoding="utf-8")
    assert load_robot(path) == load_robot("thesis")


# --- Round trip and properties ----------------------------------------------------------------------------


@pytest.mark.parametrize("name", SHIPPED)
def test_saved_robot_is_read_back_equal(name: str, tmp_path: Path) -> None:
    robot = load_robot(name)
    save_robot(robot, tmp_path / "again.yaml")
    assert load_robot(tmp_path / "again.yaml") == robot


def test_effects_and_tolerances_survive_the_round_trip(tmp_path: Path) -> None:
    data = thesis()
    data["physics"] = [{"name": "drive_coulomb_friction", "target": "rear_left", "coulomb": 0.7}]
    data["tolerances"] = {"wheel_radius": "1.5 %", "steer_zero": "0.01 rad"}
    robot = parse_robot(data)
    save_robot(robot, tmp_path / "again.yaml")
    again = load_robot(tmp_path / "again.yaml")
    assert again == robot
    assert again.physics[0].target == ("rear_left",)
    assert dict(again.physics[0].parameters) == {"coulomb": 0.7, "asymmetry": 0.0, "smoothing_speed": 0.05}
    assert again.tolerance("wheel_radius").value == pytest.approx(0.015) and again.tolerance("wheel_radius").relative
    assert again.tolerance("chassis.mass") == DEFAULT_TOLERANCES["chassis.mass"]


def number_paths(data: object, prefix: str = "") -> Iterator[str]:
    """Paths of every number in a description, in the form of `changed`."""
    items = data.items() if isinstance(data, Mapping) else enumerate(data) if isinstance(data, list) else ()
    for key, value in items:
        if isinstance(value, (int, float)):
            yield f"{prefix}{key}"
        else:
            yield from number_paths(value, f"{prefix}{key}/")


NUMBERS = sorted(number_paths(robot_to_mapping(load_robot("thesis"))))


NOT_A_NUMBER = (math.nan, math.inf, -math.inf, "1.0", [1.0, 2.0, 3.0, 4.0], {}, True)
POSITIVE = [path for path in NUMBERS if re.search(r"mass$|radius|inertia|width|speed|torque|rate|_p$|counts", path)]


@given(path=st.sampled_from(NUMBERS), value=st.sampled_from(NOT_A_NUMBER))
def test_no_number_may_be_something_else(path: str, value: object) -> None:
    key = re.sub(r"/(\d+)", r"[\1]", path).replace("/", ".")
    assert refusal(changed(path, value)).key.startswith(key)


@given(
    path=st.sampled_from(POSITIVE),
    value=st.floats(max_value=0.0, allow_nan=False).map(lambda number: -abs(number) or -1.0),
)
def test_what_is_positive_may_not_be_negative(path: str, value: float) -> None:
    error = refusal(changed(path, value))
    assert error.value == value
    assert "above 0" in error.allowed or "at least 0" in error.allowed


# --- Robots without the lever arm -------------------------------------------------------------------------


def test_wheel_beside_its_axis_loads_but_is_refused_for_torque_control() -> None:
    """MPO-700: kinematics works, and both ways into torque control say why not."""
    robot = load_robot("mpo700")
    twist = forward_kinematics(robot, np.zeros(4), np.tile([1.0, 0.0], (4, 1)))
    np.testing.assert_allclose(twist, [0.09, 0.0, 0.0], atol=1e-12)
    reason = r"mpo700: caster 'front_left' has caster_offset\[0\] = 0 m; torque control needs at least 0\.001 m .* lever arm"
    for attempt in (robot.require_torque_control, lambda: AugmentedObjectModel(robot)):
        with pytest.raises(KinematicsError, match=reason):
            attempt()


# --- The shipped robots -----------------------------------------------------------------------------------


def test_the_shipped_robots_are_those_of_the_readme() -> None:
    assert shipped_robots() == SHIPPED
    readme = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")
    for name in SHIPPED:
        robot = load_robot(name)
        assert f"| `{name}` |" in readme
        assert re.search(rf"\| `{name}` \|[^|]*\| {robot.n} \| {robot.total_mass:g} \|", readme), name


@pytest.mark.parametrize("name", SHIPPED)
def test_every_number_says_where_it_comes_from(name: str) -> None:
    """Each number lies under a key of `provenance`, each key names a place, each text a source or an assumption."""
    data = yaml.safe_load((robots_directory() / f"{name}.yaml").read_text(encoding="utf-8"))
    places = set()
    for path in number_paths(data):
        parts = [part for part in path.split("/") if not part.isdigit()]
        places.add(".".join("casters" if part == "caster_defaults" else part for part in parts))
    keys = dict(data["provenance"])
    for place in places:
        assert any(place == key or place.startswith(f"{key}.") for key in keys), f"{place} has no provenance"
    named = places | {"casters.name", "contact.model"} | ({"tolerances"} if "tolerances" in data else set())
    for key, text in keys.items():
        assert any(place == key or place.startswith(f"{key}.") for place in named), f"{key} is not in the file"
        assert re.search(r"assumed|github\.com|wiki\.|as above|as for|its maker|Li 2009|Cpp|\.h|\.py", text), f"{key}: {text}"


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_robot_can_be_and_can_drive(name: str) -> None:
    """Wheels are between a disc's hub and a ring, and torque and speed suffice for a gentle 0.25 m/s^2 and 0.25 m/s."""
    robot = load_robot(name)
    assert robot.physics == () and robot.name == name
    tyre_parameters(robot.contact)
    for caster in robot.casters:
        ring = caster.wheel.mass * caster.wheel_radius**2
        assert 0.2 * ring < caster.wheel.inertia_axle <= ring
        assert caster.wheel_radius < robot.chassis.com[2] + 0.5 * robot.chassis.size[2]
    speed, acceleration = 0.25, 0.25
    limits = robot.torque_limit
    assert np.all(robot.speed_limit[:, DRIVE] * robot.wheel_radius > speed)
    push = np.sum(limits[:, DRIVE] / robot.wheel_radius)
    if name not in TORQUE_CONTROLLED:
        assert push > robot.total_mass * acceleration
        return
    offset = np.abs(robot.caster_offset[:, 0])
    assert np.all(robot.speed_limit[:, STEER] * offset > speed)
    model = AugmentedObjectModel(robot)
    rng = np.random.default_rng(3)
    for _ in range(50):
        steer_angle = rng.uniform(-np.pi, np.pi, robot.n)
        inertia, _ = model.evaluate(steer_angle, np.zeros(3))
        scale = np.sqrt(np.diag(inertia))
        assert np.linalg.eigvalsh(inertia / np.outer(scale, scale)).min() > 0.1
        # The wheels on their own: force A^T (drive / r, steer / b), whatever the heading.
        force = np.abs(wheel_jacobian(robot, steer_angle)).T @ np.ravel(
            np.stack([limits[:, DRIVE] / robot.wheel_radius, limits[:, STEER] / offset], axis=1)
        )
        assert np.all(force[:2] > inertia[[0, 1], [0, 1]] * acceleration)


def test_gear_coupling_turns_motors_as_published() -> None:
    """TidyBot++: drive motor = N_r1 phi - N_r1 N_r2 N_w rho; XR4000: motors (-Ns phi, -Nt phi + Nt Nw rho)."""
    rho, phi = 0.7, -1.3
    tidybot = load_robot("tidybot2").gear_matrix[0] @ [rho, phi]
    drive = 50 / 14 * phi - 50 / 14 * 19 / 25 * 45 / 15 * rho
    np.testing.assert_allclose(tidybot, [drive, 32 / 15 * 60 / 10 * phi], rtol=1e-12)
    xr4000 = load_robot("xr4000").gear_matrix[0] @ [rho, phi]
    np.testing.assert_allclose(xr4000, [-85 / 35 * phi + 85 / 35 * 2 * rho, -96 / 24 * phi], rtol=1e-12)


def test_published_placeholders_would_be_refused() -> None:
    """TidyBot++'s 0.001 kg m^2 for 60 kg and MPO-700's 0.1104 kg m^2 for a wheel of 1.2 kg stay out by validation."""
    data = robot_to_mapping(load_robot("tidybot2"))
    data["chassis"]["inertia_zz"] = 0.001
    assert refusal(data).key == "chassis.inertia_zz"
    data = robot_to_mapping(load_robot("mpo700"))
    data["casters"][0]["wheel"]["inertia_axle"] = 0.11042056
    assert refusal(data).key == "casters[0].wheel.inertia_axle"


def test_arrays_of_a_robot_cannot_be_changed() -> None:
    robot = load_robot("thesis")
    with pytest.raises(ValueError, match="read-only"):
        robot.steer_axis[0, 0] = 1.0
    with pytest.raises(dataclasses.FrozenInstanceError):
        robot.name = "other"  # type: ignore[misc]


# --- XR4000 against its published closed form -------------------------------------------------------------


class PublishedXr4000:
    """Lambda and mu of the XR4000 in the form of its published code, derived anew from the energies of its parts.

    Coordinates of one caster: (sigma_dot, rho_dot, omega) = steering, rolling, chassis. Its parts turn at: fork sigma_dot +
    omega; wheel rho_dot; shaft h in the fork sigma_dot + omega - Nw rho_dot; shaft i sigma_dot + omega + Nw rho_dot; steering
    rotor omega - Ns sigma_dot; drive rotor omega - Nt sigma_dot + Nt Nw rho_dot. mu uses the inertial acceleration in body
    axes: F = Lambda a + mu with a = V_dot + omega x v.

    Attributes:
        module_form: leave out what the module form of pcw_robot/1 cannot say: the coupling of spinning rotors to the yaw of
            the chassis, and the cross term of shaft i.
        as_printed: It Nt in place of It Nt^2 in the steering entry, as the published code has it.
    """

    h, b, r, f = 0.2159, -0.020 * 0.995, 0.055, -0.010
    fork_mass, fork_inertia = 2.720, 3.32e-3
    shaft_h, shaft_i, rotor_s, rotor_t, axle = 4.78e-4, 1.74e-5, 7.11e-5, 8.53e-5, 4.00e-4
    ns, nt, nw = 96 / 24, 85 / 35, 2.0
    fixed_mass, fixed_inertia, platform_mass, platform_inertia = 5.2, 0.022, 30.0, 2.1
    axes = ((0.0, h), (-h, 0.0), (0.0, -h), (h, 0.0))

    def __init__(self, module_form: bool = False, as_printed: bool = False) -> None:
        self.module_form, self.as_printed = module_form, as_printed

    def joint_inertia(self) -> np.ndarray:
        """The 3 x 3 inertia of one caster in (sigma_dot, rho_dot, omega)."""
        e = self.f - self.b
        parts = [
            (self.fork_mass * e**2 + self.fork_inertia, (1.0, 0.0, 1.0)),
            (self.fork_mass * self.r**2 + self.axle, (0.0, 1.0, 0.0)),
        ]
        rotors = [
            (self.shaft_h, (1.0, -self.nw)), (self.rotor_s, (-self.ns, 0.0)), (self.rotor_t, (-self.nt, self.nt * self.nw)),
        ]
        if self.module_form:
            for inertia, spin in rotors:
                parts += [(inertia, (*spin, 0.0)), (inertia, (0.0, 0.0, 1.0))]
            parts += [(self.shaft_i, (1.0, 0.0, 1.0)), (self.shaft_i, (0.0, self.nw, 0.0))]
        else:
            parts += [(inertia, (*spin, 1.0)) for inertia, spin in rotors] + [(self.shaft_i, (1.0, self.nw, 1.0))]
        matrix = sum(inertia * np.outer(row, row) for inertia, row in parts)
        if self.as_printed:
            matrix[0, 0] += self.rotor_t * (self.nt - self.nt**2)
        return np.asarray(matrix)

    def evaluate(self, steer_angle: np.ndarray, twist: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return Lambda and mu."""
        omega = twist[2]
        inertia = np.diag([self.platform_mass, self.platform_mass, self.platform_inertia])
        bias = np.zeros(3)
        e, joint_inertia = self.f - self.b, self.joint_inertia()
        for (kx, ky), angle in zip(self.axes, steer_angle, strict=True):
            c, s = math.cos(angle), math.sin(angle)
            rates_from_twist = np.array(
                [
                    [s / self.b, -c / self.b, -(kx * c + ky * s) / self.b - 1.0],
                    [c / self.r, s / self.r, (kx * s - ky * c) / self.r],
                    [0.0, 0.0, 1.0],
                ]
            )
            steer_rate, roll_rate, _ = rates_from_twist @ twist
            turn = steer_rate + omega
            lever = self.fork_mass * self.r * e
            coriolis = np.array([lever * roll_rate * turn, -lever * turn**2, lever * roll_rate * turn])
            # Acceleration of the vehicle's centre at constant joint rates, inertial, in body axes.
            u, n = np.array([c, s]), np.array([-s, c])
            drift = self.r * roll_rate * turn * n + omega**2 * np.array([kx, ky]) + self.b * turn**2 * u
            bias += rates_from_twist.T @ (coriolis - joint_inertia @ rates_from_twist @ [*drift, 0.0])
            bias[:2] -= self.fixed_mass * omega**2 * np.array([kx, ky])
            inertia += rates_from_twist.T @ joint_inertia @ rates_from_twist
            m = self.fixed_mass
            inertia += [[m, 0.0, -m * ky], [0.0, m, m * kx], [-m * ky, m * kx, self.fixed_inertia + m * self.h**2]]
        return inertia, bias


def xr4000_deviation(published: PublishedXr4000) -> tuple[float, float]:
    """Largest deviation of our Lambda (per sqrt of its diagonal) and theta (median, relative) over random states."""
    model = AugmentedObjectModel(load_robot("xr4000"))
    rng = np.random.default_rng(4000)
    inertia_deviation, bias_deviation = [], []
    for _ in range(200):
        steer_angle, twist = rng.uniform(-np.pi, np.pi, 4), rng.normal(size=3)
        ours, our_bias = model.evaluate(steer_angle, twist)
        theirs, mu = published.evaluate(steer_angle, twist)
        # Their acceleration is V_dot + omega x v, ours V_dot.
        their_bias = mu + theirs @ np.array([-twist[2] * twist[1], twist[2] * twist[0], 0.0])
        scale = np.sqrt(np.diag(theirs))
        inertia_deviation.append(np.abs((ours - theirs) / np.outer(scale, scale)).max())
        bias_deviation.append(np.linalg.norm((our_bias - their_bias) / scale) / np.linalg.norm(their_bias / scale))
    return max(inertia_deviation), float(np.median(bias_deviation))


def test_xr4000_agrees_with_its_published_closed_form() -> None:
    """The conversion to fork, wheel, rotors and gears loses nothing but two small couplings, whose size is measured here."""
    inertia, bias = xr4000_deviation(PublishedXr4000(module_form=True))
    assert inertia < 1e-14 and bias < 1e-13
    inertia, bias = xr4000_deviation(PublishedXr4000())
    assert 0.001 < inertia < 0.005 and bias < 0.03


def test_xr4000_as_printed_is_not_an_inertia_of_its_parts() -> None:
    """The published steering entry has It Nt where the energy gives It Nt^2: 3 % of Lambda, ten times what we leave out."""
    inertia, _ = xr4000_deviation(PublishedXr4000(as_printed=True))
    assert 0.015 < inertia < 0.04
