"""Files of a spectral picture: an EXR of all bands and a PNG for viewing, with metadata. All are marked as
simulated."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import coupole
from coupole.appearance.render import bands, colour
from coupole.appearance.render.rendering import Spectral, degree_of_linear_polarisation
from coupole.appearance.render.scene_file import Scene
from coupole.appearance.render.spectra import power
from coupole.appearance.spectra.grid import Array
from coupole.errors import InputError

_HALF_MOST = 65504.0
SYNTHETIC = "simulated: computed by spectral path tracing, no photograph"


def white_of(scene: Scene, folder: Path) -> Array:
    """XYZ [3] of the first light, Y = 1: of the perfect diffuser under it."""
    chosen = bands.chosen(scene.bands.step_nm)
    spectrum = power(scene.lights[0].spectrum, folder)[chosen]
    xyz = colour.tristimulus(spectrum, chosen, scene.bands.step_nm, scene.observer)
    return np.asarray(xyz / xyz[1])


def tristimulus(scene: Scene, found: Spectral) -> Array:
    """XYZ [h, w, 3] as the scene's observer sees it."""
    step_nm = scene.bands.step_nm
    return colour.tristimulus(found.radiance, bands.chosen(step_nm), step_nm, scene.observer)


def write(scene: Scene, found: Spectral, stem: Path, *, white: Array, written_by: str) -> dict[str, Any]:
    """Write `stem`.exr and `stem`.png, with polarisation also `stem`-polarisation.png; returns their summary.

    `white` is the XYZ shown as white, `written_by` names renderer and variant. Raises OSError, InputError.
    """
    xyz = tristimulus(scene, found)
    shown_white = scene.display.white_cd_m2 or float(np.quantile(xyz[..., 1], 1.0 - scene.display.clipped))
    if shown_white <= 0.0:
        raise InputError(f"{scene.name}: expected some light in the picture, found none; see to lights and camera")
    picture, outside = colour.displayed(colour.adapted(xyz / shown_white, white, scene.display.adaptation))
    files = {"png": f"{stem.name}.png", "exr": f"{stem.name}.exr"}
    about = f"{scene.name}: {SYNTHETIC}; {written_by}"
    write_png(stem.with_name(files["png"]), picture, about)
    _write_exr(stem.with_name(files["exr"]), scene, found, xyz, about)
    summary: dict[str, Any] = {
        "files": files,
        "white_cd_m2": round(shown_white, 6),
        "mean_cd_m2": round(float(xyz[..., 1].mean()), 6),
        "outside_srgb": round(outside, 6),
    }
    if len(found.stokes) > 1:
        degree = degree_of_linear_polarisation(found.stokes)
        files["polarisation"] = f"{stem.name}-polarisation.png"
        grey = np.round(255.0 * np.clip(degree, 0.0, 1.0)).astype(np.uint8)
        write_png(stem.with_name(files["polarisation"]), grey, f"degree of linear polarisation, 0 to 1; {about}")
        summary["degree_of_linear_polarisation"] = {
            "median": round(float(np.median(degree)), 4),
            "greatest": round(float(degree.max()), 4),
        }
    return summary


def write_png(path: Path, picture: NDArray[np.uint8], about: str) -> None:
    """An sRGB picture [h, w, 3], or a grey one [h, w], that says what it is."""
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    chunks: Any = PngInfo()
    chunks.add(b"sRGB", b"\x00")  # perceptual intent; with this chunk no profile is needed (PNG, 11.3.2.5)
    chunks.add_text("Description", about)
    chunks.add_text("Software", f"coupole {coupole.__version__}")
    Image.fromarray(picture).save(path, "PNG", optimize=True, pnginfo=chunks)


def _write_exr(path: Path, scene: Scene, found: Spectral, xyz: Array, about: str) -> None:
    """Channels and attributes of Fichet et al., "An OpenEXR Layout for Spectral Images", JCGT 10(3), 2021."""
    import mitsuba

    mi: Any = mitsuba
    planes = [xyz] if scene.outputs.xyz else []
    names = list("XYZ") if scene.outputs.xyz else []
    for number, part in enumerate(found.stokes):
        planes.append(part)
        names += [f"S{number}.{nm:.0f}nm" for nm in found.wavelengths_nm]
    pixels = np.concatenate(planes, axis=2).astype(np.float32)
    if scene.outputs.spectra == "half" and np.abs(pixels).max() > _HALF_MOST:
        raise InputError(
            f"{path.name}: expected values up to {_HALF_MOST:g} for half precision, found "
            f"{np.abs(pixels).max():.3g}; write `outputs: {{spectra: float}}`"
        )
    numbers = pixels.astype(np.float16) if scene.outputs.spectra == "half" else pixels
    bitmap = mi.Bitmap(numbers, mi.Bitmap.PixelFormat.MultiChannel, names)
    told = bitmap.metadata()
    told["spectralLayoutVersion"] = "1.0"
    told["emissiveUnits"] = "W.m^-2.sr^-1.nm^-1"
    told["polarisationHandedness"] = "right"
    told["comments"] = about
    told["synthetic"] = "true"
    told["observer"] = f"CIE {scene.observer}"
    try:
        bitmap.write(str(path))
    except RuntimeError as error:  # what Mitsuba makes of a full disk
        raise OSError(f"{path.name}: {error}") from error
