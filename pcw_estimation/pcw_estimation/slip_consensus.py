"""Which wheels slip: the set of components that explains the encoders at the least cost, with the noise of each.

Beyond the procedure of (4.6)-(4.8), which looks at the projected residuals of one axis at a time, all 2n sensed velocities
are weighed together. A hypothesis H names the components that slip. With the twist V that fits the others best, it costs

    J(H) = 1/2 sum_(not in H) (w_i - A_i V)^2 / sigma_i^2  +  1/2 gate^2 c(H)  +  min(1/2 |V - V_0|^2_P0, cap)

so a component belongs to H when its studentised residual exceeds `gate` (least squares with truncated cost, the consensus
that RANSAC looks for at random). c(H) counts the components, but those that say little new for less: a wheel that has
lost its hold slips along and across, and goes on doing so. sigma_i^2 grows with speed and steering rate (`slip_noise`).
V_0 is the twist before, P0 its covariance and what traction can have changed since: of two sets of wheels that agree each
among themselves, the robot moves with the one that goes on as before. The cap lets the other win where it needs fewer
slipping components.

The search is exact where it matters and always the same: all sets of at most two components, all sets of casters in the
rolling axis, in the steering axis and in both, and from the best of them single components in and out until nothing
improves. While the last set remains such an optimum it is kept, and searched for anew every eighth measurement.

It cannot know (`Verdict.CANNOT_KNOW`)
  - where a component that is trusted is the only one to tell a direction of the motion (all others slip);
  - where another set of wheels explains the measurement as well;
  - where those that are trusted agree no better than wheels that all slip would by chance (`evidence_against_all`);
  - where the wheels agree on a motion that traction cannot have caused: all of them slip, and may do so for a while.
Slip of all wheels alike that begins gently is within `CONSISTENT`; only another sensor sees it (`imu_slip`).
"""

from __future__ import annotations

import math

import numpy as np

from pcw_description.compiled import compiled
from pcw_description.differential_kinematics import wheel_jacobian_kernel
from pcw_description.robot_description import GRAVITY, STEER, FloatArray, RobotDescription

from .normal_equations import full_inverse, is_determined, parts_of_rows, solve, sum_of, upper_inverse
from .slip_noise import SlipNoise, sensed_kernel, variance_kernel
from .slip_verdict import (
    REFUSED,
    ConfirmParameters,
    SlipFinding,
    Verdict,
    check_measurement,
    confirm_kernel,
    describe_kernel,
    finding_of,
    finite_kernel,
)

# Part of the cost of one slipping component that a leap of the twist costs at most: with three casters one that slips must
# still be cheaper than two, however the motion was misjudged before.
LEAP_SHARE = 0.8
# Parts of the cost of a slipping component: of those of a caster that is known to slip, and of the second one of a caster.
# Where the slip of a wheel passes through zero along or across, a wheel that rolls would be as good a reason for the rest.
SLIPPING_SHARE, SECOND_SHARE = 0.25, 0.3
# Cost by which the best hypothesis must lead any other that is neither part of it nor the other way round: odds of 20 to 1.
CLEAR_LEAD = 3.0
# Logarithm of the odds, 3 to 1, by which it must be more likely that some wheels roll than that all slip.
LEAST_EVIDENCE = math.log(3.0)
# Above this leverage a component is fitted and not checked.
UNCHECKED = 0.98
SEARCH_EVERY = 8
# Sets of more casters than this are not enumerated.
MOST_CASTERS = 8
# Of what traction can do, mu_p g, one standard deviation of a healthy robot's acceleration.
ACCELERATION_SHARE = 1.0 / 3.0
# For so long after a leap of all wheels it is not said that they roll [s].
DOUBT_TIME = 2.0
# After so long nothing follows any more from the twist before [s].
LONGEST_ANCHOR = 1.0
_CONSISTENT, _SLIP, _CANNOT_KNOW = int(Verdict.CONSISTENT), int(Verdict.SLIP), int(Verdict.CANNOT_KNOW)


