"""The YAML of a suggested plan."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from textwrap import wrap

from coupole.plan.plan import LookAt

_WIDTH = 110


@dataclass(frozen=True)
class PlanText:
    """The part of a suggested plan that does not depend on its views. Paths are relative to the plan."""

    name: str
    rig: str
    object_id: str
    mesh: str
    mesh_unit: str
    calibrations: tuple[str, ...] = ()
    """Calibration records; if empty, the records of the rig."""
    translation_mm: tuple[float, float, float] | None = None
    """Place of the mesh's frame on the support."""

    def with_views(
        self,
        views: Sequence[LookAt],
        exposures_us: Sequence[int],
        led_ids: Sequence[int] | None,
        remarks: Sequence[str] = (),
    ) -> str:
        """Return the plan with these views and LEDs (None for all LEDs); `remarks` are comments at its head."""
        lines = [f"# {line}" for remark in remarks for line in wrap(remark, _WIDTH)]
        lines += [
            "schema_version: 1",
            f"name: {_quote(self.name)}",
            f"rig: {_quote(self.rig)}",
            "object:",
            f"  id: {_quote(self.object_id)}",
            f"  mesh: {_quote(self.mesh)}",
            f"  mesh_unit: {self.mesh_unit}",
        ]
        if self.translation_mm is not None:
            numbers = ", ".join(f"{value:.3f}" for value in self.translation_mm)
            lines.append(f"  support_from_object: {{translation_mm: [{numbers}], abc_deg: [0, 0, 0]}}")
        if self.calibrations:
            lines += ["calibrations:", *(f"  - {_quote(path)}" for path in self.calibrations)]
        lines += ["views:", *map(_line, views)]
        lines += _lights(led_ids)
        if len(exposures_us) == 1:
            lines.append(f"exposure: {{kind: fixed, exposure_us: {exposures_us[0]}}}")
        else:
            lines.append(f"exposure: {{kind: bracket, exposures_us: {list(exposures_us)}}}")
        lines += ["darks_per_view: 2", "trigger: hardware", "reshoot_limit: 3"]
        return "\n".join(lines) + "\n"


def _line(view: LookAt) -> str:
    target = ", ".join(f"{value:g}" for value in view.target_mm)
    return (
        f"  - {{kind: look_at, name: {view.name}, target_mm: [{target}], distance_mm: {view.distance_mm:g}, "
        f"azimuth_deg: {view.azimuth_deg:g}, elevation_deg: {view.elevation_deg:g}}}"
    )


def _lights(led_ids: Sequence[int] | None) -> list[str]:
    if led_ids is None:
        return ["lights: {kind: all}"]
    numbers = wrap(", ".join(map(str, led_ids)), _WIDTH)
    return ["lights:", "  kind: ids", "  ids: [", *(f"    {line}" for line in numbers), "  ]"]


def _quote(text: str) -> str:
    """Return any text as a YAML string; JSON strings are valid YAML."""
    return text if text.replace("-", "").replace("_", "").isalnum() and text[0].isalpha() else json.dumps(text)
