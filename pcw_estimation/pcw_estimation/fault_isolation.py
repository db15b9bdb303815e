"""Which joint is at fault, and how: a dead, stuck, drifting or swapped encoder, a drive without torque (thesis, 6.4).

The twist V that the wheels in agreement give (`slip_consensus`) says how fast every joint should turn; of a caster whose own
readings are not trusted the heading is foretold as well, as the fork trails: b_x phi_dot = -n . v_p. In windows of half a
second the measured speed m of each joint, and the difference of its positions, is compared with the foretold p:

    m = 0         dead: nothing is read, or the joint is blocked
    m = -p        swapped sign
    m = c         stuck: the same speed is read whatever the joint does
    m = p + d     drifting: the same error whatever the joint does, at standstill too
    m = g p       wrong scale: gear or counts

A law that explains the window to within its noise, where m = p does not, is a suspicion; lasting ones are named. Slip passes
or changes with the motion; drift and scale are named only once the motion has changed and they have not. A drive is without
torque where the torque measured is none of that commanded. What no law explains is slip and not named here.

Where gears couple drive and steering, encoders and torques are those of motors, E q_dot and E^-T tau (`gear_coupling`), and a
fault of one motor may follow no law in the joints. There the laws are tried for joints and for motors, and what takes fewer
faults is named; a motor's fault at the joint of its own axis.
"""

from __future__ import annotations

import dataclasses
import enum
import math

import numpy as np

from pcw_description.compiled import compiled
from pcw_description.robot_description import MINIMUM_CASTER_OFFSET, FloatArray, RobotDescription

from .errors import EstimationError
from .slip_noise import SlipNoise, variance_kernel
from .slip_verdict import SlipFinding, Verdict


class Fault(enum.Enum):
    """What can be wrong with a joint."""

    NONE = "no fault"
    DEAD = "dead encoder, or the joint is blocked"
    SWAPPED = "swapped sign"
    STUCK = "stuck reading"
    DRIFTING = "drifting reading"
    SCALE = "wrong scale"
    NO_TORQUE = "no torque although commanded"


@dataclasses.dataclass(frozen=True)
class FaultParameters:
    """When a fault is named.

    Attributes:
        window: length of one comparison [s].
        confirm_windows: windows in a row with the same fault before it is named; twice as many for drift and scale.
        clear_windows: windows in a row without a fault before it is withdrawn.
        least_torque: mean commanded torque, as a part of the joint's limit, from which on its absence is seen [1].
    """

    window: float = 0.5
    confirm_windows: int = 3
    clear_windows: int = 4
    least_torque: float = 0.05

    def __post_init__(self) -> None:
        """Check the parameters.

        Raises:
            EstimationError: names the field, its value and what is allowed.
        """
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if not (math.isfinite(value) and value > 0):
                raise EstimationError(f"{field.name} = {value!r} is not allowed; allowed: a positive number")


@dataclasses.dataclass
class _Suspicion:
    """What the last windows of one joint said."""

    kind: Fault = Fault.NONE
    count: int = 0
    clean: int = 0
    number: float = 0.0
    least: float = math.inf
    most: float = -math.inf
    named: Fault = Fault.NONE


# Sums of one window by joint and source: weight, p, m, pp, pm, mm, variance.
_W, _SP, _SM, _SPP, _SPM, _SMM, _SVAR, _COUNT = 0, 1, 2, 3, 4, 5, 6, 7
# Residuals of so many standard deviations (rms over a window) contradict a law; so many are explained by noise.
CONTRADICTS, EXPLAINED = 4.0, 3.0
# A joint foretold to turn by so many standard deviations tells whether it is dead or swapped.
MOVES = 8.0


