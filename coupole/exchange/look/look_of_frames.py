"""Contents of a page of a run without fits: its frames, and each view under lights between its LEDs."""

from __future__ import annotations

import base64
import fnmatch
import io
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from coupole.calibration.light.frames import LightFrame, LightFrames, open_light_frames
from coupole.calibration.light.records import dark_signal
from coupole.errors import InputError
from coupole.exchange.demosaiced import demosaiced
from coupole.exchange.look.light_planes import LightPlanes, error_figures, light_planes
from coupole.exchange.look.look_blocks import Block, Look, block_of, jpeg_of
from coupole.exchange.look.look_frames import MOST_PX, block_means
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
"""Number of LEDs for which the written data are compared with the frames."""


@dataclass(frozen=True)
class Frames:
    """A view's frames of single LEDs, as shares of the camera's range."""

    of_run: LightFrames
    dark: Callable[[LightFrame], NDArray[np.float32]]
    frame_of_led: dict[int, LightFrame]

    @property
    def shortest_us(self) -> float:
        return min(frame.exposure_us for frame in self.frame_of_led.values())

    def share(self, led: int) -> NDArray[np.float32]:
        """[h, w, 3] shares, scaled to the shortest exposure; colours between a Bayer filter's pixels are
        interpolated."""
        frame, run = self.frame_of_led[led], self.of_run
        steps = 65535.0 / (run.white_dn - run.black_dn)
        linear = np.clip((frame.read() - self.dark(frame)) * np.float32(steps), 0, 65535)
        codes = np.rint(linear).astype(np.uint16)
        colours = demosaiced(codes, run.pattern).astype(np.float32)
        return colours * np.float32(self.shortest_us / frame.exposure_us / 65535.0)


def look_of_run(folder: Path, patterns: Sequence[str], say: Said) -> Look:
    """Return the page's contents for the views of a run that match one of the patterns, or for all views.
    Positions are nominal; no calibration is used.

    Raises InputError if there is no run or no such view, or if there are too few LEDs; StorageError,
    ChecksumMismatch for damaged frames.
    """
    run = Run(folder)
    frames = open_light_frames([folder])
    names = list(dict.fromkeys(frame.view for frame in frames.lit if frame.led is not None))
    view_names = [
        name for name in names if not patterns or any(fnmatch.fnmatchcase(name, pattern) for pattern in patterns)
    ]
    if not view_names:
        raise InputError(
            f"{folder}: no view with frames under single LEDs matches; it has {', '.join(names) or 'none'}"
        )
    cell = read_plan(run.plan_path, run.rig_path).cell
    dark = dark_signal(frames, None)
    blocks: list[Block] = []
    tiles: list[Block] = []
    pictures: list[Block] = []
    views = []
    for name in view_names:
        view_frames = Frames(frames, dark, frames_of_leds(folder, frames, name))
        target_mm = _target_mm(view_frames, cell.rig.lens.focus_distance_mm)
        ways = _ways(view_frames, cell.leds, target_mm)
        about, lights, view_tiles, view_pictures = _view(
            view_frames, name, ways, lambda step, *n, of=name: say(f"{of}: {step}", *n)
        )
        about |= _shots(run, view_frames, name, cell.leds, target_mm)
        views.append(about)
        blocks.append(lights)
        tiles += view_tiles
        pictures += view_pictures
    tiles.sort(key=lambda block: -int(block.name.rsplit("-", 3)[1]))  # the coarsest first
    return Look(_about(run, frames, views), tuple(blocks), (*tiles, *pictures), errors=_ERRORS)


_ERRORS = {
    "frames": (
        f"means of squares, at most {MOST_PX} pixels on the longer side; JPEG of 8 bit, encoded as sRGB, up to "
        "the brightest pixel of each picture"
    ),
    "between LEDs": "see Missed",
}


