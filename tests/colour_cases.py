"""A camera, a lamp and a chart of known spectra, by colour-science."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from lazily import lazily

colour: Any = lazily("colour")

D65 = (0.3127, 0.3290)


def shape() -> Any:
    return colour.SpectralShape(380, 780, 5)


def sensor() -> np.ndarray:
    """[81, 3] of a camera that is known."""
    return np.asarray(colour.MSDS_CAMERA_SENSITIVITIES["Nikon 5100 (NPL)"].copy().align(shape()).values)


def lamp() -> np.ndarray:
    """[81] of a white LED."""
    return np.asarray(colour.SDS_ILLUMINANTS["LED-B3"].copy().align(shape()).values)


def patches() -> tuple[np.ndarray, np.ndarray]:
    """[25, 81] reflectances of a colour checker and the perfect white, and their [25, 3] XYZ under D65."""
    chart = [one.copy().align(shape()) for one in colour.SDS_COLOURCHECKERS["BabelColor Average"].values()]
    chart.append(colour.SpectralDistribution(np.ones(81), shape().wavelengths))
    daylight = colour.SDS_ILLUMINANTS["D65"].copy().align(shape())
    eye = colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"].copy().align(shape())
    truth = [colour.sd_to_XYZ(one, eye, daylight, method="Integration") / 100.0 for one in chart]
    return np.stack([one.values for one in chart]), np.stack(truth)


def write_tables(folder: Path) -> tuple[Path, Path]:
    """Of the camera's sensitivities and the lamp's power."""
    paths = folder / "sensor.csv", folder / "led.csv"
    for path, values in zip(paths, (sensor(), lamp()[:, None]), strict=True):
        np.savetxt(path, np.column_stack([shape().wavelengths, values]), delimiter=";", fmt="%.8g")
    return paths
