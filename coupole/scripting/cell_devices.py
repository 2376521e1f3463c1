"""The devices of a cell for a script of one's own: opened by their contracts, safe on exit."""

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

    `cell.ledbox`, `cell.camera` and `cell.robot` are as described in `coupole.devices`; `cell.clock` is the
    rig's clock, and `cell.identities` has the identity of each device. At the end, also by an exception or Ctrl-C,
    the lights are
    switched off, the arm is stopped, the camera is disarmed, and the devices are closed. No path is checked for
    you, and no ledger counts the light: only a plan does both. So a real cell opens only with your word that its
    `support_is_empty`.

    Raises InputError: the rig is wrong, a real cell without that word, or another process has its devices;
    DeviceError: one cannot be opened, the arm is in a fault, or (at the end) it is not sure that all is off and at
    rest; PreflightRefused: a real cell that was not commissioned.
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
