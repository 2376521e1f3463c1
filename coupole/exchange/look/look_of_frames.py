"""Contents of a page on a run that nothing was fitted to: its frames, and each view between its LEDs."""

from __future__ import annotations

import base64
import fnmatch
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from coupole.calibration.light.frames import LightFrame, LightFrames, open_light_frames
from coupole.calibration.light.records import dark_signal
from coupole.errors import InputError
from coupole.exchange.look.light_planes import LightPlanes, light_planes, missed
from coupole.exchange.look.look_blocks import Block, Look, block_of, jpeg_of
from coupole.exchange.look.look_frames import MOST_PX, averaged
from coupole.exchange.look.look_tiles import TILE_PX, levels_of, tiles_of
from coupole.exchange.srgb import srgb
from coupole.geometry import apply, inverse
from coupole.plan.led_table import LedTable
from coupole.plan.reading import read_plan
from coupole.plan.shot_id import Led
from coupole.reflectance.uncalibrated import frames_of_leds
from coupole.storage.run import Run

Floats = NDArray[np.float64]
Said = Callable[[str, int, int], None]
FRAME_QUALITY, PLANE_QUALITY = 85, 90
_CHECKED = 8
"""LEDs for which what is written is compared with the frames."""


@dataclass(frozen=True)
class Frames:
    """A view's frames of single LEDs, as shares of the camera's range."""

    of_run: LightFrames
    dark: Callable[[LightFrame], NDArray[np.float32]]
    chosen: dict[int, LightFrame]

    @property
    def shortest_us(self) -> float:
        return min(frame.exposure_us for frame in self.chosen.values())

    def share(self, led: int) -> NDArray[np.float32]:
        """[h, w, 3] as at the shortest exposure; colours between a Bayer filter's pixels are interpolated."""
        frame, run = self.chosen[led], self.of_run
        steps = 65535.0 / (run.white_dn - run.black_dn)
        linear = np.clip((frame.read() - self.dark(frame)) * np.float32(steps), 0, 65535)
        counted = np.rint(linear).astype(np.uint16)
        if run.pattern == "MONO":
            colours = np.repeat(counted[..., None], 3, axis=2)
        else:
            colours = cv2.demosaicing(counted, getattr(cv2, f"COLOR_Bayer{run.pattern}2RGB"))
        return colours.astype(np.float32) * np.float32(self.shortest_us / frame.exposure_us / 65535.0)


def look_of_run(folder: Path, patterns: Sequence[str], say: Said) -> Look:
    """Return the page's contents for the views of a run that match one of the patterns, or for all. Places are
    nominal; no calibration is used.

    Raises InputError: no run, no such view, too few LEDs; StorageError, ChecksumMismatch for damaged frames.
    """
    run = Run(folder)
    frames = open_light_frames([folder])
    names = list(dict.fromkeys(frame.view for frame in frames.lit if frame.led is not None))
    wanted = [name for name in names if not patterns or any(fnmatch.fnmatchcase(name, one) for one in patterns)]
    if not wanted:
        raise InputError(
            f"{folder}: no view with frames under single LEDs matches; it has {', '.join(names) or 'none'}"
        )
    cell = read_plan(run.plan_path, run.rig_path).cell
    dark = dark_signal(frames, None)
    blocks: list[Block] = []
    tiles: list[Block] = []
    pictures: list[Block] = []
    views = []
    for name in wanted:
        mine = Frames(frames, dark, frames_of_leds(folder, frames, name))
        target_mm = _target_mm(mine, cell.rig.lens.focus_distance_mm)
        ways = _ways(mine, cell.leds, target_mm)
        about, lights, tiled, shown = _view(mine, name, ways, lambda step, *n, of=name: say(f"{of}: {step}", *n))
        about |= _shots(run, mine, name, cell.leds, target_mm)
        views.append(about)
        blocks.append(lights)
        tiles += tiled
        pictures += shown
    tiles.sort(key=lambda block: -int(block.name.rsplit("-", 3)[1]))  # the coarsest first
    return Look(_about(run, frames, views), tuple(blocks), (*tiles, *pictures), errors=_ERRORS)


