"""A still camera, as `coupole.devices.Camera`. A tethering program writes its RAW files to a folder.

The box's edge (or a command) releases the shutter. The camera or its program writes CR2, NEF, ARW or DNG files,
and LibRaw (`rawpy`) decodes them. A file counts as a frame once its size no longer changes.

*Order and count are proven.* The frame id is the number in the file's name. The camera increases it with every
picture, and it wraps from 9999 to 1. So a picture that never arrives leaves a gap. The timestamp is the Exif
capture time with its fraction of a second. The run ends with a message if a file arrives after a later one, a
number is repeated, a capture time runs backwards, or camera, exposure or sensitivity differ.

*Slow.* Marks are shifted by a sixteenth of a period (docs/decisions/0002). So the period must be 40 times the
jitter of the timestamps: 0.4 s with hundredths of a second, 20 s with whole seconds.
"""

from __future__ import annotations

import contextlib
import subprocess
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from coupole.clock import Clock
from coupole.devices import CameraStatistics, Exposure, Frame, FrameFormat, HostNeed, Identity
from coupole.errors import DeviceError, DeviceFault, DeviceLost, DeviceRefused, DeviceTimeout
from drivers.camera.frame_pool import FramePool
from drivers.camera.misuse import format_for_arming, misuse_error, refuse_while_armed
from drivers.camera.raw.exif import Exif
from drivers.camera.raw.order import Order, file_number
from drivers.camera.raw.picture import RawPicture, read_picture
from drivers.host_checks import folder_of_pictures, package

_LOOK_S = 0.05
"""Interval between two looks into the folder."""
_PERIOD_IN_JITTERS = 40
"""Least period, in jitters of the timestamps. A mark is shifted by 1/16 of a period, which must exceed twice the
jitter, with some allowance for drift."""
_IN_HAND = 4
"""Greatest number of pictures in memory. The others wait as files."""
_NOMINAL_EXPOSURE = 0.1
"""Allowed relative difference between nominal and true exposure. A camera that is set to 1/125 s exposes for 1/128
s."""
_RELEASE_TIMEOUT_S = 30.0


class Settings(BaseModel):
    """Settings of a still camera in a rig."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    folder: Path
    """Folder to which the tethering program writes."""
    period_us: Annotated[int, Field(gt=0)]
    """Time from picture to picture that the camera sustains for a whole burst, with its own memory full."""
    device: str = "camera"
    """The camera's name in messages."""
    sample: Path | None = None
    """A RAW file of this camera, from which the frame format is read. None means the newest file in the folder."""
    suffixes: tuple[str, ...] = (".cr2", ".nef", ".arw", ".dng")
    last_number: Annotated[int, Field(ge=99)] = 9999
    """The camera's highest file number. After it the camera counts from 1 again."""
    release_command: tuple[str, ...] = ()
    """Program and arguments that release the shutter, for `trigger: software`."""
    shutter_jitter_us: Annotated[float, Field(ge=0)] = 5_000.0
    """Variation of the time from edge to exposure."""
    still_s: Annotated[float, Field(gt=0)] = 1.0
    """A file is complete if its size has not changed for this time."""
    patience_s: Annotated[float, Field(gt=0)] = 30.0
    """Longest wait for a picture after a later one has arrived. Then it counts as lost."""
    black_dn: Annotated[int, Field(ge=0)] | None = None
    """Black level, DN. None means the value that LibRaw finds in the file."""

    def host_needs(self) -> list[HostNeed]:
        """Needs of this machine, for `coupole doctor`."""
        return [package("rawpy", "pictures"), folder_of_pictures(self.folder)]


