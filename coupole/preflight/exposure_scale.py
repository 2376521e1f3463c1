"""Values that a white surface gives in this cell's pictures, as far as lamps, lens and sensor are known.

The simulated world scales its light to the plan (unless `world.settings.white_at_us` is set), so its frames say
nothing about a cell's exposure. The scale is known from a record of the LEDs' power that is in force, or from the
rig's `white_response`. Without both the scale is not known, and nothing is assumed.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from coupole.calibration.light.irradiance import irradiance_per_flux
from coupole.calibration.record import Record
from coupole.errors import InputError
from coupole.intake.input_files import InputFiles
from coupole.plan.light_selection import leds_of_plan

if TYPE_CHECKING:
    from coupole.preflight.job import Job

HOW_TO_KNOW = "set `white_response` in the rig (docs/how-to/expose-and-focus.md)"
UNDER_EXPOSED = 0.05
"""Share of full scale that white must reach."""


@dataclass(frozen=True)
class ExposureScale:
    """Signal of a horizontal, perfectly white diffuser at the support's centre, in the most sensitive channel."""

    dn_per_s: NDArray[np.float64]
    """[leds] above black, at gain 0 dB, under each LED of the dome's table; 0 for a dead one."""
    source: str
    """Record or rig setting that the scale comes from."""


@dataclass(frozen=True)
class ExposedWhite:
    """Brightness of white in one exposure of a plan."""

    exposure_us: int
    brightest: float
    """Share of full scale above black under the plan's brightest LED. Above 1 the white saturates."""
    median: float
    """Share of full scale above black under the median LED of the plan."""

    def verdict(self) -> str:
        """`over-exposed`, `under-exposed` or `well exposed`."""
        if self.brightest > 1.0:
            return "over-exposed"
        return "under-exposed" if self.median < UNDER_EXPOSED else "well exposed"


def exposure_scale(job: Job) -> ExposureScale | None:
    """Return the cell's scale of exposure; None if it is not known. Raises InputError for a damaged record."""
    rig, leds = job.cell.rig, job.cell.leds
    base_from_support = rig.support.base_from_support.matrix()
    per_flux = irradiance_per_flux(
        base_from_support[:3, 3],
        base_from_support[:3, 2],
        leds.positions_mm,
        leds.normals,
        emission=rig.dome.emission,
    )
    for item in job.calibrations or ():
        record = item.record
        if record.kind == "led-power" and "gain_db" in record.fixed and record.validity.f_number is not None:
            power = _power(item.path, record, job.cell.files, leds.ids) * 10.0 ** (-record.fixed["gain_db"] / 20.0)
            return ExposureScale(power * per_flux / np.pi, str(item.path))
    white_response = rig.white_response
    if white_response is None or abs(white_response.f_number - rig.lens.f_number) > 1e-3 * white_response.f_number:
        return None
    return ExposureScale(leds.flux_lm * per_flux * white_response.dn_per_lux_s, "the rig's white_response")


def exposed_white(job: Job, scale: ExposureScale) -> list[ExposedWhite]:
    """Return the brightness of white in each exposure of the plan; empty if the plan lights no LED."""
    cell = job.cell
    rows = leds_of_plan(job.plan, cell.leds, cell.rig.support.base_from_support.matrix())
    lit = scale.dn_per_s[rows] * 10.0 ** (job.plan.gain_db / 20.0)
    lit = lit[lit > 0.0]
    if not len(lit):
        return []
    full_dn = cell.rig.sensor.white_dn - cell.rig.sensor.black_dn
    exposures_us = job.plan.exposure.exposures_us
    if job.schedule.is_open:  # among these is chosen
        exposures_us = (exposures_us[0], exposures_us[-1])
    return [
        ExposedWhite(e, float(lit.max()) * e * 1e-6 / full_dn, float(np.median(lit)) * e * 1e-6 / full_dn)
        for e in exposures_us
    ]


def white_share(job: Job, scale: ExposureScale, exposure_us: int) -> float:
    """Return the share of full scale that white reaches in an exposure at gain 0 dB under the median LED of the
    dome."""
    sensor = job.cell.rig.sensor
    return float(np.median(scale.dn_per_s)) * exposure_us * 1e-6 / (sensor.white_dn - sensor.black_dn)


def _power(path: Path, record: Record, files: InputFiles, ids: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return [ids] power in the channel with the highest power, DN s^-1 m^2 sr; 0 for LEDs that are dead or not in
    the record.
    """
    table = path.parent / record.files[0].name
    try:
        lines = [line for line in files.read_bytes(table).decode("utf-8").splitlines() if not line.startswith("#")]
        rows = list(csv.DictReader(lines))
        channels = [name for name in rows[0] if name.startswith("power_")]
        of_led = {int(row["id"]): max(float(row[channel]) for channel in channels) for row in rows}
    except (OSError, UnicodeDecodeError, ValueError, KeyError, IndexError, TypeError) as error:
        raise InputError(f"{table}: expected the table of LED powers beside {path.name}: {error}") from error
    powers = np.array([of_led.get(int(led), 0.0) for led in ids])
    return np.where(np.isfinite(powers), powers, 0.0)
