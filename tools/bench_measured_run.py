"""A run of full-size frames for the benchmark of reflectance: a relief in the demo's dome, seen from above.

Frames are rendered by the simulator, one for each LED, and written by the store of real runs with their journal.
No calibration record is needed: lens, poses and positions of the LEDs are the simulator's own, powers are equal,
and noise is that of a usual sensor.
"""

from __future__ import annotations

import mmap
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench_render import (
    FULL,
    SENSOR_WIDTH_MM,
    WORKING_DISTANCE_MM,
    camera_pose,
    photographer,
    relief,
    render_leds,
)


@dataclass(frozen=True)
class Size:
    """Width and height of frames, and size of the relief, about nine tenths of which are seen."""

    size_px: tuple[int, int] = FULL
    triangles: int = 1_150_000


LIFT_MM = 6.0
"""Height of the relief above the dome's support; the camera is raised by the same height."""
VIEW, MESH, DARK_FRAMES = "top", "relief.ply", 2
EXPOSURE_US = 8000
POWER = 1.2e7
"""Power of every LED and channel, DN s^-1 m^2 sr."""
NOISE = (6.0, 0.4)
"""Variance in the dark, DN^2, and gain, DN/e."""


def make_run(root: Path, folder: Path, frames: int, size: Size) -> Any:
    """Make a run with frames under `frames` LEDs, spread over the dome, and some dark frames."""
    import trimesh

    from coupole.acquisition.recorder import RunRecorder, ViewStart
    from coupole.devices import ArmState, FrameFormat
    from coupole.plan.shot_id import ShotId
    from coupole.storage.journal_events import SessionStarted, SessionStopped, ViewBegun
    from coupole.storage.run import Run
    from coupole.storage.run_inputs import Inputs

    vertices, faces = relief(size.triangles)
    trimesh.Trimesh(vertices + np.array([0, 0, LIFT_MM]), faces, process=False).export(folder / MESH)
    by, pose = photographer(root, folder / MESH, size.size_px)
    width_px, height_px = size.size_px
    support = pose @ np.linalg.inv(camera_pose())
    pose[:3, 3] -= LIFT_MM * pose[:3, 2]
    leds = _evenly_spaced_ids(by.leds.ids, frames)
    labels = [*(f"led{led:04d}/e0" for led in leds), *(f"dark{n}/e0" for n in range(DARK_FRAMES))]
    inputs = Inputs(root / "configs/plans/demo.yaml", root / "configs/rigs/sim.yaml", ())
    about = {"views": [VIEW], "labels": labels, "simulated": True, "object": None}
    run = Run.create(folder / "runs", "bench", inputs, about)
    recorder = RunRecorder(run, {"sample": "relief", "simulated": True, **_lens(by, width_px)})
    recorder.note(SessionStarted(simulated=True))
    recorder.note(ViewBegun(view=VIEW))
    arm = ArmState((0, 0, 0, 0, 0, 0), pose, 1, moving=False)
    frame_format = FrameFormat(height_px, width_px, 12, "GBRG", 64, 4095)
    recorder.begin_view(ViewStart(VIEW, len(labels), frame_format, arm, pose, {}))
    memory = mmap.mmap(-1, 2 * width_px * height_px)
    pixels = np.frombuffer(memory, np.uint16).reshape(height_px, width_px)
    for number, label in enumerate(labels):
        led = int(leds[number]) if number < frames else None
        if led is None:
            pixels[:] = 64
        else:
            render_leds(by, pose, pixels, range(led, led + 1))
        _keep(recorder, pixels, number, ShotId.parse(f"{VIEW}/{label}"), led)
    recorder.end_view()
    recorder.note(SessionStopped(outcome="done"))
    recorder.close()
    places = {"ids": leds, "centres_mm": by.leds.positions_mm[_rows(by, leds)]}
    np.savez(folder / "leds.npz", **places, normals=by.leds.normals[_rows(by, leds)], support=support)
    return run


def _evenly_spaced_ids(ids: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    subset: NDArray[np.int64] = np.sort(ids)[np.linspace(0, len(ids) - 1, count).astype(int)].astype(np.int64)
    return subset


def _rows(by: Any, leds: NDArray[np.int64]) -> list[int]:
    row = {int(led): n for n, led in enumerate(by.leds.ids)}
    return [row[int(led)] for led in leds]


def _lens(by: Any, width_px: int) -> dict[str, float]:
    return {
        "pixel_pitch_um": SENSOR_WIDTH_MM / width_px * 1e3,
        "focal_length_mm": by._camera.focal_length_mm,
        "focus_distance_mm": WORKING_DISTANCE_MM,
        "f_number": by._camera.f_number,
    }


def _keep(recorder: Any, pixels: NDArray[np.uint16], number: int, shot: Any, led: int | None) -> None:
    from coupole.devices import Frame

    slot = recorder.store(Frame(number, 1000 * number, pixels), EXPOSURE_US)
    recorder.prove(
        slot, shot, {"led": 65535 if led is None else led, "step": number, "t_trigger_ns": 1000 * number}
    )
    recorder.commit(now=number % 16 == 0)


def read_run(folder: Path) -> tuple[Any, Any]:
    """Return the run in the form that extraction needs (`MeasuredRun`), and its radiometry."""
    from coupole.calibration.light.frames import channels_of, open_light_frames
    from coupole.calibration.light.tile_views import Positions
    from coupole.calibration.optics import Intrinsics
    from coupole.calibration.posed_camera import CameraPrior
    from coupole.geometry import apply
    from coupole.reflectance.extraction.measured_run import Drift, MeasuredRun, MeasuredView, Powers
    from coupole.reflectance.extraction.pointing import pointings
    from coupole.reflectance.extraction.radiance import Radiometry
    from coupole.scan.mesh_files import read_mesh
    from coupole.storage.run import Run

    led_arrays = np.load(folder / "leds.npz")
    frames = open_light_frames([next((folder / "runs").iterdir())])
    run, shape, count = Run(next((folder / "runs").iterdir())), read_mesh(folder / MESH), len(led_arrays["ids"])
    focal_px, (width, height) = frames.focal_px, frames.size_px
    equal = np.ones((count, len(channels_of(frames.pattern))))
    about = frames.about
    lens = Intrinsics(focal_px, focal_px, (width - 1) / 2, (height - 1) / 2)
    camera, pose = CameraPrior(lens, (), np.eye(4), np.zeros((6, 6))), frames.lit[0].base_from_flange
    (pointing,) = pointings(camera, pose[None], np.zeros(3))
    measured_run = MeasuredRun(
        run,
        frames,
        (MeasuredView(VIEW, pose, frames.lit, pointing),),
        lens,
        apply(led_arrays["support"], shape.vertices)[shape.triangles],
        shape.triangles,
        Positions(led_arrays["ids"], led_arrays["centres_mm"], led_arrays["normals"]),
        Powers(led_arrays["ids"], POWER * equal, np.full(count, 25.0), 0.01 * equal, 0.01 * equal),
        "lambertian",
        {},
        0.3,
        folder / MESH,
        (about.focal_length_mm or 0.0, about.focus_distance_mm or 0.0, about.f_number or 0.0),
        led_arrays["support"],
        Drift(),
        True,
        camera,
    )
    radiometry = Radiometry(measured_run)
    radiometry.noise[:] = NOISE
    return measured_run, radiometry