class RawFiles:
    """A still camera, as `coupole.devices.Camera`."""

    def __init__(self, settings: Settings, clock: Clock) -> None:
        self._settings, self._name = settings, settings.device
        self._armed = threading.Event()
        self._exposure: Exposure | None = None
        self._format: FrameFormat | None = None
        self._pool = FramePool(1, 2)
        if not settings.folder.is_dir():
            raise DeviceLost(
                self._name,
                expected=f"a folder {settings.folder} that the tethering program writes to",
                happened="there is none",
                remedy="Make it, or correct `folder` in the rig.",
            )
        self._order = Order(settings.folder, settings.suffixes, settings.last_number, settings.device)
        self._sample = self._read_picture(settings.sample or self._newest())
        self._last_taken: Exif | None = None
        self.id_modulus = (1, settings.last_number)
        self.delivery_s = settings.patience_s
        # A timestamp is placed at the middle of its resolution interval.
        self.timestamp_jitter_us = self._sample.exif.resolution_us / 2 + settings.shutter_jitter_us

    def _newest(self) -> Path:
        files = self._order.files()
        if not files:
            raise DeviceRefused(
                self._name,
                expected="one RAW file of this camera, which shows the format of the frames",
                happened=f"none is in {self._settings.folder}",
                remedy="Take a picture, or name a file as `sample` in the rig.",
            )
        return max(files, key=lambda path: path.stat().st_mtime_ns)

    def _read_picture(self, path: Path) -> RawPicture:
        try:
            return read_picture(path, self._settings.black_dn)
        except (OSError, ValueError) as error:
            raise DeviceRefused(
                self._name,
                expected=f"a whole RAW file of a Bayer sensor in {path.name}",
                happened=str(error),
                remedy="Check the file; if it is truncated, increase `still_s` in the rig.",
            ) from error
        except ModuleNotFoundError as error:
            raise DeviceRefused(
                self._name,
                expected="the package rawpy, which decodes RAW files",
                happened=str(error),
                remedy="Install it: pip install 'coupole[pictures]'.",
            ) from error

    # -- who it is ----------------------------------------------------------------------------------------

    def identify(self) -> Identity:
        exif = self._sample.exif
        words = (exif.make, exif.model, exif.serial, exif.firmware)
        vendor, model, serial, firmware = (word or "unknown" for word in words)
        return Identity(vendor, model, serial, firmware)

    def self_test(self) -> Mapping[str, str]:
        """Return data of the sample. Raises DeviceLost if the folder is gone."""
        files = self._order.files()
        return {
            "files": str(len(files)),
            "timestamp_resolution_us": str(self._sample.exif.resolution_us),
            "sample_exposure_us": f"{self._sample.exif.exposure_us:.0f}",
            "sample_iso": str(self._sample.exif.iso),
        }

    # -- exposure -----------------------------------------------------------------------------------------

    def configure(self, exposure: Exposure) -> FrameFormat:
        """Return the format. The exposure is set on the camera by hand, and each picture is checked for it."""
        refuse_while_armed(self._name, is_armed=self._armed.is_set())
        if exposure.gain_db:
            raise DeviceRefused(
                self._name,
                expected="a gain of 0 dB: a still camera's sensitivity is set on its body",
                happened=f"{exposure.gain_db:g} dB was asked for",
                remedy="Set ISO on the camera and the gain to 0 in the plan.",
            )
        if not exposure.hardware_trigger and not self._settings.release_command:
            raise DeviceRefused(
                self._name,
                expected="a `release_command` in the rig for `trigger: software`",
                happened="there is none",
                remedy="Name one, or let the box release the shutter.",
            )
        self._exposure, self._format = exposure, self._sample.frame_format
        return self._format

    def min_period_us(self, exposure: Exposure) -> int:
        to_distinguish_marks_us = int(_PERIOD_IN_JITTERS * self.timestamp_jitter_us)
        return max(self._settings.period_us, exposure.exposure_us, to_distinguish_marks_us)

    # -- acquisition --------------------------------------------------------------------------------------

    def arm(self, buffers: int) -> None:
        """Begin a burst. Files already in the folder do not belong to it. `buffers` is not used, because files
        wait on the disk."""
        frame_format = format_for_arming(self._name, self._format)
        self.disarm()
        self._order.begin()
        self._last_taken = None
        if self._pool.slot_bytes != frame_format.frame_bytes:
            self._pool = FramePool(_IN_HAND, frame_format.frame_bytes)
        self._pool.begin()
        self._armed.set()

    def next_frame(self, timeout_s: float) -> Frame | None:
        end_s = time.monotonic() + timeout_s
        while True:
            if self._armed.is_set():
                path = self._order.next(self._settings.still_s, self._settings.patience_s)
                if path is not None:
                    return self._frame(path, max(0.0, end_s - time.monotonic()))
            left_s = end_s - time.monotonic()
            if left_s <= 0:
                return None
            time.sleep(min(_LOOK_S, left_s))

    def _frame(self, path: Path, timeout_s: float) -> Frame | None:
        """Return the next frame. None if no memory became free in time; the file then remains the next file."""
        slot = self._pool.take(timeout_s)
        if slot is None:
            return None
        try:
            picture = self._read_picture(path)
            self._check(path, picture)
        except BaseException:
            slot.release()
            raise
        pixels = slot.memory.view(np.uint16).reshape(picture.pixels.shape)
        np.copyto(pixels, picture.pixels)
        self._order.take(path)
        self._last_taken = picture.exif
        return Frame(
            frame_id=file_number(path, self._name, self._settings.last_number),
            timestamp_ns=picture.exif.taken_ns + picture.exif.resolution_us * 500,
            pixels=pixels,
            release=slot.release,
        )

    def _check(self, path: Path, picture: RawPicture) -> None:
        """Raises DeviceFault for a picture that is not of this burst or was not taken as requested."""
        assert self._exposure is not None
        sample, exif, asked_us = self._sample, picture.exif, self._exposure.exposure_us
        body = (exif.make, exif.model, exif.serial)
        if body != (sample.exif.make, sample.exif.model, sample.exif.serial):
            raise self._bad_picture(path, f"a picture of {sample.exif.model} {sample.exif.serial}", " ".join(body))
        if picture.frame_format != self._format:
            raise self._bad_picture(path, f"a picture like {self._format}", f"it is {picture.frame_format}")
        if exif.resolution_us > sample.exif.resolution_us:
            raise self._bad_picture(
                path,
                f"a capture time to {sample.exif.resolution_us} us",
                f"it is recorded to {exif.resolution_us} us",
            )
        if abs(exif.exposure_us - asked_us) > _NOMINAL_EXPOSURE * asked_us:
            raise self._bad_picture(path, f"an exposure of {asked_us} us", f"it was {exif.exposure_us:.0f} us")
        before = self._last_taken
        if before is not None and exif.iso != before.iso:
            raise self._bad_picture(path, f"ISO {before.iso} as before", f"it was ISO {exif.iso}")
        if before is not None and exif.taken_ns <= before.taken_ns:
            raise self._bad_picture(
                path, "a capture time after the capture time of the picture before", "it is not later"
            )

    def trigger(self) -> None:
        if self._exposure is None or self._exposure.hardware_trigger:
            raise misuse_error(
                self._name, "hardware_trigger=False", "a software trigger while the box releases the shutter"
            )
        command = self._settings.release_command
        try:
            process = subprocess.run(
                command, capture_output=True, text=True, timeout=_RELEASE_TIMEOUT_S, check=False
            )
        except (OSError, subprocess.TimeoutExpired) as error:
            raise DeviceTimeout(
                self._name,
                expected=f"`{command[0]}` to release the shutter",
                happened=str(error),
                remedy="Check `release_command` in the rig.",
            ) from error
        if process.returncode:
            raise DeviceRefused(
                self._name,
                expected=f"`{command[0]}` to release the shutter",
                happened=f"it ended with code {process.returncode}: {process.stderr.strip()[-200:]}",
                remedy="Check the camera's USB cable and `release_command` in the rig.",
            )

    def statistics(self) -> CameraStatistics:
        """A picture counts as exposed once its own number or a later one has arrived."""
        release_count, file_count = self._order.counted, self._order.taken
        return CameraStatistics(
            exposed=release_count,
            delivered=file_count,
            lost_transfers=release_count - file_count,
            over_triggers=-1,
            overflows=0,
        )

    def disarm(self) -> None:
        self._armed.clear()

    def close(self) -> None:
        with contextlib.suppress(DeviceError):
            self.disarm()

    # -- errors -------------------------------------------------------------------------------------------

    def _bad_picture(self, path: Path, expectation: str, observation: str) -> DeviceFault:
        return DeviceFault(
            self._name,
            expected=f"{expectation} in {path.name}",
            happened=observation,
            remedy="Set the camera to manual, let no other program write to the folder, then resume the run.",
        )
