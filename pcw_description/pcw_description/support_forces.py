"""How the load of a robot is shared by its wheels: a rigid body on springs, without vertical motion."""

from __future__ import annotations

import numpy as np

from .compiled import compiled


@compiled
def support_forces(weight, moment_x, moment_y, spring, centre, height, normal_force):  # type: ignore[no-untyped-def]
    """Fill normal_force (n,) [N]: equal springs under a rigid body, on ground of uneven height; they push and do not pull.

    Args:
        weight: sum of the forces [N].
        moment_x, moment_y: sum of the forces times x and y of their places [N m].
        spring: stiffness of one wheel [N/m].
        centre: places (n, 2) [m].
        height: of the ground under each, or of what lifts the wheel (n,) [m].

    A wheel that would pull is off the ground, and the others carry its share. With two wheels the moment across their
    line is carried by nothing here.
    """
    n = len(normal_force)
    lifted = np.zeros(n, dtype=np.bool_)
    for _ in range(n):
        count, sx, sy, sh, sxx, sxy, syy, shx, shy = 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for i in range(n):
            if not lifted[i]:
                x, y, push = centre[i, 0], centre[i, 1], spring * height[i]
                count += 1
                sx += x
                sy += y
                sh += push
                sxx += x * x
                sxy += x * y
                syy += y * y
                shx += push * x
                shy += push * y
        # Centred sums decouple the mean load from the two tilts.
        mx, my = sx / count, sy / count
        cxx, cxy, cyy = sxx - count * mx * mx, sxy - count * mx * my, syy - count * my * my
        ridge = 1e-9 * (cxx + cyy)
        cxx += ridge
        cyy += ridge
        rx = moment_x - weight * mx - (shx - sh * mx)
        ry = moment_y - weight * my - (shy - sh * my)
        determinant = cxx * cyy - cxy * cxy
        tilt_x = (cyy * rx - cxy * ry) / determinant
        tilt_y = (cxx * ry - cxy * rx) / determinant
        least, where = 0.0, -1
        for i in range(n):
            normal_force[i] = 0.0
            if not lifted[i]:
                load = (weight - sh) / count + tilt_x * (centre[i, 0] - mx) + tilt_y * (centre[i, 1] - my)
                load += spring * height[i]
                normal_force[i] = max(load, 0.0)
                if load < least:
                    least, where = load, i
        if where < 0 or count <= 2:
            return
        lifted[where] = True


@compiled
def plane_gradient(centre, height):  # type: ignore[no-untyped-def]
    """Slopes along x and y of the plane nearest to heights (n,) [m] at places (n, 2) [m]: how a body on equal springs stands.

    Places on one line leave the slope across it at zero.
    """
    n = len(height)
    mx, my, mh, flat = 0.0, 0.0, 0.0, True
    for i in range(n):
        mx += centre[i, 0] / n
        my += centre[i, 1] / n
        mh += height[i] / n
        flat = flat and height[i] == height[0]
    if flat:
        return 0.0, 0.0
    cxx, cxy, cyy, chx, chy = 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(n):
        x, y, h = centre[i, 0] - mx, centre[i, 1] - my, height[i] - mh
        cxx += x * x
        cxy += x * y
        cyy += y * y
        chx += h * x
        chy += h * y
    ridge = 1e-9 * (cxx + cyy)
    cxx += ridge
    cyy += ridge
    determinant = cxx * cyy - cxy * cxy
    return (cyy * chx - cxy * chy) / determinant, (cxx * chy - cxy * chx) / determinant
