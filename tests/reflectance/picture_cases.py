"""Small sets of pictures whose truth is known: a ball that throws a shadow on a plane, drawn here with Cook and
Torrance's material and Beckmann's distribution, which the fit does not have."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cells
import cv2
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

SIZE_PX, RADIUS_PX, HEIGHT_PX = 64, 18.0, 22.0
KD = np.array([0.35, 0.3, 0.2])
KS, SLOPE = 0.08, 0.25
WHITE = 0.9


@dataclass(frozen=True)
class Case:
    """A folder of pictures, and what is in them."""

    folder: Path
    directions: Floats
    normals: Floats
    """[h, w, 3]"""
    pictures: Floats
    """[lights, h, w, 3] before they were rounded, full scale 1."""

    def arguments(self) -> list[str]:
        return ["--pictures", str(self.folder), "--lights", str(self.folder / "light_directions.txt")]


def lights_in_rings(rings: int = 5, per_ring: int = 9) -> Floats:
    """Unit vectors in rings of a dome, up to 60 degrees from its top, and the top."""
    directions = [(0.0, 0.0, 1.0)]
    for ring in range(1, rings + 1):
        tilt = np.radians(60.0 * ring / rings)
        for number in range(per_ring):
            turn = 2 * np.pi * (number + 0.5 * (ring % 2)) / per_ring
            directions.append((np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)))
    return np.array(directions)


def ball_on_a_plane(directions: Floats) -> tuple[Floats, Floats]:
    """Normals [h, w, 3] and pictures [lights, h, w, 3] of a half ball that floats over a plane."""
    y, x = np.mgrid[SIZE_PX / 2 : -SIZE_PX / 2 : -1, -SIZE_PX / 2 : SIZE_PX / 2]
    off2 = x**2 + y**2
    on_ball = off2 < (0.97 * RADIUS_PX) ** 2
    z = np.where(on_ball, HEIGHT_PX + np.sqrt(np.maximum(RADIUS_PX**2 - off2, 0.0)), 0.0)
    normals = np.zeros((SIZE_PX, SIZE_PX, 3))
    normals[..., 2] = 1.0
    normals[on_ball] = np.stack([x, y, z - HEIGHT_PX], axis=-1)[on_ball] / RADIUS_PX
    places = np.stack([x, y, z], axis=-1)
    pictures = np.stack([_lit(normals, places, direction) for direction in directions])
    pictures *= WHITE / pictures.max()
    return normals, pictures


def _lit(normals: Floats, places: Floats, light: Floats) -> Floats:
    """[h, w, 3] of one light; the ball hides the plane from it."""
    half = light + np.array([0.0, 0.0, 1.0])
    half /= np.linalg.norm(half)
    nl, nv, nh = np.maximum(normals @ light, 0.0), np.maximum(normals[..., 2], 1e-6), normals @ half
    tan2 = 1.0 / np.maximum(nh, 1e-6) ** 2 - 1.0
    beckmann = np.exp(-tan2 / SLOPE**2) / (np.pi * SLOPE**2 * np.maximum(nh, 1e-6) ** 4)
    masked = np.minimum(1.0, 2 * nh * np.minimum(nv, nl) / half[2])
    lobe = np.where(nl > 0, KS * beckmann * masked / (4 * np.maximum(nl, 1e-6) * nv), 0.0)
    centre = np.array([0.0, 0.0, HEIGHT_PX])
    along = (centre - places) @ light
    distance2 = np.sum((centre - places) ** 2, axis=-1) - along**2
    hidden = (places[..., 2] == 0) & (along > 0) & (distance2 < RADIUS_PX**2)
    lit: Floats = np.where(hidden, 0.0, nl)[..., None] * (KD / np.pi + lobe[..., None])
    return lit


def write_case(folder: Path, *, seed: int = 0) -> Case:
    """The ball under 46 lights, 16 bit, with noise."""
    directions = lights_in_rings()
    normals, pictures = ball_on_a_plane(directions)
    folder.mkdir(parents=True, exist_ok=True)
    noise = np.random.default_rng(seed).normal(0.0, 1e-3, pictures.shape)
    for number, picture in enumerate(np.clip(pictures + noise, 0, 1)):
        values = np.rint(picture * 65535).astype(np.uint16)
        cv2.imwrite(str(folder / f"{number:03}.png"), values[..., ::-1])
    np.savetxt(folder / "light_directions.txt", directions)
    return Case(folder, directions, normals, pictures)


LEFT_OUT = [3, 12, 21, 30]
Made = tuple[Case, Path, dict[str, Any]]
"""A case, the folder of its result, and what `--json` said."""


def made_result(folder: Path) -> Made:
    """Write a case's pictures, and make its result without the lights `LEFT_OUT`."""
    case = write_case(folder / "pictures")
    out = folder / "result"
    ended = cells.here(
        "reflectance", *case.arguments(), "--leave-out", ",".join(map(str, LEFT_OUT)), "--out", out, "--json"
    )
    assert ended.code == 0, ended.err
    return case, out, ended.document


def interval_of(out: Path, direction: np.ndarray, folder: Path, *more: str | Path) -> tuple[np.ndarray, ...]:
    """Return the picture of a light, and the bounds of its interval."""
    way = ",".join(map(str, direction))
    low, high = folder / "low.npy", folder / "high.npy"
    options = (f"--direction={way}", "--to", folder / "a.npy", "--interval", f"{low},{high}", *more)
    ended = cells.here("reflectance", "relight", out, *options)
    assert ended.code == 0, ended.err
    return np.load(folder / "a.npy"), np.load(low), np.load(high)
