"""Follows a run by its journal. It takes the samples of each view as soon as the view is complete. While it waits
for the next view, it makes a result of the views so far. After the last view it makes the final result."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

from coupole.errors import CoupoleError, reason
from coupole.preflight.machine import little_address_space, memory_behind
from coupole.reflectance.beside.growing import Growth, fit_so_far
from coupole.reflectance.beside.looking_ahead import look_ahead
from coupole.reflectance.beside.page_maker import PageMaker
from coupole.reflectance.beside.view_drawing import Drawing
from coupole.reflectance.light_paths import Ahead
from coupole.reflectance.result_pages import run_reflectance_page
from coupole.reflectance.run_job import RunRequest, extract_beside, reflectance_of
from coupole.storage.discarding import NOT_YET, reason_to_keep, to_discard
from coupole.storage.growing_pictures import GrowingPictures
from coupole.storage.journal import Follower
from coupole.storage.journal_events import FrameProven, SessionStopped, ViewBegun, ViewSealed
from coupole.storage.processing import Progress, Step, hold_result, tell
from coupole.storage.run import Run

_LOOK_EVERY_S = 0.2
_TELL_EVERY_S = 1.0
_FIRST_EARLY_LOOK = 32
"""Number of frames under LEDs at which a view is drawn for the first time. It is drawn again each time that this
number has doubled."""
_DEFECT = "this is a defect of Coupole: please report it"
_NONE_SO_FAR = "result so far and page to relight"
Say = Callable[[dict[str, Any]], object]
AtTheEnd = Callable[[Callable[[], None]], None]


def process_run(folder: Path, result: Path, say: Say, at_the_end: AtTheEnd, page_program: str = "") -> bool:
    """Process a run into its result, during its acquisition and after it; True if the result is complete. `say`
    receives the progress, and `times` at the end. `at_the_end` runs a function when all frames are there.
    `page_program` is the module that makes pages to relight. Failures are reported, and existing results stay."""
    teller = _Teller(result, say)
    try:
        with hold_result(result):
            follower = _Follower(Run(folder), result, teller, page_program)
            follower.until_all_frames_are_there()
            at_the_end(follower.make_result)
    except Exception as error:  # noqa: BLE001  a defect must not end without a word
        teller.fail(_words_on(error))
        return False
    return True


def _words_on(error: Exception) -> str:
    """Return why there is no result. An error is always reported, but it is not called a defect if memory ran
    short."""
    is_expected = isinstance(error, CoupoleError | OSError)
    words = reason(error) if is_expected else f"{type(error).__name__}: {error}"
    if shortage := memory_behind(error):
        return f"memory did not suffice: {shortage} ({words})"
    if is_expected:
        return words
    if limit_words := little_address_space(os.getpid()):
        return f"{words}. Unless the limit of memory is the cause, {_DEFECT} ({limit_words})"
    return f"{words}. T{_DEFECT[1:]}"


class _ViewsCameError(Exception):
    """Ends a result of the views so far, because there are more views now."""


class _Teller:
    """Reports the progress to the result's folder and to the parent process, at a limited rate."""

    def __init__(self, result: Path, say: Say) -> None:
        self._result, self.say = result, say
        self._progress = Progress()
        self._told_s = -_TELL_EVERY_S

    def tell(self, **changes: Any) -> None:
        """Report it now."""
        self._progress = self._progress.model_copy(update=changes)
        self._told_s = time.monotonic()
        with contextlib.suppress(OSError):  # also when the result is whole, and the folder gone
            tell(self._result, self._progress)
        self.say({"progress": self._progress.model_dump()})

    def step(self, step: Step, **changes: Any) -> None:
        """Report that another step begins."""
        self.tell(**{"step": step, "detail": "", "done_count": 0, "of": 0} | changes)

    def part(self, detail: str, done_count: int, of: int) -> None:
        """Report the progress of the step, unless something was reported a moment ago."""
        if detail != self._progress.detail or time.monotonic() - self._told_s > _TELL_EVERY_S:
            self.tell(detail=detail, done_count=done_count, of=of)

    def fail(self, why: str) -> None:
        self.step("failed", why=why)


