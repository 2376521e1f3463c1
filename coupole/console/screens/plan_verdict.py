"""Verdict of preflight on a plan, in words for a screen."""

from __future__ import annotations

from coupole.console.plans.drafts import Checked
from coupole.console.screens.parts import table_html
from coupole.viewing.terminal import bytes_text, duration_text


def figures_of(checked_plan: Checked) -> dict[str, str]:
    """Return what the plan needs, by its preflight."""
    report = checked_plan.report
    dose = f"{report['dose_lux_h']:.3f} lux h"
    if report["dose_before_lux_h"]:
        dose += f" after {report['dose_before_lux_h']:.3f}"
    if checked_plan.budget_lux_h is not None:
        dose += f" of {checked_plan.budget_lux_h:g} in its life"
    figures = {
        "views, shots, frames": f"{report['views']}, {report['shots']}, {report['frames']}",
        "duration": duration_text(report["duration_s"]),
        "light on the object": dose,
        "on disk": bytes_text(report["bytes"]),
        "hottest LED board": f"{report['peak_board_c']:.1f} C",
        "white is exposed to": "; ".join(
            f"{white['brightest']:.0%} at {white['exposure_us'] / 1e3:g} ms ({white['verdict']})"
            for white in report["white"]
        )
        or "not known: press Meter in Focus",
    }
    if (placement := report["object"]) is not None:
        sides = zip(placement["low_mm"], placement["high_mm"], strict=True)
        figures["object"] = " x ".join(f"{high - low:.0f}" for low, high in sides) + " mm"
        lowest = placement["lowest_over_disk_mm"]
        figures["it stands"] = "beside the disk" if lowest is None else f"{lowest:.1f} mm above the disk"
    return figures


def view_table(checked_plan: Checked) -> str:
    """Return a line for each view, in the order of the visits."""
    framing_of_view = {
        view_framing["view"]: view_framing
        for view_framing in (checked_plan.report["object"] or {}).get("views", [])
    }
    rows = []
    for view in checked_plan.views:
        framing = framing_of_view.get(view["name"])
        field = "-" if framing is None else f"{framing['in_field']:.0%}"
        sharp = "-" if framing is None or framing["in_focus"] is None else f"{framing['in_focus']:.0%}"
        times = duration_text(view["duration_s"]), f"{view['dose_lux_h']:.3f}"
        rows.append((view["name"], *times, _share_cell(field), _share_cell(sharp)))
    return table_html(("view", "time", "lux h", "object in field", "of it sharp"), rows)


def _share_cell(share: str) -> str:
    return share if share in ("-", "100%") else f"warm|{share}"
