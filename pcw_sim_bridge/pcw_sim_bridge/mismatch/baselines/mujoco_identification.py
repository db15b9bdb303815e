"""`mujoco.sysid` with everything freed: least squares between recorded and simulated joint motion, over short windows.

The toolbox's parameters, residual, optimiser and confidence intervals are its own, used as its documentation has them. A
number is named where it leaves its nominal value by more than three of its standard errors, and of its tolerances where it
has one.
"""

from __future__ import annotations

import dataclasses
import io
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ..errors import MismatchError
from ..regression.regression_problem import FloatArray
from .comparison_packages import comparison_module

# Iterations of Gauss-Newton that the time is planned for; the residual falls little after the first few.
ITERATIONS = 6
# Step of the finite differences, in sizes of a number: far above rounding, far below what matters.
DIFFERENCE = 1e-2
SIGNIFICANCE = 3.0
# A sensor counts as moving by this part of what the liveliest one does, at least.
SMALLEST_SCALE = 0.02
WINDOW = 1.0  # [s]
AXIS_WINDOWS = 24
FEWEST_WINDOWS, MOST_WINDOWS = 4, 40


@dataclasses.dataclass(frozen=True)
class FreeNumber:
    """A number that is freed.

    Attributes:
        name: as the report has it, or `effect/target`.
        nominal: value of the description; lower and upper bound it.
        size: tolerance, or a typical size where it has none.
        tolerance: 0 where it has none.
        start: where the search begins; None is at the nominal value.
    """

    name: str
    nominal: float
    size: float
    lower: float
    upper: float
    tolerance: float = 0.0
    start: float | None = None


@dataclasses.dataclass(frozen=True)
class Window:
    """A piece of a recording to simulate.

    Attributes:
        initial_state: MuJoCo's full physics state.
        time: (L,) [s].
        torque: controls (L, u).
        sensed: sensors (L, s).
    """

    initial_state: FloatArray
    time: FloatArray
    torque: FloatArray
    sensed: FloatArray


@dataclasses.dataclass(frozen=True)
class Identified:
    """Values of the freed numbers, and those that have moved."""

    values: dict[str, float]
    moved: tuple[str, ...]
    remark: str


def identify(
    spec: Any,
    windows: Sequence[Window],
    numbers: Sequence[FreeNumber],
    rollout: Callable[..., Any] | None = None,
    modifiers: Sequence[Callable[[Any, float], None]] | None = None,
) -> Identified:
    """Fit numbers to windows.

    Args:
        spec: MjSpec with one motor per column of the controls and the sensors of the windows.
        rollout: replaces MuJoCo's own simulation (`custom_rollout` of the toolbox). Without it the sensors are those of
            the whole state, in its order.
        modifiers: per number what writes its value into a spec; not needed with a rollout of one's own.

    Raises:
        MismatchError: the toolbox gave up.
    """
    sysid = comparison_module("mujoco.sysid")
    model = spec.compile()
    parameters = sysid.ParameterDict()
    for k, number in enumerate(numbers):
        # In sizes from the nominal value, so that one step of differences suits all.
        low, high = ((bound - number.nominal) / number.size for bound in (number.lower, number.upper))
        write = _writer(number, modifiers[k]) if modifiers else None
        parameters.add(sysid.Parameter(number.name, 0.0, low, high, modifier=write))
        if number.start is not None:
            parameters[number.name].value[:] = (number.start - number.nominal) / number.size
    sequences = sysid.ModelSequences(
        "recordings",
        spec,
        [f"window {k}" for k in range(len(windows))],
        [window.initial_state for window in windows],
        [sysid.TimeSeries.from_control_names(window.time, window.torque, model) for window in windows],
        [sysid.TimeSeries.from_names(window.time, window.sensed, model) for window in windows],
    )
    everything = np.concatenate([window.sensed - window.sensed[0] for window in windows])
    scale = np.sqrt(np.mean(everything**2, axis=0))
    # A joint that hardly moves must not weigh most.
    scale = np.maximum(scale, SMALLEST_SCALE * np.max(scale))

    def difference(
        parameters: Any, predicted: Any, measured: Any, model: Any, return_all: bool, state: FloatArray, **ignored: Any
    ) -> tuple[FloatArray, Any, Any]:
        later = sysid.TimeSeries(measured.times[1:], measured.data[1:], measured.signal_mapping)
        # MuJoCo's own rollout reports sensors as of the beginning of a step, and the state as of its end.
        simulated = predicted.data if rollout else state[:, 1:]
        return (simulated - later.data) / scale, predicted, later

    options: dict[str, Any] = {"custom_rollout": rollout, "build_model": lambda p, s: model} if rollout else {}
    residual = sysid.build_residual_fn(
        models_sequences=[sequences], modify_residual=difference, resample_true=False, n_threads=1, **options
    )
    try:
        fitted, result = sysid.optimize(
            parameters, residual, optimizer="mujoco", verbose=False, max_iters=ITERATIONS, x_scale="jac", eps=DIFFERENCE,
            output=io.StringIO(),  # prints every iteration otherwise
        )
        best = fitted.as_vector()
        left = [np.ravel(piece) for piece in residual(best, fitted)[0]]
        _, half = sysid.calculate_intervals(left, np.asarray(result.jac))
    except (ValueError, ArithmeticError, np.linalg.LinAlgError) as error:
        raise MismatchError(f"could not run: the toolbox gave up ({error})") from error
    values, moved, undetermined = {}, [], 0
    for number, change, interval in zip(numbers, best, half, strict=True):
        values[number.name] = number.nominal + float(change) * number.size
        deviation = float(interval) / 1.96 * number.size
        undetermined += not np.isfinite(deviation)
        if abs(float(change)) * number.size > SIGNIFICANCE * max(deviation, number.tolerance):
            moved.append(number.name)
    start = float(np.mean(np.concatenate([np.ravel(p) for p in residual(np.zeros(len(best)), fitted)[0]]) ** 2))
    end = float(np.mean(np.concatenate(left) ** 2))
    remark = f"{len(numbers)} numbers, {len(windows)} windows of {windows[0].time[-1] - windows[0].time[0]:.2g} s; "
    remark += f"rollout error {np.sqrt(start):.3g} -> {np.sqrt(end):.3g} of the motion"
    if undetermined:
        remark += f"; {undetermined} numbers undetermined"
    return Identified(values, tuple(moved), remark)


def _writer(number: FreeNumber, modifier: Callable[[Any, float], None]) -> Callable[[Any, Any], None]:
    def write(spec: Any, parameter: Any) -> None:
        modifier(spec, number.nominal + float(parameter.value[0]) * number.size)

    return write


def spread_out(pieces: Sequence[tuple[int, int]], length: int, count: int) -> list[tuple[int, int]]:
    """Choose windows: up to `count` of (piece, start), evenly over pieces (index, samples) without overlap."""
    starts = [(piece, start) for piece, samples in pieces for start in range(0, samples - length, length)]
    places = np.unique(np.linspace(0, len(starts) - 1, min(count, len(starts))).astype(int)).tolist() if starts else []
    return [starts[k] for k in places]
