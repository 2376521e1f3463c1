"""All errors that Coupole raises deliberately, with their exit codes.

::

    CoupoleError
    ├── InputError            2  plan, rig or arguments are wrong
    │   └── FrameDiscarded    2  ... a frame is asked for that was discarded, as its plan said
    ├── PreflightRefused      3  the plan is well formed but must not be run
    ├── DoseBudgetReached     3  more light would exceed the object's budget
    ├── CalibrationRefused    3  the calibration misses its limits: written, but not to be used
    ├── CommissioningFailed   3  a step of a cell's commissioning did not pass
    ├── DeviceError           4  a device failed
    │   ├── DeviceTimeout     4  ... did not answer in time
    │   ├── DeviceLost        4  ... its link is gone
    │   ├── DeviceRefused     4  ... refused a command
    │   ├── ArmUnattended     4  ... braked, because nobody watched its motion
    │   └── DeviceFault       4  ... is in a latched fault; only an operator may clear it
    ├── UnprovenError         5  frames are missing or unproven after re-shooting
    ├── StorageError          6  the disk
    │   ├── DiskFull          6  ... has no space left
    │   └── ChecksumMismatch  6  ... does not give back what was written
    ├── ResourceShortage      1  this machine or process has too little memory, files or processes
    └── Interrupted         130  the operator stopped the run (129: hang-up, 143: SIGTERM)

A message names what was expected, what happened and what to do next.
"""

from __future__ import annotations

import signal
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any


class CoupoleError(Exception):
    """Base class; never raised itself."""

    exit_code = 1
    heading = ""
    """Line above the message, for messages that do not say by themselves what has happened."""


@dataclass(frozen=True)
class Problem:
    """One mistake in an input: its position, and what was expected.

    `line` and `column` count from 1; 0 means that the problem concerns the file as a whole.
    """

    file: str
    """Path of the file."""
    line: int
    """Line, from 1; 0: the file as a whole."""
    column: int
    """Column, from 1."""
    key: str
    """Key of the file that it concerns, with the keys above it; empty for the file as a whole."""
    message: str
    """Sentence that says what was expected, and what was found."""

    def __str__(self) -> str:
        place = f"{self.file}:{self.line}:{self.column}" if self.line else self.file
        return f"{place}: {self.key}: {self.message}" if self.key else f"{place}: {self.message}"


class InputError(CoupoleError):
    """Plan, rig or arguments are wrong; `problems` holds all of them, in the order of the file."""

    exit_code = 2

    def __init__(self, problems: Sequence[Problem] | str) -> None:
        self.problems: tuple[Problem, ...] = () if isinstance(problems, str) else tuple(problems)
        super().__init__(problems if isinstance(problems, str) else "\n".join(map(str, problems)))


class FrameDiscarded(InputError):
    """A frame is requested, but its pixels were discarded when its samples were safe, as its plan said."""


class ExtraMissing(CoupoleError):
    """An optional library is not installed; the message names the extra that adds it."""

    exit_code = 2


class PreflightRefused(CoupoleError):
    """Preflight found reasons not to run; `refusals` holds all of them."""

    exit_code = 3
    heading = "refused:"

    def __init__(self, refusals: Sequence[str]) -> None:
        self.refusals = tuple(refusals)
        super().__init__("\n".join(refusals))


class DoseBudgetReached(CoupoleError):
    """The next light would exceed the object's dose budget; it was not given."""

    exit_code = 3


class CalibrationRefused(CoupoleError):
    """A calibration misses its acceptance limits; `refusals` holds all of them."""

    exit_code = 3
    heading = "the calibration misses its limits:"

    def __init__(self, refusals: Sequence[str]) -> None:
        self.refusals = tuple(refusals)
        super().__init__("\n".join(refusals))


class CommissioningFailed(CoupoleError):
    """A step of a cell's commissioning did not pass; `reasons` says what was wrong and what to do."""

    exit_code = 3

    def __init__(self, step: str, reasons: Sequence[str]) -> None:
        self.step, self.reasons = step, tuple(reasons)
        super().__init__("\n".join([f"the step {step} did not pass", *reasons]))


class DeviceError(CoupoleError):
    """A device failed.

    Attributes: `device` (its name in the rig), `expected`, `happened`, `remedy` (what to do next).
    """

    exit_code = 4

    def __init__(self, device: str, *, expected: str, happened: str, remedy: str) -> None:
        self.device, self.expected, self.happened, self.remedy = device, expected, happened, remedy
        super().__init__(f"{device}: expected {expected}; {happened}. {remedy}")


class DeviceTimeout(DeviceError):
    """The device did not answer within the time allowed for the operation."""


class DeviceLost(DeviceError):
    """The link to the device is gone: cable, port, socket or process."""


class DeviceRefused(DeviceError):
    """The device refused a command."""


class ArmUnattended(DeviceError):
    """The arm braked on its path because nobody watched its motion. No fault is latched, and the arm may move
    again.

    `silent_s` is the time for which the arm was not checked, on the machine's clock.
    """

    def __init__(self, silent_s: float) -> None:
        self.silent_s = silent_s
        super().__init__(
            "robot",
            expected="a check of the arm every 0.1 s while it moves",
            happened=f"the arm was not checked for {silent_s:.2f} s (the program stood still, or "
            f"waited for something), so "
            "the arm braked on its path",
            remedy="Check that the cell is clear, then continue.",
        )


class DeviceFault(DeviceError):
    """The device is in a latched fault (emergency stop, over-temperature, watchdog)."""


class UnprovenError(CoupoleError):
    """Shots are missing or unproven, although they were taken again up to the plan's limit."""

    exit_code = 5


class StorageError(CoupoleError):
    """The run's folder cannot be written or read."""

    exit_code = 6


class DiskFull(StorageError):
    """The disk with the run has no space left."""


class ChecksumMismatch(StorageError):
    """Bytes on disk differ from those that were written."""


class ResourceShortage(CoupoleError):
    """Memory, open files or processes ran short: a limit of this machine or of this process, no defect."""

    exit_code = 1


class Interrupted(CoupoleError):
    """The operator asked to stop, or a signal did; the run can be resumed.

    The exit code is 128 + the signal's number, as in shells: 130 Ctrl-C, 143 SIGTERM, 129 SIGHUP.
    """

    exit_code = 128 + signal.SIGINT

    def __init__(self, message: str, signal_number: int = signal.SIGINT) -> None:
        super().__init__(message)
        self.exit_code = 128 + signal_number


def unsafe_end(what_happened: str, remedy: str = "Look at the cell.") -> DeviceError:
    """Return the error of a session after which the cell may not be safe."""
    return DeviceError(
        "cell",
        expected="lights off, the arm at rest and the camera disarmed at the end",
        happened=what_happened,
        remedy=remedy,
    )


def reason(error: BaseException) -> str:
    """Return why something failed, in words; errors of the system are given without their numbers."""
    return (error.strerror if isinstance(error, OSError) else None) or str(error)


def error_as_told(figures: Mapping[str, Any]) -> CoupoleError:
    """Return the error in the figures of another process's `--json`: `kind`, `error` and `exit_code`."""
    kind = globals().get(figures["kind"], CoupoleError)
    error: CoupoleError = kind.__new__(kind)
    Exception.__init__(error, figures["error"])
    error.exit_code = figures["exit_code"]
    return error
