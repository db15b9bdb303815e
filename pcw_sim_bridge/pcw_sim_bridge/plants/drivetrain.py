"""From a torque command to the torques on the joints of one caster: limits, actuators, gears and friction.

All plants call this, each step and caster: `motor_torques` first, then `joint_torques`, and `turn_motors` once the new
joint rates are known. Torques on the joints come with their slope over the joint rates, so that a plant can take them
implicitly: friction then neither chatters nor overshoots, and a stiff gear is stable at any step.
"""

from __future__ import annotations

import math

from pcw_description.compiled import compiled
from pcw_description.effects.kinds import MOTOR_RATE, STEP, TORQUE

from .caster_arrays import LIMIT_DRIVE, LIMIT_STEER, MOTOR_PHI, MOTOR_RHO, PHI, PHI_DOT, RHO, RHO_DOT
from .effect_tables import (
    ANGLE,
    DAMPING,
    GEAR,
    INERTIA,
    MOMENTUM,
    PLAY,
    RATE,
    ROTOR,
    SLOPE,
    STIFFNESS,
    TORQUE_AT_REST,
)


@compiled
def motor_torques(i, dt, caster, command, wheel, effects, at):  # type: ignore[no-untyped-def]
    """Fill the motor torques of caster i in `wheel`: the command within the limits, through the actuators' effects."""
    n = len(effects.gears)
    wheel[MOTOR_RHO] = min(max(command[0], -caster[LIMIT_DRIVE]), caster[LIMIT_DRIVE])
    wheel[MOTOR_PHI] = min(max(command[1], -caster[LIMIT_STEER]), caster[LIMIT_STEER])
    for axis in range(2):
        first = effects.array_start[n + 2 * i + axis]
        last = effects.array_start[n + 2 * i + axis + 1]
        if first == last:
            continue
        torque = wheel[MOTOR_RHO + axis]
        has_gear = effects.gears[i, axis, GEAR] > 0.0
        at[MOTOR_RATE] = effects.gear_state[i, axis, RATE] if has_gear else wheel[RHO_DOT + axis]
        at[STEP] = dt
        for k in range(first, last):
            part = effects.memory[effects.memory_start[k] : effects.memory_start[k + 1]]
            part[TORQUE] = torque
            effects.array_kernels[k](at, effects.array_numbers[k], part)
            torque = part[TORQUE]
        wheel[MOTOR_RHO + axis] = torque


@compiled
def joint_torques(i, dt, wheel, normal, effects):  # type: ignore[no-untyped-def]
    """Return the torques of motors, gears and friction on (rho, phi) of caster i, and minus their slopes.

    What depends on an angle is taken at the middle of the step.

    Returns:
        tau_rho, tau_phi [N m] and the slopes over the joint rates (rho, rho), (rho, phi), (phi, phi) [N m s/rad], >= 0.
    """
    gears, coupling, gear_state = effects.gears, effects.coupling, effects.gear_state
    kernels, numbers = effects.joint_kernels, effects.joint_numbers
    tau_rho, tau_phi, s_rr, s_rp, s_pp = 0.0, 0.0, 0.0, 0.0, 0.0
    # Torques of the motors, each on its own shaft, joint side: tau = E^T u with the rows E of the coupling.
    e01, e10 = coupling[i, 0, 1], coupling[i, 1, 0]
    determinant = 1.0 - e01 * e10
    shaft_0 = (wheel[MOTOR_RHO] - e10 * wheel[MOTOR_PHI]) / determinant
    shaft_1 = (wheel[MOTOR_PHI] - e01 * wheel[MOTOR_RHO]) / determinant
    on_motor_0, on_motor_1, motor_slope_0, motor_slope_1 = 0.0, 0.0, 0.0, 0.0
    for k in range(effects.joint_start[i], effects.joint_start[i + 1]):
        axis = effects.joint_place[k, 0]
        on_motor = effects.joint_place[k, 1] == 1
        angle, rate, motor = wheel[RHO + axis], wheel[RHO_DOT + axis], wheel[MOTOR_RHO + axis]
        if on_motor:
            motor = shaft_0 if axis == 0 else shaft_1
            if gears[i, axis, GEAR] > 0.0:
                angle, rate = gear_state[i, axis, ANGLE], gear_state[i, axis, RATE]
            else:
                angle = coupling[i, axis, 0] * wheel[RHO] + coupling[i, axis, 1] * wheel[PHI]
                rate = coupling[i, axis, 0] * wheel[RHO_DOT] + coupling[i, axis, 1] * wheel[PHI_DOT]
        torque, slope = kernels[k](angle + 0.5 * dt * rate, rate, motor, normal, numbers[k])
        slope = max(slope, 0.0)
        if on_motor and axis == 0:
            on_motor_0 += torque
            motor_slope_0 += slope
        elif on_motor:
            on_motor_1 += torque
            motor_slope_1 += slope
        elif axis == 0:
            tau_rho += torque
            s_rr += slope
        else:
            tau_phi += torque
            s_pp += slope
    for axis in range(2):
        row_rho, row_phi = coupling[i, axis, 0], coupling[i, axis, 1]
        shaft = shaft_0 + on_motor_0 if axis == 0 else shaft_1 + on_motor_1
        slope = motor_slope_0 if axis == 0 else motor_slope_1
        if gears[i, axis, GEAR] > 0.0:
            shaft, slope = _gear_torque(
                dt,
                shaft,
                slope,
                row_rho * wheel[RHO] + row_phi * wheel[PHI],
                row_rho * wheel[RHO_DOT] + row_phi * wheel[PHI_DOT],
                gears[i, axis],
                gear_state[i, axis],
            )
        tau_rho += row_rho * shaft
        tau_phi += row_phi * shaft
        s_rr += slope * row_rho * row_rho
        s_rp += slope * row_rho * row_phi
        s_pp += slope * row_phi * row_phi
    return tau_rho, tau_phi, s_rr, s_rp, s_pp


