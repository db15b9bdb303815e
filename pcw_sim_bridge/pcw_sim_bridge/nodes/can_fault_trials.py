"""Faults and kills in real time, with every process of its own: how soon no drive has torque, by what name, and for how long.

Times are those of the monotonic clock, which all processes of a computer share: from the fault at the emulator, the signal or
the kill, to the end of the step of the plant in which no drive gave torque any more.
"""

from __future__ import annotations

import argparse
import os
import signal
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pcw_description import load_robot
from pcw_description.nodes.node_testing import RosTest

from ..can.can_file import on_udp, read_can_file
from ..can.drive_set import make_drives
from ..can.python_can import PythonCanTransport
from ..can.trial_rig import ALLOWED_MS
from ..can.trials import FAULT_TRIALS, STUCK_SPEED, write_into
from .can_faulty_driver import EMPTY_AT, FULL_AT
from .can_stack import DRIVER, FAULTY_DRIVER, Stack

FAULTS = tuple(fault for fault, _, _ in FAULT_TRIALS)
AFTERWARDS = 0.15  # for which torque must stay off, with the fault and without, while it is commanded [s]
ROW = slice(0, 36)  # of a table: drives and fault
SEEN_WITHIN = 5.0  # after which a fault has not been seen [s]
TRIES = 5  # of a trial that something else than its fault ended


class Trial(NamedTuple):
    """One fault.

    Attributes:
        zero_after_ms: until no drive had torque; None: never.
        named: what the driver said.
        right_name: it is one of the names that are right.
        stays_off: neither time nor healing nor commands nor activate gave torque before the faults were cleared.
    """

    zero_after_ms: float | None
    named: str
    right_name: bool
    stays_off: bool


class Interrupted(Exception):
    """Something else stopped the robot before the fault."""


def fault_trial(
    stack: Stack, fault: str, kind: str, names: Sequence[str], rng: np.random.Generator
) -> Trial:
    """Do one fault while driving, and drive again.

    Raises:
        Interrupted: the robot was stopped before, by what it says.
    """
    _drive_again(stack, rng)
    where = _place(stack, kind, rng)
    stack.forget()
    begun: float | None = None
    if fault == "driver_killed":
        begun = time.monotonic()
        stack.driver.process.kill()
        stack.driver.wait()
        stack.drive_for(AFTERWARDS)
        named = " ".join(sorted(set(stack.measured()["failures"].values())))
        names = ("drive_watchdog",)
    else:
        if fault == "command_timeout":
            begun = time.monotonic()
            stack.controller.process.send_signal(signal.SIGSTOP)
        elif fault == "transmit_buffer_full":
            stack.driver.process.send_signal(signal.SIGUSR1)
        else:
            stack.order(f"{fault} {where}")
        try:
            stack.wait_for(lambda: stack.stopped_at is not None, deadline=SEEN_WITHIN)
        except AssertionError:
            pass  # nobody noticed: what the driver says then is no right name
        named = stack.drives[0].split(": ", 1)[-1]
        stack.drive_for(AFTERWARDS)
    measured = stack.measured()
    off = not any(measured["torque"])
    if fault == "transmit_buffer_full":
        begun = float(stack.driver.log.rpartition(FULL_AT)[2].split()[0])
        stack.driver.process.send_signal(signal.SIGUSR2)
        stack.wait_for(lambda: stack.driver.log.rfind(EMPTY_AT) > stack.driver.log.rfind(FULL_AT))
    driving = True
    if begun is None:
        zero, driving = (measured["reactions"][-1][key] for key in ("zero_after_ms", "driving"))
    else:
        after = [1000.0 * (stopped - begun) for stopped in measured["stopped_at"] if stopped > begun]
        zero = round(after[0], 1) if after else None
    _heal(stack, fault)
    if fault == "driver_killed":
        stack.drive_for(AFTERWARDS)
        off = off and not any(stack.measured()["torque"])
        stack.start_driver()
    else:
        off = off and not stack.activate()
        stack.drive_for(AFTERWARDS)
        off = off and not any(stack.measured()["torque"])
        cleared = stack.clear_faults()
        off = off and cleared and not any(stack.measured()["torque"])
    if off and (zero is None or not driving):
        raise Interrupted("there was no torque any more when the fault began")
    return Trial(zero, named, bool(set(names) & set(named.replace(":", " ").split())), off)