def _about(run: Run, frames: LightFrames, views: list[dict[str, Any]]) -> dict[str, Any]:
    wide, high = views[0]["picture_px"]
    off = "; ".join(
        f"{view['name']}: {_error_text(view['missed'])} at the LEDs, {_error_text(view['missed_between'])} "
        f"between them"
        for view in views
    )
    return {
        "kind": "run",
        "picture_px": [wide, high],
        "tile_px": TILE_PX,
        "views": views,
        "fit": "principal components",
        "simulated": run.is_simulated,
        "software": {run.about["software"]["name"]: run.about["software"]["version"]},
        "origin_mm": [0.0, 0.0, 0.0],
        "step_mm": 1.0,
        "irradiance": 1.0,
        "unit": "of the camera's range",
        "told": {
            "Run": f"{run.folder.name}, {'simulated' if run.is_simulated else 'measured'}",
            "Frames": f"{wide} x {high}, {frames.pattern}, without their darks"
            + (
                ""
                if frames.pattern == "MONO"
                else "; colours between the filter's pixels are interpolated, and are the camera's own"
            ),
            "Proof": run.proof,
            "Places": "LEDs at their places in the rig, as seen from the point in focus",
            "Missed": f"Median and rms, shares of the camera's range: {off}. Most of the error is at edges of "
            "shadows. "
            "For the figure between LEDs, an eighth of the LEDs was left out.",
        },
    }


def _error_text(off: tuple[float, float] | None) -> str:
    return "unknown (too few LEDs)" if off is None else f"{off[0]:.2%} and {off[1]:.2%}"


def _target_mm(frames: Frames, focus_distance_mm: float) -> Floats:
    pose = next(iter(frames.frame_of_led.values())).base_from_camera
    return np.asarray(pose[:3, 3] + focus_distance_mm * pose[:3, 2])


def _towards(frames: Frames, target_mm: Floats, places_mm: Floats) -> Floats:
    """[n, 3] unit vectors from the target to places: x to the right of the picture, y up, z to the camera."""
    into_camera = inverse(next(iter(frames.frame_of_led.values())).base_from_camera)
    apart = (apply(into_camera, places_mm) - apply(into_camera, target_mm)) * (1.0, -1.0, -1.0)
    ways: Floats = apart / np.linalg.norm(apart, axis=1, keepdims=True)
    return ways


def _ways(frames: Frames, leds: LedTable, target_mm: Floats) -> Floats:
    return _towards(frames, target_mm, leds.positions_mm[leds.rows(sorted(frames.frame_of_led))])


def _view(
    frames: Frames, name: str, ways: Floats, say: Said
) -> tuple[dict[str, Any], Block, list[Block], list[Block]]:
    """Return the page's facts of a view, its block of lights, its tiles, and the pictures of its frames."""
    leds = sorted(frames.frame_of_led)
    frame_facts: list[dict[str, Any]] = []
    pictures: list[Block] = []

    def see(number: int, share: NDArray[np.float32]) -> None:
        frame = frames.frame_of_led[leds[number]]
        block, frame_about = _frame(f"frame-{name}-{leds[number]}", share)
        pictures.append(block)
        of_shot = {"shot": str(frame.shot), "exposure_us": frame.exposure_us, "way": ways[number].tolist()}
        frame_facts.append({"led": leds[number], **of_shot, **frame_about})

    light_planes_of_view = light_planes(lambda number: frames.share(leds[number]), ways, see, say)
    low, high = light_planes_of_view.planes.min(axis=(1, 2)), light_planes_of_view.planes.max(axis=(1, 2))
    step = np.maximum(high - low, 1e-12) / 255.0
    height, width = light_planes_of_view.planes.shape[1:]
    tiles = list(_plane_tiles(light_planes_of_view.planes, name, low, step, say))
    lights = block_of(f"lights-{name}", light_planes_of_view.bases(ways))
    about = {
        "name": name,
        "picture_px": [width, height],
        "levels": levels_of(width, height),
        "tiles": f"tile-{name}",
        "lights": lights.name,
        "planes": len(light_planes_of_view.planes),
        "low": low.tolist(),
        "step": step.tolist(),
        "frame_step_px": math.ceil(max(width, height) / MOST_PX),
        "shortest_us": frames.shortest_us,
        "missed": _missed_as_written(frames, leds, light_planes_of_view, tiles, low, step),
        "missed_between": None
        if math.isnan(light_planes_of_view.missed_between[0])
        else light_planes_of_view.missed_between,
        "apart_deg": _apart_deg(ways),
        "frames": frame_facts,
    }
    return about, lights, tiles, pictures


