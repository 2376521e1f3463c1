"""Files of a spectral picture: an EXR of all bands and a PNG for viewing, with metadata. All are marked as
simulated."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import coupole
from coupole.appearance.render import colour
from coupole.appearance.render.denoising import DENOISED, denoised_xyz
from coupole.appearance.render.rendering import Spectral, degree_of_linear_polarisation
from coupole.appearance.render.scene_file import PlainScene
from coupole.appearance.render.spectra import power, scaled_power
from coupole.appearance.spectra.grid import Array
from coupole.errors import InputError

_HALF_MOST = 65504.0
SYNTHETIC = "simulated: computed by spectral path tracing, not a photograph"


def eye_of(scene: PlainScene, folder: Path) -> colour.Eye:
    """Return the scene's observer, adapted to the first light; spectra of several lights have equal weight."""
    powers = [power(light.spectrum, folder) for light in scene.lights]
    mixture = np.sum([scaled_power(light_power, 1.0) for light_power in powers], axis=0)
    return colour.eye(scene.observer, mixture, powers[0], scene.bands.step_nm)


def write(
    scene: PlainScene,
    spectral_picture: Spectral,
    stem: Path,
    *,
    eye: colour.Eye,
    written_by: str,
    with_spectra: bool = True,
) -> dict[str, Any]:
    """Write `stem`.exr (if `with_spectra`) and `stem`.png, with polarisation also `stem`-polarisation.png. Return
    their summary.

    `eye` is the observer of the shown colours, `written_by` names renderer and variant. Raises OSError,
    InputError.
    """
    xyz = eye.tristimulus(spectral_picture.radiance)
    shown_white = scene.display.white_cd_m2 or float(np.quantile(xyz[..., 1], 1.0 - scene.display.clipped))
    if shown_white <= 0.0:
        raise InputError(f"{scene.name}: expected some light in the picture, found none; check lights and camera")
    about = f"{scene.name}: {SYNTHETIC}; {written_by}"
    display_xyz = denoised_xyz(xyz) if scene.display.denoised else xyz
    comment = f"{about}; {DENOISED}" if scene.display.denoised else about
    picture, outside = colour.displayed_srgb(
        colour.adapted_xyz(display_xyz / shown_white, eye.white, scene.display.adaptation)
    )
    files = {"png": f"{stem.name}.png"} | ({"exr": f"{stem.name}.exr"} if with_spectra else {})
    write_png(stem.with_name(files["png"]), picture, comment)
    if with_spectra:
        write_exr(stem.with_name(files["exr"]), scene, spectral_picture, xyz, about)
    summary: dict[str, Any] = {
        "files": files,
        "white_cd_m2": round(shown_white, 6),
        "mean_cd_m2": round(float(eye.luminance(spectral_picture.radiance).mean()), 6),
        "outside_srgb": round(outside, 6),
        "denoised": scene.display.denoised,
        "samples": spectral_picture.samples,
        "noise": None if spectral_picture.noise is None else round(spectral_picture.noise, 5),
    }
    if len(spectral_picture.stokes) > 1:
        degree = degree_of_linear_polarisation(spectral_picture.stokes)
        files["polarisation"] = f"{stem.name}-polarisation.png"
        grey = np.round(255.0 * np.clip(degree, 0.0, 1.0)).astype(np.uint8)
        write_png(stem.with_name(files["polarisation"]), grey, f"degree of linear polarisation, 0 to 1; {about}")
        summary["degree_of_linear_polarisation"] = {
            "median": round(float(np.median(degree)), 4),
            "greatest": round(float(degree.max()), 4),
        }
    return summary


def write_png(path: Path, picture: NDArray[np.uint8], about: str, more: Mapping[str, str] | None = None) -> None:
    """Write an sRGB picture [h, w, 3], or a grey one [h, w], with texts that describe it; `more` are texts by
    their keywords."""
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    chunks: Any = PngInfo()
    chunks.add(b"sRGB", b"\x00")  # perceptual intent; with this chunk no profile is needed (PNG, 11.3.2.5)
    chunks.add_text("Description", about)
    chunks.add_text("Software", f"coupole {coupole.__version__}")
    for keyword, words in (more or {}).items():
        chunks.add_itxt(keyword, words)
    Image.fromarray(picture).save(path, "PNG", optimize=True, pnginfo=chunks)


def write_exr(
    path: Path,
    scene: PlainScene,
    spectral_picture: Spectral,
    xyz: Array,
    about: str,
    more: Mapping[str, str] | None = None,
) -> None:
    """Write channels and attributes by Fichet et al., "An OpenEXR Layout for Spectral Images", JCGT 10(3), 2021,
    and `more` attributes. Raises OSError, InputError."""
    import mitsuba

    mi: Any = mitsuba
    planes = [xyz] if scene.outputs.xyz else []
    names = list("XYZ") if scene.outputs.xyz else []
    for number, part in enumerate(spectral_picture.stokes):
        planes.append(part)
        names += [f"S{number}.{nm:.0f}nm" for nm in spectral_picture.wavelengths_nm]
    pixels = np.concatenate(planes, axis=2).astype(np.float32)
    if scene.outputs.spectra == "half" and np.abs(pixels).max() > _HALF_MOST:
        raise InputError(
            f"{path.name}: expected values up to {_HALF_MOST:g} for half precision, found "
            f"{np.abs(pixels).max():.3g}; write `outputs: {{spectra: float}}`"
        )
    numbers = pixels.astype(np.float16) if scene.outputs.spectra == "half" else pixels
    bitmap = mi.Bitmap(numbers, mi.Bitmap.PixelFormat.MultiChannel, names)
    metadata = bitmap.metadata()
    metadata["spectralLayoutVersion"] = "1.0"
    metadata["emissiveUnits"] = "W.m^-2.sr^-1.nm^-1"
    metadata["polarisationHandedness"] = "right"
    metadata["comments"] = about
    metadata["synthetic"] = "true"
    metadata["observer"] = f"CIE {scene.observer}; Y of the first light is its luminance in cd/m2"
    for name, value in (more or {}).items():
        metadata[name] = value
    try:
        bitmap.write(str(path))
    except RuntimeError as error:  # what Mitsuba makes of a full disk
        raise OSError(f"{path.name}: {error}") from error
