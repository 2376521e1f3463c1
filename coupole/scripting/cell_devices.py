"""The devices of a cell for scripts: opened by their contracts, safe on exit."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from coupole.acquisition import opened_cell
from coupole.acquisition.opened_cell import OpenedCell
from coupole.acquisition.operator import refuse_uncommissioned
from coupole.console.command_line.client import borrowed_cell
from coupole.errors import InputError, unsafe_end
from coupole.plan.cell import read_cell
from coupole.plan.rig_devices import in_world
from coupole.storage.arm_faults import faults_of


@contextmanager
def open_cell(rig: str | os.PathLike[str] = "sim", *, support_is_empty: bool = False) -> Iterator[OpenedCell]:
    """Open the devices of a rig (a file, or the name of a shipped one), with its simulated world if it has one.

    `cell.ledbox`, `cell.camera` and `cell.robot` are as described in `coupole.devices`; `cell.clock` is the rig's
    clock, and `cell.identities` has the identity of each device. At the end, also after an exception or Ctrl-C,
    the lights are switched off, the arm is stopped, the camera is disarmed, and the devices are closed. No path is
    checked, and no ledger counts the light: both are done only for plans. Therefore a real cell opens only if you
    state that its `support_is_empty`.

    Raises InputError if the rig is wrong, if `support_is_empty` is missing for a real cell, or if another process
    holds the devices; DeviceError if a device cannot be opened, if the arm is in a fault, or (at the end) if it is
    not certain that the cell is safe; PreflightRefused if a real cell was not commissioned.
    """
    cell = read_cell(Path(rig))
    if not (support_is_empty or in_world(cell.rig, dry_run=False)):
        raise InputError(
            f"{cell.document.path}: is a real cell, where this function checks no path and counts no light: "
            "remove the object and give support_is_empty=True, or acquire a plan"
        )
    faults_of(cell).refuse(cell.document.path)
    refuse_uncommissioned(cell)
    with borrowed_cell(cell, "a script"), opened_cell.open_cell(cell) as devices:
        refuse_uncommissioned(cell, devices.identities)
        yield devices
    if devices.trouble:
        raise unsafe_end("; ".join(devices.trouble))
