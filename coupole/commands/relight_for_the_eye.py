"""`coupole reflectance relight --for-the-eye`: relit pictures in the colours that the eye sees, by a chart or by
spectra of sensor and LEDs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from coupole.errors import InputError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from coupole.exchange.camera_colour import CameraColour
    from coupole.reflectance.new_light.light_kinds import AnyLight
    from coupole.scripting.relit_result import Relit

PEAK_QUANTILE = 0.999

EyeOption = Annotated[
    bool,
    typer.Option(
        "--for-the-eye",
        help="Write sRGB instead of camera channels; needs --colour, or --sensor-spectra and --led-spectrum.",
    ),
]
SensorOption = Annotated[
    Path | None,
    typer.Option("--sensor-spectra", help="Table of the sensor's spectral sensitivities: nm, red, green, blue."),
]
SpectrumOption = Annotated[
    Path | None,
    typer.Option("--led-spectrum", help="Table of the spectrum of the dome's LEDs: nm, power."),
]

RecordOption = Annotated[
    Path | None,
    typer.Option("--colour", help="A record of `calibrate colour`, instead of tables of spectra."),
]


@dataclass(frozen=True)
class EyeColours:
    """Options of pictures for the eye, and of the colours that their channels become."""

    for_the_eye: EyeOption = False
    sensor_spectra: SensorOption = None
    led_spectrum: SpectrumOption = None
    colour_record: RecordOption = None

    def read_colour(self) -> CameraColour | None:
        """Read the colour conversion from a record, or from tables of spectra; None if no picture for the eye is
        wanted.

        Raises InputError for options that do not go together, and as `camera_colour` and `colour_of_record`.
        """
        from coupole.exchange.camera_colour import camera_colour, colour_of_record

        tables = {"--sensor-spectra": self.sensor_spectra, "--led-spectrum": self.led_spectrum}
        option_names = [name for name, path in tables.items() if path is not None]
        if self.colour_record is not None:
            if not self.for_the_eye or option_names:
                raise InputError("--colour: is for --for-the-eye, in place of --sensor-spectra and --led-spectrum")
            return colour_of_record(self.colour_record)
        if not self.for_the_eye:
            if option_names:
                raise InputError(f"{', '.join(option_names)}: is for --for-the-eye")
            return None
        if self.sensor_spectra is None or self.led_spectrum is None:
            missing = ", ".join(name for name, path in tables.items() if path is None)
            raise InputError(
                f"--for-the-eye: expected {missing} too, a table measured by the maker; or --colour, a record of "
                "`calibrate colour`"
            )
        return camera_colour(self.sensor_spectra, self.led_spectrum)


def write_relit_for_the_eye(
    relit: Relit,
    lights: Sequence[AnyLight],
    to: Path,
    colour: CameraColour,
    white: float | None,
    bars: Callable[[str, int, int], None],
    before_writing: Callable[[], None],
) -> dict[str, Any]:
    """Compute the picture and write it as sRGB; return the content of `--json`."""
    import numpy as np

    from coupole.exchange.picture_for_the_eye import linear_colours, write_for_the_eye
    from coupole.reflectance.new_light.light_kinds import LedLight

    if not relit.has_colours:
        raise InputError("--for-the-eye: the camera has one channel; it has no colours")
    if any(isinstance(light, LedLight) for light in lights):
        raise InputError(
            "--for-the-eye: the values of an LED's picture are shares of the camera's range; expected lights of "
            "other kinds"
        )
    linear = linear_colours(relit.picture(lights, lambda count, of: bars("light", count, of)), colour)
    white = white or float(np.quantile(bright(linear), PEAK_QUANTILE)) or 1.0
    about = {**relit.about, "colour": colour.origin.partition("; white")[0], "white": white}
    before_writing()
    write_for_the_eye(to, linear, white, about)
    return {"picture": str(to.resolve()), **about}


def bright(picture: NDArray[Any]) -> NDArray[Any]:
    """Return the values of the pixels that are not black."""
    lit = picture[picture.max(axis=2) > 0.0]
    return lit if len(lit) else picture.reshape(-1, 3)
