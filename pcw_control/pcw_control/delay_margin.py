"""How much delay a velocity loop over the tyres bears, and the gain that leaves enough of it.

A motor with the wheel's own mass m_w pushes the robot's share m through the tyre, a spring c at small slip. The loop
feeds back the wheel's speed (collocated) with the gain k_p:

    P(s) = (s^2 + c/m) / (m_w s (s^2 + w_t^2)),   w_t^2 = c (1/m_w + 1/m)

Without delay its phase stays within +-90 degrees: no gain makes it unstable. A delay tau may turn it by another 90
degrees at the highest frequency where the loop's gain is 1, above the resonance:

    k = k_p / m_w (1 - w_a^2 / w^2),   w_c = (k + sqrt(k^2 + 4 w_t^2)) / 2 with k = k_p / m_w,   tau < pi / (2 w_c)

(w_a^2 = c/m is left out: it only makes the gain smaller.) The hold of the last torque for one period is a delay of half of it.
So the gain for a delay tau is k_p = m_w (w_c - w_t^2 / w_c) with w_c = pi / (2 tau): what resonates above w_c leaves none.
The tyre's stiffness is that of its curve at small slip over the relaxation length, c = 2 mu_p F_z / (lambda_p sigma); damping
is left out, so the margin is that of a robot at rest, the worst one.
"""

from __future__ import annotations

import math

import numpy as np

from pcw_description.robot_description import DRIVE, GRAVITY, STEER, FloatArray, RobotDescription

# Bandwidth of the velocity loops where delay allows it [rad/s]: five times below what a loop delay of 2 ms would disturb.
BANDWIDTH = 10.0
# What a loop has to bear at rest besides the hold, with tyres that damp nothing [s]; rolling, it bears about twice as much.
DELAY = 0.001
# A gain is never derived so small that the robot stands still, however soft its tyres are; in parts of the one asked for.
LEAST_PART = 0.2


def effective_mass(robot: RobotDescription) -> FloatArray:
    """Return what each wheel centre feels of the robot, along and across (n, 2) [kg]: its own mass and its share."""
    return own_mass(robot) + robot.total_mass / robot.n


def own_mass(robot: RobotDescription) -> FloatArray:
    """Return the mass m_w that rotor, rim and fork have at the wheel centre, along and across (n, 2) [kg]."""
    along = robot.armature[:, DRIVE, DRIVE] + [c.wheel.inertia_axle for c in robot.casters]
    across = robot.armature[:, STEER, STEER] + [c.module.inertia_zz for c in robot.casters]
    return np.stack([along / robot.wheel_radius**2, across / robot.caster_offset[:, 0] ** 2], axis=1)


def tyre_resonance(robot: RobotDescription) -> FloatArray:
    """Return w_t along and across (n, 2) [rad/s]: a wheel against the robot on the spring of its tyre."""
    share = robot.total_mass / robot.n
    peak = np.array([[t.mu_p / t.lambda_p, t.lateral.mu_p / t.lateral.lambda_p] for t in robot.tyres])
    stiffness = 2.0 * peak * share * GRAVITY / np.array([[t.relaxation_length] for t in robot.tyres])
    resonance: FloatArray = np.sqrt(stiffness * (1.0 / own_mass(robot) + 1.0 / share))
    return resonance


def delay_margin(robot: RobotDescription, gain: FloatArray) -> FloatArray:
    """Return how much delay the loops bear besides the hold, (n, 2) [s]; below 0 they are unstable without any.

    Args:
        robot: the robot.
        gain: k_p on the velocity of the wheel centres, along and across (n, 2) [N s/m].
    """
    k, w_t = gain / own_mass(robot), tyre_resonance(robot)
    w_c = 0.5 * (k + np.sqrt(k**2 + 4.0 * w_t**2))
    margin: FloatArray = 0.5 * math.pi / w_c - 0.5 / robot.sensors.encoders.rate
    return margin


def derived_bandwidth(robot: RobotDescription, wanted: float, delay: float = DELAY) -> float:
    """Return the bandwidth w [rad/s], at most `wanted`, whose k_p = 2 w m bears `delay` [s] at every wheel.

    Where only a w below a part of `wanted` would, or none, it is that part, which does not bear it: `gain_check` says so.

    Args:
        robot: the robot.
        wanted: [rad/s].
        delay: besides the hold [s].
    """
    w_t = tyre_resonance(robot)
    w_c = 0.5 * math.pi / (delay + 0.5 / robot.sensors.encoders.rate)
    gain = own_mass(robot) * (w_c - w_t**2 / w_c)
    allowed = float(np.min(gain / (2.0 * effective_mass(robot))))
    return max(min(wanted, allowed), LEAST_PART * wanted)
