"""How a wanted wrench is shared by the wheels: solutions of A^T F_con = F (5.2) that differ in what they keep small.

    through A           F_con = A (A^T A)^-1 F            (5.6): the least sum of squared forces, no internal force
    through J           tau = J (J^T J)^-1 F, J = B^-1 A  the least sum of squared joint torques (fig. 5.7)
    weighted            F_con = W A (A^T W A)^-1 F        W = diag(limit^2): wheels that hold more do more
    limited             least |F_con| within a box        table 5.3, so that no wheel is asked for more than it holds
    friction-optimal    least s with |F_i| <= s limit_i   the largest use of friction of all wheels is the least possible

A is the wheel Jacobian (2n, 3), F (3,) in base_link, F_con (n, 2) in the wheel frames [N]. All but the last are compiled;
that one is a small quadratic program.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import quadprog

from pcw_description.compiled import compiled
from pcw_description.robot_description import FloatArray

from .errors import ControlError

# A wheel that holds nothing still has to have a finite weight [N].
LEAST_LIMIT = 1e-3
# Corners of the polygon within the circle of friction: it leaves out at most 2 % of the circle's radius.
CORNERS = 16
# What the sum of squared uses counts against the square of the largest one, so that the solution is unique.
EVENNESS = 1e-4
_NEWTON_STEPS = 60


@dataclasses.dataclass(frozen=True)
class SharedForces:
    """A distribution that says itself how good it is.

    Attributes:
        force: contact forces in the wheel frames (n, 2) [N].
        use: largest of |F_i| / limit_i.
        missing: F - A^T force (3,) [N, N, N m]: what of the wrench is not made.
    """

    force: FloatArray
    use: float
    missing: FloatArray


@compiled
def weighted_forces_kernel(A, wrench, weight):  # type: ignore[no-untyped-def]
    """Return W A (A^T W A)^-1 F as (n, 2); weights (2n,) above 0, only their ratios count."""
    rows = A.shape[0]
    largest = 0.0
    for k in range(rows):
        largest = max(largest, weight[k])
    m = np.zeros((3, 3))
    for k in range(rows):
        w = weight[k] / largest
        for i in range(3):
            for j in range(3):
                m[i, j] += w * A[k, i] * A[k, j]
    x = solve_kernel(m, wrench)
    force = np.empty((rows // 2, 2))
    for k in range(rows):
        force[k // 2, k % 2] = weight[k] / largest * (A[k, 0] * x[0] + A[k, 1] * x[1] + A[k, 2] * x[2])
    return force


@compiled
def solve_kernel(m, right):  # type: ignore[no-untyped-def]
    """Return m^-1 right of a symmetric positive definite (3, 3), by Cholesky."""
    a = math.sqrt(m[0, 0])
    b, c = m[1, 0] / a, m[2, 0] / a
    d = math.sqrt(max(m[1, 1] - b * b, 1e-300))
    e = (m[2, 1] - b * c) / d
    f = math.sqrt(max(m[2, 2] - c * c - e * e, 1e-300))
    y0 = right[0] / a
    y1 = (right[1] - b * y0) / d
    y2 = (right[2] - c * y0 - e * y1) / f
    x = np.empty(3)
    x[2] = y2 / f
    x[1] = (y1 - e * x[2]) / d
    x[0] = (y0 - b * x[1] - c * x[2]) / a
    return x


def jacobian_forces(A: FloatArray, wrench: FloatArray, B_inverse: FloatArray) -> FloatArray:
    """Return contact forces (n, 2) of the least sum of squared joint torques, tau = J (J^T J)^-1 F with J = B^-1 A.

    Args:
        A: wheel Jacobian (2n, 3).
        wrench: F (3,).
        B_inverse: inverses of the blocks of B (n, 2, 2).
    """
    forces: FloatArray = _jacobian_forces(A, wrench, B_inverse)
    return forces


@compiled
def _jacobian_forces(A, wrench, B_inverse):  # type: ignore[no-untyped-def]
    n = len(B_inverse)
    J, normal = np.empty((n, 2, 3)), np.zeros((3, 3))
    for i in range(n):
        for j in range(2):
            for k in range(3):
                J[i, j, k] = B_inverse[i, j, 0] * A[2 * i, k] + B_inverse[i, j, 1] * A[2 * i + 1, k]
        for k in range(3):
            for m in range(3):
                normal[k, m] += J[i, 0, k] * J[i, 0, m] + J[i, 1, k] * J[i, 1, m]
    x = solve_kernel(normal, wrench)
    forces = np.empty((n, 2))
    for i in range(n):
        drive = J[i, 0, 0] * x[0] + J[i, 0, 1] * x[1] + J[i, 0, 2] * x[2]
        steer = J[i, 1, 0] * x[0] + J[i, 1, 1] * x[1] + J[i, 1, 2] * x[2]
        for j in range(2):
            forces[i, j] = B_inverse[i, 0, j] * drive + B_inverse[i, 1, j] * steer
    return forces


def basic_forces(A: FloatArray, wrench: FloatArray) -> FloatArray:
    """Return a solution (n, 2) with only three forces that are not zero, those that A spans best: one of the many of (5.4).

    What a solver of linear equations returns that seeks few numbers instead of small ones. It is here to compare with: wheels
    that carry nothing stand beside wheels that carry all, and push against each other.
    """
    left, rows = A.T.copy(), []
    for _ in range(3):
        rows.append(int(np.argmax(np.sum(left * left, axis=0))))
        direction = left[:, rows[-1]] / np.linalg.norm(left[:, rows[-1]])
        left -= np.outer(direction, direction @ left)
    force = np.zeros(len(A))
    force[rows] = np.linalg.solve(A[rows].T, wrench)
    return force.reshape(-1, 2)


def weighted_forces(A: FloatArray, wrench: FloatArray, limit: FloatArray) -> FloatArray:
    """Return W A (A^T W A)^-1 F with W = diag(limit^2): every wheel as its hold allows, without a program to solve.

    Args:
        A: wheel Jacobian (2n, 3).
        wrench: F (3,).
        limit: what each wheel holds, along and across (n, 2) [N].
    """
    forces: FloatArray = forces_by_limit_kernel(A, wrench, limit)
    return forces


@compiled
def forces_by_limit_kernel(A, wrench, limit):  # type: ignore[no-untyped-def]
    """As `weighted_forces`; one call in a control cycle."""
    weight = np.empty(2 * len(limit))
    for i in range(len(limit)):
        for j in range(2):
            weight[2 * i + j] = max(limit[i, j], LEAST_LIMIT) ** 2
    return weighted_forces_kernel(A, wrench, weight)


def limited_forces(A: FloatArray, wrench: FloatArray, limit: FloatArray) -> SharedForces:
    """Return the least forces that make the wrench with |F_con| <= limit in every component.

    min |F|^2 subject to A^T F = wrench, |F_k| <= limit_k. By duality F = clip(A x, +- limit) with three unknowns x, found by
    Newton steps on a piecewise linear equation. Where the wrench cannot be made, the limits hold and the wrench made is the
    nearest one, measured by the forces that the rest would take.

    Args:
        A: wheel Jacobian (2n, 3).
        wrench: F (3,).
        limit: (n, 2) [N].
    """
    force, missing = limited_forces_kernel(A, wrench, limit)
    return SharedForces(force, float(np.max(np.abs(force) / np.maximum(limit, LEAST_LIMIT))), missing)


@compiled
def limited_forces_kernel(A, wrench, limit):  # type: ignore[no-untyped-def]
    """As `limited_forces`; returns force (n, 2) and missing (3,)."""
    n = limit.shape[0]
    rows = 2 * n
    bound = np.empty(rows)
    for k in range(rows):
        bound[k] = max(limit[k // 2, k % 2], 0.0)
    normal = np.zeros((3, 3))
    for k in range(rows):
        for i in range(3):
            for j in range(3):
                normal[i, j] += A[k, i] * A[k, j]
    # In the metric of A^T A the ridge asks for the nearest wrench. Where the wrench can be made, what the ridge takes off is
    # put back by starting again around the solution: the proximal point method, exact after two rounds.
    ridge = 1e-9
    scale = abs(wrench[0]) + abs(wrench[1]) + abs(wrench[2])
    x, centre = solve_kernel(normal, wrench), np.zeros(3)
    for _ in range(3):
        _maximise_dual(A, wrench, bound, normal, ridge, centre, scale, x)
        force = np.empty((n, 2))
        missing = wrench.copy()
        for k in range(rows):
            held = min(max(A[k, 0] * x[0] + A[k, 1] * x[1] + A[k, 2] * x[2], -bound[k]), bound[k])
            force[k // 2, k % 2] = held
            for i in range(3):
                missing[i] -= A[k, i] * held
        left = abs(missing[0]) + abs(missing[1]) + abs(missing[2])
        if left <= 1e-13 * scale or left > 1e-4 * scale:
            break
        centre = x.copy()
    return force, missing


@compiled
def _maximise_dual(A, wrench, bound, normal, ridge, centre, scale, x):  # type: ignore[no-untyped-def]
    """Move x (3,) to the maximum of F . x - sum of the least costs - ridge |x - centre|^2 / 2, by Newton steps."""
    rows = len(bound)
    gradient = np.empty(3)
    slope = np.empty(rows)
    value = np.empty(rows)
    crossing = np.empty(2 * rows)
    for _ in range(_NEWTON_STEPS):
        hessian = ridge * normal
        for i in range(3):
            gradient[i] = wrench[i]
            for j in range(3):
                gradient[i] -= ridge * normal[i, j] * (x[j] - centre[j])
        for k in range(rows):
            value[k] = A[k, 0] * x[0] + A[k, 1] * x[1] + A[k, 2] * x[2]
            held = min(max(value[k], -bound[k]), bound[k])
            for i in range(3):
                gradient[i] -= A[k, i] * held
            if abs(value[k]) < bound[k]:
                for i in range(3):
                    for j in range(3):
                        hessian[i, j] += A[k, i] * A[k, j]
        if abs(gradient[0]) + abs(gradient[1]) + abs(gradient[2]) <= 1e-14 * scale:
            break
        step = solve_kernel(hessian, gradient)
        # Exact search along the step: the slope of the dual is piecewise linear and falls.
        for k in range(rows):
            slope[k] = A[k, 0] * step[0] + A[k, 1] * step[1] + A[k, 2] * step[2]
        count = 0
        for k in range(rows):
            if slope[k] != 0.0:
                for side in (-1.0, 1.0):
                    t = (side * bound[k] - value[k]) / slope[k]
                    if t > 0.0:
                        crossing[count] = t
                        count += 1
        crossing[:count].sort()
        length = _rise(wrench, x, centre, step, value, slope, bound, normal, ridge, crossing, count)
        moved = 0.0
        for i in range(3):
            moved += abs(length * step[i])
            x[i] += length * step[i]
        if moved <= 1e-15 * (abs(x[0]) + abs(x[1]) + abs(x[2])):
            break


@compiled
def _slope_at(t, wrench, x, centre, step, value, slope, bound, normal, ridge):  # type: ignore[no-untyped-def]
    """Return the slope of the dual at x + t step along the step."""
    total = 0.0
    for i in range(3):
        pull = 0.0
        for j in range(3):
            pull += normal[i, j] * (x[j] + t * step[j] - centre[j])
        total += step[i] * (wrench[i] - ridge * pull)
    for k in range(len(value)):
        total -= slope[k] * min(max(value[k] + t * slope[k], -bound[k]), bound[k])
    return total


@compiled
def _rise(wrench, x, centre, step, value, slope, bound, normal, ridge, crossing, count):  # type: ignore[no-untyped-def]
    """Return how far along the step the dual rises: where its slope, linear between the crossings, is zero."""
    left, left_slope = 0.0, _slope_at(0.0, wrench, x, centre, step, value, slope, bound, normal, ridge)
    for c in range(count):
        right = crossing[c]
        right_slope = _slope_at(right, wrench, x, centre, step, value, slope, bound, normal, ridge)
        if right_slope <= 0.0:
            return left + (right - left) * left_slope / (left_slope - right_slope) if left_slope > right_slope else left
        left, left_slope = right, right_slope
    right = left + 1.0
    right_slope = _slope_at(right, wrench, x, centre, step, value, slope, bound, normal, ridge)
    if left_slope > right_slope:
        return left + left_slope / (left_slope - right_slope)
    return right


def friction_optimal_forces(A: FloatArray, wrench: FloatArray, limit: FloatArray) -> SharedForces:
    """Return the forces whose largest use of friction is the least possible.

        min s^2 + w sum |F_i / limit_i|^2   subject to   A^T F = wrench,   (F_ix / limit_ix, F_iy / limit_iy) in s P

    with P the regular polygon of 16 corners in the unit circle and w = 1e-4, which makes the solution unique. The wrench is
    made in full even where s > 1, which is more than the ground gives: `use` says so.

    Args:
        A: wheel Jacobian (2n, 3).
        wrench: F (3,).
        limit: mu F_z along and across, (n, 2) [N].

    Raises:
        ControlError: the numbers are not finite, so that there is no solution.
    """
    n = len(limit)
    held = np.maximum(limit, LEAST_LIMIT)
    scale = float(np.max(held))
    relative = (held / scale).ravel()
    # Unknowns: forces over their limits, then s. All in units of the largest limit.
    C = _constraints(n)
    C[: 2 * n, :3] = A * relative[:, None]
    b = np.zeros(C.shape[1])
    b[:3] = wrench / scale
    try:
        x, *_ = quadprog.solve_qp(_hessian(n), np.zeros(2 * n + 1), C, b, 3, True)
    except ValueError as error:
        raise ControlError(f"the forces for the wrench {wrench.tolist()} within {limit.tolist()} N: {error}") from error
    force = (x[: 2 * n] * relative * scale).reshape(n, 2)
    use = float(np.sqrt(np.max(np.sum((force / held) ** 2, axis=1))))
    return SharedForces(force, use, wrench - A.T @ force.ravel())


_HESSIANS: dict[int, FloatArray] = {}
_CONSTRAINTS: dict[int, FloatArray] = {}


def _hessian(n: int) -> FloatArray:
    """Return R^-1 of the Hessian R^T R, as the solver takes it; a constant of the number of casters."""
    if n not in _HESSIANS:
        _HESSIANS[n] = np.diag([1.0 / math.sqrt(2.0 * EVENNESS)] * (2 * n) + [1.0 / math.sqrt(2.0)])
    return _HESSIANS[n].copy()


def _constraints(n: int) -> FloatArray:
    """Return the polygon's half planes, cos(pi / K) s - normal . x_i >= 0, after three columns left for the equation."""
    if n not in _CONSTRAINTS:
        C = np.zeros((2 * n + 1, 3 + n * CORNERS))
        angles = math.tau * np.arange(CORNERS) / CORNERS
        for i in range(n):
            columns = slice(3 + i * CORNERS, 3 + (i + 1) * CORNERS)
            C[2 * i, columns], C[2 * i + 1, columns] = -np.cos(angles), -np.sin(angles)
            C[2 * n, columns] = math.cos(math.pi / CORNERS)
        _CONSTRAINTS[n] = C
    return _CONSTRAINTS[n].copy()
