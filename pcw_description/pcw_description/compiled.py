"""The one way this project compiles inner loops: numba where it is installed, plain Python where it is not.

Plain Python gives the same numbers, only slower, so a machine without numba still runs every node.

Numba's cache knows the file of a kernel, not the files of the kernels it calls: after an edit of a friction curve, or an
update of one package, a plant would go on with the old curve. So the cache also depends on every file that holds kernels.
"""

from __future__ import annotations

import functools
import hashlib
import sys
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

try:
    import numba
    from numba.core.errors import NumbaExperimentalFeatureWarning

    NUMBA_AVAILABLE = True
    warnings.filterwarnings("ignore", category=NumbaExperimentalFeatureWarning)
    # False where NUMBA_DISABLE_JIT is set, to debug: kernels are then plain Python too.
    COMPILES = not numba.config.DISABLE_JIT
except ImportError:  # pragma: no cover - exercised on machines without numba
    NUMBA_AVAILABLE = COMPILES = False

Function = TypeVar("Function", bound=Callable[..., Any])

# Signature of every joint-torque kernel: (position [rad], velocity [rad/s], motor_torque [N m], normal_force [N],
# parameters) -> torque [N m] and minus its slope over velocity [N m s/rad]. One signature lets a compiled plant call any
# list of effects through function pointers, so that adding an effect does not compile the plant again.
JOINT_TORQUE_SIGNATURE = "UniTuple(float64, 2)(float64, float64, float64, float64, float64[::1])"
# Signature of every other kernel: (at, parameters, result), what they hold being a matter of the effect's kind. One
# signature for all, because each further list of kernels costs a plant's step more than its arithmetic.
ARRAY_SIGNATURE = "void(float64[::1], float64[::1], float64[::1])"


def compiled(function: Function) -> Function:
    """Compile `function` to machine code, cached on disk; a division by zero gives inf or nan, as in numpy."""
    if not NUMBA_AVAILABLE:
        return function
    # What was typed into an interpreter has no file, and the cache no place.
    in_file = Path(function.__code__.co_filename).is_file()
    # No kernel holds Python objects, so several may run at once in threads.
    dispatcher = numba.njit(cache=in_file, error_model="numpy", nogil=True)(function)
    _depend_on_all_kernels(dispatcher, function.__module__)
    return dispatcher  # type: ignore[no-any-return]


def compiled_joint_torque(function: Function) -> Function:
    """Compile a joint-torque kernel with the common signature `JOINT_TORQUE_SIGNATURE`."""
    return _compiled_as(JOINT_TORQUE_SIGNATURE, function)


def compiled_array_kernel(function: Function) -> Function:
    """Compile a kernel of arrays with the common signature `ARRAY_SIGNATURE`."""
    return _compiled_as(ARRAY_SIGNATURE, function)


def awaits_compiling(function: Callable[..., Any]) -> bool:
    """Whether the first call of what `compiled` returned will compile it, which takes seconds: once after an installation."""
    if not COMPILES or getattr(function, "signatures", None):
        return False
    load_index = getattr(getattr(getattr(function, "_cache", None), "_cache_file", None), "_load_index", None)
    return load_index is not None and not load_index()


def _compiled_as(signature: str, function: Function) -> Function:
    if not NUMBA_AVAILABLE:
        return function
    dispatcher: Any = compiled(function)
    if dispatcher is not function:  # the same where NUMBA_DISABLE_JIT is set, to debug
        dispatcher.compile(signature)
        dispatcher.disable_compile()
    return dispatcher  # type: ignore[no-any-return]


def _depend_on_all_kernels(dispatcher: Any, module: str) -> None:
    """Add the kernels of its own package and of this one, those it can call, to what the cache of `dispatcher` depends on."""
    package = sys.modules.get(module.partition(".")[0])
    folders = {str(Path(__file__).parent), *getattr(package, "__path__", ())}
    # No public name for this in numba; where it has gone, the cache is the usual one.
    cache_file: Any = getattr(getattr(dispatcher, "_cache", None), "_cache_file", None)
    if hasattr(cache_file, "_source_stamp"):
        cache_file._source_stamp = (cache_file._source_stamp, *(_kernels_digest(folder) for folder in sorted(folders)))


