"""The acquisition's part of the processing beside it: begins its process, listens to its progress, and ends it.

The process has the lowest priority and reads only the run's folder (`coupole.reflectance.beside`). Here a thread
waits for its lines, at most about one a second. The sequencer does not know of the process. If the process fails,
the acquisition goes on and says so.
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rich.console import Console

from coupole.acquisition.discarder import Discarder
from coupole.acquisition.signals import SignalReceived
from coupole.bounded import run_bounded
from coupole.errors import CoupoleError, InputError
from coupole.intake.plain_data import json_of
from coupole.preflight.discard_room import DiscardRoom
from coupole.preflight.machine import little_address_space
from coupole.storage.journal_events import FramesDiscarded
from coupole.storage.processing import Progress, default_result, go_on_command, tell
from coupole.storage.run import Run
from coupole.storage.run_status import is_complete
from coupole.storage.so_far import LINK
from coupole.storage.stopped_process import cpu_time_s, is_stopped
from coupole.viewing.terminal import alarm, step_bars

_PROGRAM = "coupole.reflectance.beside.process"
_PAGE_PROGRAM = "coupole.exchange.look.page_beside"
_READY_WITHIN_S = 120.0
"""Longest wait for the first answer: the process needs less time for its imports, even on a busy machine."""
_TOLD_AFTER_S = 1.0
_NOTHING_SAID, _NO_MEMORY = "its process ended without a message", "memory did not suffice"
_SILENT_S, _LEAST_CPU_S = 120.0, 1.0
"""A process hangs if, with all frames there, it reports nothing and computes nothing for this time."""
_IDLE_S = 20.0
"""A process that waits this long for a complete view, and finds none, will find none."""
_LOOK_EVERY_S, _ENDS_WITHIN_S = 0.5, 5.0
Say = Callable[[str, int, int], None]


class ProcessingBeside:
    """One run's processing, in a process of its own."""

    def __init__(
        self, plan: Path, rig: Path, result: Path | None, console: Console, *, resumed_run: Path | None = None
    ) -> None:
        """Begin the process. It checks whether plan and rig can have a result. `result` is the result's folder;
        None is a folder beside the run's folder. That folder must be empty, unless it holds the earlier result of
        a resumed run."""
        self._console, self._result = console, None if result is None else result.absolute()
        self._run: Path | None = None
        self._progress = Progress()
        self._times: dict[str, float | None] = {}
        self._reasons: list[str] | None = None
        self._has_answered = threading.Event()
        self._told = threading.Event()
        self._discarder: Discarder | None = None
        """Set while a session lasts whose frames are discarded."""
        self._heard_s, self._cpu_at_s = 0.0, 0.0
        """Monotonic time of the newest line, and the CPU time that the process had used by then."""
        self._has_ended = threading.Event()
        self._is_ending = False
        self._why = ""
        """Known reason why the result is not complete."""
        self._shortage = ""
        """Sentence on the limit of the process's memory, if it has ended under a limit that is too low."""
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115  closed with the process
        self._process = subprocess.Popen(
            [sys.executable, "-m", _PROGRAM, str(os.getpid())],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            process_group=0,  # Ctrl-C and Ctrl-Z at the terminal are for the acquisition
        )
        result_text = None if self._result is None else str(self._result)
        run_text = None if resumed_run is None else str(resumed_run.resolve())
        self._ask(
            {"plan": str(plan.absolute()), "rig": str(rig.absolute()), "result": result_text, "run": run_text}
        )
        self._listener = threading.Thread(target=self._listen, name="processing beside", daemon=True)
        self._listener.start()

    def __enter__(self) -> ProcessingBeside:
        return self

    def __exit__(self, *_: object) -> None:
        """End the process if it has not ended. Its results are kept."""
        if self._end() and self._run is not None:
            self._say_stopped(self._run)
        assert self._process.stdin is not None
        with contextlib.suppress(OSError):
            self._process.stdin.close()
        self._listener.join(_ENDS_WITHIN_S)
        self._errors.close()

    # -- before anything moves --------------------------------------------------------------------------------

    def refusals(self) -> list[str]:
        """Return the reasons why a result cannot be made. Call it before anything moves."""
        if not self._has_answered.wait(_TOLD_AFTER_S):
            self._console.print("reflectance: checking plan, mesh and records ...", markup=False)
        if not self._has_answered.wait(_READY_WITHIN_S):
            return [f"--reflectance: its process gave no answer within {_READY_WITHIN_S:g} s"]
        if why := self._shortage or self._shortage_now():
            return [f"--reflectance: {_NO_MEMORY}: {why}"]
        if self._reasons is None:
            return [f"--reflectance: its process ended: {self._last_words}"]
        return self._reasons

    # -- while the run is acquired ----------------------------------------------------------------------------

    def result_of(self, run: Path) -> Path:
        """Return the folder of a run's result."""
        return self._result or default_result(run)

    def follow(self, run: Path) -> None:
        """Process this run from now on."""
        self._run, self._result = run, self.result_of(run)
        self._console.print(f"reflectance {self._result}", markup=False)
        with contextlib.suppress(OSError):  # what an earlier session left there is over
            tell(self._result, Progress())
        self._ask({"run": str(run), "result": str(self._result), "page_program": _PAGE_PROGRAM})

    def discard(
        self, run: Run, note: Callable[[FramesDiscarded], None], room: DiscardRoom
    ) -> Callable[[str], bool]:
        """Discard frames of this session's run when their samples are safe, as its plan says; `note` writes the
        event to the journal on the disk. Returns the function that tells whether there is room for a view."""
        self._discarder = discarder = Discarder(run, note, room, self._console)
        waited_for_view = ""

        def has_room(view: str) -> bool:
            nonlocal waited_for_view
            if view != waited_for_view:  # its process gets the time that it may be silent anew
                waited_for_view = view
                self._heard_s, self._cpu_at_s = time.monotonic(), self._cpu_s()
            return discarder.has_room(view, self._why_no_more)

        return has_room

    def end_session(self) -> None:
        """Prepare for the end of the session, which is about to give up the run. The process that makes the result
        discards the rest."""
        if self._discarder is not None:
            discarder, self._discarder = self._discarder, None
            discarder.end()

    def _why_no_more(self) -> str:
        """Return why no more frames will be discarded. The text is empty while some may still be discarded."""
        if self._has_ended.is_set():
            return f"the processing has ended ({self._reason})"
        if is_stopped(self._process.pid):
            return f"its process {self._process.pid} is stopped (SIGSTOP)"
        silent_s = time.monotonic() - self._heard_s
        if self._progress.step == "waiting" and silent_s > _IDLE_S:
            return "all complete views were processed"
        if silent_s > _SILENT_S and self._cpu_s() - self._cpu_at_s < _LEAST_CPU_S:
            return f"its process did nothing for {_SILENT_S:g} s"
        return ""

    # -- after the last frame ---------------------------------------------------------------------------------

    def wait(self) -> None:
        """Wait for the result, after all frames are there and no device is open. A signal ends the process, and
        then the command. The run stays complete. A result that fails changes no exit code: it tells of the
        frames."""
        if self._run is None:
            return
        try:
            with step_bars(self._console) as say:
                self._wait_for_end(say)
        except (KeyboardInterrupt, SignalReceived):
            self._end()
            self._say_stopped(self._run)
            raise
        if self._is_whole:
            self._console.print(f"  result  {self._result}", markup=False)
        else:
            self._say_unfinished()

    def figures(self) -> dict[str, Any]:
        """Return the content of `reflectance` in `--json`."""
        if self._run is None:
            return {}
        return {
            "result": str(self._result),
            "is_whole": self._is_whole,
            "views": self._progress.views_done,
            "why": "" if self._is_whole else self._reason,
            **self._times,
        }

    # -- helpers ----------------------------------------------------------------------------------------------

    def _wait_for_end(self, say: Say) -> None:
        heard_s, cpu_s = time.monotonic(), self._cpu_s()
        while not self._has_ended.wait(_LOOK_EVERY_S):
            progress = self._progress
            if self._told.is_set():
                self._told.clear()
                heard_s, cpu_s = time.monotonic(), self._cpu_s()
                if progress.of:
                    say(progress.detail, progress.done_count, progress.of)
            if is_stopped(self._process.pid):
                self._give_up(f"its process {self._process.pid} is stopped (SIGSTOP), and was ended")
            elif time.monotonic() - heard_s > _SILENT_S:
                if self._cpu_s() - cpu_s < _LEAST_CPU_S:
                    self._give_up(f"its process did nothing for {_SILENT_S:g} s, and was ended")
                heard_s, cpu_s = time.monotonic(), self._cpu_s()

    def _give_up(self, why: str) -> None:
        self._end()
        self._why = why
        self._leave_word()

    def _cpu_s(self) -> float:
        return cpu_time_s(self._process.pid)

    @property
    def _is_whole(self) -> bool:
        return self._has_ended.is_set() and self._process.returncode == 0

    @property
    def _views_text(self) -> str:
        return f"{self._progress.views_done} of {self._progress.views} views"

    @property
    def _reason(self) -> str:
        """Return why the process has ended. The reason that the process itself gives counts; a limit of memory is
        named as the cause only if the process gave none."""
        if why := self._why or self._progress.why:
            return why
        words = self._last_words
        if not self._shortage:
            return words
        said_nothing = (self._process.returncode or 0) < 0 or words == _NOTHING_SAID or "MemoryError" in words
        return f"{_NO_MEMORY}: {self._shortage} ({words})" if said_nothing else f"{words} ({self._shortage})"

    def _say_stopped(self, run: Path) -> None:
        """Say what is kept after a stop, and what goes on with it."""
        if _is_known_to_be_complete(run):
            self._why = "stopped while it was made"
            self._say_unfinished()
            return
        self._why = "the processing ended with the run, which is not complete"
        self._console.print(
            f"reflectance: the processing ended with the run; the samples of {self._views_text} are kept "
            "until the run is resumed",
            markup=False,
        )

    def _say_unfinished(self) -> None:
        assert self._run is not None
        assert self._result is not None
        alarm(
            f"  the frames are complete; their result is not: {self._reason}\n"
            f"  goes on from what is there ({self._views_text}): {go_on_command(self._run, self._result)}"
        )

    def _ask(self, document: dict[str, Any]) -> None:
        assert self._process.stdin is not None
        with contextlib.suppress(OSError):  # it has ended, as its listener tells
            self._process.stdin.write(json.dumps(document).encode() + b"\n")
            self._process.stdin.flush()

    def _listen(self) -> None:
        """Listen to all lines until the process has ended. This runs in a thread of its own."""
        assert self._process.stdout is not None
        with self._process.stdout as lines:
            for line in lines:
                with contextlib.suppress(InputError, ValueError):
                    self._hear(json_of(line, _PROGRAM))
        self._shortage = self._shortage_now()
        self._process.wait()
        self._has_answered.set()
        self._has_ended.set()
        if self._process.returncode and self._run is not None and not self._is_ending:
            self._tell_of_failure()

    def _hear(self, document: Any) -> None:
        self._heard_s, self._cpu_at_s = time.monotonic(), self._cpu_s()
        discarder = self._discarder
        if "discard" in document and discarder is not None:
            discarder.ask(FramesDiscarded.model_validate(document["discard"]))
        elif "kept" in document and discarder is not None:
            discarder.keep(str(document["kept"]), str(document["why"]))
        elif "reasons" in document:
            self._reasons = list(map(str, document["reasons"]))
            self._has_answered.set()
        elif "times" in document:
            self._times = document["times"]
        elif "progress" in document:
            before, self._progress = self._progress, Progress.model_validate(document["progress"])
            self._told.set()
            if self._progress.views_done != before.views_done:
                self._console.print(f"reflectance: samples of {self._views_text} are there", markup=False)
            if self._progress.fitted_views != before.fitted_views:
                self._say_grown()

    def _say_grown(self) -> None:
        assert self._result is not None
        count, of = self._progress.fitted_views, self._progress.views
        self._console.print(f"reflectance so far, from {count} of {of} views: {self._result / LINK}", markup=False)

    def _tell_of_failure(self) -> None:
        self._leave_word()
        alarm(
            f"reflectance failed: {self._reason.rstrip('.')}. The acquisition continues without it; "
            f"the samples of {self._views_text} are kept"
        )

    def _shortage_now(self) -> str:
        """Return a sentence on the limit of the process's memory, before the process is waited for; empty if the
        limit is high enough."""
        return little_address_space(self._process.pid)

    def _leave_word(self) -> None:
        """Write why the process has ended, for those who only see the folder of the result."""
        assert self._result is not None
        with contextlib.suppress(OSError):
            tell(self._result, self._progress.model_copy(update={"why": self._reason}))

    @property
    def _last_words(self) -> str:
        """Return why the process ended, as far as this is known."""
        code = self._process.returncode
        if code is not None and code < 0:
            return f"its process was killed by signal {-code}" + (" (memory was short?)" if code == -9 else "")
        if self._errors.closed:
            return "its process ended"
        self._errors.seek(0)
        lines = self._errors.read().decode(errors="replace").strip().splitlines()
        return lines[-1] if lines else _NOTHING_SAID

    def _end(self) -> bool:
        """End the process; False if it had ended."""
        if self._has_ended.is_set():
            return False
        self._is_ending = True
        self._process.kill()  # every file of a result is whole or not there
        self._has_ended.wait(_ENDS_WITHIN_S)
        return True


def _is_known_to_be_complete(run: Path) -> bool:
    """Tell whether all frames of a run are there. False if its disk gives no answer: this must hide no other
    error."""
    with contextlib.suppress(CoupoleError, OSError):
        return run_bounded(lambda: is_complete(run))
    return False
