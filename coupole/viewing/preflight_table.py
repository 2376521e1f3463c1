"""Preflight's report for the operator: a summary, the object on its support, a line for each view."""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import Any

from rich.console import Console
from rich.table import Table

from coupole.plan.bursts import BurstTiming
from coupole.preflight.exposure_scale import HOW_TO_KNOW
from coupole.preflight.framing import SHARP_PX, Framing, Placement
from coupole.preflight.preflight import Report
from coupole.viewing.terminal import bytes_text, duration_text

_ON_THE_DISK_MM = 0.05


def show_preflight(console: Console, report: Report, *, name: str, rig: str) -> None:
    """Print the summary of a preflight. For a resumed run the figures are for the rest of the run, beside the
    figures for the whole run.
    """
    whole = report.whole
    table = Table(title=f"{name} on {rig}", title_justify="left", box=None, show_header=False)
    counts = f"{report.view_count}, {report.shots}, {report.frames}"
    size, duration = bytes_text(report.bytes), duration_text(report.duration_s)
    if whole is not None:
        counts += f" left of {whole.views}, {whole.shots}, {whole.frames}"
        size += f" left of {bytes_text(whole.bytes)}"
        duration += f" left of {duration_text(whole.duration_s)}"
    at_most = ", at most" if report.is_bound else ""
    table.add_row(f"views, shots, frames{at_most}", counts)
    if report.candidates is not None:
        table.add_row("views are chosen from", f"{report.candidates} candidates; the arm has a way to each")
    size_name = "on disk" if report.peak_bytes is None else "all frames, added up"
    table.add_row(f"{size_name}{at_most}", size + (_speeds(report) if report.frames else ""))
    if report.peak_bytes is not None and report.staying_bytes is not None:
        beside = "" if whole is None else " beside what is there"
        at_a_time = "frames of one view, kept frames of all views, samples and fits"
        table.add_row(f"on disk at a time{beside}, at most", f"{bytes_text(report.peak_bytes)}: {at_a_time}")
        stays = "frames that are not discarded, samples and fits"
        table.add_row("stays on disk, at most", f"{bytes_text(report.staying_bytes)}: {stays}")
    if report.timings:
        table.add_row("a frame every", "; ".join(map(_pace, report.timings)))
    table.add_row(f"duration{at_most}", f"{duration} (at best {duration_text(report.ideal_s)})")
    table.add_row(f"light on the object{at_most}", _dose(report))
    table.add_row("hottest LED board", f"{report.peak_board_c:.1f} C")
    table.add_row("white is exposed to", _white(report))
    if report.object_check is not None:
        table.add_row("object", _placement_text(report.object_check.placement))
    console.print(table)
    for warning in report.warnings:
        console.print(f"[yellow]note:[/] {warning}")


def show_views(console: Console, report: Report) -> None:
    """Print a line for each view with motion, time and light, and one with the view of the object."""
    table = Table("view", "joints (deg)", "move", "bursts", "lux.h", box=None)
    for view in report.views:
        joints = "-" if view.joints_deg is None else " ".join(f"{j:.0f}" for j in view.joints_deg)
        times = duration_text(view.move_s), duration_text(view.burst_s)
        table.add_row(view.name, joints, *times, f"{view.dose_lux_h:.3f}")
    console.print(table)
    if report.object_check is None:
        return
    framings = {framing.view: framing for framing in report.object_check.views}
    table = Table("view", "object in field", "of the field", "mm away", "sharp", "px per mm", box=None)
    for view in report.views:
        table.add_row(view.name, *_framing_cells(framings[view.name]))
    console.print(table)
    nearest, farthest = (_distance(mm) for mm in report.object_check.sharp_mm)
    console.print(f"sharp (blurred over at most {SHARP_PX:g} pixels) is {nearest} to {farthest}")