@compiled
def _gear_torque(dt, motor_torque, motor_slope, angle, rate, gear, state):  # type: ignore[no-untyped-def]
    """Return the torque of a gear on its joint's shaft [N m] and minus its slope over the shaft's rate.

    Spring and damper are taken implicitly at both ends, with the motor's new rate eliminated:

        J (w' - w) = dt (u - tau'),    tau' = K (x + dt (w' - v')) + D (w' - v'),

    x being the twist beyond the play, w and v the rates of motor and shaft. Out of contact the motor turns freely.
    """
    twist = state[ANGLE] - angle
    ahead = twist + dt * (state[RATE] - rate)
    half = 0.5 * gear[PLAY]
    inertia = gear[ROTOR] + dt * motor_slope
    momentum = inertia * state[RATE] + dt * motor_torque
    state[INERTIA], state[MOMENTUM] = inertia, momentum
    if abs(ahead) <= half and gear[PLAY] > 0.0:
        state[TORQUE_AT_REST], state[SLOPE] = 0.0, 0.0
        return 0.0, 0.0
    spring = gear[STIFFNESS] * (twist - math.copysign(half, ahead))
    grip = gear[STIFFNESS] * dt + gear[DAMPING]
    at_rest = spring + grip * (momentum - dt * spring) / (inertia + dt * grip)
    slope = grip * inertia / (inertia + dt * grip)
    torque = at_rest - slope * rate
    if gear[PLAY] > 0.0 and torque * ahead < 0.0:  # the flanks push and do not pull
        state[TORQUE_AT_REST], state[SLOPE] = 0.0, 0.0
        return 0.0, 0.0
    state[TORQUE_AT_REST], state[SLOPE] = at_rest, slope
    return torque, slope


@compiled
def turn_motors(i, dt, rho_dot, phi_dot, effects):  # type: ignore[no-untyped-def]
    """Advance the motors behind the gears of caster i, now that the new joint rates are known."""
    for axis in range(2):
        if effects.gears[i, axis, GEAR] == 0.0:
            continue
        state = effects.gear_state[i, axis]
        rate = effects.coupling[i, axis, 0] * rho_dot + effects.coupling[i, axis, 1] * phi_dot
        torque = state[TORQUE_AT_REST] - state[SLOPE] * rate
        before = state[RATE]
        state[RATE] = (state[MOMENTUM] - dt * torque) / state[INERTIA]
        state[ANGLE] += 0.5 * dt * (before + state[RATE])
