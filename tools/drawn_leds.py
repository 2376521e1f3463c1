"""Random cells for LED positions: spots from a separate forward model, with one effect that a calibration may not
model.

The lens follows Brown's formulas, dies are squares of many points, and the primary lens is that of
`sim.strangers`. All else is drawn at random: boards that are not where the table says, an arm with noise, and
records with errors of their stated size. The effects are those of `prove_led_positions`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from coupole.calibration.leds.matching import LedSightings
from coupole.calibration.leds.sources import LedImages
from coupole.calibration.optics import NAMES, Intrinsics
from coupole.calibration.posed_camera import CameraPrior
from coupole.calibration.sources import About
from coupole.plan.led_table import LedTable
from sim.render.emitter import LED_SIDE_MM, Emitter
from sim.strangers.light_stranger import LightStranger

Floats = NDArray[np.float64]
SIZE_PX = np.array([4096, 3072])
FOCAL_PX, INDEX = 7120.0, 1.41
DOME_MM, MIDDLE_MM = 1500.0, np.array([200.0, 0.0, 1450.0])
MOST_ANGLE_DEG, NEAREST_MM, MARGIN_PX = 65.0, 300.0, 60.0
LENS_U = np.array([0.3, 0.3, 0.5, 0.5, 2e-4, 2e-3, 1e-5, 1e-5])
HAND_EYE_MM, HAND_EYE_DEG, ARM_MM, ARM_DEG = 0.02, 0.002, 0.03, 0.003
PIXEL_PX, TOLERANCE_MM = 0.05, 0.05


@dataclass(frozen=True)
class DrawnLeds:
    """A random cell: what a calibration knows, and the truth."""

    table: LedTable
    images: LedImages
    prior: CameraPrior
    true_mm: Floats


def draw_leds(seed: int, boards: int, views: int, cause: str, strength: float) -> DrawnLeds:
    """Return a cell with one effect of this strength. For one seed, all else is the same."""
    random, random_of_dies = np.random.default_rng((seed, 1)), np.random.default_rng((seed, 2))
    table = _table(boards, random)
    true_mm, frames = _as_built(table, random)
    eyes = _eyes(views, table, random)
    lens = np.array([FOCAL_PX, FOCAL_PX + 1, 2049.3, 1533.8, -0.05, 0.02, 2e-4, -3e-4, 0.0])
    lens[:2] += random.normal(0.0, 5.0)
    image_of = _image(cause, strength, len(true_mm), random_of_dies)
    view, led, pixels = [], [], []
    for number, eye in enumerate(eyes):
        moved_mm = np.array([0.6, -0.64, 0.48]) * strength if cause == "moved" and 2 * number >= views else 0.0
        for row in _visible(true_mm + moved_mm, frames, eye, lens):
            die = _die(true_mm[row] + moved_mm, frames[row])
            spot = _spot(image_of(die, eye[:3, 3], int(row)), eye, lens, *_of_field(cause, strength))
            view.append(number)
            led.append(int(row))
            pixels.append(spot + random.normal(0.0, PIXEL_PX, 2))
    flange_from_camera = _pose((31.0, -42.0, 118.0), np.array([4.0, -3.0, 60.0]))
    reported_poses = np.stack([eye @ np.linalg.inv(flange_from_camera) for eye in eyes])
    for pose in reported_poses:
        turn = Rotation.from_rotvec(random.normal(0.0, ARM_DEG, 3), degrees=True).as_matrix()
        pose[:3, :3] = pose[:3, :3] @ turn
        pose[:3, 3] += random.normal(0.0, ARM_MM, 3)
    if cause == "arm":
        reported_poses[:, :3, 3] *= 1.0 + 1e-4 * strength
    sightings = LedSightings(
        np.array(view),
        np.array(led),
        np.array(pixels).reshape(-1, 2),
        np.tile(PIXEL_PX**2 * np.eye(2), (len(view), 1, 1)),
        np.stack([view, led], axis=1),
    )
    names = tuple(f"v{number}" for number in range(views))
    images = LedImages(
        sightings, reported_poses, names, (4096, 3072), (), About(is_simulated=True), (("drawn", "0" * 64),)
    )
    return DrawnLeds(table, images, _records(lens, flange_from_camera, random), true_mm)


def _table(boards: int, random: np.random.Generator) -> LedTable:
    """Return the table of boards of 2 x 3 LEDs around one direction of the dome; z of the base points down."""
    towards = Rotation.from_rotvec([0.0, 0.0, random.uniform(0.0, 2 * np.pi)]).apply([0.8, 0.0, -0.6])
    spiral = np.arange(180)
    heights = np.sin(np.radians(8)) + (np.sin(np.radians(70)) - np.sin(np.radians(8))) * (spiral + 0.5) / 180
    ring, around = np.sqrt(1 - heights**2), spiral * np.pi * (3 - np.sqrt(5))
    outwards = np.stack([ring * np.cos(around), ring * np.sin(around), -heights], axis=1)
    outwards = outwards[np.sort(np.argsort(-outwards @ towards)[:boards])]
    places, normals = [], []
    for out in outwards:
        along = np.array([-out[1], out[0], 0.0]) / np.hypot(out[0], out[1])
        across = np.cross(out, along)
        places += [
            MIDDLE_MM + DOME_MM * out + 60.0 * (column * along + row * across)
            for row in (-0.5, 0.5)
            for column in (-1, 0, 1)
        ]
        normals += [-out] * 6
    count = 6 * boards
    return LedTable(np.arange(count), np.arange(count) // 6, np.array(places), np.array(normals), np.ones(count))


def _as_built(table: LedTable, random: np.random.Generator) -> tuple[Floats, Floats]:
    """Return true centres [n, 3] and frames of the dies [n, 3, 3]: x and y along the board's sides, z along its
    normal."""
    true_mm, frames = table.positions_mm.copy(), np.empty((len(table.ids), 3, 3))
    for board in np.unique(table.boards):
        rows = np.flatnonzero(table.boards == board)
        turn = Rotation.from_rotvec(random.normal(0.0, 0.5, 3), degrees=True).as_matrix()
        middle_mm = true_mm[rows].mean(axis=0)
        off_mm = true_mm[rows] - middle_mm
        along = off_mm[2] - off_mm[0]
        x, normal = along / np.linalg.norm(along), table.normals[rows[0]]
        frames[rows] = turn @ np.stack([x, np.cross(normal, x), normal], axis=1)
        true_mm[rows] = middle_mm + random.normal(0.0, 2.0, 3)
        true_mm[rows] += (off_mm + random.normal(0.0, TOLERANCE_MM, (6, 3))) @ turn.T
    return true_mm, frames


def _eyes(count: int, table: LedTable, random: np.random.Generator) -> Floats:
    """Return poses [count, 4, 4] of the camera within the arm's reach, each towards one of the boards."""
    middles_mm = table.positions_mm.reshape(-1, 6, 3).mean(axis=1)
    poses = np.tile(np.eye(4), (count, 1, 1))
    for number, pose in enumerate(poses):
        target_mm = middles_mm[number * len(middles_mm) // count]
        outwards = (target_mm - MIDDLE_MM) / DOME_MM
        place_mm = np.array([200.0, 0.0, 700.0]) - 250 * outwards * [1, 1, 0] + random.uniform(-450, 450, 3)
        z = target_mm + random.uniform(-80, 80, 3) - place_mm
        z /= np.linalg.norm(z)
        x = np.cross(z, random.normal(size=3))
        x /= np.linalg.norm(x)
        pose[:3, :3], pose[:3, 3] = np.stack([x, np.cross(z, x), z], axis=1), place_mm
    return poses


def _visible(centres_mm: Floats, frames: Floats, eye: Floats, lens: Floats) -> NDArray[np.intp]:
    away = eye[:3, 3] - centres_mm
    facing = np.einsum("ni,ni->n", away, frames[:, :, 2]) / np.linalg.norm(away, axis=1)
    in_camera = -away @ eye[:3, :3]
    pixels = _brown(in_camera, lens)
    inside = np.all((pixels > MARGIN_PX) & (pixels < SIZE_PX - MARGIN_PX), axis=1)
    return np.flatnonzero((in_camera[:, 2] > NEAREST_MM) & inside & (facing > np.cos(np.radians(MOST_ANGLE_DEG))))


def _die(centre_mm: Floats, frame: Floats) -> Emitter:
    half = 0.5 * LED_SIDE_MM
    return Emitter(centre_mm, frame[:, 2], half * frame[:, 0], half * frame[:, 1], 1.0)


ImageOf = Callable[[Emitter, Floats, int], Emitter]


def _image(cause: str, strength: float, leds: int, random: np.random.Generator) -> ImageOf:
    """Return the function that gives the image of a die: `image_of(die, eye_mm, led)`."""
    if cause in ("primary", "each"):
        sizes_mm = strength * (1.0 + (0.3 * random.standard_normal(leds) if cause == "each" else np.zeros(leds)))
        lenses = [LightStranger(primary_lens_mm=float(size)) for size in sizes_mm]
        return lambda die, eye_mm, led: lenses[led].seen_from(die, eye_mm)
    if cause == "oval":
        return lambda die, eye_mm, led: _through_oval(die, eye_mm, strength)
    if cause == "window":
        return lambda die, eye_mm, led: _through_window(die, eye_mm, strength)
    return lambda die, eye_mm, led: die


def _through_oval(die: Emitter, eye_mm: Floats, strength_mm: float) -> Emitter:
    away = (eye_mm - die.centre_mm) / np.linalg.norm(eye_mm - die.centre_mm)
    x, y = (half / np.linalg.norm(half) for half in (die.half_u_mm, die.half_v_mm))
    return replace(die, centre_mm=die.centre_mm + strength_mm * ((away @ x) * x + 0.5 * (away @ y) * y))


def _through_window(die: Emitter, eye_mm: Floats, thick_mm: float) -> Emitter:
    """Return a die under a flat layer: its image is raised along the normal, more for oblique views."""
    away = (eye_mm - die.centre_mm) / np.linalg.norm(eye_mm - die.centre_mm)
    cosine = float(away @ die.normal)
    tangent = np.sqrt(1.0 - cosine**2) / cosine
    sine_inside = np.sqrt(1.0 - cosine**2) / INDEX
    tangent_inside = sine_inside / np.sqrt(1.0 - sine_inside**2)
    raised_mm = thick_mm * (1.0 - tangent_inside / tangent)
    return replace(die, centre_mm=die.centre_mm + raised_mm * die.normal)


def _of_field(cause: str, strength: float) -> tuple[float, float]:
    """Return the relative growth of the picture, and the growth in proportion to the nearness (at a distance of 1
    m)."""
    return (
        1e-4 * strength if cause == "field" else 0.0,
        1e-4 * strength if cause == "near" else 0.0,
    )


def _spot(die: Emitter, eye: Floats, lens: Floats, of_field: float, of_near: float) -> Floats:
    """Return the middle of a die's picture: many points on it, weighted by their area in the picture."""
    steps = (np.arange(5) - 2.0) / 2.5
    a, b = (axis.ravel() for axis in np.meshgrid(steps, steps))
    there = die.centre_mm + a[:, None] * die.half_u_mm + b[:, None] * die.half_v_mm
    in_camera = (there - eye[:3, 3]) @ eye[:3, :3]
    weights = in_camera[:, 2] ** -3.0
    middle = np.asarray(weights @ _brown(in_camera, lens) / weights.sum())
    relative_growth = of_field + of_near * 1000.0 / float(in_camera[:, 2].mean())
    return middle + relative_growth * (middle - lens[2:4])


def _brown(in_camera: Floats, lens: Floats) -> Floats:
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = lens
    x, y = in_camera[:, 0] / in_camera[:, 2], in_camera[:, 1] / in_camera[:, 2]
    square = x**2 + y**2
    radial = 1.0 + k1 * square + k2 * square**2 + k3 * square**3
    bent_x = radial * x + 2.0 * p1 * x * y + p2 * (square + 2.0 * x**2)
    bent_y = radial * y + 2.0 * p2 * x * y + p1 * (square + 2.0 * y**2)
    return np.stack([cx + fx * bent_x, cy + fy * bent_y], axis=1)


def _pose(translation_mm: Sequence[float], turn_deg: Floats) -> Floats:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_rotvec(turn_deg, degrees=True).as_matrix(), translation_mm
    return pose


def _records(lens: Floats, flange_from_camera: Floats, random: np.random.Generator) -> CameraPrior:
    """Return records of lens and hand-eye with errors of their stated size."""
    sigma = np.concatenate([LENS_U, np.full(3, HAND_EYE_MM), np.radians(np.full(3, HAND_EYE_DEG))])
    off = sigma * random.normal(size=len(sigma))
    values = lens.copy()
    values[: len(LENS_U)] += off[: len(LENS_U)]
    hand_eye = flange_from_camera.copy()
    hand_eye[:3, 3] += off[-6:-3]
    hand_eye[:3, :3] = hand_eye[:3, :3] @ Rotation.from_rotvec(off[-3:]).as_matrix()
    intrinsics = Intrinsics(**dict(zip(NAMES, values.tolist(), strict=True)))
    return CameraPrior(intrinsics, NAMES[: len(LENS_U)], hand_eye, np.diag(sigma**2))