class FaultIsolation:
    """Watches the joints of one robot; call `update` with every finding of a detector.

    Args:
        robot: the robot.
        noise: of a healthy one; default: what the robot file says.
        parameters: see there.
    """

    def __init__(
        self, robot: RobotDescription, noise: SlipNoise | None = None, parameters: FaultParameters | None = None
    ) -> None:
        self.robot = robot
        self.parameters = parameters or FaultParameters()
        self._noise = (noise or SlipNoise.of_robot(robot)).array()
        self._geometry = (robot.steer_axis, robot.caster_offset, robot.wheel_radius)
        self._counts_noise = self._noise[:2].copy()
        # Motors, joint side, from joints; all of them are joints where no gears are coupled.
        self._coupling = np.ascontiguousarray(robot.gear_coupling)
        self._torques_of_motors = np.ascontiguousarray(np.linalg.inv(self._coupling).swapaxes(1, 2))
        self._coupled = np.any(self._coupling != np.eye(2), axis=(1, 2))
        self.reset()

    def reset(self) -> None:
        """Forget everything, as after a gap."""
        n = self.robot.n
        self._heading = np.full(n, np.nan)
        self._position = np.full((n, 2), np.nan)
        # First of joints, then of motors.
        self._sums = np.zeros((2, 2, n, 2, _COUNT))
        self._torque = np.zeros((2, n, 2, 3))
        self._elapsed = 0.0
        self._suspicions = [[[[_Suspicion() for _ in range(2)] for _ in range(n)] for _ in range(2)] for _ in range(2)]
        self._torque_suspicions = [[[_Suspicion() for _ in range(2)] for _ in range(n)] for _ in range(2)]

    def update(
        self, joint_position: FloatArray, joint_velocity: FloatArray, finding: SlipFinding, dt: float,
        effort: FloatArray | None = None, commanded_effort: FloatArray | None = None,
    ) -> bool:  # fmt: skip
        """Take one measurement; returns whether a fault was named or withdrawn.

        Args:
            joint_position: (n, 2) [rad].
            joint_velocity: (n, 2) [rad/s].
            finding: what the detector says of it.
            dt: time since the measurement before [s]; 0 for the first one.
            effort, commanded_effort: torques (n, 2) [N m] where they are known; NaN for a joint without.
        """
        if dt <= 0.0:
            self._position[:] = joint_position
            self._heading[:] = joint_position[:, 1]
            return False
        known = finding.verdict != Verdict.CANNOT_KNOW
        _compare_kernel(
            *self._geometry, np.ascontiguousarray(joint_position), np.ascontiguousarray(joint_velocity), self._position,
            self._heading, finding.twist, finding.suspect, known, dt, self._noise, self._coupling, self._coupled, self._sums,
        )
        if effort is not None and commanded_effort is not None:
            _torque_kernel(
                np.ascontiguousarray(effort), np.ascontiguousarray(commanded_effort), dt, self._torques_of_motors,
                self._coupled, self._torque,
            )  # fmt: skip
        self._elapsed += dt
        if self._elapsed < self.parameters.window:
            return False
        before = self.faults()
        self._judge()
        self._sums[:] = 0.0
        self._torque[:] = 0.0
        self._elapsed = 0.0
        return before != self.faults()

    def faults(self) -> dict[str, Fault]:
        """Return what is at fault, by joint; {} when nothing is."""
        found: dict[str, Fault] = {}
        for i in range(self.robot.n):
            of_caster = self._faults_of(i, 0)
            if self._coupled[i]:
                of_motors = self._faults_of(i, 1)
                if of_motors and (not of_caster or len(of_motors) < len(of_caster)):
                    of_caster = of_motors
            found |= of_caster
        return found

    def _faults_of(self, i: int, motors: int) -> dict[str, Fault]:
        """Return the faults of one caster, of its joints (0) or of its motors (1)."""
        found: dict[str, Fault] = {}
        for j in range(2):
            speed, position = (self._suspicions[motors][source][i][j].named for source in range(2))
            if position is Fault.DEAD and speed is not Fault.DEAD:
                position = Fault.STUCK  # it stays where it was, while a speed is still read
            for fault in (position, speed, self._torque_suspicions[motors][i][j].named):
                if fault is not Fault.NONE:
                    found[self.robot.joint_names[2 * i + j]] = fault
                    break
        return found

    def _judge(self) -> None:
        for motors in range(2):
            for i in range(self.robot.n):
                if motors and not self._coupled[i]:
                    continue
                for j in range(2):
                    for source in range(2):
                        sums = self._sums[motors, source, i, j]
                        self._weigh(self._suspicions[motors][source][i][j], *_law(sums), sums)
                    self._judge_torque(motors, i, j)

    def _weigh(self, suspicion: _Suspicion, kind: Fault | None, number: float, mean: float, sums: FloatArray) -> None:
        if kind is None:
            return  # the window tells nothing
        if kind is Fault.NONE:
            suspicion.kind, suspicion.count = Fault.NONE, 0
            suspicion.clean += 1
            if suspicion.clean >= self.parameters.clear_windows:
                suspicion.named = Fault.NONE
            return
        suspicion.clean = 0
        deviation = math.sqrt(sums[_SVAR] / sums[_W])
        same = kind is suspicion.kind and abs(number - suspicion.number) <= _allowed_change(kind, number, deviation)
        if not same:
            suspicion.kind, suspicion.count, suspicion.number = kind, 0, number
            suspicion.least, suspicion.most = math.inf, -math.inf
        suspicion.count += 1
        suspicion.least, suspicion.most = min(suspicion.least, mean), max(suspicion.most, mean)
        needed = self.parameters.confirm_windows
        if kind in (Fault.DRIFTING, Fault.SCALE, Fault.STUCK):
            # Slip that lasts looks the same until the motion changes.
            changed = suspicion.most - suspicion.least > MOVES * deviation
            needed = 2 * needed if changed else suspicion.count + 1
        if suspicion.count >= needed:
            suspicion.named = kind

    def _judge_torque(self, motors: int, i: int, j: int) -> None:
        weight, measured, commanded = self._torque[motors, i, j]
        if weight < 0.5 * self.parameters.window:
            return
        suspicion = self._torque_suspicions[motors][i][j]
        if commanded / weight < self.parameters.least_torque * self.robot.torque_limit[i, j]:
            return
        if measured > 0.1 * commanded:
            suspicion.count = 0
            suspicion.clean += 1
            if suspicion.clean >= self.parameters.clear_windows:
                suspicion.named = Fault.NONE
            return
        suspicion.clean = 0
        suspicion.count += 1
        if suspicion.count >= self.parameters.confirm_windows:
            suspicion.named = Fault.NO_TORQUE


