"""Speed and memory of the simulated dome's renderer, against Open3D, Embree and Mitsuba.

Scenes are reliefs that fill the frame, 10 mm above the support in the demo's dome. Peers that are not installed
are left out: `pip install open3d mitsuba`.
"""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

FULL = (4096, 3072)
SENSOR_WIDTH_MM = 22.528
WORKING_DISTANCE_MM = 334.0
SIMULATED_CAMERA_PER_S = 25.0
RAISED_MM = 10.0


@dataclass(frozen=True)
class Size:
    """Size of frames, width and height in pixels, and of reliefs, in millions of triangles."""

    full_px: tuple[int, int] = FULL
    small_px: tuple[int, int] = (1024, 768)
    medium: float = 1.4
    large: float = 10.0
    small: float = 0.1
    """Size of the relief of the small frame."""
    least_rounds: int = 3
    leds_of_a_round: int = 12
    pixel_leds_of_a_round: int = 4


SMALLEST = Size((128, 96), (64, 48), 0.001, 0.002, 0.001, 1, 2, 1)


def figures(root: Path, rounds: int, *, smallest: bool = False) -> Iterator[dict[str, Any]]:
    """All figures of the renderer."""
    size = SMALLEST if smallest else Size()
    yield from gbuffer_figures(rounds, size)
    yield from frame_figures(root, rounds, size)
    yield from pixel_figures(root, rounds, size)
    yield memory_figure(root, size)