def _heal(stack: Stack, fault: str) -> None:
    if fault == "command_timeout":
        stack.controller.process.send_signal(signal.SIGCONT)
    stack.order("heal all")
    stack.order("bus_heal can0")


def _drive_again(stack: Stack, rng: np.random.Generator) -> None:
    """Clear what is left of the trial before, activate, and drive for a while."""
    for _ in range(TRIES):
        if stack.drives[0].startswith("stopped"):
            stack.clear_faults()
        if not stack.drives[0].startswith("armed"):
            stack.activate()
        try:
            stack.wait_for(lambda: stack.is_driving, deadline=5.0)
            stack.drive_for(float(rng.uniform(0.1, 0.5)))
        except AssertionError:
            continue
        if stack.is_driving:
            return
    raise Interrupted(stack.drives[0])


def _place(stack: Stack, kind: str, rng: np.random.Generator) -> str:
    """Return where the fault is to be."""
    names = np.array(load_robot("thesis").joint_names)
    if kind == "turning joint":
        try:
            stack.wait_for(lambda: _fast(stack).any() or not stack.drives[0].startswith("armed"), deadline=20.0)
        except AssertionError:
            raise Interrupted("no joint turned fast enough") from None
        if not _fast(stack).any():
            raise Interrupted(stack.drives[0])
        names = names[_fast(stack)]
    return str(rng.choice(names)) if "joint" in kind else "can0"


def _fast(stack: Stack) -> Any:
    assert stack.states is not None
    # It may slow down until the fault has gone through pipe and bus.
    return np.abs(stack.states.velocity) >= 1.5 * STUCK_SPEED


def faults(options: argparse.Namespace) -> int:
    """Do every fault so many times with every protocol; exit code 0 when all was as it must be."""

    def each(stack: Stack, name: str, rng: np.random.Generator) -> Iterator[tuple[str, bool]]:
        for fault, kind, names in FAULT_TRIALS:
            if options.only and fault not in options.only or (fault == "hot" and "cia402" in name):
                continue
            yield _do_fault(stack, name, fault, kind, names, options.times, rng)

    head = f"{'drives':14} {'fault':21} {'times':>5}  {'median':>7}  {'largest':>8}  named  stays off  others"
    lines, fine = _with_every_protocol(options, head, each, FAULTY_DRIVER)
    if options.into is not None:
        write_into(options.into, "real_time_faults", "\n".join(_merged(options.into, lines) if options.only else lines))
    return 0 if fine else 1


def _with_every_protocol(
    options: argparse.Namespace,
    head: str,
    each: Callable[[Stack, str, np.random.Generator], Iterable[tuple[str, bool]]],
    driver: str = DRIVER,
) -> tuple[list[str], bool]:
    """Do trials with a stack per file of drives; return the table, and whether all was as it must be.

    Args:
        head: of the table.
        each: (stack, file, generator) -> lines of the table, each with whether it is as it must be.
        driver: its module.
    """
    lines, fine = [_how(options), head], True
    for name in options.can_file:
        one = argparse.Namespace(**{**vars(options), "can_file": name})
        with tempfile.TemporaryDirectory() as folder, RosTest() as ros:
            stack = Stack(ros, Path(folder), one, driver, watch=True)
            for line, good in each(stack, name, np.random.default_rng(options.seed)):
                lines, fine = [*lines, line], fine and good
                print(line, flush=True)
            stack.close()
    print("met" if fine else "NOT MET")
    return [*lines, _computer()], fine


def _merged(page: Path, lines: Sequence[str]) -> list[str]:
    """Return the table that stands in a page, with the rows of `lines` in the place of those of the same drives and fault."""
    table = page.read_text(encoding="utf-8").partition("<!-- real_time_faults -->\n")[2].partition("<!-- /")[0]
    rows = {line[ROW]: line for line in lines[2:-1]}
    done = [line.removeprefix("    ") for line in table.splitlines()]
    return [rows.get(line[ROW], line) for line in done] if done else list(lines)


