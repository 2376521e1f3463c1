"""A random simulated cell: its true parameters, and its rendered frames in the form of a run."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.calibration.grey_image import Picture
from coupole.calibration.leds.led_plan import led_plan
from coupole.calibration.leds.matching import LedSightings
from coupole.calibration.leds.sources import LedImages
from coupole.calibration.leds.spots import find_spots
from coupole.calibration.poses import kuka_poses
from coupole.calibration.sources import About, Source, Sources
from coupole.geometry import apply, inverse, transform
from coupole.motion.itinerary import plan_itinerary
from coupole.plan.cell import Cell, read_cell
from coupole.plan.led_table import LedTable
from coupole.plan.templates import TEMPLATES
from coupole.preflight.job import read_job
from coupole.preflight.simulated_world import world_config
from sim.devices.kuka_kinematics import PoseErrors, flange_pose
from sim.strangers import Strangers
from sim.world.config import Config
from sim.world.stills import Stills
from strange_cells import draw_stranger

ROOT = Path(__file__).resolve().parents[1]
RIG = ROOT / "configs/rigs/sim-imperfect.yaml"
EXPOSURE_S = 0.001
LAMPS, LAMPS_ELEVATION_DEG = 6, 62.0
"""Number of LEDs around board and object that light them. They are few, because each is rendered separately."""
SQUARES, SQUARE_MM, MARKER_MM, THICKNESS_MM = (12, 9), 16.0, 9.6, 4.0
STICKERS, STICKER_MM = 16, 6.0
LED_BOARDS, MESH_IMAGES = 8, 10
_MIDDLE_BOARD = 60
FULL_WIDTH_PX, FULL_PITCH_UM = 4096, 5.5

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Postures:
    """The arm's angles for each acquisition, in degrees; the same for all cells."""

    board: Floats
    """[n, 6]."""
    mesh: Floats
    """[n, 6]."""
    leds: Floats
    """[v, 6]."""
    boards_of_leds: tuple[tuple[int, ...], ...]
    """[v] boards of the dome that are lit at each."""


def postures(images: int, *, led_boards: int | None = None, leds: bool = True) -> Postures:
    """Return postures as `coupole plan new` plans them: for `images` images of the calibration board, and for the
    LEDs of `led_boards` neighbouring boards of the dome, or of all; without `leds`, none for LEDs."""
    cell = read_cell(RIG)
    with tempfile.TemporaryDirectory() as folder:
        board, mesh = (_itinerary(Path(folder), TEMPLATES[name]) for name in ("charuco", "mesh"))
        views = _led_views(cell, led_boards, Path(folder)) if leds else ()
    return Postures(
        _some(board, images),
        _some(mesh, MESH_IMAGES),
        np.array([view.joints_deg for view in views]).reshape(-1, 6),
        tuple(view.lights.boards for view in views),
    )


def _led_views(cell: Cell, led_boards: int | None, folder: Path) -> Sequence[Any]:
    middles_mm = cell.leds.positions_mm.reshape(-1, 6, 3).mean(axis=1)
    nearest = np.argsort(np.linalg.norm(middles_mm - middles_mm[_MIDDLE_BOARD], axis=1))[:led_boards]
    cell = replace(cell, leds=some_leds(cell.leds, cell.leds.boards[::6][nearest]))
    plan = folder / "leds.yaml"
    plan.write_text(led_plan(cell, name="leds", rig=str(RIG)))
    return tuple(read_job(plan).plan.view_entries)


def some_leds(table: LedTable, boards: Sequence[int] | NDArray[np.int64]) -> LedTable:
    """The part of a dome's table with these boards."""
    rows = np.isin(table.boards, boards)
    return LedTable(
        table.ids[rows], table.boards[rows], table.positions_mm[rows], table.normals[rows], table.flux_lm[rows]
    )


def lamps(table: LedTable, base_from_support: Floats) -> list[int]:
    """LEDs nearest to `LAMPS` directions around the support."""
    azimuths = np.radians(np.arange(LAMPS) * 360.0 / LAMPS)
    elevation = np.radians(LAMPS_ELEVATION_DEG)
    directions = np.stack(
        [
            np.cos(azimuths) * np.cos(elevation),
            np.sin(azimuths) * np.cos(elevation),
            np.full(LAMPS, np.sin(elevation)),
        ]
    )
    there = apply(inverse(base_from_support), table.positions_mm)
    nearest = np.argmax(there / np.linalg.norm(there, axis=1, keepdims=True) @ directions, axis=0)
    return [int(led) for led in table.ids[nearest]]


