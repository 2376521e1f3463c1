"""Pictures of a colour chart, drawn from spectra, light and camera, with none of the product's formulas.

Each draw has its own patches, camera, lamp and view. The lamp is a point at a finite distance, whose light falls
off by cosine and square of the distance; the lens vignettes by the fourth power of the cosine.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from lazily import lazily
from numpy.typing import NDArray
from scipy.optimize import minimize

colour: Any = lazily("colour")

Array = NDArray[np.float64]
NM = np.arange(380.0, 781.0, 5.0)
ROWS, COLUMNS, PITCH_MM, PATCH_MM = 4, 6, 22.0, 18.0
SIZE_PX = (640, 480)
GREYS = (0.90, 0.60, 0.37, 0.20, 0.09, 0.032)


def random_reflectances(random: np.random.Generator, count: int) -> Array:
    """[count, wavelengths] bands and edges of paints."""
    base = random.uniform(0.03, 0.15, (count, 1))
    band = np.exp(-0.5 * ((NM - random.uniform(410, 660, (count, 1))) / random.uniform(25, 70, (count, 1))) ** 2)
    edge = 1.0 / (1.0 + np.exp(-(NM - random.uniform(470, 640, (count, 1))) / random.uniform(8, 30, (count, 1))))
    shares = random.dirichlet((1.0, 1.0, 0.6), count)
    return base + random.uniform(0.2, 0.8, (count, 1)) * (
        shares[:, :1] * band + shares[:, 1:2] * edge + 0.6 * shares[:, 2:]
    )


def greys(random: np.random.Generator, values: Array) -> Array:
    """[greys, wavelengths] nearly flat."""
    tilt = random.normal(0.0, 0.01, (len(values), 1)) * (NM - 580.0) / 200.0
    return np.asarray(values)[:, None] * (1.0 + tilt)


def d50_xyz(spectra: Array) -> Array:
    """[n, 3] by the CIE's tables, white with Y = 1."""
    shape = colour.SpectralShape(380, 780, 5)
    eye = colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"].copy().align(shape).values
    light = colour.SDS_ILLUMINANTS["D50"].copy().align(shape).values
    weights = eye * light[:, None]
    return np.asarray(
        spectra @ weights / weights[:, 1].sum() * (np.array([0.9642, 1.0, 0.8249]) / _white(weights))
    )


def _white(weights: Array) -> Array:
    return np.asarray(weights.sum(axis=0) / weights[:, 1].sum())


def d50_lab(xyz: Array) -> Array:
    """[n, 3] by colour-science."""
    white = np.array([0.9642, 1.0, 0.8249])
    return np.asarray(colour.XYZ_to_Lab(xyz, colour.XYZ_to_xy(white)))


