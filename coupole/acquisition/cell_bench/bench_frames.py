"""Pictures of a bench, exposed on request, with figures for focus and exposure."""

from __future__ import annotations

import contextlib
import math
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.acquisition.cell_bench.bench_devices import BenchDevices
from coupole.acquisition.cell_bench.bench_requests import FrameAsked, LoupeAsked
from coupole.acquisition.cell_bench.bench_work import Works
from coupole.acquisition.dose import FlashMeter
from coupole.acquisition.looking import lux_of_leds
from coupole.acquisition.opened_cell import OpenedCell
from coupole.acquisition.operator import longest_exposure_us
from coupole.acquisition.runtime_folder import named_after
from coupole.acquisition.single_shots import Shot, SingleShots
from coupole.devices import NO_LED
from coupole.errors import DeviceError, InputError, StorageError
from coupole.plan.cell import Cell
from coupole.preflight.job import Job
from coupole.viewing.raw_preview import figures, look, loupe, white_point

_KEPT_FRAMES = 4
_MOST_LOUPE_PX = 2048


class BenchFrames:
    """Takes one picture at a time. The newest pictures are in a folder that only this user can enter."""

    def __init__(
        self, cell: Cell, opened_cell: OpenedCell, job: Job | None, devices: BenchDevices, works: Works
    ) -> None:
        self._cell, self._opened, self._devices = cell, opened_cell, devices
        self._job, self._works = job, works
        self._lux = lux_of_leds(cell, job)
        self.begin_counting()
        self._last: Shot | None = None
        self._number = 0
        self._folder = named_after(cell.state_folder, "frames")
        shutil.rmtree(self._folder, ignore_errors=True)  # of a bench that was killed
        self._folder.mkdir(mode=0o700)

    def frame(self, request: FrameAsked, stops: int) -> dict[str, Any]:
        """Expose under each light in turn, and add the pictures up. `stops` is the number of stops when this was
        requested: after another stop no more light is given. Raises InputError, DoseBudgetReached, DeviceError."""
        self._refuse_what_there_is_not(request)
        if request.stops not in (None, stops):
            raise InputError("frame: the bench was stopped while it waited; look at its state, then ask again")
        with self._devices.in_use:
            before_lux_h = self._shots.given_lux_h
            shot = self._expose_lights(request, stops)
            self._devices.note_answer("ledbox", "camera")
            self._last = shot
            self._number += 1
            number, given_lux_h = self._number, float((self._shots.given_lux_h - before_lux_h).max())
        coding, marks = shot.coding, request.marks
        jpeg = look(
            shot.raw,
            coding,
            request.width_px,
            saturation="saturation" in marks,
            focus="focus" in marks,
            gains=request.gains,
        )
        return {
            "number": number,
            "width_px": shot.raw.shape[1],
            "height_px": shot.raw.shape[0],
            **vars(coding),
            "picture": str(self._keep(f"{number}.jpg", jpeg)),
            "raw": str(self._keep_raw(number, shot.raw)),
            **vars(figures(shot.raw, coding)),
            "region": self._figures_of(shot, request.region) if request.region else None,
            "dose_lux_h": given_lux_h,
        }

    def loupe(self, request: LoupeAsked) -> dict[str, Any]:
        """Return a region of the last picture, pixel by pixel, without another exposure. Raises InputError."""
        shot, number = self._last, self._number
        if shot is None:
            raise InputError("loupe: expected a `frame` before it")
        if max(request.region[2:]) > _MOST_LOUPE_PX:
            raise InputError(f"region: expected at most {_MOST_LOUPE_PX} x {_MOST_LOUPE_PX} px")
        region, at_px = _region(shot, request.region)
        picture = self._keep("loupe.png", loupe(region, shot.coding, request.gains))
        height_px, width_px = region.shape
        return {"number": number, "region": [*at_px, width_px, height_px], "picture": str(picture)}

    def dose(self) -> dict[str, Any]:
        """Return the dose of this bench, and of the object if it is known. A ledger that cannot be read gives the
        `warning`; the other figures are returned all the same.
        """
        meter, total_lux_h, left_lux_h, warning = self._meter, None, math.inf, ""
        if meter:
            try:
                total_lux_h, left_lux_h, warning = meter.total_lux_h, meter.left_lux_h, meter.warning
            except StorageError as error:
                warning = str(error)
        return {
            "bench_lux_h": float(self._shots.given_lux_h.max()),
            "total_lux_h": total_lux_h,
            "left_lux_h": left_lux_h if math.isfinite(left_lux_h) else None,
            "warning": warning,
        }

    def begin_counting(self) -> None:
        """Begin to count from the present state of the object's ledger. Raises StorageError."""
        job = self._job
        self._meter = FlashMeter(job, self._opened, "bench", 1.0) if job and job.plan.object else None
        self._shots = SingleShots(self._cell, self._opened, self._lux, self._meter)

    def release(self) -> None:
        """Let others use the camera."""
        self._shots.disarm()

    def end(self) -> None:
        """Once the cell is safe, enter the light that was given and remove the pictures."""
        self._settle()
        shutil.rmtree(self._folder, ignore_errors=True)

    def _expose_lights(self, request: FrameAsked, stops: int) -> Shot:
        lights = [(led, 0) for led in request.lights] + [(NO_LED, panel) for panel in request.panels]
        shots = []
        try:
            for led, panel in lights or [(NO_LED, 0)]:
                if self._works.stops != stops or self._opened.made_safe:
                    raise InputError("frame: the bench was stopped before the frame's last light")
                shots.append(self._shots.take(led, request.exposure_us, request.gain_db, panel))
                self._shots.rest()
        except DeviceError:
            with contextlib.suppress(DeviceError):
                self._opened.ledbox.lights_off()
                self._settle()
            self.release()
            raise
        self._settle()
        return _added_up(shots)

    def _settle(self) -> None:
        if self._meter is not None:
            self._meter.settle()

    def _figures_of(self, shot: Shot, region: Sequence[int]) -> dict[str, Any]:
        pixels, _ = _region(shot, region)
        return {**vars(figures(pixels, shot.coding)), "white_point": white_point(pixels, shot.coding)}

    def _refuse_what_there_is_not(self, request: FrameAsked) -> None:
        leds, panels = set(self._cell.leds.ids.tolist()), self._opened.ledbox.panel_count
        if strange := [led for led in request.lights if led not in leds]:
            raise InputError(f"lights: expected LEDs of the dome, found {strange[0]}")
        if strange := [panel for panel in request.panels if not 1 <= panel <= panels]:
            raise InputError(f"panels: expected numbers from 1 to {panels}, found {strange[0]}")
        longest_us = longest_exposure_us(self._cell.rig)
        if request.exposure_us > longest_us:
            raise InputError(f"exposure_us: expected at most {longest_us}, found {request.exposure_us}")
        sensor = self._cell.rig.sensor
        if request.region:
            _within(request.region, sensor.width_px, sensor.height_px)

    def _keep(self, name: str, content: bytes) -> Path:
        path = self._folder / name
        path.write_bytes(content)
        return path

    def _keep_raw(self, number: int, raw: NDArray[np.uint16]) -> Path:
        path = self._folder / f"{number}.npy"
        np.save(path, raw)
        for suffix in ("npy", "jpg"):
            (self._folder / f"{number - _KEPT_FRAMES}.{suffix}").unlink(missing_ok=True)
        return path


