"""Random cells for LED power: signals of a white tile from a separate forward model, with one effect that a
calibration may not model.

LEDs are squares of small emitters, the tile has Minnaert's law, written out. Lobes, tilts, stain and gain are
those of `sim.strangers`. All else is drawn at random: fluxes, the tile's pose, reflectance and exponent within
their stated uncertainties, the flat field's gradient in each view, flashes, and noise of pixels. The effects are
those of `prove_led_power`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from coupole.calibration.light.spectralon import Tile
from coupole.calibration.light.tile_views import Positions, TileView
from sim.strangers.light_stranger import LightStranger
from sim.strangers.sensor_stranger import SensorStranger
from sim.strangers.target_stranger import TargetStranger

Floats = NDArray[np.float64]
TILE = Tile()
DOME_MM, DISTANCE_MM, TOP_MM = 1500.0, 335.0, 10.0
FLASH, PIXELS, FLAT = 5e-4, 8e-4, 1e-3
"""Relative noise of a flash and of one part of the tile, and the flat field's error from the tile's middle to its
side."""
SESSION_S, PAUSE_S, LONG_VIEWS = 120.0, 6.0, 4
VIEWS = (
    ("even-low", 45.0, 45.0, 2, 0),
    ("even-high", -45.0, 60.0, 2, 0),
    ("odd-high", 45.0, 60.0, 2, 1),
    ("odd-low", -45.0, 45.0, 2, 1),
    ("again", 45.0, 45.0, 10, 0),
)
"""Name, azimuth, elevation, and LEDs (every so many, from which on), as of the plan `spectralon`."""
PLACES_MM = np.array(
    [[0.0, 0.0, 10.0], [40.0, 0.0, 10.0], [-40.0, 0.0, 10.0], [0.0, 40.0, 10.0], [0.0, 0.0, 50.0]]
)
"""Places at which the light is compared, in the support's frame: an object is as large."""
_PARTS_MM = np.stack(np.meshgrid(*[np.array([-15.0, -5.0, 5.0, 15.0])] * 2), axis=-1).reshape(-1, 2)


@dataclass(frozen=True)
class DrawnPowers:
    """A random cell: what a calibration knows, and the truth."""

    positions: Positions
    views: tuple[TileView, ...]
    irradiance: Floats
    """[n, places] true irradiance of a horizontal face at `PLACES_MM`, in the unit of signals times pi."""


_NO_LIGHT, _NO_TARGET = LightStranger(), TargetStranger()


@dataclass(frozen=True)
class _Effects:
    light: LightStranger = _NO_LIGHT
    target: TargetStranger = _NO_TARGET
    drift: Callable[[Floats], Floats] = np.ones_like
    """Factor of the signal at times from 0 (begin of the session) to 1."""
    moved_deg: float = 0.0

    def gain(self, times: Floats) -> Floats:
        """Return the factor of the signal over its mean over the session."""
        return self.drift(times) / float(self.drift(np.linspace(0.0, 1.0, 500)).mean())