def _do_fault(
    stack: Stack, drives: str, fault: str, kind: str, names: Sequence[str], times: int, rng: np.random.Generator
) -> tuple[str, bool]:
    trials: list[Trial] = []
    others: list[str] = []
    while len(trials) < times and len(others) < TRIES + times:
        try:
            trial = fault_trial(stack, fault, kind, names, rng)
        except Interrupted as interrupted:
            others.append(str(interrupted))
            continue
        trials.append(trial)
        if not trial.right_name or not trial.stays_off or trial.zero_after_ms is None or trial.zero_after_ms > ALLOWED_MS:
            print(f"  {fault}: {trial}", flush=True)
    zeros = [trial.zero_after_ms for trial in trials]
    named, off = sum(trial.right_name for trial in trials), sum(trial.stays_off for trial in trials)
    known = [zero for zero in zeros if zero is not None]
    good = len(known) == named == off == times and max(known) <= ALLOWED_MS
    largest = "never" if len(known) < len(trials) else f"{max(known):5.1f} ms" if known else ""
    median = f"{np.median(known):4.1f} ms" if known else ""
    line = f"{drives:14} {fault:21} {len(trials):5}  {median:>7}  {largest:>8}  {named:5}  {off:9}  {len(others):6}"
    return line + ("" if good else "  NOT MET"), good


def _computer() -> str:
    return f"load of the computer {os.getloadavg()[0]:.1f}, on {os.cpu_count()} cores"


def _how(options: argparse.Namespace) -> str:
    """Return what the processes were run with."""
    priority = f"priority {options.priority} (chrt -f)" if options.priority else "ordinary priority"
    return f"{options.rate:g} Hz, {priority}, {_computer()}"


# --- Kills -----------------------------------------------------------------------------------------------


def kill(options: argparse.Namespace) -> int:
    """Kill each process while driving: the others are safe in time, and a restart drives again."""

    def each(stack: Stack, name: str, rng: np.random.Generator) -> Iterator[tuple[str, bool]]:
        for victim in ("driver", "controller", "emulator"):
            done = [_kill_once(stack, victim, rng) for _ in range(options.times)]
            after = [milliseconds for milliseconds, _, _ in done]
            again = sum(drives for _, _, drives in done)
            said = "; ".join(sorted({name for _, name, _ in done}))
            good = again == options.times and max(after) <= ALLOWED_MS
            line = f"{name:14} {victim:10} {options.times:5}  {np.median(after):7.1f} ms  {max(after):5.1f} ms  "
            yield f"{line}{again:12}  {said}{'' if good else '  NOT MET'}", good

    head = f"{'drives':14} {'killed':10} {'times':>5}  {'safe after':>10}  {'largest':>8}  drives again  said"
    lines, fine = _with_every_protocol(options, head, each)
    if options.into is not None:
        write_into(options.into, "kills", "\n".join(lines))
    return 0 if fine else 1


def _kill_once(stack: Stack, victim: str, rng: np.random.Generator) -> tuple[float, str, bool]:
    """Kill one process while driving, start it again; returns milliseconds to safety, what was said, if it drives again."""
    _drive_again(stack, rng)
    stack.forget()
    process = getattr(stack, victim)
    listener = _Listener(stack) if victim == "emulator" else None
    begun = time.monotonic()
    process.process.kill()
    process.wait()
    if listener is not None:
        safe = listener.last_torque(begun)
        stack.wait_for(lambda: stack.stopped_at is not None)
        said = stack.drives[0].split(": ")[1].split(" at ")[0]
        stack.start_emulator()
    else:
        stack.drive_for(AFTERWARDS)
        measured = stack.measured()
        safe = next((at for at in measured["stopped_at"] if at > begun), float("inf"))
        if victim == "driver":
            said = " ".join(sorted(set(measured["failures"].values())))
            stack.start_driver()
        else:
            stack.wait_for(lambda: stack.stopped_at is not None)
            said = stack.drives[0].split(": ")[1].split(" at ")[0]
            stack.start_controller()
    try:
        _drive_again(stack, rng)
    except Interrupted:
        return 1000.0 * (safe - begun), said, False
    return 1000.0 * (safe - begun), said, True


class _Listener:
    """Somebody else on the bus, who hears what the drives are told."""

    def __init__(self, stack: Stack) -> None:
        robot = load_robot("thesis")
        file = on_udp(read_can_file(stack.file, robot), int(stack.port))
        self._drives = make_drives(robot, file)
        self._transport = PythonCanTransport(file.buses)

    def last_torque(self, since: float) -> float:
        """Listen for a while and return when a drive was last told to give torque, at the earliest `since` [s]."""
        last = since
        while time.monotonic() < since + 2.0 * AFTERWARDS:
            for arrived in self._transport.receive(0.002):
                wants = [drive.decode_command(arrived.frame) for drive in self._drives]
                if any(want is not None and want.enabled and want.value != 0.0 for want in wants):
                    last = max(last, arrived.time)
        self._transport.close()
        return last
