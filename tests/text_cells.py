"""The small simulated cell with a box of text lines in place of the one that runs tables."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import cells
from busy_machine import slowness
from cells import CellFolder

SOME = {"kind": "ids", "ids": [2, 9, 17, 26, 33, 41, 50, 61]}
BOX = {
    "driver": "drivers.ledbox.text_lines:TextLineBox",
    "settings": {
        "led_count": 64,
        "first_led": 1,
        "on": "LED {led} ON {on_ms}",
        "identify": "ID",
        "settle_ms": 0,
    },
}


def text_cell(folder: Path, **plan: Any) -> CellFolder:
    """The small cell with a box of text lines and its 64 LEDs. The host must answer while a light shines, within
    60 ms of the world's time. So its world runs at half the pace of life, and slower the busier the machine is."""
    cell = CellFolder(folder, speed=0.5 / slowness(), write_now=False)
    cell.rig_data["ledbox"] = copy.deepcopy(BOX)
    cell.rig_data["dome"]["leds"] = str(cells.REPO / "configs/domes/text-dome.csv")
    cell.write(**{"lights": SOME, "trigger": "software", "reshoot_limit": 1, **plan})
    return cell
