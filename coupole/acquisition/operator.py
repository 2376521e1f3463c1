"""Common parts of all sessions at a cell: signals, confirmation, identities of devices, the dose ledger."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from rich.console import Console

from coupole.acquisition.observer import Control
from coupole.acquisition.opened_cell import OpenedCell
from coupole.devices import Identity
from coupole.errors import Interrupted, PreflightRefused
from coupole.plan.bursts import EXPOSURE_MARGIN_US
from coupole.plan.cell import Cell
from coupole.plan.rig import Rig
from coupole.plan.rig_devices import in_world
from coupole.preflight import ledger
from coupole.preflight.job import Job
from coupole.preflight.preflight import Report
from coupole.viewing.terminal import ask

UNLIMITED_BYTES = 2**62
"""A dry run stores nothing, so the disk does not matter."""


def refuse(found: Report) -> None:
    if found.refusals:
        raise PreflightRefused(found.refusals)


@contextmanager
def operator_at(control: Control) -> Iterator[None]:
    """Ctrl-C and SIGTERM stop, SIGUSR1 pauses or continues; the former handlers are restored at the end."""

    def stop(*_: Any) -> None:
        control.stop.set()

    def pause(*_: Any) -> None:
        (control.pause.clear if control.pause.is_set() else control.pause.set)()

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    wanted = {signal.SIGINT: stop, signal.SIGTERM: stop, signal.SIGUSR1: pause}
    before = {number: signal.signal(number, handler) for number, handler in wanted.items()}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def ask_to_begin(cell: Cell, *, confirm: bool) -> None:
    """Ask the operator before a real cell moves the arm or switches lights."""
    real = not in_world(cell.rig, dry_run=False)
    if real and confirm and not ask("Move the arm and light the object?"):
        raise Interrupted("not started: answer the question, or say `--yes`")


def longest_exposure_us(rig: Rig) -> int:
    """Longest exposure that the LEDs' longest on-time allows."""
    return rig.led_limits.on_us[1] - rig.led_limits.rise_us - EXPOSURE_MARGIN_US


def enter_dose(job: Job, cell: OpenedCell, dose_lux_h: float, what_for: str) -> None:
    """Enter the light of a real cell in the object's dose ledger."""
    if job.plan.object and not cell.simulated:
        ledger.add(job.cell.storage_folder, job.plan.object.id, run=what_for, dose_lux_h=dose_lux_h)


def identity_printer(console: Console) -> Any:
    def tell(kind: str, identity: Identity) -> None:
        how = " (simulated)" if identity.simulated else ""
        console.print(f"  {kind}: {identity.vendor} {identity.model} {identity.serial}{how}")

    return tell
