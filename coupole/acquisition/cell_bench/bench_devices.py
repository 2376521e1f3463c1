"""The devices of a bench: their identities, links and last reports."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from coupole.acquisition.opened_cell import OpenedCell
from coupole.errors import DeviceError
from coupole.plan.cell import Cell
from coupole.plan.rig_devices import DEVICES, device_for
from coupole.storage.line_file import utc_now

_ADDRESSES = ("port", "address", "listen", "controller", "host", "camera", "serial", "folder")
"""Settings of drivers, and endpoints of a world, that say where a device is."""
_NAMES = {"ledbox": "led box", "camera": "camera", "robot": "robot"}
_ASKED_BOARDS = 6
_ASKED_EVERY_S = 2.0


class BenchDevices:
    """State of the three devices, as far as it is known."""

    def __init__(self, cell: Cell, opened_cell: OpenedCell) -> None:
        self._cell, self._opened = cell, opened_cell
        self._links = {kind: self._link(kind) for kind in DEVICES}
        self._errors: dict[str, dict[str, str]] = {}
        self._tested: dict[str, dict[str, Any]] = {}
        self._heard_s = dict.fromkeys(DEVICES, time.monotonic())
        self._asked_s = 0.0
        self._box_c: float | None = None
        self.in_use = threading.Lock()
        """Held by the thread that talks to box and camera."""

    def state(self, robot_heard_s_ago: float | None) -> dict[str, Any]:
        """Return by kind of device: identity, link, temperature, last error, last self-test. The box is asked for
        its temperature at intervals, unless it is busy."""
        self._ask_the_box()
        now_s = time.monotonic()
        heard_s_ago = {kind: round(now_s - heard_s, 3) for kind, heard_s in self._heard_s.items()}
        if robot_heard_s_ago is not None:
            heard_s_ago["robot"] = robot_heard_s_ago
        return {
            kind: {
                "identity": {**vars(identity), "settings": dict(identity.settings)},
                "link": self._links[kind],
                "heard_s_ago": heard_s_ago[kind],
                "temperature_c": self._box_c if kind == "ledbox" else None,
                "last_error": self._errors.get(kind),
                "self_test": self._tested.get(kind),
            }
            for kind, identity in self._opened.identities.items()
        }

    def self_test(self, kind: str) -> dict[str, Any]:
        """Have a device test itself; the report stays in the state. Box and camera must not be in use."""
        device = getattr(self._opened, kind)
        test: Callable[[], Mapping[str, str]] = device.self_test
        outcome: dict[str, Any] = {"t": utc_now(), "passed": True, "report": {}}
        try:
            with self.in_use:
                outcome["report"] = dict(test())
            self.note_answer(kind)
        except DeviceError as error:
            self.note_error(error)
            outcome |= {"passed": False, "report": {"error": str(error)}}
        self._tested[kind] = outcome
        return {"device": kind, **outcome}

    def note_answer(self, *kinds: str) -> None:
        """Note that these devices have just answered."""
        for kind in kinds:
            self._heard_s[kind] = time.monotonic()

    def note_error(self, error: DeviceError) -> None:
        """Keep the last error of each device."""
        for kind, name in _NAMES.items():
            if error.device == name:
                self._errors[kind] = {"t": utc_now(), "message": str(error)}

    def _ask_the_box(self) -> None:
        if time.monotonic() - self._asked_s < _ASKED_EVERY_S or not self.in_use.acquire(blocking=False):
            return
        try:
            self._asked_s = time.monotonic()
            boards = np.unique(self._cell.leds.boards)
            some = boards[np.unique(np.linspace(0, len(boards) - 1, _ASKED_BOARDS).astype(int))]
            temperatures_c = [self._opened.ledbox.board_temperature_c(int(board)) for board in some]
            self._box_c = max((c for c in temperatures_c if c is not None), default=None)
            if self._box_c is not None:
                self.note_answer("ledbox")
        except DeviceError as error:
            self.note_error(error)
        finally:
            self.in_use.release()

    def _link(self, kind: str) -> str:
        _, settings = device_for(self._cell.rig, kind, dry_run=False)
        endpoints = self._opened.world_endpoints
        link_settings = {**settings, **(endpoints[kind] if endpoints else {})}
        return ", ".join(
            f"{name} {link_settings[name]}"
            for name in _ADDRESSES
            if isinstance(link_settings.get(name), str | int)
        )
