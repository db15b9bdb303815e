"""Least squares for the three numbers of a planar twist, from normal equations that rows can be taken out of."""

from __future__ import annotations

import numpy as np

from pcw_description.compiled import compiled


@compiled
def parts_of_rows(rows, offset, variance):  # type: ignore[no-untyped-def]
    """Return what each component adds to the normal equations (2n + 1, 10), and last the sum of all.

    In order: the upper triangle of A^T A / sigma^2 (6), A^T y / sigma^2 (3), y^2 / sigma^2.
    """
    count = len(offset)
    parts = np.zeros((count + 1, 10))
    for k in range(count):
        weight = 1.0 / variance[k // 2, k % 2]
        a, b, c, y = rows[k, 0], rows[k, 1], rows[k, 2], offset[k]
        parts[k, 0], parts[k, 1], parts[k, 2] = weight * a * a, weight * a * b, weight * a * c
        parts[k, 3], parts[k, 4], parts[k, 5] = weight * b * b, weight * b * c, weight * c * c
        parts[k, 6], parts[k, 7], parts[k, 8] = weight * a * y, weight * b * y, weight * c * y
        parts[k, 9] = weight * y * y
        for m in range(10):
            parts[count, m] += parts[k, m]
    return parts


@compiled
def sum_of(parts, left_out):  # type: ignore[no-untyped-def]
    """Return the normal equations (10,) without the components of a set."""
    total = np.zeros(10)
    for k in range(len(parts) - 1):
        if not left_out >> k & 1:
            for m in range(10):
                total[m] += parts[k, m]
    return total


@compiled
def is_determined(total):  # type: ignore[no-untyped-def]
    """Whether normal equations have one solution: the pivots of their Cholesky factor are not rounding alone."""
    size = total[0] + total[3] + total[5]
    if not total[0] > 1e-7 * size:
        return False
    second = total[3] - total[1] * total[1] / total[0]
    if not second > 1e-7 * size:
        return False
    b = total[4] - total[1] * total[2] / total[0]
    return total[5] - total[2] * total[2] / total[0] - b * b / second > 1e-7 * size


@compiled
def full_inverse(total):  # type: ignore[no-untyped-def]
    """Return the inverse (3, 3) of normal equations that are determined."""
    upper = np.empty((3, 3))
    upper[0, 0], upper[0, 1], upper[0, 2] = total[0], total[1], total[2]
    upper[1, 0], upper[1, 1], upper[1, 2] = total[1], total[3], total[4]
    upper[2, 0], upper[2, 1], upper[2, 2] = total[2], total[4], total[5]
    return inverse(upper)


@compiled
def upper_inverse(matrix):  # type: ignore[no-untyped-def]
    """Return the upper triangle (6,) of the inverse of a symmetric matrix (3, 3)."""
    found = inverse(matrix)
    return np.array([found[0, 0], found[0, 1], found[0, 2], found[1, 1], found[1, 2], found[2, 2]])


@compiled
def inverse(m):  # type: ignore[no-untyped-def]
    """Return the inverse of a symmetric positive definite matrix (3, 3), by cofactors."""
    found = np.empty((3, 3))
    c00 = m[1, 1] * m[2, 2] - m[1, 2] * m[1, 2]
    c01 = m[0, 2] * m[1, 2] - m[0, 1] * m[2, 2]
    c02 = m[0, 1] * m[1, 2] - m[0, 2] * m[1, 1]
    scale = 1.0 / (m[0, 0] * c00 + m[0, 1] * c01 + m[0, 2] * c02)
    found[0, 0], found[1, 1] = c00 * scale, (m[0, 0] * m[2, 2] - m[0, 2] * m[0, 2]) * scale
    found[2, 2] = (m[0, 0] * m[1, 1] - m[0, 1] * m[0, 1]) * scale
    found[0, 1] = found[1, 0] = c01 * scale
    found[0, 2] = found[2, 0] = c02 * scale
    found[1, 2] = found[2, 1] = (m[0, 1] * m[0, 2] - m[0, 0] * m[1, 2]) * scale
    return found


@compiled
def solve(total, prior, with_prior):  # type: ignore[no-untyped-def]
    """Return the least of 1/2 sum of squares and where it is taken (3); LDL^T by hand.

    A direction that nothing determines stays at zero.
    """
    n00, n01, n02, n11, n12, n22 = total[0], total[1], total[2], total[3], total[4], total[5]
    if with_prior:
        n00 += prior[0]
        n01 += prior[1]
        n02 += prior[2]
        n11 += prior[3]
        n12 += prior[4]
        n22 += prior[5]
    least = 1e-9 * (n00 + n11 + n22) + 1e-300
    l10 = n01 / n00 if n00 > least else 0.0
    l20 = n02 / n00 if n00 > least else 0.0
    d1 = n11 - l10 * n01
    l21 = (n12 - l20 * n01) / d1 if d1 > least else 0.0
    d2 = n22 - l20 * n02 - l21 * (n12 - l20 * n01)
    y0 = total[6]
    y1 = total[7] - l10 * y0
    y2 = total[8] - l20 * y0 - l21 * y1
    gain, x, y, z = 0.0, 0.0, 0.0, 0.0
    if d2 > least:
        z = y2 / d2
        gain += y2 * z
    if d1 > least:
        y = y1 / d1
        gain += y1 * y
        y -= l21 * z
    if n00 > least:
        x = y0 / n00
        gain += y0 * x
        x -= l10 * y + l20 * z
    return 0.5 * (total[9] - gain), x, y, z
