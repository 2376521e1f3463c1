"""A spot of a result of reflectance, for `coupole identify`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from coupole.errors import InputError

if TYPE_CHECKING:
    import numpy as np

    from coupole.heritage.analysis.references import References

_FARTHEST_EDGES = 3.0
_CHANNELS = 3


@dataclass(frozen=True)
class Spot:
    """A place on a result, with the spectra of camera and LEDs."""

    result: Path
    at: str
    """X,Y,Z in mm of the exported mesh."""
    sensor: Path
    """Table with the columns nm, red, green, blue."""
    leds: Path
    """Table with the columns nm, power."""


def asked_spot(result: Path | None, at: str | None, sensor: Path | None, leds: Path | None) -> Spot | None:
    """Return the spot that the options name; None if none of these options is given. Raises InputError if one of
    them is missing."""
    options = {"--result": result, "--at": at, "--sensor-spectra": sensor, "--led-spectrum": leds}
    if all(value is None for value in options.values()):
        return None
    if missing := [name for name, value in options.items() if value is None]:
        raise InputError(f"{', '.join(missing)}: a spot of a result needs {', '.join(options)}")
    assert result is not None
    assert at is not None
    assert sensor is not None
    assert leds is not None
    return Spot(result, at, sensor, leds)


def identify_spot(spot: Spot, references: References) -> dict[str, Any]:
    """Return the content of `--json` for a spot: the keys of a spectrum, and the classes that cannot be
    distinguished.

    Three channels cannot prove a class. The verdict is "ambiguous", or "unknown" if no class has the colour.
    """
    from coupole.appearance.spectra.measured import read_spectrum
    from coupole.heritage.analysis.channel_classes import classes_of_channels

    reflectance, u_reflectance = _channels_at(spot)
    answer = classes_of_channels(
        reflectance,
        u_reflectance,
        read_spectrum(spot.leds, unit="power"),
        [read_spectrum(spot.sensor, unit="power", column=column) for column in (1, 2, 3)],
        references,
    )
    apart = answer.not_told_apart
    many = (
        f"{len(apart)} of {len(answer.candidates)} classes of the library have the spot's colour at some "
        "concentration"
    )
    return {
        "name": f"{spot.result.resolve().name} at {spot.at}",
        "verdict": "ambiguous" if apart else "unknown",
        "class": answer.candidates[0].class_name,
        "candidates": [
            {"name": candidate.name, "class": candidate.class_name, "probability": candidate.probability}
            for candidate in answer.candidates
        ],
        "not_told_apart": list(apart),
        "reflectance": reflectance.tolist(),
        "u_reflectance_relative": u_reflectance.tolist(),
        "reason": f"three channels: {many}" + (f": {', '.join(apart)}" if apart else ""),
    }


def _channels_at(spot: Spot) -> tuple[np.ndarray, np.ndarray]:
    """Return [3] the diffuse reflectance pi kd of the nearest fitted triangle, and its relative uncertainty."""
    import h5py
    import numpy as np

    from coupole.reflectance.fits import GGX_NORMAL
    from coupole.reflectance.new_light.light_kinds import place_of
    from coupole.reflectance.run_result import OBJECT, RunResult

    result = RunResult(spot.result)
    name = GGX_NORMAL.name
    for path in (spot.result / OBJECT, result.materials_path(name)):
        if not path.is_file():
            raise InputError(f"{path}: is not there; expected a fitted result of runs")
    place = np.array([*place_of(spot.at, "--at"), 1.0])
    corners = result.corners_mm[result.triangles].astype(float)
    apart = np.linalg.norm(corners.mean(axis=1) - (result.base_from_support @ place)[:3], axis=1)
    nearest = int(np.argmin(apart))
    edge = float(np.linalg.norm(corners[nearest, 1] - corners[nearest, 0]))
    if apart[nearest] > _FARTHEST_EDGES * edge:
        raise InputError(
            f"--at {spot.at}: expected a place on the object, in mm of the exported mesh; the nearest triangle is "
            f"{apart[nearest]:.1f} mm away"
        )
    row = np.array([nearest])
    kd = result.materials(name, row).kd[0]
    if len(kd) != _CHANNELS:
        raise InputError(f"{spot.result}: expected a colour camera's three channels, found {len(kd)}")
    with h5py.File(result.materials_path(name), "r") as file:
        u = np.asarray(file["u_kd"][nearest], float) if "u_kd" in file else np.zeros(_CHANNELS)
    return np.pi * kd, np.nan_to_num(u)
