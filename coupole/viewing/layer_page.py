"""The page of a paint layer: K and S with their bands, spectra as measured and as fitted, and what they tell."""

from __future__ import annotations

import numpy as np

from coupole.heritage.analysis import layer_fit
from coupole.heritage.analysis.four_flux_fit import FourFlux
from coupole.heritage.analysis.layer_fit import COVERAGE_FACTOR, Coefficients
from coupole.heritage.analysis.layer_model import Deserved
from coupole.heritage.analysis.layer_samples import LayerGiven, Samples
from coupole.viewing.page_parts import facts, page, section, text
from coupole.viewing.spectra_drawing import Array, Curve, chart


def layer_page(
    description: LayerGiven, samples: Samples, fit: Coefficients, model: Deserved, four: FourFlux | None
) -> str:
    """HTML."""
    nm, sure = samples.wavelengths_nm, fit.determined_bands
    unit = "per mm" if samples.is_per_mm else "of the layer"
    head = {
        "Model": f"{text(model.model)}: {text(model.because)}",
        "Spectra": str(fit.spectra),
        "Binder": f"index {description.binder_index:g}, {text(description.geometry)}",
        "Noise": f"{description.noise:g} of full reflectance, standard uncertainty",
        "Bands": f"{len(nm)} of {nm[0]:g} to {nm[-1]:g} nm; S is told in {int(sure.sum())} of them",
    }
    body = f"<h1>{text(description.name)}: absorption and scattering</h1>{facts(head)}"
    if sure.sum() > 1:
        sure_nm = nm[sure]
        curves = [
            _with_band("K", fit.absorption[sure], fit.u_absorption[sure]),
            _with_band("S", fit.scattering[sure], fit.u_scattering[sure]),
        ]
        body += section("coefficients", "K and S", chart(f"K and S {unit}, with 95 % bands", sure_nm, curves))
    fits = []
    for film, told_film in zip(samples.films, description.films, strict=True):
        prediction = layer_fit.predict(fit, samples.face, film.thickness_mm, film.ground)
        fits += [
            Curve(f"{told_film.spectrum.name}, measured", film.reflectance),
            Curve(f"{told_film.spectrum.name}, fitted", prediction.seen, is_dashed=True),
        ]
    body += section("fit", "Measured and fitted", chart("Reflectance in air", nm, fits))
    if four is not None:
        directional = [
            _with_band("k", four.direct_absorption, four.u_direct_absorption),
            _with_band("s_i, forward", four.forward, four.u_forward),
            _with_band("s_j, backward", four.backward, four.u_backward),
        ]
        body += section("four", "Four fluxes", chart(f"Directional light, {unit}, 95 % bands", nm, directional))
    return page(f"{description.name}: K and S", body)


def _with_band(name: str, values: Array, u: Array) -> Curve:
    wide = COVERAGE_FACTOR * u
    return Curve(name, values, np.asarray(values - wide), np.asarray(values + wide))
