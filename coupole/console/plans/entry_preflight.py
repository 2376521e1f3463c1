"""Preflight of entries of the queue, in a separate process, which reports its progress for the people who wait."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

from coupole.console.processes.warm_process import WarmProcess, say
from coupole.errors import CoupoleError, InputError, PreflightRefused, Problem
from coupole.preflight.files import Files, check_files
from coupole.storage.line_file import utc_now

AT_MOST_S = 1500.0
"""Longest duration, s; less than the command line waits (`client.PREFLIGHT_S`)."""
BESIDE_A_RUN = 5
"""Niceness during a run: about a third of the time of a core that run and preflight both need. A higher value
would starve the preflight on a busy machine. Bursts do not wait for the preflight, because the box fires by
itself."""


@dataclass(frozen=True)
class Found:
    """Result of a preflight."""

    problems: tuple[Problem, ...] = ()
    """Mistakes in the files, or refusals; if there are any, nothing can be run."""
    document: dict[str, Any] = field(default_factory=dict)
    """Figures, as in `coupole check --json`."""
    exit_code: int = InputError.exit_code
    """Exit code of `coupole check`, if there are problems."""


def check_entry(files: Files, *, measure: bool) -> Found:
    """Make the preflight of files; mistakes in them are in `problems`."""
    from coupole.viewing.preflight_table import document_of

    name = str(files.resume or files.plan)
    try:
        report = check_files(files, measure=measure, say=say)[1]
    except InputError as error:
        return Found(problems=tuple(error.problems) or (Problem(name, 0, 0, "", str(error)),))
    except CoupoleError as error:
        return Found(problems=(Problem(name, 0, 0, "", str(error)),), exit_code=error.exit_code)
    problems = tuple(Problem(name, 0, 0, "", refusal) for refusal in report.refusals)
    return Found(problems, document_of(report), PreflightRefused.exit_code)


class EntryPreflight:
    """The process that makes a preflight, and its present work."""

    def __init__(self) -> None:
        self._process = WarmProcess("makes preflight")
        self._for = ""

    @property
    def words(self) -> str:
        """Text about the present check: its plan, the person who entered it, its begin and its progress; empty if
        there is no check.
        """
        if not (subject := self._for):
            return ""
        return f"{subject}: {self._process.step or 'it begins'}"

    def of(self, files: Files, by: str, *, beside_a_run: bool) -> Found:
        """Return the result of the preflight of files. Raises InputError if it takes too long or is given up, or
        if its process dies."""
        with self._with_words(f"{(files.resume or files.plan).name}, entered by {by} at {utc_now()[11:19]} UTC"):
            niceness = BESIDE_A_RUN if beside_a_run else 0
            return self._process.run(check_entry, AT_MOST_S, niceness, files, measure=not beside_a_run)

    @contextlib.contextmanager
    def _with_words(self, words: str) -> Iterator[None]:
        self._for = words
        try:
            yield
        finally:
            self._for = ""

    def give_up(self) -> None:
        """End the present check; its plan or run is not entered. Raises InputError if nothing is being checked."""
        if not self._for:
            raise InputError("no preflight is being made")
        self._process.end()

    def close(self) -> None:
        """End the process."""
        self._process.end()
