"""What tests/neighbours/test_bluesky.py kills: bluesky's RunEngine flies a long view. Arguments: rig, folder."""

from __future__ import annotations

import sys
from typing import Any

from bluesky import RunEngine
from bluesky import preprocessors as bpp
from ophyd_async.core import init_devices

import coupole
from coupole.neighbours.bluesky import DomeCell, take_view

engine = RunEngine({})
plan = coupole.Plan.read("demo-short")
plan = coupole.Plan.model_validate(plan.model_dump() | {"lights": {"kind": "all"}, "repeats": 3})
with init_devices():
    cell = DomeCell(plan, rig=sys.argv[1], output=sys.argv[2])


@bpp.run_decorator()
def long_view() -> Any:
    yield from take_view(cell, exposure_us=8000)


engine(long_view())
