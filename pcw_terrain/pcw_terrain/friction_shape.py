"""The shape of a friction curve, stretched by its two numbers: mu(lambda) = mu_p g(lambda / lambda_p), odd in lambda.

For Kiencke's curve (3.47) [Li2009] g(x) = 2 x / (1 + x^2). For every other contact model g is that of the robot file, with
its shape numbers; lambda_p then is the slip to which the model gives that name. g and its first two slopes are tabulated over
u = x / (1 + x), so that one kernel serves all models.
"""

from __future__ import annotations

import numpy as np

from pcw_description.compiled import compiled
from pcw_description.contact.contact_model import friction_coefficient, tyre_parameters
from pcw_description.robot_description import ContactDescription, FloatArray

POINTS = 1024
# Beyond so many critical slips a curve is taken as level.
FARTHEST = 100.0


def shape_table(contact: ContactDescription | None = None) -> FloatArray:
    """Return g, g' and g'' (POINTS, 3) of a contact, None for Kiencke's curve."""
    u = np.arange(POINTS) / POINTS
    x = u / (1.0 - u)
    if contact is None or contact.model == "kiencke":
        square = 1.0 + x * x
        return np.stack([2.0 * x / square, 2.0 * (1.0 - x * x) / square**2, 4.0 * x * (x * x - 3.0) / square**3], axis=1)
    tyre = tyre_parameters(contact)

    def g(at: FloatArray) -> FloatArray:
        return np.array([friction_coefficient(tyre, slip * contact.lambda_p, 0.0)[0] / contact.mu_p for slip in at])

    step = 0.02  # wide enough to look over the corners that some curves have
    middle, after, before = g(x), g(x + step), np.where(x >= step, g(np.abs(x - step)), -g(np.abs(x - step)))
    second = (after - 2.0 * middle + before) / step**2
    return np.stack([middle, (after - before) / (2.0 * step), np.where(x < FARTHEST, second, 0.0)], axis=1)


@compiled
def shape_at(table, x):  # type: ignore[no-untyped-def]
    """Return g, g' and g'' at x = lambda / lambda_p of either sign."""
    size = min(abs(x), FARTHEST)
    place = size / (1.0 + size) * len(table)
    index = min(int(place), len(table) - 2)
    part = place - index
    g = table[index, 0] + part * (table[index + 1, 0] - table[index, 0])
    slope = table[index, 1] + part * (table[index + 1, 1] - table[index, 1])
    bend = table[index, 2] + part * (table[index + 1, 2] - table[index, 2])
    if x < 0.0:
        return -g, slope, -bend
    return g, slope, bend
