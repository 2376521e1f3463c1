"""Frame rate of whole runs with and without simultaneous processing (`coupole acquire --reflectance`), in turn.

Each run is the command itself, in a separate process: full-size frames at the camera's full rate, three views with
moves between them. The camera sends pictures that were rendered before. In the first view its memory is filled
with them, so the rate is that of the other views. Times are those of the journal.
"""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime
from itertools import pairwise
from pathlib import Path
from typing import Any

from drawn_records import Scale, draw_records, write_camera_record

SENSOR_WIDTH_UM = 22528.0
EXPOSURE_US = 1000
_VIEWS = {"top": (-90.0, 80.0), "side": (-60.0, 55.0), "low": (-120.0, 55.0)}
"""Azimuth and elevation of the views, degrees."""
_KINDS = ("camera", "flat-field", "hand-eye", "led-power", "leds", "response")


@dataclass(frozen=True)
class Size:
    """Size of the runs."""

    width_px: int = 4096
    height_px: int = 3072
    leds: int = 330
    frames_per_s: float = 100.0


SMALLEST = Size(256, 192, 45)


@dataclass(frozen=True)
class LiveRun:
    """Figures of one run."""

    frames_per_s: float
    """Median over the views after the first, from the first to the last proven frame of each."""
    frames: int
    lost_count: int
    """Frames that did not arrive, or shots that were taken again."""
    move_s: float
    """Longest time from a view's last frame to the next one's first."""
    result_figures: dict[str, Any]
    """Figures of `--json` about the result; empty without a result."""


def figures(root: Path, rounds: int, *, smallest: bool = False) -> Iterator[dict[str, Any]]:
    """Yield figures of both kinds of runs in turn, `rounds` of each."""
    size = SMALLEST if smallest else Size()
    alone_runs, beside_runs = [], []
    for _ in range(rounds):
        alone_runs.append(_live_run(root, size))
        beside_runs.append(_live_run(root, size, "--reflectance"))
    alone = statistics.median(run.frames_per_s for run in alone_runs)
    beside = statistics.median(run.frames_per_s for run in beside_runs)
    common = {
        "frames": sum(run.frames for run in beside_runs),
        "frame_px": [size.width_px, size.height_px],
        "lost": sum(run.lost_count for run in beside_runs),
        "peer_lost": sum(run.lost_count for run in alone_runs),
    }
    yield {
        "name": "live_beside",
        "value": beside,
        "unit": "frames/s",
        "peer": "without_processing",
        "ratio": beside / alone,
        "peer_value": round(alone, 2),
        **common,
    }
    samples_s = statistics.median(run.result_figures["samples_after_last_frame_s"] for run in beside_runs)
    result_s = statistics.median(run.result_figures["result_after_last_frame_s"] for run in beside_runs)
    move_s = statistics.median(run.move_s for run in beside_runs)
    for name, value_s in (("samples_after_last_frame", samples_s), ("result_after_last_frame", result_s)):
        yield {
            "name": name,
            "value": value_s,
            "unit": "s",
            "peer": "longest_move",
            "ratio": move_s / value_s,
            "peer_value": round(move_s, 2),
            "over_a_move_s": round(value_s - move_s, 2),
        }


def _live_run(root: Path, size: Size, *options: str) -> LiveRun:
    with tempfile.TemporaryDirectory(prefix=".bench-", dir=root) as name:
        folder = Path(name)
        _write_cell(root, folder, size)
        command = [
            sys.executable,
            "-m",
            "coupole",
            "acquire",
            "plan.yaml",
            "--yes",
            "--json",
            *options,
        ]
        completed = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        if completed.returncode:
            raise RuntimeError(completed.stderr)
        document = json.loads(completed.stdout)
        result_figures = document.get("reflectance", {})
        if options and not result_figures["is_whole"]:
            raise RuntimeError(result_figures["why"])
        return _figures_of(Path(document["run"]), document, result_figures)


def _figures_of(run: Path, document: dict[str, Any], result_figures: dict[str, Any]) -> LiveRun:
    events = [json.loads(line) for line in (run / "journal.jsonl").read_text(encoding="utf-8").splitlines()]
    times_of_view: dict[str, list[datetime]] = {}
    for event in events:
        if event["event"] == "frame":
            view = event["shot"].partition("/")[0]
            times_of_view.setdefault(view, []).append(datetime.fromisoformat(event["t"]))
    views = list(times_of_view.values())
    rates = [(len(times) - 1) / (times[-1] - times[0]).total_seconds() for times in views[1:]]
    moves_s = [(after[0] - before[-1]).total_seconds() for before, after in pairwise(views)]
    lost_count = document["reshot"] + sum(event["lost_in_transfer"] for event in events if event["event"] == "gap")
    return LiveRun(statistics.median(rates), document["frames"], lost_count, max(moves_s), result_figures)


def _write_cell(root: Path, folder: Path, size: Size) -> None:
    from ruamel.yaml import YAML

    pitch_um = SENSOR_WIDTH_UM / size.width_px
    draw_records(folder / "records", None, Scale(pitch_um=pitch_um, size_px=(size.width_px, size.height_px)))
    write_camera_record(folder / "records")
    rig = YAML(typ="safe", pure=True).load(root / "configs/rigs/sim.yaml")
    rig["sensor"] = {
        "width_px": size.width_px,
        "height_px": size.height_px,
        "pixel_pitch_um": pitch_um,
        "max_frames_per_s": size.frames_per_s,
    }
    rig["dome"]["leds"] = str(root / "configs/domes/coupole.csv")
    rig["led_limits"] |= {"cooldown_ratio": 0.0}
    rig["world"]["settings"] |= {"camera": {"render_once": True}, "interreflection": True}  # it is subtracted
    rig["robot"]["settings"] = {"link_timeout_s": 30.0, "attention_s": 0.5}
    rig["ledbox"]["settings"]["watchdog_s"] = 30.0
    rig |= {"storage": {"folder": "runs", "reserve_bytes": 0}, "ledger": "ledger", "controllers": "controllers"}
    (folder / "rig.yaml").write_text(json.dumps(rig), encoding="utf-8")
    plan = {
        "schema_version": 1,
        "name": "live",
        "rig": "rig.yaml",
        "object": {"id": "relief", "mesh": str(root / "configs/objects/relief.ply")},
        "calibrations": [f"records/{kind}.yaml" for kind in _KINDS],
        "views": [
            {
                "kind": "look_at",
                "name": name,
                "target_mm": [0, 0, 30],
                "distance_mm": 335,
                "azimuth_deg": azimuth_deg,
                "elevation_deg": elevation_deg,
            }
            for name, (azimuth_deg, elevation_deg) in _VIEWS.items()
        ],
        "lights": {"kind": "ids", "ids": list(range(size.leds))},
        "exposure": {"kind": "fixed", "exposure_us": EXPOSURE_US},
        "darks_per_view": 2,
    }
    (folder / "plan.yaml").write_text(json.dumps(plan), encoding="utf-8")