_ERRORS = {
    "frames": f"means of squares, at most {MOST_PX} pixels on the longer side; JPEG of 8 bit, as sRGB has it, up "
    "to the brightest pixel of each",
    "between LEDs": "see Missed",
}


def _about(run: Run, frames: LightFrames, views: list[dict[str, Any]]) -> dict[str, Any]:
    wide, high = views[0]["picture_px"]
    off = "; ".join(
        f"{view['name']}: {_told(view['missed'])} at the LEDs, {_told(view['missed_between'])} between them"
        for view in views
    )
    return {
        "kind": "run",
        "picture_px": [wide, high],
        "tile_px": TILE_PX,
        "views": views,
        "fit": "principal components",
        "simulated": run.simulated,
        "software": {run.about["software"]["name"]: run.about["software"]["version"]},
        "origin_mm": [0.0, 0.0, 0.0],
        "step_mm": 1.0,
        "irradiance": 1.0,
        "unit": "of the camera's range",
        "told": {
            "Run": f"{run.folder.name}, {'simulated' if run.simulated else 'measured'}",
            "Frames": f"{wide} x {high}, {frames.pattern}, without their darks"
            + (
                ""
                if frames.pattern == "MONO"
                else "; colours between the filter's pixels are interpolated, and are the camera's own"
            ),
            "Proof": run.proof,
            "Places": "LEDs where the rig has them, as the point sees them that the camera is focused on",
            "Missed": f"Median and rms, shares of the camera's range: {off}. Most of it lies at edges of shadows. "
            "Between: an eighth of the LEDs was left out for this.",
        },
    }


def _told(off: tuple[float, float] | None) -> str:
    return "unknown (too few LEDs)" if off is None else f"{off[0]:.2%} and {off[1]:.2%}"


def _target_mm(frames: Frames, focus_distance_mm: float) -> Floats:
    pose = next(iter(frames.chosen.values())).base_from_camera
    return np.asarray(pose[:3, 3] + focus_distance_mm * pose[:3, 2])


def _towards(frames: Frames, target_mm: Floats, places_mm: Floats) -> Floats:
    """[n, 3] unit vectors from the target to places: x right of the picture, y up, z to the camera."""
    into_camera = inverse(next(iter(frames.chosen.values())).base_from_camera)
    apart = (apply(into_camera, places_mm) - apply(into_camera, target_mm)) * (1.0, -1.0, -1.0)
    found: Floats = apart / np.linalg.norm(apart, axis=1, keepdims=True)
    return found


def _ways(frames: Frames, leds: LedTable, target_mm: Floats) -> Floats:
    return _towards(frames, target_mm, leds.positions_mm[leds.rows(sorted(frames.chosen))])


def _view(
    frames: Frames, name: str, ways: Floats, say: Said
) -> tuple[dict[str, Any], Block, list[Block], list[Block]]:
    """Return what the page knows of a view; its block of lights; tiles; pictures of frames."""
    leds = sorted(frames.chosen)
    shown: list[dict[str, Any]] = []
    pictures: list[Block] = []

    def see(number: int, share: NDArray[np.float32]) -> None:
        frame = frames.chosen[leds[number]]
        block, told = _frame(f"frame-{name}-{leds[number]}", share)
        pictures.append(block)
        of_shot = {"shot": str(frame.shot), "exposure_us": frame.exposure_us, "way": ways[number].tolist()}
        shown.append({"led": leds[number], **of_shot, **told})

    taken = light_planes(lambda number: frames.share(leds[number]), ways, see, say)
    low, high = taken.planes.min(axis=(1, 2)), taken.planes.max(axis=(1, 2))
    step = np.maximum(high - low, 1e-12) / 255.0
    height, width = taken.planes.shape[1:]
    tiles = list(_plane_tiles(taken.planes, name, low, step, say))
    lights = block_of(f"lights-{name}", taken.bases(ways))
    about = {
        "name": name,
        "picture_px": [width, height],
        "levels": levels_of(width, height),
        "tiles": f"tile-{name}",
        "lights": lights.name,
        "planes": len(taken.planes),
        "low": low.tolist(),
        "step": step.tolist(),
        "frame_step_px": math.ceil(max(width, height) / MOST_PX),
        "shortest_us": frames.shortest_us,
        "missed": _missed_as_written(frames, leds, taken, tiles, low, step),
        "missed_between": None if math.isnan(taken.missed_between[0]) else taken.missed_between,
        "apart_deg": _apart_deg(ways),
        "frames": shown,
    }
    return about, lights, tiles, pictures


