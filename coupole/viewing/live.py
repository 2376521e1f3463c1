"""Live view: the newest frame of a cell or of a run in progress, for focusing, aiming and watching.

A *source* gives frames, and `Studio` holds the newest one for viewers. Viewers poll it at any time, and nothing
waits for them. For a run only its folder is read, so viewers cannot slow it.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, ValidationError

from coupole.errors import FrameDiscarded, InputError
from coupole.plan.shot_id import Led
from coupole.storage import journal
from coupole.storage.discarding import discarded_views, place_of_result
from coupole.storage.journal_events import FrameProven
from coupole.storage.run import Run
from coupole.storage.run_status import CREATED, PAUSED, RUNNING, Status, status
from coupole.storage.view_reader import read_view
from coupole.viewing.raw_preview import Coding, Figures, figures

_POLL_S = 0.2
_STATUS_S, _STATUS_REST = 1.0, 20.0
"""Least time between two readings of a run's status; and the pause after a reading, as a multiple of the reading's
time."""
UNWATCHED_S = 5.0
"""A source of light stops when no page has asked for this time. An open page asks five times a second; a page in
the background asks once a second."""


@dataclass(frozen=True)
class Choice:
    """The viewer's choice of light and exposure."""

    led: int | None
    """Id of the LED that is lit; None for none."""
    exposure_us: int


@dataclass(frozen=True)
class Shown:
    """One frame with its metadata and figures."""

    number: int
    title: str
    raw: NDArray[np.uint16]
    coding: Coding
    exposure_us: int
    led: int | None
    figures: Figures
    frames_per_s: float
    dose_lux_h: float
    run: str = ""
    """State and progress of the frame's run; empty for a camera's frame."""


class Source(Protocol):
    """Gives frames until it is closed."""

    leds: tuple[int, ...]
    """Ids that may be chosen; empty if there is no choice."""

    def frames(self, studio: Studio) -> None:
        """Pass frames to `studio.show` until `studio.closing` is set. Raises the error that ends it."""
        ...


class Studio:
    """The newest frame, and the viewers' choice."""

    def __init__(self, choice: Choice) -> None:
        self.closing = threading.Event()
        self.remark = ""
        """Remark of the source, for the viewer; empty if there is none."""
        self._asked_s = time.monotonic()
        self._lock = threading.Lock()
        self._shown: Shown | None = None
        self._choice = choice

    @property
    def is_watched(self) -> bool:
        """False if no page has asked for some seconds, or if no page has come yet."""
        return time.monotonic() - self._asked_s < UNWATCHED_S

    def note_request(self) -> None:
        """Note that a page asks, which means that somebody may be watching."""
        self._asked_s = time.monotonic()

    @property
    def choice(self) -> Choice:
        with self._lock:
            return self._choice

    def choose(self, choice: Choice) -> None:
        with self._lock:
            self._choice = choice

    @property
    def shown_frame(self) -> Shown | None:
        with self._lock:
            return self._shown

    def show(self, frame: Shown) -> None:
        with self._lock:
            self._shown = frame


class FrameRate:
    """Frames per second, over the last frames."""

    def __init__(self) -> None:
        self._times_s: list[float] = []

    def beat(self) -> float:
        self._times_s = [*self._times_s[-9:], time.monotonic()]
        took_s = self._times_s[-1] - self._times_s[0]
        return (len(self._times_s) - 1) / took_s if took_s > 0 else 0.0


