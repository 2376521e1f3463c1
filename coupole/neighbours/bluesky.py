"""A cell as a device of ophyd-async, and one view of it as a flight: bluesky's RunEngine runs a dome.

::

    cell = DomeCell("demo-short", name="cell")
    RE(take_view(cell, "top", exposure_us=8000))

The cell's signals say which frames the next flight takes; setting them lights and moves nothing. A flight calls
`coupole.acquire`, which starts a separate process with preflight, ledger, proof, and supervision of the arm. So
nothing stays lit or in motion if the process of the RunEngine is killed. If the RunEngine is paused, the flight
takes the rest of the view. Documents name proven frames only. This module needs the extra `bluesky`.
"""

from __future__ import annotations

import asyncio
import math
import os
import time
from collections.abc import AsyncIterator, Iterator, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from bluesky import plan_stubs as bps
from bluesky import preprocessors as bpp
from bluesky.protocols import EventCollectable, Flyable, Stoppable, StreamAsset, WritesStreamAssets
from bluesky.utils import MsgGenerator
from event_model import DataKey, PartialEvent, compose_stream_resource
from event_model.documents.event_descriptor import Dtype
from ophyd_async.core import (
    Array1D,
    AsyncStatus,
    Device,
    StandardReadable,
    StandardReadableFormat,
    soft_signal_r_and_setter,
    soft_signal_rw,
)

from coupole.errors import InputError
from coupole.plan.plan import Grid, Joints, LookAt
from coupole.plan.schedule import views_of_grid
from coupole.scripting.acquisition import Acquisition, acquire
from coupole.scripting.opened_run import Run
from coupole.scripting.plans import Plan
from coupole.scripting.proven_frame import Frame
from coupole.storage.frame_file import DATA
from coupole.storage.journal_events import FrameProven

AnyPath = str | os.PathLike[str]
_UNITS = {"us": "exposure_us", "deg": "a1_deg a2_deg a3_deg a4_deg a5_deg a6_deg"}
_UNITS["mm"] = "led_x_mm led_y_mm led_z_mm camera_x_mm camera_y_mm camera_z_mm"
_UNIT_OF = {name: unit for unit, names in _UNITS.items() for name in names.split()}


def _facts(row: int, frame: Frame) -> dict[str, Any]:
    """Return the facts of a frame as single values, because Tiled turns lists in a table into text.

    `row` is the frame's row in the stream of pixels; A1 to A6 are measured angles. If no LED is lit, `led` is -1
    and its position is NaN.
    """
    led_mm = [math.nan] * 3 if frame.led_position_mm is None else frame.led_position_mm
    return {
        "shot": frame.shot,
        "row": row,
        "led": -1 if frame.led is None else frame.led,
        "is_dark": frame.is_dark,
        "exposure_us": frame.exposure_us,
        **{f"a{axis}_deg": float(angle) for axis, angle in enumerate(frame.joints_deg, start=1)},
        **{f"led_{axis}_mm": float(value) for axis, value in zip("xyz", led_mm, strict=True)},
        **{f"camera_{axis}_mm": float(frame.base_from_camera[place, 3]) for place, axis in enumerate("xyz")},
        "proof": frame.proof,
        "xxh3": frame.xxh3,
        "taken_utc": str(frame.taken_utc),
    }


def _key(name: str, value: Any) -> DataKey:
    dtype: Dtype = "string"
    if isinstance(value, bool | int | float):
        dtype = "boolean" if isinstance(value, bool) else "integer" if isinstance(value, int) else "number"
    key = DataKey(source="coupole", dtype=dtype, shape=[])
    if name in _UNIT_OF:
        key["units"] = _UNIT_OF[name]
    return key


class ProvenFrames(Device, EventCollectable):
    """Facts of the proven frames of a cell's last flight: one event for each, in the order of the journal."""

    def __init__(self) -> None:
        super().__init__()
        self.rows: list[tuple[int, Frame]] = []
        """Row in the stream of pixels, and frame."""

    async def describe_collect(self) -> dict[str, DataKey]:
        """Return the key of each value of an event. Raises InputError if no flight has been completed."""
        if not self.rows:
            raise InputError("no flight has been completed: there are no frames to describe")
        return {name: _key(name, value) for name, value in _facts(*self.rows[0]).items()}

    def collect(self) -> Iterator[PartialEvent]:
        """Yield one partial event for each proven frame."""
        now_s = time.time()
        for row, frame in self.rows:
            facts = _facts(row, frame)
            yield {"time": now_s, "data": facts, "timestamps": dict.fromkeys(facts, now_s)}


