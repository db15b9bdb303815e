"""The registry: every name makes a controller that keeps the contract's shape, and the README tells of each."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from pcw_control import CONTROLLERS, ControllerMeasurement, ForceReference, TwistReference, make_controller
from pcw_control.controller_interface import ControllerParameters
from pcw_description import load_robot

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
        for field in dataclasses.fields(entry.parameters):
            if field.metadata:
                assert f"| `{field.name}` |" in text or f"| `{name}.{field.name}` |" in text, field.name
