"""Follows a run by its journal: takes the samples of each view as soon as it is complete, and makes the result
after the last."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from coupole.errors import CoupoleError, reason
from coupole.reflectance.beside.first_look import write_normals
from coupole.reflectance.result_pages import run_reflectance_page
from coupole.reflectance.run_job import RunRequest, extract_beside, reflectance_of
from coupole.storage.discarding import NOT_YET, reason_to_keep, to_discard
from coupole.storage.journal import Follower
from coupole.storage.journal_events import FrameProven, SessionStopped, ViewBegun, ViewSealed
from coupole.storage.processing import PICTURE, Progress, Step, hold_result, tell
from coupole.storage.run import Run

_LOOK_EVERY_S = 0.2
_TELL_EVERY_S = 1.0
Say = Callable[[dict[str, Any]], object]


def process_run(folder: Path, result: Path, say: Say) -> bool:
    """Process a run into its result, while it is acquired and after it; True if the result is whole. `say` is
    given the progress, and `times` at the end. What fails is told, and what is there stays."""
    teller = _Teller(result, say)
    try:
        with hold_result(result):
            _Follower(Run(folder), result, teller).to_the_end()
    except (CoupoleError, OSError, MemoryError) as error:
        teller.fail(str(error) if isinstance(error, CoupoleError) else reason(error))
        return False
    except Exception as error:  # noqa: BLE001  a defect must not end without a word
        teller.fail(f"{type(error).__name__}: {error}. This is a defect of Coupole: please report it")
        return False
    return True


class _Teller:
    """Tells the progress in the result's folder and to whoever began the process, seldom enough."""

    def __init__(self, result: Path, say: Say) -> None:
        self._result, self.say = result, say
        self._progress = Progress()
        self._told_s = -_TELL_EVERY_S

    def tell(self, **changes: Any) -> None:
        """Tell it now."""
        self._progress = self._progress.model_copy(update=changes)
        self._told_s = time.monotonic()
        with contextlib.suppress(OSError):  # also when the result is whole, and the folder gone
            tell(self._result, self._progress)
        self.say({"progress": self._progress.model_dump()})

    def step(self, step: Step, **changes: Any) -> None:
        """Tell that another step begins."""
        self.tell(**{"step": step, "detail": "", "done_count": 0, "of": 0} | changes)

    def part(self, detail: str, done_count: int, of: int) -> None:
        """Tell how much of a part of the step is done, if nothing was told for a moment."""
        if detail != self._progress.detail or time.monotonic() - self._told_s > _TELL_EVERY_S:
            self.tell(detail=detail, done_count=done_count, of=of)

    def fail(self, why: str) -> None:
        self.step("failed", why=why)


class _Follower:
    """One run, and how far its result is."""

    def __init__(self, run: Run, result: Path, teller: _Teller) -> None:
        self._run, self._result, self._teller = run, result, teller
        self._journal = Follower(run.journal_path)
        self._taken: set[str] = set()
        """Views whose samples are there."""
        self._safe: dict[str, str] = {}
        """Digests of samples that were read back, of views of which is not told yet if they are discarded."""
        self._is_done = False
        """The newest session has ended with all frames."""
        self._last_frame = ""
        """Time of the newest proven frame, UTC."""

    def to_the_end(self) -> None:
        """Raises as `reflectance_of`."""
        self._teller.step("waiting", views=len(self._run.about["views"]))
        looks = True
        while True:
            looks |= self._read_news()
            if looks:
                self._offer_safe()
            if looks and not self._take_samples():
                if self._is_done:
                    break
                looks = False
            time.sleep(_LOOK_EVERY_S)
        samples_s = self._seconds_since_last_frame()
        self._teller.step("fitting")
        reflectance_of(RunRequest((self._run.folder,)), self._result, say=self._teller.part)
        run_reflectance_page.write(self._result)
        result_s = self._seconds_since_last_frame()
        self._teller.say(
            {"times": {"samples_after_last_frame_s": samples_s, "result_after_last_frame_s": result_s}}
        )

    def _read_news(self) -> bool:
        """Read what the journal has gained; True if a view may be complete by now."""
        looks = False
        for event in self._journal.news():
            match event:
                case FrameProven():
                    self._last_frame = event.t
                case SessionStopped():
                    self._is_done, looks = event.outcome == "done", True
                case ViewBegun() | ViewSealed():
                    looks = True
                case _:
                    pass
        return looks

    def _take_samples(self) -> bool:
        """Take the samples of the first complete view that lacks them; False if there is none."""
        remaining_views = [view for view in self._run.complete_views() if view not in self._taken]
        if not remaining_views:
            return False
        view = remaining_views[0]
        self._teller.step("extracting", detail=view)
        if digest := extract_beside(self._run.folder, view, self._result, self._teller.part):
            self._safe[view] = digest
        self._taken.add(view)
        if not self._is_done:
            with contextlib.suppress(OSError):  # a picture alone
                write_normals(self._result, view, self._result / PICTURE)
        self._teller.step("waiting", views_done=len(self._taken))
        return True

    def _offer_safe(self) -> None:
        """Tell the acquisition, which holds the run, of the frames that may be discarded now. What it does not do,
        because it has ended, is done when the result is made."""
        for view, digest in list(self._safe.items()):
            why = reason_to_keep(self._run, view)
            if why == NOT_YET:
                continue
            del self._safe[view]
            event = None if why else to_discard(self._run, view, self._result.resolve(), digest)
            self._teller.say(
                {"kept": view, "why": why} if event is None else {"discard": event.model_dump(mode="json")}
            )

    def _seconds_since_last_frame(self) -> float | None:
        """None if no frame's time is known."""
        if not self._last_frame:
            return None
        return round((datetime.now(UTC) - datetime.fromisoformat(self._last_frame)).total_seconds(), 3)