class DomeCell(StandardReadable, Flyable, Stoppable, WritesStreamAssets):
    """The cell of a plan's rig. A flight takes the view that `view` names, under the lights of `leds`.

    `plan` is a `coupole.Plan`, a file, or the name of a shipped plan. `rig` replaces the plan's rig. `output` is
    the parent folder of runs. A real cell moves only if `yes` is True.
    """

    def __init__(
        self,
        plan: Plan | AnyPath,
        *,
        rig: AnyPath | None = None,
        output: AnyPath | None = None,
        yes: bool = False,
        name: str = "",
    ) -> None:
        self.plan = plan if isinstance(plan, Plan) else Plan.read(plan)
        """Plan whose views, lights and exposures are used if a signal is not set."""
        self._options: dict[str, Any] = {"rig": rig, "output": output, "yes": yes}
        self._acquisition: Acquisition | None = None
        self._stream_assets: list[StreamAsset] = []
        self._pixels_key: DataKey | None = None
        self._row_count = 0
        with self.add_children_as_readables(StandardReadableFormat.CONFIG_SIGNAL):
            self.view = soft_signal_rw(str, self.views()[0].name)
            """Name of the view that the next flight takes; setting it moves nothing yet."""
            self.leds = soft_signal_rw(Array1D[np.int64])
            """Numbers of the LEDs that light the view, in this order; if empty, the lights of the plan."""
            self.exposure_us = soft_signal_rw(int, self.plan.exposure.exposures_us[0], units="us")
            """Exposure time of each frame; for a bracket only the shortest time, unless a time is given here."""
            self.run_folder, self._set_run_folder = soft_signal_r_and_setter(str)
            """Folder of the last flight's run."""
            self.proof, self._set_proof = soft_signal_r_and_setter(str)
            """How the identity of this run's frames was proven, in the words of run.json."""
        self.proven, self._set_proven = soft_signal_r_and_setter(int)
        """Number of frames that the present flight has proven."""
        self.frames = ProvenFrames()
        super().__init__(name)

    async def next_plan(self) -> Plan:
        """Return the plan of the next flight, as the signals `view` and `leds` set it. Raises InputError if the
        plan has no such view.
        """
        name, leds = await self.view.get_value(), await self.leds.get_value()
        views = {view.name: view for view in self.views()}
        if name not in views:
            raise InputError(f"{name}: the plan {self.plan.name} has no such view; it has: {', '.join(views)}")
        view = views[name].model_dump()
        changes: dict[str, Any] = {"views": [view]}
        if len(leds):
            view["lights"] = {"kind": "ids", "ids": [int(led) for led in leds]}
        changes["exposure"] = {"kind": "fixed", "exposure_us": await self.exposure_us.get_value()}
        return Plan.model_validate(self.plan.model_dump() | changes)

    def views(self) -> list[LookAt | Joints]:
        """Names of the plan's views, including each view of its grids."""
        return [
            view
            for entry in self.plan.view_entries
            for view in (views_of_grid(entry) if isinstance(entry, Grid) else [entry])
        ]

    @AsyncStatus.wrap
    async def kickoff(self) -> None:
        """Begin a flight. If the acquisition is refused, `complete` raises the error."""
        if self._acquisition is not None:
            raise InputError("the cell is in a flight; complete it first")
        plan = await self.next_plan()
        self._forget()
        # A run is bound to the thread that begins it. The thread of the event loop lives as long as its process.
        self._acquisition = acquire(plan, **self._options)

    @AsyncStatus.wrap
    async def complete(self) -> None:
        """Wait until the flight is over. Raises what `coupole.acquire` raises."""
        acquisition = self._acquisition
        if acquisition is None:
            raise InputError("the cell is not in a flight; kick it off first")
        try:
            proven = 0
            while (event := await asyncio.to_thread(next, acquisition, None)) is not None:
                if isinstance(event, FrameProven):
                    proven += 1
                    self._set_proven(proven)
        finally:
            await self._land()
        assert acquisition.run is not None
        self._remember(acquisition.run)

    async def stop(self, success: bool = True) -> None:
        """End a flight: lights off, arm still, camera disarmed. The RunEngine calls it when a plan ends."""
        await self._land()

    @AsyncStatus.wrap
    async def unstage(self) -> None:
        """End a flight that is still going on."""
        await self._land()
        await super().unstage()

    async def describe_collect(self) -> dict[str, DataKey]:
        """Return the key of the stream of pixels. The stream has all rows of the flight's file; `frames` names the
        proven ones."""
        if self._pixels_key is None:
            raise InputError("no flight has been completed: there are no pixels to describe")
        return {"pixels": self._pixels_key}

    async def collect_asset_docs(self, index: int | None = None) -> AsyncIterator[StreamAsset]:
        """Yield the documents of the last flight's files; a second call yields none."""
        assets, self._stream_assets = self._stream_assets, []
        for asset in assets:
            yield asset

    async def get_index(self) -> int:
        """Number of rows of the last flight."""
        return self._row_count

    async def _land(self) -> None:
        acquisition, self._acquisition = self._acquisition, None
        if acquisition is not None:
            await asyncio.to_thread(acquisition.close)

    def _forget(self) -> None:
        self._stream_assets, self._pixels_key, self._row_count, self.frames.rows = [], None, 0, []
        self._set_proven(0)

    def _remember(self, folder: Path) -> None:
        """Store the facts of a flight's run, which has one view."""
        run = Run(folder)
        (view,) = run.values()
        self._set_run_folder(str(folder))
        self._set_proof(run.proof)
        self.frames.rows = [(frame.slot, frame) for frame in view.values()]
        self._row_count = 1 + max(row for row, _ in self.frames.rows)
        path = folder / self.frames.rows[0][1].file
        with h5py.File(path, "r") as file:
            shape, dtype = file[DATA].shape, file[DATA].dtype
        self._pixels_key = {
            "source": "coupole",
            "dtype": "array",
            "dtype_numpy": dtype.str,
            "shape": [1, *shape[1:]],
            "external": "STREAM:",
        }
        parameters = {"dataset": DATA, "slice": f":{self._row_count}", "swmr": False, "chunk_shape": [1]}
        bundle = compose_stream_resource(
            mimetype="application/x-hdf5", uri=_uri(path), data_key="pixels", parameters=parameters
        )
        rows = bundle.compose_stream_datum({"start": 0, "stop": self._row_count})
        self._stream_assets = [("stream_resource", bundle.stream_resource_doc), ("stream_datum", rows)]


