"""`coupole layer`: K, S and their uncertainty from the spectra of films of one paint."""

from __future__ import annotations

import json
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from coupole.commands.common import JsonOption, OverwriteOption, fail
from coupole.commands.option_groups import flatten_options
from coupole.errors import CoupoleError, InputError, StorageError, reason

if TYPE_CHECKING:
    from rich.console import Console

    from coupole.appearance.matter.glossy_face import Geometry
    from coupole.heritage.analysis.four_flux_fit import FourFlux
    from coupole.heritage.analysis.layer_samples import LayerGiven
    from coupole.heritage.analysis.other_thickness import FilmAtThickness


@dataclass(frozen=True)
class FilmSpectra:
    """Films of one paint: spectra, grounds and thickness."""

    over_black: Annotated[Path | None, typer.Option(help="Spectrum of the film over black.")] = None
    over_white: Annotated[Path | None, typer.Option(help="Spectrum of the film over white.")] = None
    black: Annotated[Path | None, typer.Option(help="Spectrum of the black ground.")] = None
    white: Annotated[Path | None, typer.Option(help="Spectrum of the white ground.")] = None
    opaque: Annotated[Path | None, typer.Option(help="Spectrum of an opaque film of the same paint.")] = None
    thickness_um: Annotated[
        float | None, typer.Option(min=0.01, help="Thickness of the film; K and S are then per mm.")
    ] = None
    u_thickness_um: Annotated[float, typer.Option(min=0.0, help="Standard uncertainty of the thickness.")] = 0.0

    def are_named(self) -> bool:
        """True if any of these options was given."""
        options = (self.over_black, self.over_white, self.black, self.white, self.opaque, self.thickness_um)
        return any(option is not None for option in options)

    def film_descriptions(self) -> list[dict[str, Any]]:
        """List the films in the form of `LayerGiven`. Raises InputError for a film without its ground, and for too
        few films."""
        films: list[dict[str, Any]] = []
        for film, ground, kind in ((self.over_black, self.black, "black"), (self.over_white, self.white, "white")):
            if (film is None) != (ground is None):
                option, missing = (
                    (f"--over-{kind}", f"--{kind}") if ground is None else (f"--{kind}", f"--over-{kind}")
                )
                raise InputError(f"{option}: needs {missing}, too: the film and the ground that it lies on")
            if film is not None:
                films.append({"spectrum": film, "over": ground, "thickness_um": self.thickness_um})
                films[-1]["u_thickness_um"] = self.u_thickness_um
        if self.opaque is not None:
            films.append({"spectrum": self.opaque})
        if len(films) < 2:
            raise InputError(
                "expected --over-black and --over-white, or one of them and --opaque: "
                "one spectrum cannot separate K from S"
            )
        return films


@dataclass(frozen=True)
class Instrument:
    """The spectrometer's geometry, and the refractive index of the paint's film."""

    binder_index: Annotated[
        float, typer.Option(min=1.0, max=3.0, help="Refractive index of the film; 1 means no glossy face.")
    ] = 1.5
    geometry: Annotated[
        str, typer.Option(help="Geometry of the instrument: gloss excluded, gloss included, or 45:0.")
    ] = "gloss excluded"

    def known_geometry(self) -> Geometry:
        """Return the geometry of the instrument. Raises InputError if there is none of that name."""
        from typing import get_args

        from coupole.appearance.matter.glossy_face import Geometry

        geometry: Geometry | None = next((name for name in get_args(Geometry) if name == self.geometry), None)
        if geometry is None:
            raise InputError(f"--geometry: expected {', '.join(get_args(Geometry))}; found {self.geometry!r}")
        return geometry


@dataclass(frozen=True)
class Wishes:
    """Requested results beyond K and S."""

    at_um: tuple[float, ...]
    """Thicknesses at which the film is predicted."""
    other_paint: Path | None
    """File of a paint with another grinding of the pigment."""
    out: Path | None
    """Folder for the files."""
    overwrite: bool = False
    """True if existing files may be replaced."""

    def files_of(self, paint_name: str) -> tuple[Path, Path] | None:
        """Return the paths of paint file and report; None if no folder is given. Raises InputError if the files
        exist and may not be replaced."""
        from coupole.appearance.matter.paint_file import ENDING
        from coupole.exchange.target_folder import refuse_standing

        if self.out is None:
            return None
        stem = "".join(letter if letter.isalnum() or letter in "-_" else "-" for letter in paint_name)
        files = self.out / f"{stem}{ENDING}", self.out / f"{stem}.html"
        if not self.overwrite:
            refuse_standing(files)
        return files


