"""Folders for facts that belong to the controller of a cell's arm, and not to the rig's name or to the folder of
the runs.

Examples are a fault that is not confirmed yet, and a commissioning. Such facts are stored in three folders:

- One is named after the serial number of the arm's controller, which is known after a device is opened.
- One is named after the controller's address, which is known before.
- One is the rig's own state folder, for all who share that rig.

Every fact is written to all three folders and read from all three. The folder of an address also stores the serial
numbers that have answered there. So the folders of these serial numbers are found before the next opening.

A simulated cell has only its state folder, because each of its worlds is a different controller.
"""

from __future__ import annotations

import contextlib
import os
import re
from pathlib import Path

from pydantic import BaseModel

from coupole.devices import Identity
from coupole.plan.cell import Cell
from coupole.plan.registry import settings_class
from coupole.plan.rig_devices import device_for, in_world

_SERIALS = "answered-here.txt"
_OWN_SOCKET = "listen"
_ADDRESSES = ("controller", "host", "address", _OWN_SOCKET)
"""Settings of drivers that give the controller's address, the most specific one first. `listen` is only this
machine's own socket. Then all controllers that may use this socket count as one; so a fault of one stops them all,
which is safe."""


def places_of_arm(cell: Cell, identity: Identity | None = None) -> tuple[Path, ...]:
    """Return the folders, which may not exist yet: the controller's own first, the rig's state folder last.
    `identity` is the identity of the opened arm."""
    if in_world(cell.rig, dry_run=False):
        return (cell.state_folder,)
    by_address = _by_address(cell)
    serials = dict.fromkeys([*_by_serial(identity), *_remembered_serials(by_address)])
    return (*(cell.controllers_folder / name for name in serials), by_address, cell.state_folder)


def remember_controller(cell: Cell, identity: Identity) -> None:
    """Store the serial number of an arm that has answered, so that its facts are found by its address from now on.
    Errors of the disk are ignored, because the serial number is read again at each opening."""
    if in_world(cell.rig, dry_run=False):
        return
    by_address = _by_address(cell)
    new = [name for name in _by_serial(identity) if name not in _remembered_serials(by_address)]
    if not new:
        return
    with contextlib.suppress(OSError):
        by_address.mkdir(parents=True, exist_ok=True)
        with (by_address / _SERIALS).open("a", encoding="utf-8") as file:
            file.write("".join(f"{name}\n" for name in new))
            file.flush()
            os.fsync(file.fileno())


def _by_address(cell: Cell) -> Path:
    driver, settings = device_for(cell.rig, "robot", dry_run=False)
    model = settings_class(driver)
    address, name = _address(model, settings)
    return cell.controllers_folder / _file_name("at", name, address)


def _address(model: type[BaseModel], settings: dict[str, object]) -> tuple[str, str]:
    """Return the address at which a driver with these settings finds its controller, and the name of the setting
    that has this address. Without an address, return an empty text and `unknown`.
    """
    for name in _ADDRESSES:
        field = model.model_fields.get(name)
        address = settings.get(name, field.default if field is not None else "")
        if field is not None and isinstance(address, str) and address.strip():
            host = address.strip().lower()
            return (host if name == _OWN_SOCKET else host.partition(":")[0]), name
    return "", "unknown"


def _by_serial(identity: Identity | None) -> list[str]:
    """Return the name of the folder for a serial number. The list is empty for a stand-in, and if the driver
    cannot read the number."""
    if identity is None or identity.simulated or not identity.serial.strip(" 0"):
        return []
    return [_file_name("serial", identity.vendor, identity.serial)]


def _remembered_serials(by_address: Path) -> list[str]:
    try:
        lines = (by_address / _SERIALS).read_text("utf-8", errors="replace").splitlines()
    except OSError:
        return []
    return [line for line in lines if re.fullmatch(r"serial-[\w.-]{1,120}", line)]


def _file_name(*parts: str) -> str:
    return re.sub(r"[^A-Za-z0-9.-]+", "_", "-".join(parts))[:120]
