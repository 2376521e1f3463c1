"""A line of identified points as a profile: classes, their probabilities and the reflectance along the line."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.appearance.spectra.grid import Array
from coupole.errors import StorageError, reason
from coupole.heritage.analysis.identification import PigmentFinding
from coupole.heritage.pigment_maps.line_points import LinePoints
from coupole.heritage.result_pages.class_colours import AMBIGUOUS, RGB, UNKNOWN, class_colour, with_legend
from coupole.pages.palettes import colours_of
from coupole.storage.durable import write_synced

_WIDTH_PX, _CLASSES_PX, _BARS_PX, _SPECTRA_PX, _GAP_PX = 900, 60, 90, 160, 8
_WHITE = 255
_WORDS = {"unknown": "not in the library", "ambiguous": "not decided"}


@dataclass(frozen=True, eq=False)
class LineProfile:
    """Points along a line with their findings, in the same order."""

    points: LinePoints
    findings: Sequence[PigmentFinding]

    @property
    def length_mm(self) -> float:
        """Length from the first point to the last."""
        return float(self.points.distances_mm[-1])

    def names(self) -> list[str]:
        """Return the answer at each point: a class, a mixture, or the reason why there is none."""
        return [
            " + ".join(sorted({part.class_name for part in finding.parts}))
            or _WORDS.get(finding.verdict, finding.class_name)
            for finding in self.findings
        ]

    def colours(self) -> dict[str, RGB]:
        """The colour of each name, in the order in which they occur along the line."""
        greys = {_WORDS["unknown"]: UNKNOWN, _WORDS["ambiguous"]: AMBIGUOUS}
        classes = [name for name in dict.fromkeys(self.names()) if name not in greys]
        return {name: class_colour(number) for number, name in enumerate(classes)} | {
            name: grey for name, grey in greys.items() if name in self.names()
        }

    def png(self) -> bytes:
        """The profile as a picture: above the classes; in the middle the probability of the first class; below
        the reflectance, wavelengths upwards. Each point reaches half of the way to its neighbours."""
        points = self._nearest()
        colours = self.colours()
        classes = np.array([colours[name] for name in self.names()], np.uint8)
        picture = np.full((_CLASSES_PX + _BARS_PX + _SPECTRA_PX + 2 * _GAP_PX, _WIDTH_PX, 3), _WHITE, np.uint8)
        picture[:_CLASSES_PX] = classes[points]
        probabilities = np.array([finding.candidates[0].probability for finding in self.findings])[points]
        heights = np.arange(_BARS_PX, 0, -1)[:, None] / _BARS_PX
        bars = picture[_CLASSES_PX + _GAP_PX : _CLASSES_PX + _GAP_PX + _BARS_PX]
        bars[:] = np.where((heights <= probabilities)[..., None], np.uint8(90), np.uint8(235))
        picture[-_SPECTRA_PX:] = self._spectra()[:, points]
        nm = self._wavelengths()
        entries = [
            *colours.items(),
            (
                f"from left to right: 0 to {self.length_mm:.1f} mm; bars: probability of the first class, 0 "
                "to 100 %",
                (90, 90, 90),
            ),
            (
                f"below: reflectance, from {nm[0]:g} nm (bottom) to {nm[-1]:g} nm (top), yellow is high",
                (240, 215, 80),
            ),
        ]
        return with_legend(picture, entries)

    def _nearest(self) -> NDArray[np.intp]:
        """[columns of the picture] number of the point that is nearest to each column."""
        distances = self.points.distances_mm
        at = (np.arange(_WIDTH_PX) + 0.5) / _WIDTH_PX * distances[-1]
        nearest: NDArray[np.intp] = np.searchsorted((distances[1:] + distances[:-1]) / 2, at)
        return nearest

    def _wavelengths(self) -> Array:
        spectra = self.points.spectra
        low = max(spectrum.wavelengths_nm[0] for spectrum in spectra)
        high = min(spectrum.wavelengths_nm[-1] for spectrum in spectra)
        return np.linspace(low, high, _SPECTRA_PX)

    def _spectra(self) -> NDArray[np.uint8]:
        """[rows, points, 3] colours of the reflectance."""
        nm = self._wavelengths()
        rows = [np.interp(nm, spectrum.wavelengths_nm, spectrum.reflectance) for spectrum in self.points.spectra]
        values = np.nan_to_num(np.stack(rows, axis=1)[::-1])
        return np.asarray(np.rint(255 * colours_of(values / max(float(values.max()), 1e-6))), np.uint8)

    def rows(self) -> list[dict[str, Any]]:
        """Return the results of each point, as JSON's values."""
        return [
            {
                "name": finding.name,
                "distance_mm": float(distance),
                **dict(
                    zip((f"{axis.split('_')[0]}_mm" for axis in self.points.axes), map(float, place), strict=True)
                ),
                "verdict": finding.verdict,
                "says": name,
                "class": finding.class_name,
                "probability": finding.candidates[0].probability,
                "not_in_library": finding.not_in_library,
            }
            for finding, name, distance, place in zip(
                self.findings, self.names(), self.points.distances_mm, self.points.positions_mm, strict=True
            )
        ]

    def document(self) -> dict[str, Any]:
        """The line as JSON's values."""
        return {"length_mm": self.length_mm, "points": self.rows()}

    def write(self, folder: Path) -> list[Path]:
        """Write picture and table, and return their paths. Raises StorageError."""
        text = io.StringIO()
        rows = self.rows()
        writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
        paths = [folder / "profile.png", folder / "profile.csv"]
        try:
            write_synced(paths[0], self.png())
            write_synced(paths[1], text.getvalue())
        except OSError as error:
            raise StorageError(f"{folder}: {reason(error)}") from error
        return paths