def _uri(path: Path) -> str:
    return path.resolve().as_uri().replace("file:///", "file://localhost/", 1)


def take_view(
    cell: DomeCell, view: str | None = None, *, leds: Sequence[int] | None = None, exposure_us: int | None = None
) -> MsgGenerator[None]:
    """Take one view, as a part of a plan: set the given signals, fly, and collect into two streams.

    The stream with the view's name has one event for each proven frame; the stream `<view>_pixels` has the pixels
    [row, height, width], DN. The cell is safe at the end, also after an error.
    """
    settings: dict[Any, Any] = {cell.view: view, cell.leds: leds, cell.exposure_us: exposure_us}
    given_settings = [word for item in settings.items() if item[1] is not None for word in item]

    def flight() -> MsgGenerator[None]:
        if given_settings:
            yield from bps.mv(*given_settings)
        yield from bps.kickoff(cell, wait=True)
        yield from bps.complete(cell, wait=True)
        stream = yield from bps.rd(cell.view)
        yield from bps.declare_stream(cell.frames, name=stream, collect=True)
        yield from bps.collect(cell.frames, name=stream)
        yield from bps.declare_stream(cell, name=f"{stream}_pixels", collect=True)
        yield from bps.collect(cell, name=f"{stream}_pixels")

    yield from bpp.stage_wrapper(flight(), [cell])