# Layout of the state between measurements, one array because a control loop passes it on every cycle: the set of components
# (a bit each), whether a twist is known, its age [s], measurements since the last search, the lead of the set over any other,
# and for how long a leap of all wheels is doubted [s]; the last twist that traction can have caused (3) and its covariance
# (9); confirmed slip (2n), and for how long the measurements have contradicted that (2n) [s].
CHOSEN, KNOWN, AGE, SINCE_SEARCH, LEAD, DOUBT, TWIST, COVARIANCE, FLAGS = 0, 1, 2, 3, 4, 5, 6, 9, 18


class SlipConsensus:
    """The detector for one robot: its numbers as arrays, and `step`.

    Args:
        robot: the robot.
        noise: of a healthy one; default: what the robot file says.
        confirm: how long slip must last to be said.
    """

    def __init__(
        self, robot: RobotDescription, noise: SlipNoise | None = None, confirm: ConfirmParameters | None = None
    ) -> None:
        self.robot = robot
        self.noise = noise or SlipNoise.of_robot(robot)
        self.confirm = confirm or ConfirmParameters()
        reach = math.sqrt(float(np.mean(np.sum(robot.steer_axis**2, axis=1))))
        traction = ACCELERATION_SHARE * GRAVITY * max(tyre.mu_p for tyre in robot.tyres)
        self._numbers = np.concatenate(
            [
                self.noise.array(),
                [reach, traction, self.confirm.confirm_time, self.confirm.release_time, self.confirm.ratio_speed],
            ]
        )
        self._geometry = np.column_stack([robot.steer_axis, robot.caster_offset, robot.wheel_radius])
        self._shape = (robot.n, 2)

    def initial_state(self) -> FloatArray:
        """Return the state before the first measurement, or after a gap, (18 + 4n,)."""
        return np.zeros(FLAGS + 4 * self.robot.n)

    def step(
        self, state: FloatArray, joint_position: FloatArray, joint_velocity: FloatArray, dt: float
    ) -> tuple[FloatArray, SlipFinding]:
        """Decide on one measurement.

        Args:
            state: state after the measurement before.
            joint_position: (n, 2) [rad].
            joint_velocity: (n, 2) [rad/s].
            dt: measured time since the measurement before [s]; 0 for the first one.

        Returns:
            New state and finding.

        Raises:
            EstimationError: a measurement is not finite or dt is negative; the caller keeps its state.
        """
        # Here only what a kernel cannot check itself: its cost is that of the whole search.
        if not (0.0 <= dt < math.inf and joint_position.shape == joint_velocity.shape == self._shape):
            check_measurement(self.robot, joint_position, joint_velocity, dt)
        after, fitted, arrays, masks, verdict = _step_kernel(
            self._geometry, np.ascontiguousarray(joint_position, dtype=np.float64),
            np.ascontiguousarray(joint_velocity, dtype=np.float64), float(dt), self._numbers, state,
        )
        if verdict == REFUSED:
            check_measurement(self.robot, joint_position, joint_velocity, dt)
        return after, finding_of(fitted, arrays, masks, verdict)


