"""The page of a paint layer: K and S with their bands, measured and fitted spectra, and conclusions."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from coupole.heritage.analysis import layer_fit
from coupole.heritage.analysis.four_flux_fit import FourFlux
from coupole.heritage.analysis.layer_fit import COVERAGE_FACTOR, Coefficients
from coupole.heritage.analysis.layer_model import Deserved
from coupole.heritage.analysis.layer_samples import LayerGiven, Samples
from coupole.heritage.analysis.other_thickness import FilmAtThickness
from coupole.pages.page_charts import Array, Curve, chart
from coupole.pages.page_parts import Code, Page, Plot, Section
from coupole.pages.page_rendering import render


def layer_page(
    description: LayerGiven,
    samples: Samples,
    fit: Coefficients,
    model: Deserved,
    four: FourFlux | None,
    predicted_films: Sequence[FilmAtThickness] = (),
) -> str:
    """Return the page as HTML."""
    nm, sure = samples.wavelengths_nm, fit.determined_bands
    unit = "per mm" if samples.is_per_mm else "of the layer"
    told_bands = f"{int(sure.sum())} of {len(nm)} bands"
    return render(
        Page(
            title=f"{description.name}: absorption and scattering of a paint layer",
            pictures=_coefficients(nm, fit, unit),
            summary=f"K and S were solved from {fit.spectra} spectra of {nm[0]:g} to {nm[-1]:g} nm by "
            f"{model.model}.",
            quality=f"S is determined in {told_bands}; the bands in the picture are 95 % intervals.",
            next_step=[
                "Mix with it: give the paint file to ",
                Code("coupole recipe --palette"),
                "." if sure.all() else ". For the other wavelengths, measure a thinner film or another ground.",
            ],
            facts={
                "Model": f"{model.model}: {model.because}",
                "Spectra": str(fit.spectra),
                "Binder": f"index {description.binder_index:g}, {description.geometry}",
                "Noise": f"{description.noise:g} of full reflectance, standard uncertainty",
                "Bands": f"{len(nm)} of {nm[0]:g} to {nm[-1]:g} nm; S is determined in {int(sure.sum())} of them",
            },
            sections=[
                Section(
                    "fit",
                    "Measured and fitted",
                    figures=[_measured_and_fitted(description, samples, fit)],
                    figure_size="wide",
                ),
                Section("four", "Four fluxes", figures=_four_fluxes(nm, four, unit), figure_size="wide"),
                Section(
                    "at",
                    "At other thicknesses",
                    figures=_other_thicknesses(nm, predicted_films),
                    figure_size="wide",
                ),
            ],
        )
    )


def _coefficients(nm: Array, fit: Coefficients, unit: str) -> Sequence[Plot]:
    """Return K and S in the bands where both are determined."""
    sure = fit.determined_bands
    if sure.sum() < 2:
        return []
    curves = [
        _with_band("K", fit.absorption[sure], fit.u_absorption[sure]),
        _with_band("S", fit.scattering[sure], fit.u_scattering[sure]),
    ]
    return [chart(f"K and S {unit}, with 95 % bands", nm[sure], curves)]


def _measured_and_fitted(description: LayerGiven, samples: Samples, fit: Coefficients) -> Plot:
    curves = []
    for film, told_film in zip(samples.films, description.films, strict=True):
        prediction = layer_fit.predict(fit, samples.face, film.thickness_mm, film.ground)
        curves += [
            Curve(f"{told_film.spectrum.name}, measured", film.reflectance),
            Curve(f"{told_film.spectrum.name}, fitted", prediction.seen, is_dashed=True),
        ]
    return chart("Reflectance in air", samples.wavelengths_nm, curves)


def _four_fluxes(nm: Array, four: FourFlux | None, unit: str) -> Sequence[Plot]:
    if four is None:
        return []
    curves = [
        _with_band("k", four.direct_absorption, four.u_direct_absorption),
        _with_band("s_i, forward", four.forward, four.u_forward),
        _with_band("s_j, backward", four.backward, four.u_backward),
    ]
    return [chart(f"Directional light, {unit}, 95 % bands", nm, curves)]


def _other_thicknesses(nm: Array, films: Sequence[FilmAtThickness]) -> Sequence[Plot]:
    """Return one drawing for each thickness, of the known bands."""
    plots = []
    for thickness_mm in dict.fromkeys(film.thickness_mm for film in films):
        same = [film for film in films if film.thickness_mm == thickness_mm]
        is_known = np.isfinite(same[0].reflectance)
        if is_known.sum() < 2:
            continue
        curves = [
            _with_band(
                f"over {Path(film.ground_name).name}", film.reflectance[is_known], film.u_reflectance[is_known]
            )
            for film in same
        ]
        title = f"Predicted at {1e3 * thickness_mm:g} um, with 95 % bands that include the model's error"
        plots.append(chart(title, nm[is_known], curves))
    return plots


def _with_band(name: str, values: Array, u: Array) -> Curve:
    wide = COVERAGE_FACTOR * u
    return Curve(name, values, np.asarray(values - wide), np.asarray(values + wide))
