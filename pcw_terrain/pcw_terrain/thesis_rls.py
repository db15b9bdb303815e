"""The terrain estimator as printed: recursive least squares with exponential forgetting, (5.13)-(5.19) [Li2009].

    mu(lambda) = c_1 lambda / (c_2 + lambda^2),    lambda_p = sqrt(c_2),    mu_p = c_1 / (2 sqrt(c_2))           (5.13)
    y = mu lambda^2 = phi^T Theta,    phi = (lambda, -mu),    Theta = (c_1, c_2)                                    (5.14)
    P = Q phi / (lambda + phi^T Q phi),   Theta += P (y - phi^T Theta),   Q = (Q - P phi^T Q) / lambda      (5.17)-(5.19)

with the forgetting factor lambda, 0.8 in the thesis. Torque filtering (5.16): y and phi pass l / (l + s), l = 1. The thesis
does not say how the acceleration of (3.45) passes a filter of products; here it is a (rho_dot - (rho_dot)_a), with a filter
fast enough, a = 125 rad/s. (5.19) as printed, Q (I - P phi^T) / lambda, has the order of the product wrong for more than one
parameter; with Q symmetric it is meant as above.

It is here to be compared with. The regressor holds the same noise as the output (errors in variables): E[mu lambda^2] has the
slip's variance in it, which takes it off c_2. With a long memory it is certain of that wrong answer, and with five readings,
which 0.8 amounts to, it follows the noise besides. Use `terrain_estimator`.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from pcw_description.compiled import compiled
from pcw_description.robot_description import FloatArray

from .errors import TerrainError, require, require_dt

# Layout of the state: Theta (2), Q (2, 2), filtered y, phi_0, phi_1 and rolling speed, count, and the first regressors.
_THETA, _Q, _Y, _PHI, _RATE, _COUNT, _FIRST = 0, 2, 6, 7, 9, 10, 11
_STATE = 16
LEAST_DETERMINANT = 1e-12


@dataclasses.dataclass(frozen=True)
class ThesisRlsParameters:
    """Settings of the thesis.

    Attributes:
        forgetting_factor: lambda of (5.18), above 0 and at most 1 [1].
        filter_rate: l of (5.16) [rad/s].
        acceleration_rate: of the filter that finds the wheel's acceleration [rad/s].
        inertia: I_rho / r^2, where forces are given as torque over radius (3.45) [kg]; 0 where they are forces.
    """

    forgetting_factor: float = 0.8
    filter_rate: float = 1.0
    acceleration_rate: float = 125.0
    inertia: float = 0.0

    def __post_init__(self) -> None:
        """Check the parameters.

        Raises:
            TerrainError: names the field, its value and what is allowed.
        """
        require("forgetting_factor", self.forgetting_factor, above=0.0, maximum=1.0)
        require("filter_rate", self.filter_rate, above=0.0)
        require("acceleration_rate", self.acceleration_rate, above=0.0)
        require("inertia", self.inertia, minimum=0.0)


@compiled
def _advance(forgetting, rate, acceleration_rate, inertia, state, rolling, velocity, force, load, dt):  # type: ignore[no-untyped-def]
    speed = max(abs(rolling), abs(velocity), 1e-3)
    if state[_COUNT] == 0.0:
        state[_RATE] = rolling
    state[_RATE] += (1.0 - math.exp(-acceleration_rate * dt)) * (rolling - state[_RATE])
    slip = (rolling - velocity) / speed
    mu = (force - inertia * acceleration_rate * (rolling - state[_RATE])) / load
    share = 1.0 - math.exp(-rate * dt)
    state[_Y] += share * (mu * slip * slip - state[_Y])
    state[_PHI] += share * (slip - state[_PHI])
    state[_PHI + 1] += share * (-mu - state[_PHI + 1])
    phi0, phi1, y = state[_PHI], state[_PHI + 1], state[_Y]
    q = state[_Q : _Q + 4]
    state[_COUNT] += 1.0
    if state[_FIRST + 4] == 0.0:
        # Q(t_0) = (Phi^T Phi)^-1 from when Phi^T Phi is not singular.
        sums = state[_FIRST : _FIRST + 4]
        sums[0] += phi0 * phi0
        sums[1] += phi0 * phi1
        sums[2] += phi1 * phi1
        determinant = sums[0] * sums[2] - sums[1] * sums[1]
        if determinant > LEAST_DETERMINANT:
            q[0], q[1], q[2], q[3] = (
                sums[2] / determinant,
                -sums[1] / determinant,
                -sums[1] / determinant,
                sums[0] / determinant,
            )
            state[_FIRST + 4] = 1.0
        return
    q0, q1 = q[0] * phi0 + q[1] * phi1, q[2] * phi0 + q[3] * phi1
    scale = forgetting + phi0 * q0 + phi1 * q1
    error = y - phi0 * state[_THETA] - phi1 * state[_THETA + 1]
    state[_THETA] += q0 / scale * error
    state[_THETA + 1] += q1 / scale * error
    q[0] = (q[0] - q0 * q0 / scale) / forgetting
    q[3] = (q[3] - q1 * q1 / scale) / forgetting
    q[1] = (q[1] - q0 * q1 / scale) / forgetting
    q[2] = q[1]


@compiled
def _run(forgetting, rate, acceleration_rate, inertia, state, readings, dt, results):  # type: ignore[no-untyped-def]
    for k in range(len(readings)):
        _advance(
            forgetting,
            rate,
            acceleration_rate,
            inertia,
            state,
            readings[k, 0],
            readings[k, 1],
            readings[k, 2],
            readings[k, 3],
            dt,
        )
        results[k, 0], results[k, 1] = state[_THETA], state[_THETA + 1]


class ThesisRls:
    """The estimator of one wheel as printed; see the module's docstring.

    Args:
        parameters: its settings, those of the thesis by default.
    """

    def __init__(self, parameters: ThesisRlsParameters | None = None) -> None:
        self.parameters = parameters or ThesisRlsParameters()

    def initial_state(self) -> FloatArray:
        """Return the state before the first reading, Theta = 0."""
        return np.zeros(_STATE)

    def step(
        self, state: FloatArray, rolling_speed: float, velocity: float, force: float, normal_force: float, dt: float
    ) -> tuple[FloatArray, tuple[float, float]]:
        """Take one reading.

        Args:
            state: after the reading before; it is not changed.
            rolling_speed, velocity: r rho_dot and v_x [m/s].
            force: tau_rho / r, or F_x where the parameters have no inertia [N].
            normal_force: F_z [N].
            dt: measured time since the reading before [s].

        Returns:
            New state, and mu_p and lambda_p, NaN where c_2 is not positive.

        Raises:
            TerrainError: a number that is not finite, a load or dt that is not positive; the caller keeps its state.
        """
        require_dt(dt)
        for name, value in (("rolling_speed", rolling_speed), ("velocity", velocity), ("force", force)):
            require(name, value)
        require("normal_force", normal_force, above=0.0)
        p, state = self.parameters, state.copy()
        _advance(
            p.forgetting_factor, p.filter_rate, p.acceleration_rate, p.inertia, state, rolling_speed, velocity, force,
            normal_force, dt,
        )  # fmt: skip
        mu_p, lambda_p = curve_of(state[_THETA : _THETA + 2].reshape(1, 2))
        return state, (float(mu_p[0]), float(lambda_p[0]))

    def run(self, readings: FloatArray, dt: float) -> tuple[FloatArray, FloatArray]:
        """Take a whole record (T, 4 or more): rolling speed, velocity, force, normal force; returns mu_p, lambda_p (T,)."""
        require_dt(dt)
        if readings.ndim != 2 or readings.shape[1] < 4 or not np.isfinite(readings).all():
            raise TerrainError(f"readings of shape {readings.shape} are not allowed; allowed: finite numbers, shape (T, 4)")
        p, results = self.parameters, np.zeros((len(readings), 2))
        _run(p.forgetting_factor, p.filter_rate, p.acceleration_rate, p.inertia, self.initial_state(), readings, dt, results)
        return curve_of(results)


def curve_of(theta: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return mu_p and lambda_p (T,) of (c_1, c_2) (T, 2), (5.13); NaN where c_2 is not positive."""
    with np.errstate(invalid="ignore", divide="ignore"):
        lambda_p = np.sqrt(np.where(theta[:, 1] > 0.0, theta[:, 1], np.nan))
        return theta[:, 0] / (2.0 * lambda_p), lambda_p