def _itinerary(folder: Path, template: str) -> Floats:
    plan = folder / "plan.yaml"
    plan.write_text(template.format(name="prove", rig=RIG))
    job = read_job(plan)
    visits = plan_itinerary(job.schedule.views, job.cell.rig, None, job.cell.rig.motion.home_joints_deg).visits
    return np.array([visit.joints_deg for visit in visits if visit is not None])


def _some(joints_deg: Floats, count: int) -> Floats:
    subset: Floats = joints_deg[np.unique(np.linspace(0, len(joints_deg) - 1, count).astype(int))]
    return subset


# -- a cell and its truth ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class RandomCell:
    """A cell: lens, hand-eye, arm, dome, and the places of board and object, drawn by its seed."""

    seed: int
    width_px: int
    samples: int
    """Rays per pixel and direction."""
    absolute: bool
    """The arm has absolute errors of 0.3 mm and 0.02 deg in addition to its repeatability."""
    stranger: str | None = None
    """Name of one of `strange_cells.STRANGERS`; empty for a cell without effects that calibrations cannot
    model."""

    @cached_property
    def strangers(self) -> Strangers:
        return Strangers.model_validate(draw_stranger(self.stranger, self.seed, self.width_px))

    @cached_property
    def cell(self) -> Cell:
        return read_cell(RIG)

    @property
    def size_px(self) -> tuple[int, int]:
        return self.width_px, self.width_px * 3 // 4

    @cached_property
    def arm_errors(self) -> PoseErrors:
        absolute = (0.3, 0.02) if self.absolute else (0.0, 0.0)
        return PoseErrors(self.seed, 30.0, 0.003, *absolute, self.strangers.arm)

    @cached_property
    def flange_from_camera(self) -> Floats:
        random = np.random.default_rng((self.seed, 1))
        return transform(
            np.array([0.0, 0.0, 120.0]) + random.normal(0.0, 2.0, 3), tuple(random.normal(0.0, 0.7, 3))
        )

    @cached_property
    def lens(self) -> dict[str, float]:
        """Focus and distortion of the cell's lens."""
        random = np.random.default_rng((self.seed, 2))
        figures = (random.uniform(330.0, 342.0), random.normal(-0.03, 0.01), *random.normal(0.0, 1e-4, 2))
        return dict(zip(("focus_mm", "k1", "p1", "p2"), map(float, figures), strict=True))

    def place(self, purpose: int) -> dict[str, Any]:
        """Return the pose of a thing on the support, in the support's frame."""
        random = np.random.default_rng((self.seed, 3, purpose))
        return {
            "translation_mm": [*random.uniform(-8.0, 8.0, 2), 0.0],
            "abc_deg": [float(random.uniform(-15.0, 15.0)), 0.0, 0.0],
        }

    @property
    def pitch_um(self) -> float:
        return FULL_PITCH_UM * FULL_WIDTH_PX / self.width_px

    @property
    def true_lens(self) -> dict[str, float]:
        """True values of the lens, by the parameter names of records."""
        focal_px = 1e3 / self.pitch_um / (1.0 / self.cell.rig.lens.focal_length_mm - 1.0 / self.lens["focus_mm"])
        distortion = {name: self.lens[name] for name in ("k1", "p1", "p2")}
        middle = {"cx_px": 0.5 * (self.size_px[0] - 1), "cy_px": 0.5 * (self.size_px[1] - 1)}
        return {"fx_px": focal_px, "fy_px": focal_px, **middle, **distortion, "k2": 0.0}

    def config(self, *things: dict[str, Any]) -> dict[str, Any]:
        """Configuration of the cell's world, with things on the support."""
        width_px, height_px = self.size_px
        sensor = self.cell.rig.sensor.model_copy(
            update={"width_px": width_px, "height_px": height_px, "pixel_pitch_um": self.pitch_um}
        )
        config = world_config(self.cell, None, sensor)
        config["camera"] |= {
            "flange_from_camera": self.flange_from_camera.tolist(),
            "focus_distance_mm": self.lens["focus_mm"],
        }
        k4 = self.strangers.lens.rational[0]  # k4 is the coefficient of the denominator that corresponds to k1
        distortion = (self.lens["k1"] + k4, 0.0, self.lens["p1"], self.lens["p2"], 0.0)
        config["settings"] |= {
            "seed": self.seed,
            "things": list(things),
            "arm_shadows": False,
            "strangers": self.strangers.model_dump(),
            "camera": {"kind": "memory", "samples_per_side": self.samples, "distortion": distortion},
            "dome": {"seed": self.seed, "board_shift_mm": 1.0, "board_turn_deg": 0.2, "led_shift_mm": 0.05},
        }
        return config

    def shifted_base(self, in_base: Floats) -> Floats:
        """Return poses [..., 4, 4] of the base in a base shifted by the arm's error that all poses share. No image
        shows this error, and no record claims to know it."""
        return inverse(transform(tuple(self.arm_errors.base_error_mm()), (0.0, 0.0, 0.0))) @ in_base

    def own_base(self, in_base: Floats) -> Floats:
        """Return the same in the arm's own base, which is also rotated by the zero error of its first axis."""
        zero_deg = float(self.arm_errors.axis_zero_error_deg()[0])
        first = flange_pose((zero_deg, 0, 0, 0, 0, 0)) @ inverse(flange_pose((0, 0, 0, 0, 0, 0)))
        return inverse(first) @ self.shifted_base(in_base)

    @property
    def base_from_support(self) -> Floats:
        return self.cell.rig.support.base_from_support.matrix()