def _region(shot: Shot, region: Sequence[int]) -> tuple[NDArray[np.uint16], tuple[int, int]]:
    """Return the region [h, w], widened to whole Bayer cells, and x, y of its first pixel."""
    height_px, width_px = shot.raw.shape
    x, y, width, height = _within(region, width_px, height_px)
    left_px, top_px = x - x % 2, y - y % 2
    right_px, bottom_px = (-(-(at) // 2) * 2 for at in (x + width, y + height))
    return shot.raw[top_px:bottom_px, left_px:right_px], (left_px, top_px)


def _within(region: Sequence[int], width_px: int, height_px: int) -> tuple[int, int, int, int]:
    """Raises InputError for a region that is not inside a picture of this size, or that does not contain two Bayer
    cells."""
    x, y, width, height = region
    if min(width, height) < 4 or x + width > width_px or y + height > height_px:
        raise InputError(
            f"region: expected x, y, width, height of at least 4 px within {width_px} x {height_px} px, "
            f"found {list(region)}"
        )
    return x, y, width, height


def _added_up(shots: Sequence[Shot]) -> Shot:
    """Return the picture that one exposure under all lights at once would give, apart from its noise. A pixel is
    full if it is full in one of the shots."""
    if len(shots) == 1:
        return shots[0]
    coding = shots[0].coding
    light = np.sum([shot.raw.astype(np.int64) - coding.black_dn for shot in shots], axis=0)
    full = np.any([shot.raw >= coding.white_dn for shot in shots], axis=0)
    raw = np.where(full, coding.white_dn, np.clip(light + coding.black_dn, 0, coding.white_dn))
    return Shot(raw.astype(np.uint16), coding)