@flatten_options
def layer(
    samples: Annotated[
        Path | None,
        typer.Argument(help="YAML that names all films; or use the options below.", show_default=False),
    ] = None,
    *,
    films: FilmSpectra,
    noise: Annotated[
        float, typer.Option(min=1e-5, max=0.1, help="Standard uncertainty of a spectrum's value.")
    ] = 0.005,
    instrument: Instrument,
    bare_grounds: Annotated[
        bool, typer.Option("--bare-grounds", help="The grounds were measured without a glossy face.")
    ] = False,
    name: Annotated[str | None, typer.Option(help="Name of the paint.")] = None,
    other_grinding: Annotated[
        Path | None,
        typer.Option(
            help="Paint file of another grinding of the pigment, to compute the ratio of their grain sizes."
        ),
    ] = None,
    at_um: Annotated[
        list[float] | None,
        typer.Option(
            "--at-um",
            min=0.01,
            help="Predict the film at this thickness, over the grounds that were measured; repeat for more.",
            show_default=False,
        ),
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", help="Folder for paint file and report.")] = None,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Compute K and S of a paint, with 95 % intervals, from films over grounds, from an opaque and a thin film, or
    from a series.

    Give two spectra of a film over different grounds, or one over a ground and one of an opaque film.
    """
    from coupole.viewing.terminal import make_console

    console = make_console(quiet=as_json)
    try:
        if samples is None:
            descriptions, folder = films.film_descriptions(), Path()
            description = _layer_description(descriptions, name or "paint", noise, instrument, bare_grounds)
        else:
            if films.are_named():
                raise InputError(f"{samples}: names the films; leave out --over-black and the like")
            description, folder = read_films(samples)
        wishes = Wishes(tuple(at_um or ()), other_grinding, out, overwrite)
        document = _coefficients_document(description, folder, wishes)
    except CoupoleError as error:
        fail(error, as_json=as_json)
        raise
    if as_json:
        print(json.dumps(document))
    else:
        _say(document, console)


def read_films(path: Path) -> tuple[LayerGiven, Path]:
    """Read the YAML file of films; return it with the folder of its relative paths. Raises InputError with line
    and column."""
    from coupole.heritage.analysis.layer_samples import LayerGiven
    from coupole.plan import yamlfile

    document = yamlfile.read_document(path)
    return document.validate(LayerGiven), path.parent


# -- helpers --------------------------------------------------------------------------------------------------


def _layer_description(
    films: list[dict[str, Any]], name: str, noise: float, instrument: Instrument, bare: bool
) -> LayerGiven:
    from coupole.heritage.analysis.layer_samples import LayerGiven

    return LayerGiven.model_validate(
        {
            "name": name,
            "binder_index": instrument.binder_index,
            "geometry": instrument.known_geometry(),
            "grounds": "bare" if bare else "coated",
            "noise": noise,
            "films": films,
        }
    )


def _coefficients_document(layer: LayerGiven, folder: Path, wishes: Wishes) -> dict[str, Any]:
    from coupole.heritage.analysis import four_flux_fit, layer_fit, layer_model, other_thickness
    from coupole.heritage.analysis.layer_samples import paint_file, read_samples

    files = wishes.files_of(layer.name)
    samples = read_samples(layer, folder)
    if wishes.at_um and not samples.is_per_mm:
        raise InputError("--at-um: needs the thickness of the measured films: give --thickness-um")
    fit = layer_fit.fit(samples.films, samples.face, layer.noise)
    four = None
    if samples.directional is None:
        model = layer_model.deserved_model(fit, samples.films, samples.face, layer.noise)
    else:
        black, white = samples.films
        four = four_flux_fit.fit(black, white, samples.directional, samples.face, layer.noise)
        light, reflectances = samples.directional, (black.reflectance, white.reflectance)
        directional = light.over_black, light.over_white
        model = layer_model.deserved_by_measurement(reflectances, directional, light.transmittance, layer.noise)
    paint = paint_file(layer, samples, fit, four)
    document: dict[str, Any] = {
        "name": layer.name,
        "unit": paint.unit,
        "model": {
            "deserved": model.model,
            "because": model.because,
            "difference": model.difference,
            "unscattered": model.unscattered_share,
        },
        "coverage": 0.95,
        "wavelength_nm": samples.wavelengths_nm.tolist(),
        "K": fit.absorption.tolist(),
        "S": fit.scattering.tolist(),
        "half_width_K": (layer_fit.COVERAGE_FACTOR * fit.u_absorption).tolist(),
        "half_width_S": (layer_fit.COVERAGE_FACTOR * fit.u_scattering).tolist(),
        "determined": fit.determined_bands.tolist(),
        "spectra": fit.spectra,
        "misfit": _misfit(fit),
    }
    if four is not None:
        document["four_fluxes"] = _four_flux_document(four)
    predicted_films = other_thickness.films_at(
        fit, samples.films, samples.face, [1e-3 * thickness_um for thickness_um in wishes.at_um]
    )
    if predicted_films:
        document["at"] = [_film_document(film) for film in predicted_films]
    if wishes.other_paint is not None:
        document["grains"] = _grains(paint, wishes.other_paint)
    if files is not None:
        from coupole.appearance.matter.paint_file import encode
        from coupole.heritage.result_pages.layer_page import layer_page

        texts = encode(paint), layer_page(layer, samples, fit, model, four, predicted_films)
        document["files"] = _write_files(dict(zip(files, texts, strict=True)))
    return document


def _four_flux_document(four: FourFlux) -> dict[str, list[float]]:
    return {
        "k": four.direct_absorption.tolist(),
        "s_i": four.forward.tolist(),
        "s_j": four.backward.tolist(),
        "u_k": four.u_direct_absorption.tolist(),
        "u_s_i": four.u_forward.tolist(),
        "u_s_j": four.u_backward.tolist(),
    }


def _film_document(film: FilmAtThickness) -> dict[str, Any]:
    """Return the values for `--json`. A band in which the measured films hide their grounds is null."""
    from coupole.heritage.analysis.layer_fit import COVERAGE_FACTOR

    def values(array: Any) -> list[float | None]:
        return [float(value) if isfinite(value) else None for value in array]

    return {
        "thickness_um": 1e3 * film.thickness_mm,
        "over": Path(film.ground_name).name,
        "reflectance": values(film.reflectance),
        "half_width": values(COVERAGE_FACTOR * film.u_reflectance),
        "half_width_of_model": values(COVERAGE_FACTOR * film.u_model),
    }


def _misfit(fit: Any) -> float | None:
    """Return the rms residual as a multiple of the noise; None for two spectra, which leave no residual."""
    freedom = fit.spectra - 2
    return None if freedom == 0 else float((fit.chi2.mean() / freedom) ** 0.5)


def _grains(paint: Any, other_path: Path) -> dict[str, Any]:
    import numpy as np

    from coupole.appearance.matter.paint_file import read_paint
    from coupole.heritage.analysis.layer_model import grain_ratio

    other_paint = read_paint(other_path)
    if other_paint.unit != "per mm" or paint.unit != "per mm":
        raise InputError(
            f"{other_path}: to compare grain sizes, K and S of both grindings must be per mm; found "
            f"{other_paint.unit} and {paint.unit}: give --thickness-um"
        )
    nm = other_paint.wavelengths_nm
    inside = (nm >= paint.wavelengths_nm[0]) & (nm <= paint.wavelengths_nm[-1])
    paint_values = [np.interp(nm[inside], paint.wavelengths_nm, v) for v in (paint.scattering, paint.u_scattering)]
    estimate = grain_ratio(
        (paint_values[0], paint_values[1]), (other_paint.scattering[inside], other_paint.u_scattering[inside])
    )
    return {
        "than": other_paint.name,
        "ratio": estimate.ratio,
        "u_ratio": estimate.u_ratio,
        "bands": estimate.bands,
    }


def _write_files(text_of_file: dict[Path, str]) -> list[str]:
    folder = next(iter(text_of_file)).parent
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for path, text in text_of_file.items():
            path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise StorageError(f"{folder}: {reason(error)}. Choose another folder, or free space.") from error
    return [str(path) for path in text_of_file]


def _say(document: dict[str, Any], console: Console) -> None:
    from rich.table import Table

    table = Table("nm", "K", "+- 95 %", "S", "+- 95 %", box=None, padding=(0, 2, 0, 0), pad_edge=False)
    rows = list(
        zip(
            *(document[key] for key in ("wavelength_nm", "K", "half_width_K", "S", "half_width_S", "determined")),
            strict=True,
        )
    )
    for nm, k, wide_k, s, wide_s, sure in rows[:: max(1, len(rows) // 9)]:
        cells = [f"{value:.3g}" for value in (k, wide_k, s, wide_s)] if sure else ["hides", "", "", ""]
        table.add_row(f"{nm:g}", *cells)
    console.print(f"{document['name']}: K and S {document['unit']}", markup=False)
    console.print(table)
    console.print(f"{document['model']['deserved']}: {document['model']['because']}", markup=False)
    if document["model"]["difference"] > 0.0:
        console.print(
            f"spectra under directional light differ by up to {document['model']['difference']:.3f} from those "
            "under diffuse light"
        )
    if (misfit := document["misfit"]) is not None:
        console.print(
            f"the films' differences from a single K and S are {misfit:.1f} times as large as noise explains"
        )
    _say_films(document, console)
    if grains := document.get("grains"):
        console.print(
            f"its grains are {grains['ratio']:.2f} +- {2 * grains['u_ratio']:.2f} times as large as the grains of "
            f"{grains['than']}, if the grains are larger than the wavelength (S proportional to 1/size)",
            markup=False,
        )
    for path in document.get("files", ()):
        console.print(path, markup=False)


def _say_films(document: dict[str, Any], console: Console) -> None:
    """Print one line for each predicted film, with the values in the middle one of its known bands."""
    for film in document.get("at", ()):
        name = f"at {film['thickness_um']:g} um over {film['over']}"
        bands = [number for number, value in enumerate(film["reflectance"]) if value is not None]
        if not bands:
            console.print(
                f"{name}: cannot be predicted, because the measured films hide the grounds that they lie on",
                markup=False,
            )
            continue
        at = bands[len(bands) // 2]
        console.print(
            f"{name}: {film['reflectance'][at]:.3f} +- {film['half_width'][at]:.3f} (95 %) at "
            f"{document['wavelength_nm'][at]:g} nm; the model alone: +- {film['half_width_of_model'][at]:.3f}",
            markup=False,
        )