def _frame(name: str, share: NDArray[np.float32]) -> tuple[Block, dict[str, Any]]:
    """Return the picture of a frame, and the facts about it."""
    small = block_means(share, math.ceil(max(share.shape) / MOST_PX))
    peak = max(float(small.max()), 1e-9)
    codes = np.rint(255.0 * srgb(small / peak)).astype(np.uint8)
    size_px = [codes.shape[1], codes.shape[0]]
    return jpeg_of(name, codes, FRAME_QUALITY), {"block": name, "size_px": size_px, "peak": peak}


def _plane_tiles(
    planes: NDArray[np.float32], name: str, low: NDArray[np.float32], step: NDArray[np.float32], say: Said
) -> Iterator[Block]:
    """Return tiles of planes, one below the other, in 8 bits, in steps from `low`."""
    total = sum(-(-w // TILE_PX) * -(-h // TILE_PX) for w, h in levels_of(planes.shape[2], planes.shape[1]))
    for count, tile in enumerate(tiles_of(planes), start=1):
        codes = np.rint((tile.values - low[:, None, None]) / step[:, None, None])
        tile_codes = np.where(np.isfinite(codes), codes, 0.0).clip(0, 255).astype(np.uint8)
        yield jpeg_of(tile.name(f"tile-{name}"), tile_codes.reshape(-1, TILE_PX), PLANE_QUALITY)
        say("tiles", count, total)


def _missed_as_written(
    frames: Frames,
    leds: list[int],
    view_planes: LightPlanes,
    tiles: list[Block],
    low: NDArray[np.float32],
    step: NDArray[np.float32],
) -> tuple[float, float]:
    """Median and rms error, in shares, of the page's first tile under some LEDs."""
    picture = Image.open(io.BytesIO(base64.b64decode(tiles[0].text)))
    codes = np.asarray(picture.convert("L")).reshape(-1, TILE_PX, TILE_PX).astype(np.float64)
    planes = codes * step[:, None, None] + low[:, None, None]
    models, shares = [], []
    for number in range(0, len(leds), -(-len(leds) // _CHECKED)):
        share = frames.share(leds[number])[:TILE_PX, :TILE_PX]
        inside = planes[:, : share.shape[0], : share.shape[1]]
        root = np.einsum("phw,pc->hwc", inside, view_planes.of_leds[:, number]) + view_planes.means[number]
        models.append(np.maximum(root, 0.0).ravel() ** 2)
        shares.append(share.ravel().astype(np.float64))
    return error_figures(np.concatenate(models), np.concatenate(shares))


def _apart_deg(ways: Floats) -> float:
    """Return the greatest angle between a light and its nearest LED at which the light counts as between the LEDs.
    It is twice the 95 % quantile of the angle between neighbouring LEDs."""
    cosines = ways @ ways.T
    np.fill_diagonal(cosines, -1.0)
    nearest = np.degrees(np.arccos(np.clip(cosines.max(axis=1), -1.0, 1.0)))
    return float(2.0 * np.quantile(nearest, 0.95))


def _shots(run: Run, frames: Frames, view: str, leds: LedTable, target_mm: Floats) -> dict[str, Any]:
    """LEDs of the view without a frame, because it is not proven or the LED is hidden; and the number of proven
    shots."""
    proven = run.proven()
    plan_shots = [shot for shot in run.expected_shots() if shot.view == view and isinstance(shot.light, Led)]
    missing = {shot.light.id for shot in plan_shots if isinstance(shot.light, Led)} - set(frames.frame_of_led)
    hidden_ids = run.hidden_leds.get(view, [])

    def at(ids: Sequence[int]) -> list[list[float]]:
        if not ids:
            return []
        ways: list[list[float]] = _towards(frames, target_mm, leds.positions_mm[leds.rows(ids)]).tolist()
        return ways

    return {
        "shots": len(plan_shots),
        "proven": sum(shot in proven for shot in plan_shots),
        "unproven": at(sorted(missing)),
        "hidden": at(sorted(hidden_ids)),
    }
