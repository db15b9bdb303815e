"""Cross-coupling: wheels are also controlled on how they agree, after Feng, Koren and Borenstein (1993), for n casters.

    e = A V_d - B q_dot,   N = I - A A^+
    u = k_p e + k_i int e dt + c (k_p N e + k_i N int e dt)

The original closes a loop on the difference between the two wheels of a differential drive, which is what turns it off
its way. With n casters that difference is N e: what of the errors no motion of the robot explains. A wheel that lags
makes the others wait. With c = 0 this is RMRC. A baseline to compare with: it needs neither slip nor dynamics.
"""

from __future__ import annotations

import dataclasses

from pcw_description.robot_description import RobotDescription

from .controller_interface import parameter
from .delay_margin import derived_bandwidth
from .resolved_motion_rate import ResolvedMotionRate, ResolvedMotionRateParameters


@dataclasses.dataclass(frozen=True)
class CrossCouplingParameters(ResolvedMotionRateParameters):
    """Gains.

    Attributes:
        coupling: c, how much stronger the difference between wheels is controlled than their common error; less where delay
            asks for it [1].
    """

    coupling: float = parameter(
        2.0, "1", "how much stronger the difference between wheels is controlled than their common error", maximum=20.0
    )


class CrossCoupling(ResolvedMotionRate):
    """RMRC with cross-coupling of one robot."""

    parameters: CrossCouplingParameters

    def __init__(self, robot: RobotDescription, parameters: CrossCouplingParameters | None = None) -> None:
        super().__init__(robot, parameters or CrossCouplingParameters())
        # Wheels that move against each other feel 1 + c times the gain; it too has to bear the delay.
        strongest = derived_bandwidth(robot, (1.0 + self.parameters.coupling) * self.bandwidth) / self.bandwidth
        self.coupling = max(strongest - 1.0, 0.0)