def _allowed_change(kind: Fault, number: float, deviation: float) -> float:
    return 0.1 * abs(number) if kind is Fault.SCALE else 0.1 * abs(number) + 2.0 * deviation


def _law(sums: FloatArray) -> tuple[Fault | None, float, float]:
    """Return which law a window follows (None: it tells nothing), its number, and the mean foretold speed."""
    weight = sums[_W]
    if weight <= 0.0:
        return None, 0.0, 0.0
    p, m, pp, pm, mm, variance = (sums[1:_COUNT] / weight).tolist()
    contradicted, explained = CONTRADICTS**2 * variance, EXPLAINED**2 * variance
    as_foretold = mm - 2.0 * pm + pp
    if as_foretold <= contradicted:
        # A joint that should not turn and does not is no proof of health, except of what drifts.
        return (Fault.NONE if pp > MOVES**2 * variance else None), 0.0, p
    if pp > MOVES**2 * variance:
        if mm <= explained:
            return Fault.DEAD, 0.0, p
        if mm + 2.0 * pm + pp <= explained:
            return Fault.SWAPPED, 0.0, p
    laws = [(as_foretold - (m - p) ** 2, Fault.DRIFTING, m - p)]
    if pp - p * p > variance:
        laws.append((mm - m * m, Fault.STUCK, m))
    if pp > MOVES**2 * variance:
        laws.append((mm - pm * pm / pp, Fault.SCALE, pm / pp))
    least, kind, number = min(laws, key=lambda law: law[0])  # of two that do as well, the one that comes first
    return (kind, number, p) if least <= explained else (Fault.NONE, 0.0, p)