# -- its frames -------------------------------------------------------------------------------------------


class Photographs:
    """Frames of one acquisition, and the poses reported by the robot; each is rendered on request."""

    def __init__(self, cell: RandomCell, joints_deg: Floats, first_stop: int, *things: dict[str, Any]) -> None:
        config = cell.config(*things)
        self.camera = config["camera"]
        self.truth = Config.model_validate(config)
        self._stills = Stills(config)
        self._joints_deg = joints_deg
        self._lamps = lamps(cell.cell.leds, cell.base_from_support)
        self.reported = np.stack([flange_pose(joints) for joints in joints_deg])
        self._true = [
            cell.arm_errors.true_flange_pose(joints, first_stop + stop, joints_deg[max(stop - 1, 0)])
            for stop, joints in enumerate(joints_deg)
        ]

    def frame(self, number: int, leds: Sequence[int]) -> NDArray[np.uint16]:
        return self._stills.take(self._true[number], leds=leds, panels=[], exposure_s=EXPOSURE_S)

    def sources(self) -> Sources:
        """Sources in the form of a run of the things on the support."""
        white = self.white_dn - self.camera["black_dn"]

        def read_picture(number: int) -> Picture:
            frame = self.frame(number, self._lamps).astype(np.float64)
            return Picture(frame - self.camera["black_dn"], self.camera["bayer_pattern"], white, str(number))

        images = tuple(
            Source(str(number), partial(read_picture, number), tuple(joints))
            for number, joints in enumerate(self._joints_deg.tolist())
        )
        return Sources(images, kuka_poses(self.reported), About(is_simulated=True), (("rendered", "0" * 64),))

    def leds(self, table: LedTable, lit: Sequence[tuple[int, int]]) -> LedImages:
        """Return spots of LEDs; `lit` gives view and row of the table for each frame."""
        spots = []
        for view, row in lit:
            frame = self.frame(view, [int(table.ids[row])])
            found_spots = find_spots(
                frame, float(self.camera["black_dn"]), self.camera["bayer_pattern"], self.white_dn
            )
            spots += [(view, row, spot.pixel, spot.covariance) for spot in found_spots.good]
        sightings = LedSightings(
            np.array([spot[0] for spot in spots], dtype=np.intp),
            np.array([spot[1] for spot in spots], dtype=np.intp),
            np.array([spot[2] for spot in spots]).reshape(-1, 2),
            np.array([spot[3] for spot in spots]).reshape(-1, 2, 2),
            np.array(lit, dtype=np.intp),
        )
        views = tuple(str(number) for number in range(len(self.reported)))
        size_px = (self.camera["width_px"], self.camera["height_px"])
        about = About(is_simulated=True)
        return LedImages(
            sightings, self.reported, views, size_px, (), about, (("rendered", "0" * 64),), self._joints_deg
        )

    @property
    def white_dn(self) -> int:
        return (1 << int(self.camera["bit_depth"])) - 1
