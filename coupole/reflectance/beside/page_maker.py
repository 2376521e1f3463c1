"""Begins a separate program that makes the page to relight from the newest result of the views so far.

The program has the priority of this process, and ends with it. It runs while samples of the next view are taken.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import IO

from coupole.errors import StorageError
from coupole.storage.growing_pictures import GrowingPictures, PageSoFar
from coupole.storage.line_file import utc_now

_ENDS_WITHIN_S = 5.0


@dataclass
class PageMaker:
    """Makes one page at a time."""

    program: str
    """Module that is run as `python -m PROGRAM PARENT RESULT PAGE`; empty if no pages are made."""
    growing: GrowingPictures
    views: int
    """Views of the plan."""
    _next_source: tuple[Path, int] | None = None
    """Result from which the next page is made, and the number of its views."""
    _page: PageSoFar | None = None
    """Page that the process makes."""
    _process: subprocess.Popen[bytes] | None = None
    _errors: IO[bytes] = field(default_factory=BytesIO)
    """Its stderr."""

    def want(self, result: Path, fitted_views: int) -> None:
        """Make a page of this result, as soon as the page before is complete."""
        if self.program:
            self._next_source = result, fitted_views

    def look(self) -> None:
        """Show a page that is complete, and begin the next one. It does not wait. Raises OSError; StorageError if
        a page could not be made."""
        if self._process is not None:
            if self._process.poll() is None:
                return
            code, self._process = self._process.returncode, None
            with self._errors:
                if code != 0 or self._page is None:
                    raise StorageError(self._last_words(code))
            self.growing.put_page(self._page)
        if self._next_source is not None:
            (result, fitted_views), self._next_source = self._next_source, None
            name = self.growing.new_page()
            self._page = PageSoFar(file=name, fitted_views=fitted_views, views=self.views, t=utc_now())
            self._errors = tempfile.TemporaryFile()  # noqa: SIM115  closed when the program has ended
            self._process = subprocess.Popen(
                [
                    sys.executable,
                    "-m",
                    self.program,
                    str(os.getpid()),
                    str(result),
                    str(self.growing.folder / name),
                ],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,  # the lines of this process are for the acquisition
                stderr=self._errors,
            )

    def _last_words(self, code: int) -> str:
        if code < 0:
            return f"its process was killed by signal {-code}"
        self._errors.seek(0)
        lines = self._errors.read().decode(errors="replace").strip().splitlines()
        return lines[-1] if lines else f"its process ended with code {code}"

    def end(self) -> None:
        """End the process that makes a page."""
        self._next_source = None
        if self._process is not None:
            self._process.kill()
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(_ENDS_WITHIN_S)
            self._process = None
        self._errors.close()