class _Follower:
    """One run, and the progress of its result."""

    def __init__(self, run: Run, result: Path, teller: _Teller, page_program: str) -> None:
        self._run, self._result, self._teller = run, result, teller
        growing = GrowingPictures(result, is_simulated=run.is_simulated)
        self._drawing = Drawing(result, growing, run.expected_views)
        self._drawing.forget_early_look()
        self._page = PageMaker(page_program, growing, run.expected_views)
        self._request, self._ahead = RunRequest((run.folder,)), Ahead()
        self._journal = Follower(run.journal_path)
        self._taken: set[str] = set()
        """Views whose samples are there."""
        self._safe: dict[str, str] = {}
        """Digests of samples that were read back, by view, until it is known whether the view's frames are
        discarded."""
        self._is_done = False
        """True if the newest session has ended with all frames."""
        self._last_frame = ""
        """Time of the newest proven frame, UTC."""
        self._looks = True
        """True if a view may have become complete since the last look."""
        self._newest_view, self._begun_view = "", ""
        """View of the newest proven frame; and the view whose visible surface is to be computed next, or an empty
        text."""
        self._arrived, self._next_early_look = 0, _FIRST_EARLY_LOOK
        """Proven frames under LEDs of the newest view, and their number at which the view is drawn next."""
        self._tried_views: tuple[str, ...] = ()
        """Views of the newest partial result that was made or tried."""
        self._may_give_up = True
        """True if the newest result of the views so far was not abandoned, so that the next one may be
        abandoned."""

    def until_all_frames_are_there(self) -> None:
        """Take samples, look ahead and make results so far while the run goes on. Raises as `reflectance_of`."""
        why_none = _why_none_so_far(self._run)
        self._teller.step("waiting", views=self._run.expected_views, undrawn=why_none)
        self._read_news()
        try:
            while not self._is_done:
                self._draw("page to relight", self._page.look)
                if self._looks:
                    self._offer_safe()
                    if not self._take_samples():
                        self._looks = False
                elif not (self._look_ahead() or self._look_early() or self._grow()):
                    time.sleep(_LOOK_EVERY_S)
                self._read_news()
        finally:
            self._page.end()

    def make_result(self) -> None:
        """Take the samples that remain, and make the result. Raises as `reflectance_of`."""
        self._offer_safe()
        while self._take_samples():
            self._offer_safe()
        samples_s = self._seconds_since_last_frame()
        self._teller.step("fitting", views=self._run.expected_views)
        reflectance_of(self._request, self._result, say=self._teller.part, ahead=self._ahead)
        run_reflectance_page.write(self._result)
        result_s = self._seconds_since_last_frame()
        self._teller.say(
            {"times": {"samples_after_last_frame_s": samples_s, "result_after_last_frame_s": result_s}}
        )

    def _read_news(self) -> None:
        """Read the new lines of the journal, and note whether a view may now be complete."""
        for event in self._journal.news():
            match event:
                case FrameProven():
                    self._last_frame = event.t
                    if event.shot.is_shot and event.shot.view != self._newest_view:
                        self._begun_view = self._newest_view = event.shot.view
                        self._arrived, self._next_early_look = 0, _FIRST_EARLY_LOOK
                    self._arrived += event.shot.is_shot
                case SessionStopped():
                    self._is_done, self._looks = event.outcome == "done", True
                case ViewBegun() | ViewSealed():
                    self._looks = True
                case _:
                    pass

    def _take_samples(self) -> bool:
        """Take the samples of the first complete view without samples; False if there is no such view."""
        remaining_views = self._remaining_views()
        if not remaining_views:
            return False
        view = remaining_views[0]
        self._teller.step("extracting", detail=view)
        if digest := extract_beside(self._run.folder, view, self._result, self._teller.part):
            self._safe[view] = digest
        self._taken.add(view)
        if not self._is_done and self._has_samples(view):
            self._draw("page to relight", self._page.look)
            self._draw(f"pictures of {view}", partial(self._drawing.first_look, view))
        self._teller.step("waiting", views_done=len(self._taken), views=self._run.expected_views)
        return True

    def _draw(self, subject: str, draw: Callable[[], None]) -> None:
        """Draw pictures that are only looked at. The result does not need them, so a failure is only reported."""
        try:
            draw()
        except Exception as error:  # noqa: BLE001  of a picture alone
            self._teller.tell(undrawn=f"{subject}: {reason(error)}")

    def _remaining_views(self) -> list[str]:
        return [view for view in self._run.complete_views() if view not in self._taken]

    def _look_ahead(self) -> bool:
        """Compute what the samples of the present view need besides its frames, once, while they arrive; False if
        there is nothing to do. It ends when a view is complete."""
        if not self._begun_view or self._begun_view in self._taken:
            return False
        view, self._begun_view = self._begun_view, ""
        with contextlib.suppress(CoupoleError, OSError):  # found, and told, when its samples are taken
            look_ahead(self._run.folder, view, self._ahead, self._may_look_ahead)
        if not self._may_look_ahead():  # the rest of it waits for the samples of complete views
            self._begun_view = self._begun_view or view
        return True

    def _may_look_ahead(self) -> bool:
        self._read_news()
        return not self._looks or not (self._is_done or self._remaining_views())

    def _look_early(self) -> bool:
        """Draw the newest view from some of its frames while the others arrive, each time that it has twice as
        many; False if there is nothing to do. It is abandoned when a view is complete. A run that discards frames
        has no such look, because preflight has not counted the disk space of its samples."""
        view = self._newest_view
        if view in self._taken or self._arrived < self._next_early_look or self._run.discards:
            return False
        self._next_early_look = 2 * self._arrived

        def go_on(_detail: str, _done_count: int, _of: int) -> None:
            if not self._may_look_ahead():
                raise _ViewsCameError

        def draw() -> None:
            with contextlib.suppress(_ViewsCameError):
                self._drawing.early_look(self._run.folder, view, go_on)

        self._draw(f"pictures of {view}", draw)
        return True

    def _grow(self) -> bool:
        """Make a result of the views so far, if it has more views than the newest one; False if there is nothing
        to do. None is made if LEDs are chosen in the run, because the left-out LEDs change with them. When the
        next view is complete, this result is abandoned, but not twice in succession. Otherwise no result would
        ever be made if views are short.
        """
        if self._run.is_open:
            return False
        of = self._run.expected_views
        views = tuple(view for view in self._run.views if self._has_samples(view))
        if not 0 < len(views) < of or views == self._tried_views:
            return False
        self._tried_views = views
        growth = Growth.of_views(self._run.folder, self._result.resolve(), views, of)
        changes: dict[str, Any] = {}
        try:
            if not growth.has_room():
                self._teller.tell(undrawn=_why_none_so_far(self._run) or f"{_NONE_SO_FAR}: the disk has no room")
                return True
            self._teller.step("growing")
            fit_so_far(growth, self._request.memory_bytes, self._part_of_growth, self._ahead)
            self._may_give_up, changes = True, {"fitted_views": len(views)}
            self._page.want(growth.folder, len(views))
            self._draw(f"pictures of {len(views)} views", self._draw_so_far(growth.folder))
        except _ViewsCameError:
            self._may_give_up = False
        except Exception as error:  # noqa: BLE001  the result at the end comes to it again
            changes = {"detail": f"no result of {len(views)} views ({reason(error)})"}
        self._teller.step("waiting", **changes)
        return True

    def _draw_so_far(self, folder: Path) -> Callable[[], None]:
        def is_wanted() -> bool:
            self._read_news()
            return not (self._is_done or (self._looks and self._remaining_views()))

        return partial(self._drawing.so_far, folder, is_wanted)

    def _has_samples(self, view: str) -> bool:
        """Tell whether the view has samples; False also for a view that has only dark frames or panels."""
        return view in self._taken and (self._result / "samples" / f"{view}.json").exists()

    def _part_of_growth(self, detail: str, done_count: int, of: int) -> None:
        self._read_news()
        if self._is_done or (self._may_give_up and self._looks and self._remaining_views()):
            raise _ViewsCameError
        self._teller.part(detail, done_count, of)

    def _offer_safe(self) -> None:
        """Tell the acquisition, which holds the run's lock, which frames may be discarded now. If the acquisition
        has ended before it discards them, they are discarded when the result is made."""
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
        """Return the seconds since the last frame; None if no frame's time is known."""
        if not self._last_frame:
            return None
        return round((datetime.now(UTC) - datetime.fromisoformat(self._last_frame)).total_seconds(), 3)


def _why_none_so_far(run: Run) -> str:
    """Return why a run will have no result of the views so far; empty if it may have one."""
    if run.is_open:
        return f"{_NONE_SO_FAR}: the run chooses its frames"
    return f"{_NONE_SO_FAR}: the plan discards frames" if run.discards else ""
