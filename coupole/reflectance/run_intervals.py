"""Intervals of relit pictures of runs: stated uncertainties, widened by the errors under LEDs kept for the check.

Materials' covariances include neither another form of the material nor the noise of a frame. For LEDs that no fit
has used, the errors of pictures are divided by the stated uncertainty. Their 95 % quantile is found in each
stratum (`strata`). The half width of an interval is this quantile times the uncertainty.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError
from coupole.reflectance.fits import GGX_NORMAL, TEXELS
from coupole.reflectance.new_light.light_kinds import AnyLight
from coupole.reflectance.relit_uncertainty import uncertainty_of_picture
from coupole.reflectance.run_pictures import HeldOut
from coupole.reflectance.run_relighting import SAMPLES, RelitScene, Say
from coupole.reflectance.run_result import RunResult, read_about
from coupole.reflectance.strata import MOST_STRATA, StratumFactors, fit_strata
from coupole.reflectance.texels.pixel_file import read_texel_widening

Floats = NDArray[np.float64]

LEVEL = 0.95
FEWEST_SAMPLES = 500
"""Least number of pixels, in pictures kept for the check, from which a widening is found."""
_MOST_SAMPLES = 20_000
"""Number of errors that are kept for each block of triangles and channel."""
_UNCERTAINTY_EDGES = (0.01, 0.02, 0.04, 0.08, 0.16)
"""Relative uncertainties that separate the strata."""
_RESIDUAL_EDGES = (0.01, 0.02, 0.04, 0.08)
"""Residuals of a triangle's material that separate the strata."""


def strata_of(relative: NDArray[np.floating], residual: NDArray[np.floating]) -> dict[str, NDArray[np.int64]]:
    """Return the strata of samples by their relative uncertainty, and by the residual of their material."""
    return {
        "uncertainty": np.digitize(relative, _UNCERTAINTY_EDGES),
        "residual": np.digitize(residual, _RESIDUAL_EDGES),
    }


@dataclass
class WideningSamples:
    """Errors of one fit, divided by their uncertainty, collected from the blocks."""

    ratios: list[Floats] = field(default_factory=list)
    relative: list[Floats] = field(default_factory=list)
    residual: list[Floats] = field(default_factory=list)
    leds: list[NDArray[np.int64]] = field(default_factory=list)

    def add(self, part: HeldOut, values: NDArray[np.floating], relative: Floats, residual: Floats) -> None:
        """Add the pictures of a part, by the fit's `values` [n, leds, channels], its relative uncertainty [n,
        leds], and the residuals [n] of its materials."""
        for channel, (triangles, measured_values) in enumerate(part.blocks):
            modelled_values = part.pixels(values, channel)
            of_pixels = relative[:, part.columns][triangles]
            with np.errstate(divide="ignore", invalid="ignore"):
                ratios = np.abs(measured_values - modelled_values) / (of_pixels * modelled_values)
            places = np.flatnonzero(np.isfinite(ratios))
            places = places[:: 1 + len(places) // _MOST_SAMPLES]
            leds = np.broadcast_to(np.asarray(part.columns), ratios.shape)
            self.ratios.append(ratios.ravel()[places])
            self.relative.append(of_pixels.ravel()[places])
            self.residual.append(np.broadcast_to(residual[triangles][:, None], ratios.shape).ravel()[places])
            self.leds.append(leds.ravel()[places])

    def widening(self) -> dict[str, Any] | None:
        """Return the entry of `result.json` about the quantiles by strata; None from too few samples."""
        if sum(map(len, self.ratios)) < FEWEST_SAMPLES:
            return None
        strata = strata_of(np.concatenate(self.relative), np.concatenate(self.residual))
        factors = fit_strata(np.concatenate(self.ratios), strata, np.concatenate(self.leds), LEVEL)
        by_stratum = {
            name: np.exp(logs[: _stratum_count(name)]).tolist() for name, logs in factors.log_factors.items()
        }
        return {"quantile": float(np.exp(factors.log_quantile)), **by_stratum}


def _stratum_count(name: str) -> int:
    return 1 + len(_UNCERTAINTY_EDGES if name == "uncertainty" else _RESIDUAL_EDGES)


def read_widening(result: RunResult, fit: str) -> StratumFactors:
    """Read the quantiles of a fit. Texels have their own; if an earlier version made the texels, the quantiles of
    the fit from which they start are used. Raises InputError if the result has none."""
    name = GGX_NORMAL.name if fit == TEXELS else fit
    widening = read_texel_widening(result.folder) if fit == TEXELS else None
    if widening is None:
        widening = read_about(result.folder).get("widening", {}).get(name)
    if widening is None:
        raise InputError(
            f"--interval: {result.folder} has none for {fit}: no LEDs were kept for its check, or it is of an "
            f"earlier version; `coupole reflectance check {result.folder}` makes it"
        )
    logs = {name: np.zeros(MOST_STRATA) for name in ("uncertainty", "residual")}
    for key, stratum_logs in logs.items():
        stratum_logs[: len(widening[key])] = np.log(widening[key])
    return StratumFactors(float(np.log(widening["quantile"])), logs)


def half_width_of_picture(
    scene: RelitScene, lights: Sequence[AnyLight], samples: int = SAMPLES, *, say: Say = lambda count, of: None
) -> NDArray[np.float32]:
    """[h, w, channels] half width of the 95 % interval of `scene.picture(lights, samples)`, in its unit. It is NaN
    where the uncertainty is not known, and where the picture is black, since neither inter-reflection nor noise is
    known there. Raises InputError as `read_widening` and `uncertainty_of_picture`."""
    widening = read_widening(scene.result, scene.fit)
    uncertainty = uncertainty_of_picture(scene, lights, samples, say=say)
    picture = scene.picture(lights, samples)
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = np.where(picture > 0.0, uncertainty / picture, np.nan)
    residual = np.broadcast_to(residuals_of(scene)[..., None], relative.shape)
    quantiles = widening.quantiles(strata_of(relative, residual))
    return (quantiles * relative * picture).astype(np.float32)


def residuals_of(scene: RelitScene) -> Floats:
    """[h, w] residual of the material at each pixel, by the triangle that the pixel sees."""
    name = GGX_NORMAL.name if scene.fit == TEXELS else scene.fit
    places = np.searchsorted(scene.result.triangles, scene.surface.triangles)
    residual = scene.result.materials(name, places).residual
    return np.append(residual, 0.0)[scene.surface.triangle_of_pixel]
