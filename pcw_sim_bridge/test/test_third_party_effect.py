"""An effect of another package: one file, and it is listed, simulated in both plants, and checked like any other."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from pcw_description import load_robot
from pcw_description.recording import Recording

EFFECT = '''
"""A spring that pulls the steering to zero."""
from pcw_description.compiled import compiled_joint_torque
from pcw_description.effects.effect import EffectParameter
from pcw_description.effects.kinds import JointTorqueEffect


@compiled_joint_torque
def spring(position, velocity, motor_torque, normal_force, parameters):
    return -parameters[0] * position, 0.0


EFFECT = JointTorqueEffect(
    name="steering_spring",
    target_kind="caster",
    axis="steer",
    summary="A spring pulls the steering to zero.",
    sentence="A spring of {stiffness:.3g} N m/rad on the steering of {target}.",
    parameters=(EffectParameter("stiffness", "N m/rad", "torque per angle", 0.0, 100.0, 1.0, linear=True),),
    sensors=("joint_states",),
    look_alikes=("steer_coulomb_friction",),
    separating_experiment="let go of the steering away from zero",
    torque=spring,
)
'''


@pytest.fixture
def simulate(tmp_path):
    """Return a function that runs `simulate` where that package is installed."""
    package = tmp_path / "site" / "other_package"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("")
    (package / "steering_spring.py").write_text(EFFECT)
    metadata = tmp_path / "site" / "other_package-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: other-package\nVersion: 1.0\n")
    (metadata / "entry_points.txt").write_text(
        "[pcw_description.effects]\nsteering_spring = other_package.steering_spring:EFFECT\n"
    )
    path = os.pathsep.join([str(tmp_path / "site"), *(entry for entry in sys.path if entry)])

    def run(*arguments: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-P", "-m", "pcw_sim_bridge.simulate", *arguments]
        return subprocess.run(command, env={**os.environ, "PYTHONPATH": path}, capture_output=True, text=True, timeout=240)

    return run


def test_it_is_listed(simulate):
    listed = simulate("--list-effects").stdout
    assert "steering_spring (caster): A spring pulls the steering to zero." in listed
    assert "stiffness [N m/rad]: torque per angle; 0 to 100, must be given" in listed


@pytest.mark.parametrize("plant", ["reduced", pytest.param("pybullet", marks=pytest.mark.nightly)])
def test_it_is_at_work(simulate, tmp_path, plant):
    """Jacked up, the steering motor of that caster alone holds the spring: -stiffness times angle."""
    out = tmp_path / "bag"
    physics = "{name: steering_spring, target: [front_left], stiffness: 2.0}"
    options = ["--excite", "wheels_off_ground", "--duration", "12", "--ideal", "--plant", plant, "--physics", physics]
    done = simulate(*options, "--out", str(out))
    assert done.returncode == 0, done.stderr
    joints = Recording.open(out, load_robot("thesis")).joint_states
    torque, angle = joints.effort[:, :, 1], joints.position[:, :, 1]
    slopes = [np.polyfit(angle[:, i], torque[:, i], 1)[0] for i in range(4)]
    others = np.mean(slopes[1:])  # inertia makes a slope as well, the same in all
    assert np.ptp(angle[:, 0]) > 0.2
    assert slopes[0] - others == pytest.approx(2.0, rel=0.05)


def test_its_numbers_are_checked(simulate, tmp_path):
    done = simulate(
        "--excite", "spin", "--out", str(tmp_path / "bag"), "--physics", "{name: steering_spring, stiffness: -2.0}"
    )
    assert done.returncode == 2
    assert "physics[0].stiffness" in done.stderr and "allowed: 0 to 100 N m/rad" in done.stderr
    assert not Path(tmp_path / "bag").exists()
