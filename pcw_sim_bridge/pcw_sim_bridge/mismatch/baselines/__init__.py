"""Other methods on the same recordings: what they name, how well they predict, how long they take.

Only for comparison; nothing of the analyser needs it, and its packages are not part of the ordinary set-up.
"""

from .baseline_result import BaselineResult
from .comparison_packages import require_packages
from .run_baselines import run_baselines

__all__ = ["BaselineResult", "require_packages", "run_baselines"]
