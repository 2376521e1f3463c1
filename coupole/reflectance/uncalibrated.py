"""Pictures of one view of a run without calibrations, to be used as pictures under known lights.

Only nominal places of rig and LED table are used. The directions to the LEDs, and their light by the table, are
computed for the point in focus. Values are relative, and each pixel is treated alone.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coupole.calibration.light.frames import LightFrame, LightFrames, channel_mask, channels_of, open_light_frames
from coupole.calibration.light.records import dark_signal
from coupole.errors import InputError
from coupole.geometry import apply, inverse
from coupole.plan.reading import PlanFiles, read_plan
from coupole.reflectance.extraction.frames_for_check import block_offsets
from coupole.reflectance.picture_set import FEWEST_LIGHTS, ORDER_FILE
from coupole.reflectance.result_folder import complete
from coupole.storage.durable import write_synced
from coupole.storage.run import Run

Said = Callable[[str, int, int], None]
FILES = LIGHTS, INTENSITIES, MASK = "lights.txt", "intensities.txt", "mask.png"
ABOUT = "pictures.json"
_MOST_CLIPPED = 1e-3
_LEAST_SHARE = 0.02
"""Least share of the range that a pixel of the mask reaches under its brightest LED."""


@dataclass(frozen=True)
class PicturedView:
    """LEDs, lights and pictures of a view, from nominal places."""

    leds: tuple[int, ...]
    files: tuple[Path, ...]
    """Files in the order of the LEDs; none if they were not requested."""
    lights_mm: NDArray[np.float64]
    """[n, 3] vectors from the point in focus to the LEDs: x right, y up, z to the camera."""
    width_mm: float
    """Width that a row of pixels shows at this distance."""
    is_simulated: bool


def write_pictures(folder: Path, view: str | None, out: Path, say: Said) -> PicturedView:
    """Write pictures of a view of a run [h / 2, w / 2], 16 bit, linear, with one pixel for each channel of a
    block. Also write `filenames.txt`, lights, intensities and mask. Existing files are kept.

    Raises InputError if there is no such view, or too few LEDs, or if the folder has other pictures. Raises
    StorageError for damaged frames.
    """
    import cv2

    run = Run(folder)
    files = read_plan(run.plan_path, run.rig_path)
    frames = open_light_frames([folder])
    frame_of_led = frames_of_leds(folder, frames, view)
    out.mkdir(parents=True, exist_ok=True)
    leds = sorted(frame_of_led)
    shortest_us = min(frame.exposure_us for frame in frame_of_led.values())
    about = {
        "view": frame_of_led[leds[0]].view,
        "frames": [str(frame_of_led[led].shot) for led in leds],
        "run": frames.inputs,
    }
    _refuse_others(out / ABOUT, json.dumps(about) + "\n")
    dark = dark_signal(frames, None)
    brightest = np.zeros((frames.size_px[1] // 2, frames.size_px[0] // 2), np.uint16)
    for number, led in enumerate(leds):
        path = out / f"led{led:04d}.png"
        if not path.exists():
            picture = _picture(frames, frame_of_led[led], dark(frame_of_led[led]), shortest_us)
            complete(path, partial(_write_png, picture))
        stored_picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        assert stored_picture is not None
        brightest = np.maximum(brightest, stored_picture.reshape(*brightest.shape, -1).max(axis=2))
        say("pictures", number + 1, len(leds))
    pictured_view = _nominal(files, frame_of_led, run.is_simulated)
    rows = files.cell.leds.rows(leds)
    target_mm = _target_mm(files, frame_of_led[leds[0]].base_from_camera)
    light = files.cell.leds.illuminance_lux(target_mm[None])[0, rows]
    _write_rows(
        out / LIGHTS, pictured_view.lights_mm / np.linalg.norm(pictured_view.lights_mm, axis=1, keepdims=True)
    )
    _write_rows(out / INTENSITIES, np.repeat(light[:, None] / light.max(), 3, axis=1))
    write_synced(out / ORDER_FILE, "".join(f"led{led:04d}.png\n" for led in leds))
    mask = np.where(brightest > _LEAST_SHARE * 65535, np.uint8(255), np.uint8(0))
    complete(out / MASK, partial(_write_png, mask))
    return replace(pictured_view, files=tuple(out / f"led{led:04d}.png" for led in leds))


def lights_of_view(folder: Path, view: str | None) -> PicturedView:
    """Return the LEDs and lights of a view's pictures, without writing them or reading a frame. Raises InputError
    if there is no such view, or too few LEDs."""
    run = Run(folder)
    exposures_of_led = _exposures_of_leds(folder, open_light_frames([folder]), view)
    frame_of_led = {led: exposures[0] for led, exposures in exposures_of_led.items()}
    return _nominal(read_plan(run.plan_path, run.rig_path), frame_of_led, run.is_simulated)


def _nominal(files: PlanFiles, frame_of_led: dict[int, LightFrame], is_simulated: bool) -> PicturedView:
    leds = tuple(sorted(frame_of_led))
    pose = frame_of_led[leds[0]].base_from_camera
    rows = files.cell.leds.rows(leds)
    towards = apply(inverse(pose), files.cell.leds.positions_mm[rows])
    towards -= apply(inverse(pose), _target_mm(files, pose))
    towards *= (1.0, -1.0, -1.0)  # x right, y up, z to the camera
    rig = files.cell.rig
    wide_mm = rig.sensor.width_px * rig.sensor.pixel_pitch_um * 1e-3
    width_mm = wide_mm * (rig.lens.focus_distance_mm / rig.lens.focal_length_mm - 1.0)
    return PicturedView(leds, (), towards, width_mm, is_simulated)


def _target_mm(files: PlanFiles, base_from_camera: NDArray[np.float64]) -> NDArray[np.float64]:
    """[3] the point in focus."""
    return base_from_camera[:3, 3] + files.cell.rig.lens.focus_distance_mm * base_from_camera[:3, 2]


def _refuse_others(path: Path, text: str) -> None:
    if path.exists() and path.read_text(encoding="utf-8") != text:
        raise InputError(f"{path.parent} holds pictures of another run or view: remove it, or name another --out")
    write_synced(path, text)


def frames_of_leds(folder: Path, frames: LightFrames, view: str | None) -> dict[int, LightFrame]:
    """Return, for each LED, the frame of the longest exposure that is hardly clipped, otherwise the frame of the
    shortest exposure."""
    frame_of_led: dict[int, LightFrame] = {}
    for led, exposures in _exposures_of_leds(folder, frames, view).items():
        frame_of_led[led] = exposures[0]
        for shorter_exposure in exposures[1:]:
            if _clipped_share(frame_of_led[led], frames.white_dn) > _MOST_CLIPPED:
                frame_of_led[led] = shorter_exposure
    return frame_of_led


def _exposures_of_leds(folder: Path, frames: LightFrames, view: str | None) -> dict[int, list[LightFrame]]:
    """Return the frames of each LED in a view, the longest exposure first. Raises InputError if there is no such
    view, or too few LEDs."""
    views = list(dict.fromkeys(frame.view for frame in frames.lit if frame.led is not None))
    if not views:
        raise InputError(f"{folder}: no proven frame under a single LED; acquire the plan first")
    name = views[0] if view is None else view
    if name not in views:
        raise InputError(f"--view: expected one of {', '.join(views)}, got {name!r}")
    exposures_of_led: dict[int, list[LightFrame]] = {}
    for frame in sorted(frames.lit, key=lambda frame: -frame.exposure_us):
        if frame.view == name and frame.led is not None:
            exposures_of_led.setdefault(frame.led, []).append(frame)
    if len(exposures_of_led) < FEWEST_LIGHTS:
        raise InputError(
            f"{folder}: {len(exposures_of_led)} LEDs lit the view {name}; at least {FEWEST_LIGHTS} are needed"
        )
    return exposures_of_led


def _clipped_share(frame: LightFrame, white_dn: int) -> float:
    return float(np.mean(frame.read() >= white_dn))


def _picture(
    frames: LightFrames, frame: LightFrame, dark: NDArray[np.float32], shortest_us: float
) -> NDArray[np.uint16]:
    """[h / 2, w / 2, 3] picture with blue first, as OpenCV writes it, or one channel."""
    width, height = frames.size_px
    channel = np.zeros((height, width), np.int8)
    names = channels_of(frames.pattern)
    for number, name in enumerate(names):
        channel[channel_mask((height, width), frames.pattern, name)] = number
    scale = 65535.0 * shortest_us / frame.exposure_us / (frames.white_dn - frames.black_dn)
    linear = np.clip((frame.read() - dark) * scale, 0, 65535)
    parts = [
        linear[row::2, column::2][: height // 2, : width // 2]
        for row, column in block_offsets(channel, len(names))
    ]
    picture: NDArray[np.uint16] = np.rint(np.stack(parts[::-1], axis=-1)).astype(np.uint16)
    return picture


def _write_png(picture: NDArray[np.integer], path: Path) -> None:
    import cv2

    path.write_bytes(cv2.imencode(".png", picture)[1].tobytes())


def _write_rows(path: Path, rows: Sequence[Sequence[float]] | NDArray[np.float64]) -> None:
    write_synced(path, "".join(" ".join(f"{value:.9g}" for value in row) + "\n" for row in rows))
