"""The order of a still camera's files, proven by the numbers in their names."""

from __future__ import annotations

import re
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from coupole.errors import DeviceFault, DeviceLost

_NUMBER = re.compile(r"(\d+)$")


def file_number(path: Path, device: str, last_number: int) -> int:
    """Return the trailing digits of a file's name: 42 for `IMG_0042.CR2`. Raises DeviceFault if there are none."""
    digits = _NUMBER.search(path.stem)
    number = int(digits[1]) if digits else 0
    if not 1 <= number <= last_number:
        raise DeviceFault(
            device,
            expected=f"a name that ends in a number from 1 to {last_number}, as in IMG_0042.CR2",
            happened=f"a file is called {path.name}",
            remedy="Let the camera name its files, and keep others out of the folder.",
        )
    return number


@dataclass(frozen=True)
class _Seen:
    """A file that is not taken yet."""

    size: int
    first_s: float
    """Machine time at which the file was found."""
    still_s: float
    """Machine time of the last change of its size."""


class Order:
    """Finds the next file. Call `begin`, then `next` and `take` in turn."""

    def __init__(self, folder: Path, suffixes: Sequence[str], last_number: int, device: str) -> None:
        self._folder, self._suffixes = folder, frozenset(suffix.lower() for suffix in suffixes)
        self._last_number, self._device = last_number, device
        self._old: frozenset[Path] = frozenset()
        self._taken: set[Path] = set()
        self._waiting: dict[Path, _Seen] = {}
        self._last: int | None = None
        self.counted = self.taken = 0
        """Number of file numbers passed since `begin`, and number of files taken."""

    def files(self) -> list[Path]:
        """Return all RAW files of the folder. Raises DeviceLost if it cannot be read."""
        try:
            return [path for path in self._folder.iterdir() if path.suffix.lower() in self._suffixes]
        except OSError as error:
            raise DeviceLost(
                self._device,
                expected=f"the folder {self._folder}",
                happened=str(error),
                remedy="Check the disk or network drive, then resume the run.",
            ) from error

    def begin(self) -> None:
        """Begin a burst. Files already present do not belong to it; the newest of them gives the next number."""
        files = self.files()
        self._old, self._taken, self._waiting = frozenset(files), set(), {}
        newest = max(files, key=lambda path: path.stat().st_mtime_ns, default=None)
        self._last = None if newest is None else self._number(newest)
        self.counted = self.taken = 0

    def _number(self, path: Path) -> int:
        return file_number(path, self._device, self._last_number)

    def _steps(self, path: Path) -> int:
        """Distance of this file's number from the last one, 1 for the next."""
        last = self._before_first() if self._last is None else self._last
        steps = (self._number(path) - last) % self._last_number
        if not 1 <= steps <= self._last_number // 2:
            raise DeviceFault(
                self._device,
                expected=f"the files after number {last}, in their order",
                happened=f"{path.name} came after it",
                remedy="A picture came too late, or came twice: increase `patience_s` in the rig, then resume "
                "the run.",
            )
        return steps

    def _before_first(self) -> int:
        """Return the number before the first file that has arrived, if no number was known at the start of the
        burst.

        A file that arrives later with an earlier number is refused.
        """
        numbers = [self._number(path) for path in self._waiting]
        half = self._last_number // 2
        earliest = (a for a in numbers if all((b - a) % self._last_number <= half for b in numbers))
        first = next(earliest, numbers[0])  # numbers[0]: there is no earliest, and the others will be refused
        return (first - 2) % self._last_number + 1

    def next(self, still_s: float, patience_s: float) -> Path | None:
        """Return the next file, once its size has not changed for `still_s`; None if there is none yet.

        A missing number is skipped after a later file has waited for `patience_s`. Raises DeviceFault for a file
        that arrives after a later one, and for two files with one number.
        """
        self._look()
        waiting = sorted((self._steps(path), path) for path in self._waiting)
        if not waiting:
            return None
        if len({steps for steps, _ in waiting}) < len(waiting):
            raise DeviceFault(
                self._device,
                expected="one file for each number",
                happened="these came: " + ", ".join(sorted(path.name for _, path in waiting)),
                remedy="Let the camera write one RAW file per picture, and only one program fetch it.",
            )
        steps, path = waiting[0]
        sighting, now_s = self._waiting[path], time.monotonic()
        patient = steps > 1 and now_s - sighting.first_s < patience_s
        return None if patient or now_s - sighting.still_s < still_s else path

    def _look(self) -> None:
        now_s = time.monotonic()
        sightings: dict[Path, _Seen] = {}
        for path in self.files():
            if path in self._old or path in self._taken:
                continue
            try:
                size = path.stat().st_size
            except FileNotFoundError:  # the tethering program has just renamed it
                continue
            before = self._waiting.get(path)
            if before is None or before.size != size or not size:
                sightings[path] = _Seen(size, now_s if before is None else before.first_s, now_s)
            else:
                sightings[path] = before
        self._waiting = sightings

    def take(self, path: Path) -> None:
        """Mark `path`, which `next` returned, as taken."""
        self.counted += self._steps(path)
        self.taken += 1
        self._last = self._number(path)
        self._taken.add(path)
        del self._waiting[path]
