"""Common parts of all sessions at a cell: confirmation and identities of devices."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich.console import Console

from coupole.devices import Identity
from coupole.errors import Interrupted, PreflightRefused
from coupole.plan.bursts import EXPOSURE_MARGIN_US
from coupole.plan.cell import Cell
from coupole.plan.rig import Rig
from coupole.plan.rig_devices import in_world
from coupole.preflight.commissioned import commissioning_refusals
from coupole.preflight.preflight import Report
from coupole.viewing.questions import ask

UNLIMITED_BYTES = 2**62
"""Free bytes that a dry run assumes, because it stores nothing."""


def refuse(report: Report) -> None:
    if report.refusals:
        raise PreflightRefused(report.refusals)


def refuse_uncommissioned(cell: Cell, identities: Mapping[str, Identity] | None = None) -> None:
    """Raise PreflightRefused if a real cell (or one of its opened devices) is not the one that was
    commissioned."""
    if reasons := commissioning_refusals(cell, identities):
        raise PreflightRefused(reasons)


def ask_to_begin(cell: Cell, *, confirm: bool) -> None:
    """Ask the operator before a real cell moves the arm or switches lights."""
    real = not in_world(cell.rig, dry_run=False)
    if real and confirm and not ask("Move the arm and light the object?"):
        raise Interrupted("the run was not started: answer the question, or give `--yes`")


def longest_exposure_us(rig: Rig) -> int:
    """Return the longest exposure that the LEDs' longest on-time allows."""
    return rig.led_limits.on_us[1] - rig.led_limits.rise_us - EXPOSURE_MARGIN_US


def identity_printer(console: Console) -> Any:
    def tell(kind: str, identity: Identity) -> None:
        how = " (simulated)" if identity.simulated else ""
        console.print(f"  {kind}: {identity.vendor} {identity.model} {identity.serial}{how}")

    return tell