@compiled
def _step_kernel(geometry, position, velocity, dt, numbers, state):  # type: ignore[no-untyped-def]
    steer_axis, caster_offset, wheel_radius = geometry[:, 0:2], geometry[:, 2:4], geometry[:, 4]
    noise, n = numbers[:8], len(geometry)
    fitted, arrays, masks = np.empty((4, 3)), np.empty((3, n, 2)), np.zeros((3, n, 2), dtype=np.bool_)
    if not finite_kernel(position, velocity):
        return state.copy(), fitted, arrays, masks, REFUSED
    reach, traction = numbers[8], numbers[9]
    anchor, anchor_covariance = state[TWIST : TWIST + 3], state[COVARIANCE : COVARIANCE + 9].copy().reshape((3, 3))
    flagged = state[FLAGS : FLAGS + 2 * n].copy().reshape((n, 2))
    elapsed = state[FLAGS + 2 * n :].copy().reshape((n, 2))
    sensed = sensed_kernel(caster_offset, wheel_radius, velocity)
    jacobian = wheel_jacobian_kernel(steer_axis, caster_offset, position[:, STEER])
    known = state[KNOWN] > 0.0
    age = min(state[AGE] + dt, LONGEST_ANCHOR)
    reference = anchor.copy() if known else np.zeros(3)
    variance, _ = variance_kernel(caster_offset, wheel_radius, velocity, sensed, reference[2], noise)
    # Turning is counted as the speed at the wheels, so that all three unknowns are of one size.
    rows = jacobian.copy()
    rows[:, 2] /= reach
    offset = np.empty(2 * n)
    for k in range(2 * n):
        offset[k] = sensed[k // 2, k % 2] - (
            jacobian[k, 0] * reference[0] + jacobian[k, 1] * reference[1] + jacobian[k, 2] * reference[2]
        )
    parts = parts_of_rows(rows, offset, variance)
    prior = np.zeros(6)
    if known:
        spread = anchor_covariance.copy()
        for i in range(3):
            spread[i, 2] *= reach
            spread[2, i] *= reach
            spread[i, i] += (traction * age) ** 2 + LEAST_VARIANCE
        prior = upper_inverse(spread)
    slip_cost = 0.5 * noise[7] * noise[7]
    slip_costs = np.full(2 * n, slip_cost)
    for i in range(n):
        if flagged[i, 0] or flagged[i, 1]:
            slip_costs[2 * i : 2 * i + 2] *= SLIPPING_SHARE
    chosen, lead, searched, leapt = best_set(
        parts, prior, known, slip_costs, SECOND_SHARE, LEAP_SHARE * slip_cost, int(state[CHOSEN]), state[SINCE_SEARCH],
        state[LEAD],
    )
    total = sum_of(parts, chosen)
    determined, offset_twist = True, np.zeros(3)
    covariance = np.zeros((3, 3))
    if known and not leapt:
        _, x, y, z = solve(total, prior, True)
    else:
        _, x, y, z = solve(total, prior, False)
    offset_twist[0], offset_twist[1], offset_twist[2] = x, y, z
    determined = is_determined(total)
    if determined:
        # The twist itself follows from the wheels alone; what went before only helped to choose them.
        _, x, y, z = solve(total, prior, False)
        offset_twist[0], offset_twist[1], offset_twist[2] = x, y, z
        covariance = full_inverse(total)
    else:
        joined = total.copy()
        for i in range(6):
            joined[i] += prior[i]
        if is_determined(joined):
            covariance = full_inverse(joined)
    checked = determined
    for k in range(2 * n):
        if determined and chosen and not chosen >> k & 1:
            leverage = 0.0
            for i in range(3):
                for j in range(3):
                    leverage += rows[k, i] * covariance[i, j] * rows[k, j]
            checked = checked and leverage < UNCHECKED * variance[k // 2, k % 2]
    for i in range(3):
        covariance[i, 2] /= reach
        covariance[2, i] /= reach
    twist = reference.copy()
    twist[0] += offset_twist[0]
    twist[1] += offset_twist[1]
    twist[2] += offset_twist[2] / reach
    slip, threshold = arrays[0], arrays[2]
    for k in range(2 * n):
        i, j = k // 2, k % 2
        slip[i, j] = sensed[i, j] - (jacobian[k, 0] * twist[0] + jacobian[k, 1] * twist[1] + jacobian[k, 2] * twist[2])
        threshold[i, j] = noise[7] * math.sqrt(variance[i, j])
        masks[0, i, j] = chosen >> k & 1
    if chosen and checked:
        checked = evidence_against_all(rows, offset, variance, slip, masks[0]) > LEAST_EVIDENCE
    verdict = _SLIP if chosen else _CONSISTENT
    # Wheels that have leapt together go on together, whether the robot has caught up with them or not.
    doubt = max(state[DOUBT] - dt, 0.0)
    if leapt and chosen == 0:
        doubt = DOUBT_TIME
    if not checked or leapt or lead < CLEAR_LEAD or doubt > 0.0:
        verdict = _CANNOT_KNOW
    after = np.empty(len(state))
    confirm_kernel(masks[0], flagged, elapsed, dt, numbers[10], numbers[11])
    describe_kernel(sensed, slip, threshold, flagged, numbers[12], arrays[1], masks[1], masks[2])
    after[CHOSEN], after[KNOWN], after[LEAD], after[DOUBT] = chosen, 1.0, lead, doubt
    after[SINCE_SEARCH] = 0.0 if searched else state[SINCE_SEARCH] + 1.0
    if known and leapt and age < LONGEST_ANCHOR:
        after[AGE] = age
        after[TWIST:FLAGS] = state[TWIST:FLAGS]
    else:
        after[AGE] = 0.0
        after[TWIST : TWIST + 3] = twist
        after[COVARIANCE:FLAGS] = covariance.ravel()
    after[FLAGS : FLAGS + 2 * n] = flagged.ravel()
    after[FLAGS + 2 * n :] = elapsed.ravel()
    fitted[0] = twist
    fitted[1:] = covariance
    return after, fitted, arrays, masks, verdict


@compiled
def evidence_against_all(rows, offset, variance, slip, chosen):  # type: ignore[no-untyped-def]
    """Return the logarithm of the odds that the wheels outside of a set roll, against that all slip in its axes [1].

    In an axis in which wheels slip, with root mean square S, the others may do so as well: the same row, with variance
    sigma^2 + S^2. Wheels that agree as closely as their noise speak against it, the more so the larger S; two of few that
    happen to agree do not, so the odds are divided by the number of ways to choose as many. The twist is not known before:
    these are ratios of marginal likelihoods, with a flat prior of the twist.

    Args:
        rows: (2n, 3), all unknowns of one size.
        offset: sensed velocities less those of some twist (2n,) [m/s].
        variance: of healthy components (n, 2) [m^2/s^2].
        slip: sensed less fitted velocity (n, 2) [m/s].
        chosen: the set; the twist is determined without it (n, 2).
    """
    n = len(slip)
    wide, left, ways = variance.copy(), 0, 0.0
    for j in range(2):
        count, square = 0, 0.0
        for i in range(n):
            if chosen[i, j]:
                count += 1
                square += slip[i, j] * slip[i, j]
                left |= 1 << (2 * i + j)
        if count:
            ways += math.lgamma(n + 1.0) - math.lgamma(count + 1.0) - math.lgamma(n - count + 1.0)
            for i in range(n):
                wide[i, j] += square / count
    odds = -ways
    for kind in range(2):
        sign, spread = (1.0, variance) if kind == 0 else (-1.0, wide)
        total = sum_of(parts_of_rows(rows, offset, spread), left)
        d0 = total[0]
        d1 = total[3] - total[1] * total[1] / d0
        b = total[4] - total[1] * total[2] / d0
        d2 = total[5] - total[2] * total[2] / d0 - b * b / d1
        odds -= sign * (solve(total, np.zeros(6), False)[0] + 0.5 * math.log(d0 * d1 * d2))
        for i in range(n):
            for j in range(2):
                if not chosen[i, j]:
                    odds -= sign * 0.5 * math.log(spread[i, j])
    return odds


# Of a twist, so that its inverse exists [m^2/s^2].
LEAST_VARIANCE = 1e-10


@compiled
def _cost(total, prior, known, penalty, cap):  # type: ignore[no-untyped-def]
    """Return J of a set, whose components cost `penalty`, and whether the twist leaps from the one before."""
    if not known:
        return solve(total, prior, False)[0] + penalty, False
    cost = solve(total, prior, True)[0]
    # What the prior alone costs is no more than that.
    if cost > cap:
        free = solve(total, prior, False)[0]
        if free + cap < cost:
            return free + cap + penalty, True
    return cost + penalty, False


@compiled
def _size(mask):  # type: ignore[no-untyped-def]
    size = 0
    while mask:
        mask &= mask - 1
        size += 1
    return size


@compiled
def _penalty(mask, slip_costs, second):  # type: ignore[no-untyped-def]
    """Return what the components of a set cost, the cheaper one of two of a caster its part `second` alone."""
    total = 0.0
    for k in range(0, len(slip_costs), 2):
        both = mask >> k & 3
        if both & 1:
            total += slip_costs[k]
        if both & 2:
            total += slip_costs[k + 1]
        if both == 3:
            total -= (1.0 - second) * min(slip_costs[k], slip_costs[k + 1])
    return total


@compiled
def _climbed(parts, prior, known, slip_costs, second, cap, start):  # type: ignore[no-untyped-def]
    """Return the set reached from `start` by taking single components in and out while that costs less, its cost, its leap."""
    count = len(parts) - 1
    mask, total = start, sum_of(parts, start)
    cost, leapt = _cost(total, prior, known, _penalty(start, slip_costs, second), cap)
    trial = np.empty(10)
    for _ in range(2 * count):
        best, best_cost, best_leapt = -1, cost, leapt
        for k in range(count):
            sign = 1.0 if mask >> k & 1 else -1.0
            for m in range(10):
                trial[m] = total[m] + sign * parts[k, m]
            of_trial, trial_leapt = _cost(trial, prior, known, _penalty(mask ^ (1 << k), slip_costs, second), cap)
            if of_trial < best_cost - 1e-9:
                best, best_cost, best_leapt = k, of_trial, trial_leapt
        if best < 0:
            break
        mask ^= 1 << best
        total = sum_of(parts, mask)  # added and taken out again, sums would lose digits
        cost, leapt = best_cost, best_leapt
    return mask, cost, leapt


@compiled
def best_set(parts, prior, known, slip_costs, second, cap, before, since_search, lead_before):  # type: ignore[no-untyped-def]
    """Return the cheapest set, its lead over any other, whether it was searched for, and whether the twist leaps with it.

    Args:
        parts: what each component adds to the normal equations, and their sum (2n + 1, 10).
        prior: information on the twist before (6,), where it is `known`.
        slip_costs: of each component (2n,); second: part of it that the second component of a caster costs.
        cap: what a leap of the twist costs at most.
        before, since_search, lead_before: the set of the measurement before, how long ago it was searched for, and its lead.
    """
    count = len(parts) - 1
    n = count // 2
    least = slip_costs.min()
    mask, cost, leapt = _climbed(parts, prior, known, slip_costs, second, cap, before)
    if mask == 0 and cost < least:
        return mask, least, True, leapt  # any other set costs as much at least
    stays = mask == before and not leapt and since_search < SEARCH_EVERY
    if stays and cost < _penalty(mask, slip_costs, second) + second * least:
        return mask, lead_before, False, leapt
    most = 2 + count * (count + 1) // 2 + 3 * (1 << min(n, MOST_CASTERS))
    masks, costs = np.empty(most, dtype=np.int64), np.empty(most)
    masks[0], costs[0] = mask, cost
    masks[1] = 0
    costs[1], _ = _cost(parts[count], prior, known, 0.0, cap)
    found = 2
    trial = np.empty(10)
    for k in range(count):
        for m in range(k, count):
            for q in range(10):
                trial[q] = parts[count, q] - parts[k, q] - (parts[m, q] if m > k else 0.0)
            masks[found] = (1 << k) | (1 << m)
            costs[found], _ = _cost(trial, prior, known, _penalty(masks[found], slip_costs, second), cap)
            found += 1
    if n <= MOST_CASTERS:
        for casters in range(1, 1 << n):
            rolling = 0
            for i in range(n):
                if casters >> i & 1:
                    rolling |= 1 << 2 * i
            for kind in range(3):
                candidate = rolling if kind == 0 else rolling << 1 if kind == 1 else rolling | rolling << 1
                if kind < 2 and _size(casters) <= 2:
                    continue  # among the pairs
                masks[found] = candidate
                costs[found], _ = _cost(sum_of(parts, candidate), prior, known, _penalty(candidate, slip_costs, second), cap)
                found += 1
    first = np.argmin(costs[:found])
    best, best_cost, best_leapt = _climbed(parts, prior, known, slip_costs, second, cap, masks[first])
    if cost <= best_cost:
        best, best_cost, best_leapt = mask, cost, leapt
    second = np.inf
    for k in range(found):
        other = masks[k]
        if other & best != other and other & best != best:
            second = min(second, costs[k])
    return best, second - best_cost, True, best_leapt