@compiled
def _compare_kernel(  # type: ignore[no-untyped-def]
    steer_axis, caster_offset, wheel_radius, position, velocity, before, heading, twist, suspect, known, dt, noise, coupling,
    coupled, sums,
):  # fmt: skip
    """Add one measurement to the sums of the window; keeps the foretold headings and the last positions in place."""
    n = len(wheel_radius)
    foretold = np.zeros((n, 2))
    for i in range(n):
        bx, by = caster_offset[i, 0], caster_offset[i, 1]
        forks = abs(bx) >= MINIMUM_CASTER_OFFSET
        if not (suspect[i, 0] or suspect[i, 1]) or not forks or not math.isfinite(heading[i]):
            heading[i] = position[i, 1]
        c, s = math.cos(heading[i]), math.sin(heading[i])
        px, py = steer_axis[i, 0] + bx * c - by * s, steer_axis[i, 1] + bx * s + by * c
        vx, vy = twist[0] - twist[2] * py, twist[1] + twist[2] * px
        rate = -(-s * vx + c * vy) / bx if forks else velocity[i, 1]
        foretold[i, 1] = rate
        foretold[i, 0] = (c * vx + s * vy - by * rate) / wheel_radius[i]
        heading[i] += rate * dt
    wanted = np.empty((n, 2))
    for i in range(n):
        wanted[i, 0] = wheel_radius[i] * foretold[i, 0] + caster_offset[i, 1] * foretold[i, 1]
        wanted[i, 1] = -caster_offset[i, 0] * foretold[i, 1]
    # The noise of what is foretold, and not of what a faulty joint says.
    variance, _ = variance_kernel(caster_offset, wheel_radius, foretold, wanted, twist[2], noise)
    for i in range(n):
        least = min(wheel_radius[i], abs(caster_offset[i, 0]))
        for j in range(2):
            variance[i, j] /= max(wheel_radius[i] if j == 0 else abs(caster_offset[i, 0]), MINIMUM_CASTER_OFFSET) ** 2
        for j in range(2):
            lever = wheel_radius[i] if j == 0 else abs(caster_offset[i, 0])
            for source in range(2):
                if known and lever >= MINIMUM_CASTER_OFFSET:
                    m = velocity[i, j] if source == 0 else (position[i, j] - before[i, j]) / dt
                    _add(sums[0, source, i, j], foretold[i, j], m, variance[i, j], dt)
                if known and coupled[i] and least >= MINIMUM_CASTER_OFFSET:
                    p, m, spread = 0.0, 0.0, 0.0
                    for k in range(2):
                        share = coupling[i, j, k]
                        p += share * foretold[i, k]
                        m += share * (velocity[i, k] if source == 0 else (position[i, k] - before[i, k]) / dt)
                        spread += share * share * variance[i, k]
                    _add(sums[1, source, i, j], p, m, spread, dt)
        for j in range(2):
            before[i, j] = position[i, j]


@compiled
def _add(cell, p, m, variance, dt):  # type: ignore[no-untyped-def]
    """Add a foretold and a measured speed [rad/s], with its variance, to the sums of a window."""
    if math.isfinite(m):
        cell[_W] += dt
        cell[_SP] += dt * p
        cell[_SM] += dt * m
        cell[_SPP] += dt * p * p
        cell[_SPM] += dt * p * m
        cell[_SMM] += dt * m * m
        cell[_SVAR] += dt * variance


@compiled
def _torque_kernel(effort, commanded, dt, torques_of_motors, coupled, sums):  # type: ignore[no-untyped-def]
    """Add time, |effort| and |commanded| of joints and of motors to the sums of the window, where both are known."""
    for i in range(len(coupled)):
        for motors in range(2 if coupled[i] else 1):
            for j in range(2):
                measured, wanted = effort[i, j], commanded[i, j]
                if motors:
                    measured, wanted = 0.0, 0.0
                    for k in range(2):
                        measured += torques_of_motors[i, j, k] * effort[i, k]
                        wanted += torques_of_motors[i, j, k] * commanded[i, k]
                if math.isfinite(measured + wanted):
                    sums[motors, i, j, 0] += dt
                    sums[motors, i, j, 1] += dt * abs(measured)
                    sums[motors, i, j, 2] += dt * abs(wanted)