def document_of(report: Report) -> dict[str, Any]:
    """The figures of `coupole check --json`."""
    return {
        "ok": not report.refusals,
        "refusals": report.refusals,
        "warnings": report.warnings,
        "views": report.view_count,
        **({} if report.candidates is None else {"candidates": report.candidates}),
        "shots": report.shots,
        "frames": report.frames,
        "bytes": report.bytes,
        "peak_bytes": report.peak_bytes,
        "staying_bytes": report.staying_bytes,
        "duration_s": report.duration_s,
        "ideal_s": report.ideal_s,
        "dose_lux_h": report.dose_lux_h,
        "dose_before_lux_h": report.dose_before_lux_h,
        "dose_budget_lux_h": report.dose_budget_lux_h,
        "peak_board_c": report.peak_board_c,
        "exposures": [asdict(timing) for timing in report.timings],
        "exposure_scale": report.exposure_scale,
        "white": [{**asdict(white), "verdict": white.verdict()} for white in report.white],
        "object": _object_figures(report),
    }


def _object_figures(report: Report) -> dict[str, Any] | None:
    check = report.object_check
    if check is None:
        return None
    views = [{name: _finite(value) for name, value in asdict(framing).items()} for framing in check.views]
    return {**asdict(check.placement), "sharp_mm": _finite(check.sharp_mm), "views": views}


def _finite(value: Any) -> Any:
    """Return the value for JSON. NaN and infinity, which JSON does not have, become null."""
    if isinstance(value, tuple):
        return [_finite(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _dose(report: Report) -> str:
    line = f"{report.dose_lux_h:.3f} lux.h"
    line += f" left of {report.whole.dose_lux_h:.3f}" if report.whole else ""
    line += f" after {report.dose_before_lux_h:.3f} before" if report.dose_before_lux_h else ""
    return line + ("" if report.dose_budget_lux_h is None else f" of {report.dose_budget_lux_h:g} allowed")


def _pace(timing: BurstTiming) -> str:
    bounds = {"LED": "the LED's on-time", "heat": "the LEDs' heat", "disk": "the disk", "camera": "the camera"}
    return (
        f"{timing.period_us / 1e3:g} ms, as {bounds[timing.bound]} asks ({timing.exposure_us / 1e3:g} ms exposed)"
    )


def _speeds(report: Report) -> str:
    disk = f"; the disk takes {bytes_text(report.disk_bytes_s)}/s" if report.disk_bytes_s else ""
    return f" at {bytes_text(report.asked_bytes_s)}/s{disk}"


def _white(report: Report) -> str:
    if report.exposure_scale is None:
        return f"not known; {HOW_TO_KNOW}"
    return "; ".join(
        f"{white.brightest:.0%} of full scale at {white.exposure_us / 1e3:g} ms ({white.verdict()})"
        for white in report.white
    )


def _placement_text(placement: Placement) -> str:
    size = " x ".join(f"{high - low:.0f}" for low, high in zip(placement.low_mm, placement.high_mm, strict=True))
    lowest = placement.lowest_over_disk_mm
    where = "beside the disk" if lowest is None else f"its lowest point {_height(lowest)}"
    return f"{size} mm, {where}, up to {placement.reach_mm:.0f} mm from its centre"


def _height(over_disk_mm: float) -> str:
    if abs(over_disk_mm) < _ON_THE_DISK_MM:
        return "on the disk"
    return f"{abs(over_disk_mm):.1f} mm {'above the disk' if over_disk_mm > 0 else 'inside the disk'}"


def _framing_cells(framing: Framing) -> list[str]:
    if not framing.fills:
        return [f"{framing.in_field:.0%}", "0%", "-", "-", "-"]
    least, most = framing.px_per_mm
    return [
        f"{framing.in_field:.0%}",
        f"{framing.fills:.0%}",
        f"{framing.nearest_mm:.0f} to {framing.farthest_mm:.0f}",
        f"{framing.in_focus:.0%}",
        f"{least:.1f} to {most:.1f}",
    ]


def _distance(distance_mm: float) -> str:
    return f"{distance_mm:.0f} mm" if math.isfinite(distance_mm) else "infinity"