def relief(triangles: int) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Return vertices and faces of a bumpy rectangle 3:4, z up, in mm. From 1.4 million triangles on it has the
    0.2 mm cells of a scan; it is never smaller than the field of view."""
    down = round((triangles / 2 * 3 / 4) ** 0.5)
    across, half_y = down * 4 // 3, max(75.0, 0.1 * down)
    x, y = np.meshgrid(
        np.linspace(-half_y * 4 / 3, half_y * 4 / 3, across + 1), np.linspace(-half_y, half_y, down + 1)
    )
    z = 4.0 * np.sin(x / 6.0) * np.cos(y / 5.0) + 0.5 * np.sin(x * 1.7 + y)
    number = np.arange(x.size, dtype=np.int32).reshape(x.shape)
    a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]
    faces = np.stack([a, b, c, a, c, d], axis=-1).reshape(-1, 3)
    return np.stack([x, y, z], axis=-1).astype(np.float32).reshape(-1, 3), faces


def corners_of_relief(triangles: int) -> NDArray[np.float32]:
    """Return [about `triangles`, 3, 3] corners of triangles."""
    vertices, faces = relief(triangles)
    return vertices[faces]


def write_relief(path: Path, triangles: int) -> None:
    """Write a relief as binary PLY."""
    import trimesh

    trimesh.Trimesh(*relief(triangles), process=False).export(path)


def camera_pose() -> NDArray[np.float64]:
    """Return the pose of a camera that looks straight down from the working distance."""
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[2, 3] = WORKING_DISTANCE_MM
    return pose


def times_s(works: dict[str, Callable[[], Any]], rounds: int) -> dict[str, float]:
    """Return median times of interleaved functions. The first round is left out, because numba compiles then."""
    times: dict[str, list[float]] = {name: [] for name in works}
    for _ in range(1 + rounds):
        for name, work in works.items():
            start_s = time.perf_counter()
            work()
            times[name].append(time.perf_counter() - start_s)
    return {name: statistics.median(seconds[1:]) for name, seconds in times.items()}


# -- triangle of each pixel -------------------------------------------------------------------------------


def gbuffer_figures(rounds: int, size: Size) -> Iterator[dict[str, Any]]:
    """Seconds for the triangles of 12.6 Mpixel, with and without lens distortion, against ray tracers."""
    from sim.render.lens import Lens, sight
    from sim.render.raster import visible_triangles

    pose = camera_pose()
    focal_px = 1.0 / (1.0 / 35.0 - 1.0 / WORKING_DISTANCE_MM) / SENSOR_WIDTH_MM * size.full_px[0]
    straight = sight(Lens(*size.full_px, focal_px))
    distorted_sight = sight(Lens(*size.full_px, focal_px, (-0.05, 0.02, 1e-4, -2e-4, 0.01)))
    for millions in (size.medium, size.large):
        corners = corners_of_relief(int(millions * 1e6))
        works: dict[str, Callable[[], Any]] = {
            "straight": partial(visible_triangles, corners, straight, pose),
            "bent": partial(visible_triangles, corners, distorted_sight, pose),
        }
        works |= ray_tracers(corners, straight.lens, pose)
        medians = times_s(works, max(rounds, size.least_rounds))
        for lens in ("straight", "bent"):
            for peer in [name for name in works if name not in ("straight", "bent")]:
                yield {
                    "name": f"gbuffer_{millions:g}_M_triangles_{lens}_lens",
                    "value": medians[lens],
                    "unit": "s",
                    "peer": peer,
                    "ratio": medians[peer] / medians[lens],
                    "peer_value": round(medians[peer], 4),
                }


def ray_tracers(
    corners: NDArray[np.float32], lens: Any, pose: NDArray[np.float64]
) -> dict[str, Callable[[], Any]]:
    """Return functions that trace the primary rays of an undistorted camera with other programs; trees and rays
    are prepared before."""
    columns, rows = np.meshgrid(np.arange(lens.width_px), np.arange(lens.height_px))
    x, y = (columns - lens.centre_px[0]) / lens.focal_px, (rows - lens.centre_px[1]) / lens.focal_px
    ways = (np.stack([x, y, np.ones_like(x)], axis=-1) @ pose[:3, :3].T).astype(np.float32).reshape(-1, 3)
    origins = np.broadcast_to(pose[:3, 3].astype(np.float32), ways.shape).copy()
    peers: dict[str, Callable[[], Any]] = {}
    from embreex import rtcore_scene
    from embreex.mesh_construction import TriangleMesh

    tree = rtcore_scene.EmbreeScene()
    TriangleMesh(tree, corners)
    peers["embreex"] = lambda: tree.run(origins, ways)
    try:
        import open3d
    except ImportError:
        return peers
    scene = open3d.t.geometry.RaycastingScene()
    indices = np.arange(3 * len(corners), dtype=np.uint32).reshape(-1, 3)
    scene.add_triangles(open3d.core.Tensor(corners.reshape(-1, 3)), open3d.core.Tensor(indices))
    rays = open3d.core.Tensor(np.concatenate([origins, ways], axis=1))
    peers["open3d"] = lambda: scene.cast_rays(rays)
    return peers


# -- frames -----------------------------------------------------------------------------------------------


def photographer(root: Path, mesh: Path, size: tuple[int, int], **settings: Any) -> Any:
    """Return the demo's dome around one mesh, and the flange pose that looks straight down at it. `settings` are
    those of the world, by default `flat`."""
    from coupole.preflight.job import read_job
    from coupole.preflight.simulated_world import world_config
    from sim.optics.photographer import Photographer
    from sim.world.config import Config

    job = read_job(root / "configs/plans/demo.yaml")
    world = world_config(job.cell, job, job.cell.rig.sensor)
    support_from_object = np.eye(4)
    support_from_object[2, 3] = RAISED_MM
    world["scene"]["objects"] = [{"path": mesh, "unit": "mm", "support_from_object": support_from_object.tolist()}]
    world["settings"] |= {"shading": "flat", **settings}
    world["camera"] |= {
        "width_px": size[0],
        "height_px": size[1],
        "pixel_pitch_um": SENSOR_WIDTH_MM / size[0] * 1e3,
        "focus_distance_mm": WORKING_DISTANCE_MM,
        "flange_from_camera": np.eye(4).tolist(),
    }
    config = Config.model_validate(world)
    pose = np.array(config.scene.base_from_support) @ support_from_object @ camera_pose()
    return Photographer(config.scene, config.rendered_camera, config.settings), pose


def render_leds(by: Any, pose: NDArray[np.float64], out: NDArray[np.uint16], leds: range) -> None:
    from sim.devices.camera_body import Exposed

    for led in leds:
        by.render(out, Exposed({led: 0.008}, [], 0.008, 1.0, led, pose))


def frame_figures(root: Path, rounds: int, size: Size) -> Iterator[dict[str, Any]]:
    """Yield frames per second of three cases: the first frame of each LED, with its shadow rays; again with cached
    shadows, in another view of the same triangles; again from the same pose, with cached radiance as far as memory
    allows."""
    for size_px, millions in ((size.full_px, size.medium), (size.small_px, size.small)):
        label = f"{size_px[0]}x{size_px[1]}_{millions:g}_M_triangles"
        with tempfile.TemporaryDirectory() as folder:
            mesh = Path(folder) / "mesh.ply"
            write_relief(mesh, int(millions * 1e6))
            by, pose = photographer(root, mesh, size_px)
            peer = mitsuba_frame(mesh, by, size_px) if size_px == size.full_px else None
        nudged_pose = pose.copy()
        nudged_pose[0, 3] += 0.01
        out = np.zeros(size_px[::-1], np.uint16)
        render_leds(by, nudged_pose, out, range(1))
        render_leds(by, pose, out, range(1))
        per_frame: dict[str, list[float]] = {"shadow_rays": [], "shadows_kept": [], "radiance_kept": []}
        peers: list[float] = []
        for turn in range(rounds):
            if peer is not None:
                start_s = time.perf_counter()
                peer(turn)
                peers.append(time.perf_counter() - start_s)
            first = 1 + turn * size.leds_of_a_round
            leds = range(first, first + size.leds_of_a_round)
            for times, place in zip(per_frame.values(), (pose, nudged_pose, nudged_pose), strict=True):
                render_leds(by, place, out, range(1))  # the new pose is rasterised here, which is not timed
                start_s = time.perf_counter()
                render_leds(by, place, out, leds)
                times.append((time.perf_counter() - start_s) / len(leds))
        peer_s = statistics.median(peers) if peers else None
        for name, seconds in per_frame.items():
            value = 1.0 / statistics.median(seconds)
            yield {
                "name": f"frames_{label}_{name}",
                "value": value,
                "unit": "1/s",
                "peer": "simulated_camera_at_25_hz" if peer_s is None else "mitsuba_scalar_rgb_1_sample",
                "ratio": value / SIMULATED_CAMERA_PER_S if peer_s is None else value * peer_s,
                "peer_value": round(SIMULATED_CAMERA_PER_S if peer_s is None else 1.0 / peer_s, 4),
            }


def pixel_figures(root: Path, rounds: int, size: Size) -> Iterator[dict[str, Any]]:
    """Yield frames per second at full size with light and shadow on each pixel, each frame under another LED.

    The cases are the light alone, with blur, and with interreflection too. The peers are Mitsuba, and one radiance
    for each triangle. Then follows the time of blur alone, against a second.
    """
    ways: dict[str, dict[str, Any]] = {
        "flat": {"shading": "flat"},
        "pixel_direct": {
            "shading": "pixel",
            "interreflection": False,
            "camera": {"kind": "memory", "blur": False},
        },
        "pixel_direct_blurred": {"shading": "pixel", "interreflection": False},
        "pixel": {"shading": "pixel"},
    }
    out = np.zeros(size.full_px[::-1], np.uint16)
    with tempfile.TemporaryDirectory() as folder:
        mesh = Path(folder) / "mesh.ply"
        write_relief(mesh, int(size.medium * 1e6))
        photographers = {
            name: photographer(root, mesh, size.full_px, **settings) for name, settings in ways.items()
        }
        peer = mitsuba_frame(mesh, photographers["flat"][0], size.full_px)
    times: dict[str, list[float]] = {name: [] for name in (*photographers, "mitsuba")}
    for turn in range(1 + rounds):
        first = 1 + turn * size.pixel_leds_of_a_round
        leds = range(first, first + size.pixel_leds_of_a_round)
        for name, (by, pose) in photographers.items():
            if turn == 0:
                render_leds(by, pose, out, range(1))  # rasterises, and prepares all that depends on the pose
            start_s = time.perf_counter()
            render_leds(by, pose, out, leds)
            times[name].append((time.perf_counter() - start_s) / len(leds))
        if peer is not None:
            start_s = time.perf_counter()
            peer(turn)
            times["mitsuba"].append(time.perf_counter() - start_s)
    frame_s = {name: statistics.median(seconds[1:]) for name, seconds in times.items() if seconds}
    for name in list(ways)[1:]:
        for rival in ("mitsuba", "flat"):
            if rival in frame_s:
                yield {
                    "name": f"frames_{size.full_px[0]}x{size.full_px[1]}_{size.medium:g}_M_triangles_{name}",
                    "value": 1.0 / frame_s[name],
                    "unit": "1/s",
                    "peer": "mitsuba_scalar_rgb_1_sample" if rival == "mitsuba" else rival,
                    "ratio": frame_s[rival] / frame_s[name],
                    "peer_value": round(1.0 / frame_s[rival], 4),
                }
    by, pose = photographers["pixel_direct"]
    yield _blur_figure(by, pose, max(rounds, size.least_rounds), size)


def _blur_figure(by: Any, pose: NDArray[np.float64], rounds: int, size: Size) -> dict[str, Any]:
    """Return the seconds of blur alone."""
    from sim.optics.blur import through
    from sim.optics.sensor import electrons

    look = by._look_from(pose)
    image = electrons(look.view.site, by._led(look, 500), by._falloff, electrons_per_radiance=1.0)
    disk_px, channels = by._disk_px(look), by.sensor.channels()
    blur = partial(through, by._objective, image, disk_px, channels, pixel_pitch_um=5.5)
    blur_s = times_s({"ours": blur}, rounds)["ours"]
    name = f"blur_{size.full_px[0]}x{size.full_px[1]}"
    return {"name": name, "value": blur_s, "unit": "s", "peer": "limit_1_s", "ratio": 1.0 / blur_s}


def mitsuba_frame(mesh: Path, by: Any, size_px: tuple[int, int]) -> Callable[[int], None] | None:
    """Return a function that moves Mitsuba's LED and renders a frame; None if Mitsuba is not installed."""
    try:
        import mitsuba
    except ImportError:
        return None
    mitsuba.set_variant("scalar_rgb")
    transform = mitsuba.ScalarTransform4f
    scene = mitsuba.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "direct", "emitter_samples": 1, "bsdf_samples": 0},
            "mesh": {"type": "ply", "filename": str(mesh), "face_normals": True},
            "led": {
                "type": "rectangle",
                "to_world": transform().scale(3.5),
                "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [1e7] * 3}},
            },
            "camera": {
                "type": "perspective",
                "fov": 2 * np.degrees(np.arctan(SENSOR_WIDTH_MM / 2 * (1 / 35.0 - 1 / WORKING_DISTANCE_MM))),
                "to_world": transform().look_at([0, 0, WORKING_DISTANCE_MM], [0, 0, 0], [0, 1, 0]),
                "film": {"type": "hdrfilm", "width": size_px[0], "height": size_px[1], "rfilter": {"type": "box"}},
                "sampler": {"type": "independent", "sample_count": 1},
            },
        }
    )
    parameters = mitsuba.traverse(scene)

    def move_and_render(led: int) -> None:
        position = by.leds.positions_mm[led]
        parameters["led.to_world"] = transform().look_at(position, [0, 0, 0], [0, 0, 1]) @ transform().scale(3.5)
        parameters.update()
        mitsuba.render(scene, spp=1)

    return move_and_render