@functools.cache
def _kernels_digest(folder: str) -> str:
    """Return a digest of all files below `folder` that hold kernels."""
    digest = hashlib.sha256()
    for path in sorted(Path(folder).rglob("*.py")):
        content = path.read_bytes()
        if b"@compiled" in content:
            digest.update(content)
    return digest.hexdigest()


def _kernel_type(signature: str) -> Any:
    arguments, result = numba.core.sigutils.normalize_signature(signature)
    return numba.types.FunctionType(result(*arguments))


if COMPILES:
    _JOINT_TORQUE, _ARRAY_KERNEL = _kernel_type(JOINT_TORQUE_SIGNATURE), _kernel_type(ARRAY_SIGNATURE)

    # Numba's own list compiles its methods anew in every process; these come from the cache.
    @compiled
    def _no_joint_torques():  # type: ignore[no-untyped-def]
        return numba.typed.List.empty_list(_JOINT_TORQUE)

    @compiled
    def _no_array_kernels():  # type: ignore[no-untyped-def]
        return numba.typed.List.empty_list(_ARRAY_KERNEL)

    @compiled
    def _append(kernels, kernel):  # type: ignore[no-untyped-def]
        kernels.append(kernel)

    for _type in (_JOINT_TORQUE, _ARRAY_KERNEL):
        _append.compile(numba.void(numba.types.ListType(_type), _type))  # type: ignore[attr-defined]
    _append.disable_compile()  # type: ignore[attr-defined]


def joint_torque_list(functions: Sequence[Callable[..., tuple[float, float]]]) -> Any:
    """A list of joint-torque kernels that compiled code can call, empty lists included."""
    return _kernel_list(_no_joint_torques, functions) if COMPILES else list(functions)


def array_kernel_list(functions: Sequence[Callable[..., None]]) -> Any:
    """A list of kernels of arrays that compiled code can call, empty lists included."""
    return _kernel_list(_no_array_kernels, functions) if COMPILES else list(functions)


def _kernel_list(empty: Callable[[], Any], functions: Sequence[Callable[..., Any]]) -> Any:
    kernels = empty()
    for function in functions:
        _append(kernels, function)
    return kernels


def compiled_for_kernel(kernel_signature: str, result: str, arguments: str) -> Callable[[Function], Function]:
    """Compile a function whose first argument is a kernel of a common signature, once for all kernels of it.

    Args:
        kernel_signature: of the kernel.
        result, arguments: types of what the function returns and of what it takes after the kernel.
    """

    def decorate(function: Function) -> Function:
        if not COMPILES:
            return function
        kernel = _kernel_type(kernel_signature)
        others, returned = numba.core.sigutils.normalize_signature(f"{result}({arguments})")
        dispatcher: Any = compiled(function)
        dispatcher.compile(returned(kernel, *others))
        dispatcher.disable_compile()
        return dispatcher  # type: ignore[no-any-return]

    return decorate


@compiled_for_kernel(JOINT_TORQUE_SIGNATURE, "float64[::1]", ", ".join(5 * ["float64[::1]"]))
def joint_torque_along(kernel, position, velocity, motor_torque, normal_force, parameters):  # type: ignore[no-untyped-def]
    """Evaluate a joint-torque kernel along arrays (T,); returns (T,) [N m]."""
    torque = position.copy()
    for index in range(len(position)):
        torque[index], _ = kernel(
            position[index], velocity[index], motor_torque[index], normal_force[index], parameters
        )
    return torque


@compiled_for_kernel(ARRAY_SIGNATURE, "void", "float64[:, ::1], float64[::1], float64[:, ::1]")
def array_kernel_along(kernel, at, parameters, results):  # type: ignore[no-untyped-def]
    """Let a kernel of arrays add to each row of `results` what it finds at the same row of `at`."""
    for index in range(len(at)):
        kernel(at[index], parameters, results[index])
