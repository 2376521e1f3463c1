"""Options of the operator for all calibrations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta

import coupole
from coupole.calibration.record import Validity
from coupole.calibration.sources import About


@dataclass(frozen=True)
class Request:
    """Options in addition to the images."""

    name: str
    now: datetime
    valid_days: int = 180
    lens: str | None = None
    focus_tolerance_mm: float = 2.0
    temperature_margin_c: float = 5.0
    limits: Mapping[str, float] = field(default_factory=dict)
    """Acceptance limits that the operator set, by name (`coupole.calibration.acceptance`)."""

    @property
    def expires(self) -> datetime:
        return _to_the_second(self.now + timedelta(days=self.valid_days))

    def head(self) -> dict[str, object]:
        """Return name, time and software version, with which every record begins."""
        return {
            "name": self.name,
            "created": _to_the_second(self.now),
            "software": f"coupole {coupole.__version__}",
        }

    def validity(
        self, about: About, size_px: tuple[int, int], temperature_c: tuple[float, float] | None
    ) -> Validity:
        """Return the validity of a record of one camera with one lens, made between two temperatures."""
        margin = self.temperature_margin_c
        return Validity(
            expires=self.expires,
            camera=about.camera,
            lens=self.lens,
            size_px=size_px,
            focal_length_mm=about.focal_length_mm,
            focus_distance_mm=about.focus_distance_mm,
            focus_tolerance_mm=self.focus_tolerance_mm,
            f_number=about.f_number,
            temperature_c=None
            if temperature_c is None
            else (temperature_c[0] - margin, temperature_c[1] + margin),
        )


def _to_the_second(time: datetime) -> datetime:
    return time.astimezone(UTC).replace(microsecond=0)