class RunSource:
    """A run's folder: the newest proven frame, read from the disk."""

    leds: tuple[int, ...] = ()

    def __init__(self, folder: Path) -> None:
        self._run = Run(folder)
        self._status = Status()
        self._next_status_s = 0.0
        self._last_frame = "its last frame"

    def frames(self, studio: Studio) -> None:
        pace, number = FrameRate(), 0
        newest: FrameProven | None = None
        while not studio.closing.is_set():
            display = studio.shown_frame
            last = self._newest_kept() if display is None and self._run.discards else self._newest()
            is_changed = self._ask_status(studio)
            if last is not None and last != newest:
                newest = last
                with suppress(FrameDiscarded):  # since its line was read: what is shown stays
                    display = replace(self._read_frame(last, number + 1), frames_per_s=pace.beat())
                    number += 1
                    studio.show(self._with_status(display))
            elif is_changed and display is not None:
                number += 1
                studio.show(self._with_status(replace(display, number=number)))
            studio.closing.wait(_POLL_S)

    def _ask_status(self, studio: Studio) -> bool:
        """Read the run's progress from time to time, in a small part of this thread's time. True if it has
        changed."""
        begun_s = time.monotonic()
        if begun_s < self._next_status_s:
            return False
        before, self._status = self._status, status(self._run)
        took_s = time.monotonic() - begun_s
        self._next_status_s = begun_s + max(_STATUS_S, _STATUS_REST * took_s)
        if self._status.state not in (CREATED, RUNNING, PAUSED):
            studio.remark = f"the run is not being acquired ({self._status.state}): this is {self._last_frame}"
        elif studio.remark:
            studio.remark = "the run goes on"
        return self._status != before

    def _with_status(self, frame: Shown) -> Shown:
        now = self._status
        progress = f"{now.state}, {now.proven} of {now.shots} shots proven"
        return replace(frame, run=progress, dose_lux_h=now.dose_lux_h)

    def _newest_kept(self) -> FrameProven | None:
        """Return the newest frame whose pixels were not discarded; None if no frame is proven yet. If no frame is
        kept, raises FrameDiscarded, which names the pictures to look at instead."""
        proven_frames = [frame for shot, frame in self._run.proven().items() if isinstance(shot.light, Led)]
        discards = discarded_views(self._run)
        gone_shots = {shot for event in discards.values() for shot, _ in event.frames}
        if proven_frames and proven_frames[-1].shot not in gone_shots:
            return proven_frames[-1]
        self._last_frame = "its newest frame that was not discarded"
        kept_frames = [frame for frame in proven_frames if frame.shot not in gone_shots]
        if proven_frames and not kept_frames:
            result = place_of_result(self._run, discards[proven_frames[-1].shot.view])
            raise FrameDiscarded(
                f"{self._run.folder}: all its frames under LEDs were discarded when their samples were safe, as "
                f"its plan said (`discard: after_fit`). `coupole show {result} --out FILE.html` shows the "
                "result that was made of the samples"
            )
        return kept_frames[-1] if kept_frames else None

    def _newest(self) -> FrameProven | None:
        frame = None
        for event in journal.tail(self._run.journal_path, 64 * 1024):
            if isinstance(event, FrameProven) and isinstance(event.shot.light, Led):
                frame = event
        return frame

    def _read_frame(self, event: FrameProven, number: int) -> Shown:
        file = read_view(self._run.folder / event.file, [event])
        raw, record = file.pixels(event.index), file.records[event.index]
        coding = Coding(file.pattern, file.black_dn, file.white_dn)
        figures_of_frame = figures(raw, coding)
        exposure_us, led = int(record["exposure_us"]), int(record["led"])
        return Shown(number, str(event.shot), raw, coding, exposure_us, led, figures_of_frame, 0.0, 0.0)


class Wanted(BaseModel):
    """A viewer's choice as it was sent. Numbers must be whole, and nothing is converted. Omitted fields do not
    change.
    """

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True)

    led: int | None = None
    exposure_us: int = 0


def read_wanted(body: bytes) -> Wanted:
    """Raises InputError for anything other than JSON like {"led": 417, "exposure_us": 8000}."""
    try:
        return Wanted.model_validate_json(body)
    except ValidationError as error:
        problem = error.errors()[0]
        if not problem["loc"]:
            raise InputError(f'expected an object, like {{"led": 417}}: {problem["msg"]}') from error
        where = ".".join(map(str, problem["loc"]))
        raise InputError(f"{where}: expected a whole number: {problem['msg']}") from error


def choice_from(request: Wanted, before: Choice, leds: tuple[int, ...], longest_us: int) -> Choice:
    """Return a viewer's choice after checking it. Raises InputError for an LED or an exposure that the cell does
    not have."""
    led = request.led if "led" in request.model_fields_set else before.led
    exposure_us = request.exposure_us if "exposure_us" in request.model_fields_set else before.exposure_us
    if led is not None and led not in leds:
        raise InputError(f"led: expected one of the dome's, found {led!r}")
    if not 10 <= exposure_us <= longest_us:
        raise InputError(f"exposure_us: expected a whole number from 10 to {longest_us}, found {exposure_us!r}")
    return Choice(led, exposure_us)


def run_source(source: Source, studio: Studio, on_failure: Callable[[Exception], None]) -> threading.Thread:
    """Start a thread that fills the studio; `on_failure` is called with the error that ends it."""

    def work() -> None:
        try:
            source.frames(studio)
        except Exception as error:  # noqa: BLE001  passed to the thread that reports it
            on_failure(error)
            studio.closing.set()

    thread = threading.Thread(target=work, name="live", daemon=True)
    thread.start()
    return thread