# -- memory -----------------------------------------------------------------------------------------------

_ALONE = """
import json, sys, time
from pathlib import Path
import numpy as np
sys.path[:0] = [{tools!r}, {root!r}]
from bench_render import photographer, render_leds
started = time.perf_counter()
by, pose = photographer(Path({root!r}), Path({mesh!r}), {size_px!r}, shading="pixel")
read_s = time.perf_counter() - started
render_leds(by, pose, np.zeros({size_px!r}[::-1], np.uint16), range(1))
peak = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM"))
print(json.dumps([int(peak.split()[1]) / 2**20, read_s]))
"""


def memory_figure(root: Path, size: Size) -> dict[str, Any]:
    """Measure the peak memory of a process that reads a binary PLY of 10 million triangles and renders one LED at
    full size by pixel, with blur and interreflection, against the 16 GiB of a laboratory's computer."""
    with tempfile.TemporaryDirectory() as folder:
        mesh = Path(folder) / "mesh.ply"
        write_relief(mesh, int(size.large * 1e6))
        script = _ALONE.format(tools=str(root / "tools"), root=str(root), mesh=str(mesh), size_px=size.full_px)
        process = subprocess.run([sys.executable, "-c", script], check=True, capture_output=True, text=True)
    peak, read_s = json.loads(process.stdout)
    return {
        "name": f"peak_memory_{size.large:g}_M_triangles",
        "value": peak,
        "unit": "GiB",
        "peer": "memory_of_16_GiB",
        "ratio": 16.0 / peak,
        "read_s": round(read_s, 2),
    }