@dataclass(frozen=True)
class DrawnChart:
    """A chart under a light before a camera, all drawn by a seed."""

    seed: int
    u_lab: float = 0.3
    lamp_mm: float = 900.0
    """Distance of the lamp; far away it lights evenly."""
    vignetting: float = 0.0
    """Fall-off of the lens at the picture's corners."""
    noise: float = 0.01
    """Relative noise of a pixel at white."""
    turn_deg: float = 0.0
    """Turn of the chart in the picture."""
    frame: float = 0.04
    """Reflectance of what is between the patches."""
    exposure: float = 0.8
    """Value of the perfect white at the chart's middle, of full scale, in its strongest channel."""

    @cached_property
    def spectra(self) -> Array:
        """[24, wavelengths]."""
        random = np.random.default_rng((self.seed, 1))
        colours = random_reflectances(random, ROWS * COLUMNS - len(GREYS))
        return np.concatenate([colours, greys(random, np.array(GREYS))])

    @cached_property
    def sensitivities(self) -> Array:
        """[wavelengths, 3] of the camera under the lamp."""
        random = np.random.default_rng((self.seed, 2))
        peaks = np.array([600.0, 535.0, 455.0]) + random.normal(0.0, 6.0, 3)
        widths = np.array([38.0, 42.0, 30.0]) * random.uniform(0.9, 1.1, 3)
        camera = np.exp(-0.5 * ((NM[:, None] - peaks) / widths) ** 2)
        camera[:, 0] += 0.08 * np.exp(-0.5 * ((NM - 440.0) / 15.0) ** 2)
        kelvin = random.uniform(3000.0, 6500.0)
        lamp = (NM / 560.0) ** -5 / np.expm1(1.4388e7 / (NM * kelvin))
        return np.asarray(camera * (0.5, 1.0, 0.7) * (lamp / lamp.mean())[:, None])

    def signals(self, spectra: Array) -> Array:
        """[n, 3] under even light, 1 for the perfect white in its strongest channel."""
        white = self.sensitivities.sum(axis=0)
        return np.asarray(spectra @ self.sensitivities / white.max())

    @cached_property
    def stated_lab(self) -> Array:
        """[24, 3] as an instrument measured them, with its errors."""
        random = np.random.default_rng((self.seed, 3))
        return np.asarray(random.normal(d50_lab(d50_xyz(self.spectra)), self.u_lab))

    @cached_property
    def projection(self) -> Array:
        """[3, 3] from mm of the chart to pixels."""
        random = np.random.default_rng((self.seed, 4))
        angle = np.radians(self.turn_deg + random.normal(0.0, 2.0))
        half = np.array([COLUMNS * PITCH_MM, ROWS * PITCH_MM]) / 2.0
        corners = np.array([(-1, 1), (1, 1), (1, -1), (-1, -1)]) * half
        turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        wide = np.abs(corners @ turn.T).max(axis=0)
        scale = 0.40 * (np.array(SIZE_PX) / wide).min()
        at = corners @ turn.T * (scale, -scale) + np.array(SIZE_PX) / 2.0
        at += random.uniform(-0.03, 0.03, (4, 2)) * SIZE_PX[1]
        return np.asarray(cv2.getPerspectiveTransform(corners.astype(np.float32), at.astype(np.float32)))

    def light(self, on_chart: Array, pixels: Array) -> Array:
        """[...] relative irradiance times the lens's fall-off, at chart points and pixels [..., 2]."""
        random = np.random.default_rng((self.seed, 5))
        angle, height = random.uniform(0.0, 2.0 * np.pi), np.radians(random.uniform(35.0, 55.0))
        lamp = self.lamp_mm * np.array(
            [np.cos(height) * np.cos(angle), np.cos(height) * np.sin(angle), np.sin(height)]
        )
        away = lamp - np.concatenate([on_chart, np.zeros_like(on_chart[..., :1])], axis=-1)
        distance = np.linalg.norm(away, axis=-1)
        light = away[..., 2] / distance**3 / (lamp[2] / self.lamp_mm**3)
        middle = np.array(SIZE_PX) / 2.0
        tangent = ((pixels - middle) ** 2).sum(axis=-1) / (middle**2).sum()
        corner = 1.0 / np.sqrt(1.0 - self.vignetting) - 1.0  # tangent squared at a corner, for cos^4
        return np.asarray(light / (1.0 + corner * tangent) ** 2)

    def picture(self, *, white: bool = False) -> Array:
        """[h, w, 3] linear, full scale 1, not cut off; `white`: of a card in the chart's place."""
        random = np.random.default_rng((self.seed, 6 + white))
        columns, rows = np.meshgrid(np.arange(2 * SIZE_PX[0]), np.arange(2 * SIZE_PX[1]))
        pixels: Any = (np.stack([columns, rows], axis=-1) - 0.5) / 2.0
        flat = cv2.perspectiveTransform(pixels.reshape(1, -1, 2), np.linalg.inv(self.projection))
        on_chart: Any = flat.reshape(*columns.shape, 2)
        place = on_chart / PITCH_MM * (1, -1) + (COLUMNS / 2.0, ROWS / 2.0)
        cell = np.clip(np.floor(place).astype(int), 0, (COLUMNS - 1, ROWS - 1))
        inside = (np.abs(place - cell - 0.5) * PITCH_MM < PATCH_MM / 2.0).all(axis=-1)
        number = np.where(inside, cell[..., 1] * COLUMNS + cell[..., 0], ROWS * COLUMNS)
        on_frame = (np.abs(place - (COLUMNS / 2.0, ROWS / 2.0)) < (COLUMNS / 2.0 + 0.3, ROWS / 2.0 + 0.3)).all(
            axis=-1
        )
        number = np.where(on_frame, number, ROWS * COLUMNS + 1)
        around = np.full((2, len(NM)), self.frame)
        around[1] = 0.25
        seen = np.concatenate([self.signals(self.spectra), self.signals(around)])
        if white:
            seen = np.broadcast_to(self.signals(np.full((1, len(NM)), 0.85)), seen.shape)
        values = self.exposure * seen[number] * self.light(on_chart, pixels)[..., None]
        values = values.reshape(SIZE_PX[1], 2, SIZE_PX[0], 2, 3).mean(axis=(1, 3))
        sd = self.noise * np.sqrt(np.maximum(values, 0.0) * 0.9 + 0.002)
        return np.asarray(random.normal(values, sd))

    @property
    def corners_px(self) -> Array:
        """[4, 2] middles of the corner patches from the top left around."""
        half = np.array([(COLUMNS - 1) * PITCH_MM, (ROWS - 1) * PITCH_MM]) / 2.0
        corners = np.array([[(-1, 1), (1, 1), (1, -1), (-1, -1)]]) * half
        return np.asarray(cv2.perspectiveTransform(corners, self.projection)[0])

    def write_chart(self, folder: Path) -> Path:
        """The chart's description, and its values."""
        names = [f"{'ABCD'[n // COLUMNS]}{n % COLUMNS + 1}" for n in range(ROWS * COLUMNS)]
        lines = [
            f"{name},{','.join(f'{v:.6f}' for v in lab)}" for name, lab in zip(names, self.stated_lab, strict=True)
        ]
        (folder / "values.csv").write_text("name,LAB_L,LAB_A,LAB_B\n" + "\n".join(lines) + "\n")
        (folder / "chart.yaml").write_text(
            f"schema_version: 1\nname: drawn\nrows: {ROWS}\ncolumns: {COLUMNS}\n"
            f"pitch_mm: [{PITCH_MM}, {PITCH_MM}]\n"
            f"patch_mm: [{PATCH_MM}, {PATCH_MM}]\nvalues: values.csv\nu_lab: {self.u_lab}\n"
        )
        return folder / "chart.yaml"

    def true_white(self) -> Array:
        """[3] signals of the perfect white as the true greys have them: of the least squares over their Y."""
        grey = slice(ROWS * COLUMNS - len(GREYS), ROWS * COLUMNS)
        luminance = d50_xyz(self.spectra)[grey, 1]
        return np.asarray(luminance @ self.signals(self.spectra)[grey] / (luminance @ luminance))

    def true_matrix(self) -> Array:
        """[3, 3] of the least sum of squares of CIEDE2000 that keeps white, for the chart's true colours and
        signals under even light, by colour-science and its CIEDE2000."""
        xyz = d50_xyz(self.spectra)
        balanced = self.signals(self.spectra) / self.true_white()
        lab = d50_lab(xyz)
        white = np.array([0.9642, 1.0, 0.8249])

        def whole(free: Array) -> Array:
            pairs = free.reshape(3, 2)
            return np.column_stack([pairs, white - pairs.sum(axis=1)])

        def total(free: Array) -> float:
            found = d50_lab(balanced @ whole(free).T)
            return float((colour.delta_E(lab, found, method="CIE 2000") ** 2).sum())

        start, *_ = np.linalg.lstsq(balanced[:, :2] - balanced[:, 2:], xyz - balanced[:, 2:] * white)
        free = start.T.ravel()
        for _ in range(3):
            free = minimize(total, free, method="BFGS").x
        return whole(free)


def write_picture(path: Path, values: Array, bits: int = 16) -> Path:
    """TIFF, PNG (8 or 16 bit) or floating point TIFF of linear values, cut off at full scale as a sensor does."""
    if bits == 32:
        codes: Any = values.astype(np.float32)
    else:
        most = 2**bits - 1
        codes = np.rint(np.clip(values, 0.0, 1.0) * most).astype(np.uint8 if bits == 8 else np.uint16)
    assert cv2.imwrite(str(path), np.ascontiguousarray(codes[..., ::-1]))
    return path


def varied(seed: int) -> DrawnChart:
    """A draw with a near lamp, a lens that vignettes and a chart that is turned, by the seed."""
    random = np.random.default_rng((seed, 9))
    return replace(
        DrawnChart(seed),
        lamp_mm=float(random.uniform(600.0, 2000.0)),
        vignetting=float(random.uniform(0.0, 0.3)),
        turn_deg=float(random.choice([0.0, 90.0, 180.0, 270.0]) + random.uniform(-8.0, 8.0)),
        noise=float(random.uniform(0.005, 0.03)),
        frame=float(random.choice([0.04, 0.75])),
    )
