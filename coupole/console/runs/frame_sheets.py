"""Contents of a run's contact sheets and dome pictures: its frames by view, light and exposure, the brightness of
each, and the position of each LED."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coupole.console.runs.run_files import RunFiles
from coupole.errors import CoupoleError, InputError
from coupole.intake.plain_data import read_json
from coupole.plan.cell import Cell, read_cell
from coupole.plan.shot_id import Dark, Led, ShotId
from coupole.storage.durable import make_folder
from coupole.storage.view_reader import View

_MOST_PAIRS = 256
"""Greatest number of pairs of rows that are read for the mean of a frame."""
_KEPT_EVERY = 100


@dataclass(frozen=True)
class SheetFrame:
    """A proven frame on a contact sheet."""

    shot: str
    light: str
    """Name of the light for people: `LED 417`, `dark 3`."""
    led: int | None
    """Id of the LED in the dome's table; None for a panel, and without light."""
    exposure: int
    """Index into the plan's exposures."""
    exposure_us: int


@dataclass(frozen=True)
class LedPlace:
    """Direction of an LED, seen from the support's centre."""

    azimuth_deg: float
    """Azimuth about the support's z axis, from its x axis."""
    elevation_deg: float
    """Elevation above the support's plane."""


class FrameSheets:
    """Frames of all runs of a cell, and their means; a mean is computed once and stored."""

    def __init__(self, runs: RunFiles, folder: Path) -> None:
        """`folder`: for the stored means."""
        self._runs, self._folder = runs, folder
        self._reading = threading.Lock()
        self._places: dict[str, dict[int, LedPlace]] = {}

    def frames(self, name: str, view: str) -> list[SheetFrame]:
        """Return the proven frames of a view: by LED, then panels, then frames without light. Raises InputError,
        StorageError."""
        proven = {shot: event for shot, event in self._runs.proven(name).items() if shot.view == view}
        if not proven:
            return []
        exposures = self._runs.view(name, list(proven.values())).records["exposure_us"]
        return [
            SheetFrame(
                str(shot),
                _words(shot),
                shot.light.id if isinstance(shot.light, Led) else None,
                shot.label.exposure,
                int(exposures[event.index]),
            )
            for shot, event in sorted(proven.items(), key=lambda entry: _order(entry[0]))
        ]

    def places(self, name: str) -> dict[int, LedPlace]:
        """Return the directions of all LEDs of the run's own table, by id. Raises InputError."""
        if name not in self._places:
            self._places[name] = places_in(read_cell(self._runs.run(name).rig_path))
        return self._places[name]

    def known_means(self, name: str, shots: Sequence[str]) -> dict[str, float]:
        """Return the results of `means` that are stored already. Raises InputError, StorageError."""
        known_means, proven = self._stored_means(name), self._runs.proven(name)
        mean_of_shot = {
            shot: known_means.get(proven[shot_id].xxh3)
            for shot in shots
            if (shot_id := ShotId.parse(shot)) in proven
        }
        return {shot: mean for shot, mean in mean_of_shot.items() if mean is not None}

    def means(self, name: str, shots: Sequence[str], tell: Callable[[int, int], object]) -> dict[str, float]:
        """Return the mean above black of each of these proven frames of one view, as a share of full scale. At
        most 256 pairs of rows are read. `tell` is called with the number of read frames and of all frames. Raises
        InputError, StorageError."""
        with self._reading:
            known_means, proven = self._stored_means(name), self._runs.proven(name)
            events = [proven[ShotId.parse(shot)] for shot in shots]
            missing = [event for event in events if event.xxh3 not in known_means]
            view = self._runs.view(name, missing) if missing else None
            for count, event in enumerate(missing, 1):
                assert view is not None
                known_means[event.xxh3] = _mean(view.pixels(event.index), view)
                tell(count, len(missing))
                if count % _KEPT_EVERY == 0 or count == len(missing):
                    self._keep(name, known_means)
        return {shot: known_means[event.xxh3] for shot, event in zip(shots, events, strict=True)}

    def _stored_means(self, name: str) -> dict[str, float]:
        """Return the stored means, by the frames' checksums."""
        self._runs.run(name)
        try:
            means: dict[str, float] = read_json(self._folder / f"{name}.json", allow_nan=True)
        except (OSError, InputError):
            return {}
        return means

    def _keep(self, name: str, means: dict[str, float]) -> None:
        make_folder(self._folder)
        partial = self._folder / f".{name}.part"
        partial.write_text(json.dumps(means), encoding="utf-8")
        partial.replace(self._folder / f"{name}.json")


def places_in(cell: Cell) -> dict[int, LedPlace]:
    """Return the directions of all LEDs of a cell, by id."""
    support_from_base = np.linalg.inv(cell.rig.support.base_from_support.matrix())
    x, y, z = support_from_base[:3, :3] @ cell.leds.positions_mm.T + support_from_base[:3, 3:]
    azimuths, elevations = np.degrees(np.arctan2(y, x)), np.degrees(np.arctan2(z, np.hypot(x, y)))
    return {
        int(led): LedPlace(float(azimuth), float(elevation))
        for led, azimuth, elevation in zip(cell.leds.ids, azimuths, elevations, strict=True)
    }


def led_places(sheets: FrameSheets, name: str) -> dict[int, LedPlace]:
    """Return directions like `FrameSheets.places`; empty for a run whose rig can no longer be read."""
    try:
        return sheets.places(name)
    except (InputError, CoupoleError):
        return {}


def _mean(pixels: NDArray[np.uint16], view: View) -> float:
    pairs = pixels[: pixels.shape[0] // 2 * 2].reshape(-1, 2, pixels.shape[1])
    some = pairs[:: -(-len(pairs) // _MOST_PAIRS) or 1]
    return float((some.mean() - view.black_dn) / (view.white_dn - view.black_dn))


def _words(shot: ShotId) -> str:
    repeat = f", {shot.label.repeat + 1}th time" if shot.label.repeat else ""
    if isinstance(shot.light, Led):
        return f"LED {shot.light.id}{repeat}"
    if isinstance(shot.light, Dark):
        return f"dark {shot.light.number}{repeat}"
    return f"{str(shot.light).replace('panel', 'panel ').replace('-mark', ', mark ')}{repeat}"


def _order(shot: ShotId) -> tuple[int, int, str, int, int]:
    led = shot.light.id if isinstance(shot.light, Led) else 0
    kind = 0 if isinstance(shot.light, Led) else 2 if shot.is_dark else 1
    return kind, led, "" if kind == 0 else str(shot.light), shot.label.exposure, shot.label.repeat
