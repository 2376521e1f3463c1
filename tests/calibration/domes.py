"""Small and whole domes with a truth, and the spots that a camera sees of them: no code of the product."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation
from synthesis import Array, TrueLens, frame

from coupole.calibration.leds.matching import LedSightings
from coupole.calibration.optics import NAMES, Intrinsics
from coupole.calibration.posed_camera import CameraPrior
from coupole.plan.led_table import LedTable

LENS = TrueLens((7120.0, 7121.0), (2049.3, 1533.8), (-0.05, 0.02, 2e-4, -3e-4, 0.0))
SIZE_PX = (4096, 3072)
FREE = NAMES[:8]
LENS_U = np.array([0.3, 0.3, 0.5, 0.5, 2e-4, 2e-3, 1e-5, 1e-5])
HAND_EYE_MM, HAND_EYE_DEG = 0.02, 0.002
SUPPORT_MM = np.array([200.0, 0.0, 1450.0])
SIDE_MM = 7.0


@dataclass(frozen=True)
class Noise:
    """Of a synthetic cell, standard deviations."""

    pixel_px: float = 0.05
    robot_mm: float = 0.03
    robot_deg: float = 0.003
    tolerance_mm: float = 0.05
    board_mm: float = 2.0
    board_deg: float = 0.5
    records: float = 1.0
    """How far camera and hand-eye are from their records, in units of their uncertainty."""


@dataclass(frozen=True)
class Dome:
    """A dome, its table, and what was seen of it."""

    table: LedTable
    true_mm: Array
    true_normals: Array
    seen: LedSightings
    base_from_flange: Array
    """[v, 4, 4] as reported."""
    prior: CameraPrior

    @property
    def base_from_camera(self) -> Array:
        return self.base_from_flange @ self.prior.flange_from_camera


def table(boards: int = 180, radius_mm: float = 1500.0) -> LedTable:
    """Boards of 2 x 3 LEDs 60 mm apart on a zone of a sphere, z of the base pointing down; if there are fewer than
    180, those nearest to one direction."""
    heights = (
        np.sin(np.radians(8)) + (np.sin(np.radians(70)) - np.sin(np.radians(8))) * (np.arange(180) + 0.5) / 180
    )
    around, ring = np.arange(180) * np.pi * (3 - np.sqrt(5)), np.sqrt(1 - heights**2)
    outwards = np.stack([ring * np.cos(around), ring * np.sin(around), -heights], axis=1)
    nearest = np.argsort(-outwards @ [0.8, 0.0, -0.6], kind="stable")[:boards]
    positions, normals = [], []
    for out in outwards[np.sort(nearest)]:
        along = np.cross([0.0, 0.0, 1.0], out)
        along /= np.linalg.norm(along)
        across = np.cross(out, along)
        for row in range(2):
            for column in range(3):
                positions.append(SUPPORT_MM + radius_mm * out + 60 * ((column - 1) * along + (row - 0.5) * across))
                normals.append(-out)
    count = 6 * boards
    return LedTable(
        np.arange(count), np.arange(count) // 6, np.array(positions), np.array(normals), np.full(count, 1800.0)
    )


def eyes(count: int, boards: LedTable, random: np.random.Generator) -> Array:
    """Camera poses [count, 4, 4] within an arm's reach, each towards a part of the dome far from it."""
    middles = boards.positions_mm.reshape(-1, 6, 3).mean(axis=1)
    poses = []
    for number in range(count):
        target = middles[(number * len(middles)) // count]
        outwards = (target - SUPPORT_MM) / np.linalg.norm(target - SUPPORT_MM)
        place = np.array([200.0, 0.0, 700.0]) + random.uniform(-350, 350, 3) - 250 * outwards * [1, 1, 0]
        z = target + random.uniform(-80, 80, 3) - place
        z /= np.linalg.norm(z)
        x = np.cross(z, random.normal(size=3))
        x /= np.linalg.norm(x)
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = np.stack([x, np.cross(z, x), z], axis=1), place
        poses.append(pose)
    return np.array(poses)


def dome(
    seed: int,
    *,
    boards: int = 8,
    views: int = 12,
    noise: Noise = Noise(),
    most_views: int = 100,
    image: Callable[[Array, Array, Array], Array] = lambda centre_mm, normal, eye_mm: centre_mm,
) -> Dome:
    """A dome that differs from its table, seen by a camera that differs from its records; `image` is where an eye
    sees the middle of a die with this normal."""
    random = np.random.default_rng(seed)
    known = table(boards)
    true_mm, true_normals = known.positions_mm.copy(), known.normals.copy()
    for board in range(boards):
        rows = slice(6 * board, 6 * board + 6)
        turn = Rotation.from_rotvec(random.normal(0, noise.board_deg, 3), degrees=True).as_matrix()
        middle = true_mm[rows].mean(axis=0)
        own = random.normal(0, noise.tolerance_mm, (6, 3))
        true_mm[rows] = (true_mm[rows] - middle + own) @ turn.T + middle + random.normal(0, noise.board_mm, 3)
        true_normals[rows] = true_normals[rows] @ turn.T
    turn_deg = np.array([4.0, -3.0, 60.0])
    flange_from_camera = frame(np.array([31.0, -42.0, 118.0]), turn_deg)
    true_eyes = eyes(views, known, random)
    view, led, pixels = [], [], []
    for number, eye in enumerate(true_eyes):
        there = (true_mm - eye[:3, 3]) @ eye[:3, :3]
        facing = np.einsum("ni,ni->n", eye[:3, 3] - true_mm, true_normals) / np.linalg.norm(there, axis=1)
        for row in np.flatnonzero((there[:, 2] > 200) & (facing > np.cos(np.radians(65)))):
            seen_mm = image(true_mm[row], true_normals[row], eye[:3, 3])
            middle = outline_middle(LENS, eye, seen_mm, true_normals[row], random)
            if np.all((middle > 60) & (middle < np.array(SIZE_PX) - 60)) and led.count(row) < most_views:
                view.append(number)
                led.append(row)
                pixels.append(middle + random.normal(0, noise.pixel_px, 2))
    reported = []
    for eye in true_eyes:
        flange = eye @ np.linalg.inv(flange_from_camera)
        off = frame(random.normal(0, noise.robot_mm, 3), random.normal(0, noise.robot_deg, 3))
        reported.append(
            np.block([[flange[:3, :3] @ off[:3, :3], (flange[:3, 3] + off[:3, 3])[:, None]], [0, 0, 0, 1]])
        )
    count = len(view)
    seen = LedSightings(
        np.array(view),
        np.array(led),
        np.array(pixels).reshape(-1, 2),
        np.tile(max(noise.pixel_px, 1e-3) ** 2 * np.eye(2), (count, 1, 1)),
        np.stack([view, led], axis=1),
    )
    return Dome(
        known, true_mm, true_normals, seen, np.array(reported), _records(random, noise, flange_from_camera)
    )


def _across(a: Sequence[float] | Array, b: Sequence[float] | Array) -> Array:
    """Cross product of two vectors; `np.cross` takes twenty times as long for so few numbers."""
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def outline_middle(
    lens: TrueLens, eye: Array, centre_mm: Array, normal: Array, random: np.random.Generator
) -> Array:
    """Middle of an LED's picture: the mean of many places on the square, each weighted by its area in it."""
    x = _across(normal, (0.3, -0.5, 0.81))
    x /= np.linalg.norm(x)
    turn = random.uniform(0, np.pi / 2)
    y = _across(normal, x)
    x, y = np.cos(turn) * x + np.sin(turn) * y, -np.sin(turn) * x + np.cos(turn) * y
    a, b = np.meshgrid(*[(np.arange(7) - 3) / 7 * SIDE_MM] * 2)
    there = (centre_mm + a.ravel()[:, None] * x + b.ravel()[:, None] * y - eye[:3, 3]) @ eye[:3, :3]
    weight = there[:, 2] ** -3.0  # area in the picture of a piece of a plane
    return weight @ lens.see(there) / weight.sum()


def _records(random: np.random.Generator, noise: Noise, flange_from_camera: Array) -> CameraPrior:
    """What a calibration before would say: off by what it says of itself."""
    sigma = np.concatenate([LENS_U, np.full(3, HAND_EYE_MM), np.radians(np.full(3, HAND_EYE_DEG))])
    off = noise.records * sigma * random.normal(size=len(sigma))
    values = dict(zip(NAMES, LENS.vector(), strict=True))
    values |= {name: values[name] + off[i] for i, name in enumerate(FREE)}
    hand_eye = flange_from_camera.copy()
    hand_eye[:3, 3] += off[8:11]
    hand_eye[:3, :3] = hand_eye[:3, :3] @ Rotation.from_rotvec(off[11:]).as_matrix()
    return CameraPrior(Intrinsics(**values), FREE, hand_eye, np.diag(sigma**2))