def _frame(name: str, share: NDArray[np.float32]) -> tuple[Block, dict[str, Any]]:
    """A picture of a frame, and what is said of it."""
    small = averaged(share, math.ceil(max(share.shape) / MOST_PX))
    peak = max(float(small.max()), 1e-9)
    codes = np.rint(255.0 * srgb(small / peak)).astype(np.uint8)
    size_px = [codes.shape[1], codes.shape[0]]
    return jpeg_of(name, codes, FRAME_QUALITY), {"block": name, "size_px": size_px, "peak": peak}


def _plane_tiles(
    planes: NDArray[np.float32], name: str, low: NDArray[np.float32], step: NDArray[np.float32], say: Said
) -> Iterator[Block]:
    """Tiles of planes, one under the other in 8 bit from `low` in steps."""
    total = sum(-(-w // TILE_PX) * -(-h // TILE_PX) for w, h in levels_of(planes.shape[2], planes.shape[1]))
    for done, tile in enumerate(tiles_of(planes), start=1):
        codes = np.rint((tile.values - low[:, None, None]) / step[:, None, None])
        known = np.where(np.isfinite(codes), codes, 0.0).clip(0, 255).astype(np.uint8)
        yield jpeg_of(tile.name(f"tile-{name}"), known.reshape(-1, TILE_PX), PLANE_QUALITY)
        say("tiles", done, total)


def _missed_as_written(
    frames: Frames,
    leds: list[int],
    taken: LightPlanes,
    tiles: list[Block],
    low: NDArray[np.float32],
    step: NDArray[np.float32],
) -> tuple[float, float]:
    """Median and rms of the shares that the page's first tile misses under some LEDs."""
    packed = np.frombuffer(base64.b64decode(tiles[0].text), np.uint8)
    read = cv2.imdecode(packed, cv2.IMREAD_GRAYSCALE)
    assert read is not None
    codes = read.reshape(-1, TILE_PX, TILE_PX).astype(np.float64)
    planes = codes * step[:, None, None] + low[:, None, None]
    found, measured = [], []
    for number in range(0, len(leds), -(-len(leds) // _CHECKED)):
        share = frames.share(leds[number])[:TILE_PX, :TILE_PX]
        inside = planes[:, : share.shape[0], : share.shape[1]]
        root = np.einsum("phw,pc->hwc", inside, taken.of_leds[:, number]) + taken.means[number]
        found.append(np.maximum(root, 0.0).ravel() ** 2)
        measured.append(share.ravel().astype(np.float64))
    return missed(np.concatenate(found), np.concatenate(measured))


def _apart_deg(ways: Floats) -> float:
    """Return the greatest angle of a light to the nearest LED at which it is still between the LEDs: twice what
    nearly all LEDs have to their nearest neighbour."""
    cosines = ways @ ways.T
    np.fill_diagonal(cosines, -1.0)
    nearest = np.degrees(np.arccos(np.clip(cosines.max(axis=1), -1.0, 1.0)))
    return float(2.0 * np.quantile(nearest, 0.95))


def _shots(run: Run, frames: Frames, view: str, leds: LedTable, target_mm: Floats) -> dict[str, Any]:
    """LEDs of the view whose frame is not there: not proven, or hidden; and how many shots are proven."""
    proven = run.proven()
    expected = [shot for shot in run.expected_shots() if shot.view == view and isinstance(shot.light, Led)]
    missing = {shot.light.id for shot in expected if isinstance(shot.light, Led)} - set(frames.chosen)
    hidden = run.hidden_leds.get(view, [])

    def at(ids: Sequence[int]) -> list[list[float]]:
        if not ids:
            return []
        found: list[list[float]] = _towards(frames, target_mm, leds.positions_mm[leds.rows(ids)]).tolist()
        return found

    return {
        "shots": len(expected),
        "proven": sum(shot in proven for shot in expected),
        "unproven": at(sorted(missing)),
        "hidden": at(sorted(hidden)),
    }