def draw_powers(seed: int, leds: int, cause: str, strength: float) -> DrawnPowers:
    """Return a cell with one effect of this strength. For one seed, all else is the same."""
    random = np.random.default_rng((seed, 1))
    effects = _effects(cause, strength, np.random.default_rng((seed, 2)), 2 * leds)
    positions = _dome(leds, random)
    flux = 1e4 * np.exp(0.04 * random.standard_normal(leds))
    tilt_deg = random.normal(0.0, TILE.u_tilt_deg, 2)
    height_mm = float(random.normal(0.0, TILE.u_height_mm))
    rho = TILE.reflectance + TILE.u_reflectance * random.standard_normal()
    k = TILE.minnaert + TILE.u_minnaert * random.standard_normal()
    dies = effects.light.tilted_normals(positions.normals, positions.ids)
    exponents = np.array([effects.light.exponent(int(led)) for led in positions.ids])
    views = []
    for number, (name, azimuth_deg, elevation_deg, every, offset) in enumerate(VIEWS):
        rows = _in_order(np.flatnonzero(positions.ids % every == offset))
        eye_mm = _eye(azimuth_deg, elevation_deg)
        tilted_deg = tilt_deg + (effects.moved_deg if number >= LONG_VIEWS - 1 else 0.0)
        normal = Rotation.from_euler("xy", tilted_deg, degrees=True).apply([0.0, 0.0, 1.0])
        points_mm = np.column_stack([_PARTS_MM, np.full(len(_PARTS_MM), TOP_MM)])
        there_mm = points_mm + (points_mm - eye_mm) * (height_mm / (points_mm - eye_mm)[:, 2:])
        lit = _irradiance(
            there_mm,
            normal,
            positions.centres_mm[rows],
            positions.normals[rows],
            dies[rows],
            exponents[rows],
            effects.light,
        )
        f = _tile_brdf(there_mm, normal, positions.centres_mm[rows], eye_mm, rho, k, effects.target)
        step_s = (SESSION_S / LONG_VIEWS - PAUSE_S) / (leds // 2)
        times = (number * SESSION_S / LONG_VIEWS + step_s * np.arange(len(rows), dtype=np.float64)) / SESSION_S
        gradient = _PARTS_MM / 20.0 @ random.normal(0.0, FLAT, 2)
        signal = f * lit * flux[rows, None] * _clean(effects.target) * np.exp(gradient)
        signal *= (effects.gain(times) * (1.0 + FLASH * random.standard_normal(len(rows))))[:, None]
        noisy = signal * (1.0 + PIXELS * random.standard_normal(signal.shape))
        pose = np.eye(4)
        pose[2, 3] = TOP_MM
        ids, is_saturated = positions.ids[rows], np.zeros(len(rows), np.bool_)
        at_s = times * SESSION_S
        views.append(TileView(name, 0, pose, points_mm, eye_mm, ids, noisy, PIXELS * signal, is_saturated, at_s))
    up = np.array([0.0, 0.0, 1.0])
    there = _irradiance(PLACES_MM, up, positions.centres_mm, positions.normals, dies, exponents, effects.light)
    return DrawnPowers(positions, tuple(views), there * flux[:, None])


def _in_order(rows: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return the LEDs of a view in the order of their flashes: board after board, one LED of each in turn."""
    return rows[np.lexsort((rows // 6, rows % 6))]


def _effects(cause: str, strength: float, random: np.random.Generator, frames: int) -> _Effects:
    """Return the effect. Drifts have their time in shares of the session, which has this number of frames."""
    seed = int(random.integers(1 << 30))
    if cause == "stain":
        return _Effects(target=TargetStranger(tile_stain=strength, tile_stain_mm=float(random.uniform(5.0, 10.0))))
    if cause == "gloss":
        return _Effects(
            target=TargetStranger(tile_lobe=strength, tile_lobe_roughness=float(random.uniform(0.25, 0.45)))
        )
    if cause == "wave":
        wave = SensorStranger(
            gain_drift=strength, gain_period_frames=float(random.uniform(0.1, 1.0)) * frames, seed=seed
        )
        return _Effects(drift=lambda times: np.array([wave.gain(int(frame)) for frame in np.rint(times * frames)]))
    if cause == "gain":
        return _Effects(drift=lambda times: 1.0 + strength * (times - 0.5))
    if cause == "warming":
        lamps = LightStranger(warming=strength, warming_frames=float(random.uniform(0.1, 0.5)) * frames)
        return _Effects(
            drift=lambda times: np.array([lamps.warmth(int(frame)) for frame in np.rint(times * frames)])
        )
    if cause == "dies":
        return _Effects(LightStranger(die_tilt_deg=strength, seed=seed))
    if cause == "exponents":
        return _Effects(LightStranger(exponent_spread=strength, seed=seed))
    if cause == "moved":
        return _Effects(moved_deg=strength)
    raise ValueError(cause)


def _dome(leds: int, random: np.random.Generator) -> Positions:
    """Return LEDs on flat boards of six that face the support's centre."""
    boards = leds // 6
    up = np.linspace(0.2, 0.97, boards) + random.uniform(-0.01, 0.01, boards)
    turn = np.arange(boards) * np.pi * (3 - np.sqrt(5)) + random.uniform(0, 2 * np.pi)
    ring = np.sqrt(1 - up**2)
    out = np.stack([ring * np.cos(turn), ring * np.sin(turn), up], axis=1)
    along = np.stack([-np.sin(turn), np.cos(turn), np.zeros(boards)], axis=1)
    across = np.cross(out, along)
    centres = [
        DOME_MM * out + 60.0 * (column * along + row * across) for row in (-0.5, 0.5) for column in (-1, 0, 1)
    ]
    return Positions(np.arange(leds), np.stack(centres, axis=1).reshape(-1, 3), np.repeat(-out, 6, axis=0))


def _eye(azimuth_deg: float, elevation_deg: float) -> Floats:
    a, e = np.radians([azimuth_deg, elevation_deg])
    return np.array([0, 0, TOP_MM]) + DISTANCE_MM * np.array(
        [np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)]
    )


def _irradiance(
    points_mm: Floats,
    normal: Floats,
    centres_mm: Floats,
    boards: Floats,
    dies: Floats,
    exponents: Floats,
    light: LightStranger,
) -> Floats:
    """Return [n, m] irradiance per flux, m^-2, by 3 x 3 small emitters on each LED."""
    helper = np.where(np.abs(boards[:, :1]) < 0.7, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    u = np.cross(boards, helper)
    u /= np.linalg.norm(u, axis=1)[:, None]
    v = np.cross(boards, u)
    total = np.zeros((len(centres_mm), len(points_mm)))
    for a in (-7 / 3, 0.0, 7 / 3):
        for b in (-7 / 3, 0.0, 7 / 3):
            away = points_mm - (centres_mm + a * u + b * v)[:, None]
            far = np.linalg.norm(away, axis=2)
            cosine = np.einsum("nmi,ni->nm", away, dies) / far
            intensity = light.intensity(np.degrees(np.arccos(cosine))) * cosine ** exponents[:, None]
            total += intensity * (1.0 + 0.5 * exponents[:, None]) * np.maximum(-(away @ normal), 0.0) / far**3
    return np.asarray(1e6 / np.pi / 9.0 * total)


def _tile_brdf(
    points_mm: Floats,
    normal: Floats,
    centres_mm: Floats,
    eye_mm: Floats,
    rho: float,
    k: float,
    tile: TargetStranger,
) -> Floats:
    """Return [n, m] 1/sr: Minnaert's law, and GGX for the glossy part. The hemispherical reflectance is `rho`."""
    to_led = centres_mm[:, None] - points_mm
    to_led /= np.linalg.norm(to_led, axis=2)[..., None]
    to_eye = eye_mm - points_mm
    to_eye /= np.linalg.norm(to_eye, axis=1)[:, None]
    matt = rho - (_ggx_albedo(tile) if tile.tile_lobe else 0.0)
    law = matt * (k + 1) / 2 / np.pi * ((to_led @ normal) * (to_eye @ normal)) ** (k - 1)
    return np.asarray(
        law + (_ggx(to_led, np.broadcast_to(to_eye, to_led.shape), normal, tile) if tile.tile_lobe else 0.0)
    )


def _ggx(to_led: Floats, to_eye: Floats, normal: Floats, tile: TargetStranger) -> Floats:
    """Walter et al. 2007, with Schlick's Fresnel and Smith's uncorrelated shadowing."""
    half = to_led + to_eye
    half /= np.linalg.norm(half, axis=-1)[..., None]
    square = tile.tile_lobe_roughness**2
    n_l, n_v, n_h = to_led @ normal, to_eye @ normal, half @ normal
    d = square / (np.pi * (n_h**2 * (square - 1.0) + 1.0) ** 2)
    fresnel = tile.tile_lobe + (1.0 - tile.tile_lobe) * (1.0 - np.sum(half * to_led, axis=-1)) ** 5
    g = np.ones_like(n_l)
    for n_x in (n_l, n_v):
        g = g / (n_x + np.sqrt(square + (1.0 - square) * n_x**2))
    return np.asarray(d * fresnel * g)


def _ggx_albedo(tile: TargetStranger) -> float:
    """Return the hemispherical reflectance of the glossy part for light along the normal."""
    mu, turn = np.meshgrid((np.arange(400) + 0.5) / 400, (np.arange(8) + 0.5) * np.pi / 4)
    ring = np.sqrt(1 - mu**2)
    out = np.stack([ring * np.cos(turn), ring * np.sin(turn), mu], axis=-1)
    up = np.array([0.0, 0.0, 1.0])
    return float(2 * np.pi * np.mean(_ggx(np.broadcast_to(up, out.shape), out, up, tile) * mu))


def _clean(tile: TargetStranger) -> Floats:
    """Return [parts] share of the light that the stain leaves to each part of the tile."""
    fine = (np.arange(5) - 2.0) * 2.0
    steps = np.stack(np.meshgrid(fine, fine), axis=-1).reshape(-1, 2)
    away = _PARTS_MM[:, None] + steps - np.array([tile.tile_stain_mm, 0.0])
    stain = np.exp(-0.5 * np.sum(away**2, axis=-1) / tile.tile_stain_mm**2)
    return np.asarray(1.0 - tile.tile_stain * stain.mean(axis=1))
