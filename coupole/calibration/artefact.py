"""Artefacts: things with a certificate that calibrations use, and the data about them that a record keeps.

A description of a board, tile, chart or target may have a block `artefact`. The block identifies the thing, and
gives the certificate's figures and their temperature. Uncertainties are written as in certificates: expanded, with
the factor k and the coverage.
"""

from __future__ import annotations

import datetime
import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, TypeVar

import numpy as np
from pydantic import Field, field_validator

from coupole.calibration.rotations import Floats
from coupole.errors import InputError, reason
from coupole.plan import yamlfile
from coupole.plan.base_model import FilePath, Model, Words

Celsius = Annotated[float, Field(ge=-50.0, le=100.0)]
Geometry = Literal["0/h", "8/h", "0/45"]
"""Illumination and observation of a reflectance. `0/h`, `8/h`: light along the normal or at 8 degrees, and all
reflected light (gloss included). `0/45`: light along the normal, seen at 45 degrees, over a perfect diffuser."""
NOT_TRACEABLE = "not traceable: no certificate"
RUN_U_K = 2.0
"""Standard uncertainty of an artefact's temperature, if it is taken from a run's coolest LED board."""
UNKNOWN_U_K = 5.0
"""Standard uncertainty of an artefact's temperature if nothing is known: it is within 9 K of the certificate's
temperature."""
_BANDS_NM: dict[Literal["R", "G", "B"], tuple[float, float]] = {
    "R": (580.0, 680.0),
    "G": (490.0, 580.0),
    "B": (430.0, 500.0),
}
_BAND_SHIFT_NM = 20.0
"""Largest error of the place of a band."""


def _not_said(value: object) -> bool:
    return value is None


class CertifiedValue(Model):
    """One figure of a certificate."""

    value: float
    expanded_u: Annotated[float, Field(ge=0)]
    """U, in the value's unit: k times its standard uncertainty."""
    k: Annotated[float, Field(gt=0, le=10)]
    """Coverage factor of U."""
    coverage: Annotated[float, Field(gt=0, lt=1)] = 0.95
    """Probability of the interval of plus and minus U."""

    @property
    def u(self) -> float:
        """Standard uncertainty."""
        return self.expanded_u / self.k

    def words(self, unit: str) -> str:
        """Return the figure as text."""
        return f"{self.value:g} {unit}, U {self.expanded_u:g} {unit} (k = {self.k:g}, {self.coverage:.0%})"


class Certificate(Model):
    """A certificate of calibration."""

    number: Words
    laboratory: Words
    date: datetime.date
    """Date of the calibration."""
    due: datetime.date | None = Field(default=None, exclude_if=_not_said)
    """Date on which the owner of the thing wants it to be calibrated again."""
    file: FilePath | None = Field(default=None, exclude_if=_not_said)
    """The file of the certificate, beside the description. Its checksum goes into records."""
    sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")] | None = Field(default=None, exclude_if=_not_said)
    """Checksum of the certificate's file."""


class CertifiedReflectance(Model):
    """Spectral reflectance of a certificate."""

    geometry: Geometry
    k: Annotated[float, Field(gt=0, le=10)]
    coverage: Annotated[float, Field(gt=0, lt=1)] = 0.95
    values: Annotated[tuple[tuple[float, float, float], ...], Field(min_length=1, max_length=1000)]
    """Wavelength in nm, reflectance, its expanded uncertainty."""
    bands_nm: dict[Literal["R", "G", "B"], tuple[float, float]] = Field(default_factory=lambda: dict(_BANDS_NM))
    """First and last wavelength that each channel of the camera sees. They are assumed if they are not stated."""

    @field_validator("values")
    @classmethod
    def _check_values(
        cls, values: tuple[tuple[float, float, float], ...]
    ) -> tuple[tuple[float, float, float], ...]:
        rows = np.array(values)
        if (np.diff(rows[:, 0]) <= 0).any() or rows[0, 0] < 200 or rows[-1, 0] > 3000:
            raise ValueError("rows of nm, reflectance, U with wavelengths that rise, from 200 to 3000 nm")
        if (rows[:, 1] <= 0).any() or (rows[:, 1] > 1.1).any() or (rows[:, 2] < 0).any():
            raise ValueError("reflectances above 0, at most 1.1 (fractions, not percent), with U of 0 or more")
        return values

    @field_validator("bands_nm")
    @classmethod
    def _check_bands(
        cls, bands_nm: dict[Literal["R", "G", "B"], tuple[float, float]]
    ) -> dict[Literal["R", "G", "B"], tuple[float, float]]:
        if set(bands_nm) != {"R", "G", "B"} or any(first >= last for first, last in bands_nm.values()):
            raise ValueError("bands of R, G and B, each the first and the last wavelength in nm")
        return bands_nm

    def in_channel(self, channel: str, light: LightSpectrum | None) -> tuple[float, float]:
        """Return the mean reflectance in a channel, and its standard uncertainty.

        The mean is weighted by the light within the channel's band, or by the band alone. Errors at a
        certificate's wavelengths count as fully correlated, so their uncertainties add up linearly. A band is
        known within 20 nm. The change of the mean by this shift is the half width of a rectangular distribution.
        Raises InputError for a band that the certificate does not cover.
        """
        first, last = self.bands_nm[channel]  # type: ignore[index]  # a sensor's channel
        wavelengths = np.array(self.values)[:, 0]
        if first < wavelengths[0] - _BAND_SHIFT_NM or last > wavelengths[-1] + _BAND_SHIFT_NM:
            raise InputError(
                f"artefact.reflectance: its values from {wavelengths[0]:g} to {wavelengths[-1]:g} nm "
                f"do not cover the band of {channel}, {first:g} to {last:g} nm"
            )
        mean_and_u = self._mean_of_band(first, last, light)
        if mean_and_u is None:
            raise InputError(
                f"the LEDs' spectrum has no light from {first:g} to {last:g} nm, the band of {channel}"
            )
        value, u = mean_and_u
        shifted_means = [
            self._mean_of_band(first + by, last + by, light) for by in (-_BAND_SHIFT_NM, _BAND_SHIFT_NM)
        ]
        u_band = max((abs(mean[0] - value) for mean in shifted_means if mean), default=0.0) / np.sqrt(3.0)
        return value, float(np.hypot(u, u_band))

    def _mean_of_band(self, first: float, last: float, light: LightSpectrum | None) -> tuple[float, float] | None:
        """Return mean and standard uncertainty; None for a band without light."""
        grid = np.linspace(first, last, 101)
        weights = np.ones_like(grid) if light is None else light.at(grid)
        if weights.sum() <= 0:
            return None
        wavelengths, values, expanded_u = np.array(self.values).T
        mean = float(np.average(np.interp(grid, wavelengths, values), weights=weights))
        return mean, float(np.average(np.interp(grid, wavelengths, expanded_u), weights=weights)) / self.k


@dataclass(frozen=True)
class LightSpectrum:
    """Relative spectral power of the LEDs."""

    wavelengths_nm: Floats
    power: Floats
    """[n] power at each wavelength."""
    source: str
    """Name of the file or model that the power comes from."""

    def at(self, wavelengths_nm: Floats) -> Floats:
        """Return the power at other wavelengths, 0 outside."""
        return np.interp(wavelengths_nm, self.wavelengths_nm, self.power, left=0.0, right=0.0)


class Artefact(Model):
    """A thing with its certificate. All fields but name and serial number may be left out."""

    name: Words
    serial: Words
    """Serial number. A check refuses an artefact if its number is in one of the checked records."""
    certificate: Certificate | None = None
    temperature_c: Celsius = 20.0
    """Temperature for which the certified figures hold."""
    expansion_ppm_per_k: CertifiedValue | None = Field(default=None, exclude_if=_not_said)
    """Linear thermal expansion."""
    square_mm: CertifiedValue | None = Field(default=None, exclude_if=_not_said)
    """Side of a board's squares, as the mean over the whole board."""
    corner_um: CertifiedValue | None = Field(default=None, exclude_if=_not_said)
    """Departure of a corner from its place according to `square_mm`, per coordinate: value 0, and U of each
    corner."""
    flatness_um: CertifiedValue | None = Field(default=None, exclude_if=_not_said)
    """Distance of two planes that enclose the surface."""
    reflectance: CertifiedReflectance | None = Field(default=None, exclude_if=_not_said)

    @property
    def title(self) -> str:
        """Name and serial number."""
        return f"{self.name}, serial {self.serial}"


class Described(Model):
    """A description of a thing, which may have a certificate."""

    artefact: Artefact | None = None
    """Certificate and identity of the thing."""


@dataclass(frozen=True)
class Temperature:
    """Temperature of an artefact when it was measured."""

    celsius: float | None
    """None if it is not known."""
    u_k: float
    source: str


class UsedArtefact(Model):
    """Part of a record: an artefact that was used for it."""

    role: Literal["board", "tile", "chart", "glare target"]
    artefact: Artefact
    measured_c: float | None = None
    """Temperature at the measurement; None if it was not known."""
    u_measured_k: Annotated[float, Field(ge=0)] | None = None
    measured_by: str = ""
    """Source of that temperature."""
    correction_ppm: float = 0.0
    """Relative correction of all its lengths for thermal expansion."""
    u_scale_ppm: Annotated[float, Field(ge=0)] | None = None
    """Standard uncertainty of its lengths at that temperature."""
    figures: dict[str, float] = Field(default_factory=dict)
    """Figures that were taken from the certificate: `reflectance.G`, `u_reflectance.G`."""

    @property
    def is_traceable(self) -> bool:
        return self.artefact.certificate is not None


def used_as(
    role: Literal["board", "tile", "chart", "glare target"],
    artefact: Artefact | None,
    figures: dict[str, float] | None = None,
) -> tuple[UsedArtefact, ...]:
    """Return the part of a record for an artefact whose lengths do not matter; empty without an artefact."""
    return () if artefact is None else (UsedArtefact(role=role, artefact=artefact, figures=figures or {}),)


def temperature_of(celsius: float | None, u_k: float, of_run_c: tuple[float, float] | None) -> Temperature:
    """Return the temperature that was entered. Without it, return the temperature of a run's coolest LED board
    (`of_run_c`, from and to), which is nearest to the room temperature."""
    if celsius is not None:
        return Temperature(celsius, u_k, "entered by hand")
    if of_run_c is not None:
        return Temperature(of_run_c[0], RUN_U_K, "the run's coolest LED board")
    return Temperature(None, UNKNOWN_U_K, "not known")


def expansion_of(artefact: Artefact, temperature: Temperature) -> tuple[float, float]:
    """Return the relative change of an artefact's lengths from its certificate's temperature to another one, and
    its standard uncertainty. If the temperature is not known, nothing is changed, and the uncertainty allows for
    this."""
    if artefact.expansion_ppm_per_k is None:
        return 0.0, 0.0
    per_k, u_per_k = 1e-6 * artefact.expansion_ppm_per_k.value, 1e-6 * artefact.expansion_ppm_per_k.u
    warmer_k = 0.0 if temperature.celsius is None else temperature.celsius - artefact.temperature_c
    u = np.hypot(per_k * temperature.u_k, u_per_k * np.hypot(warmer_k, temperature.u_k))
    return per_k * warmer_k, float(u)


D = TypeVar("D", bound=Described)


def read_described(path: Path, model: type[D]) -> D:
    """Read a description (YAML), with the checksum of its certificate's file. Raises InputError with all problems,
    also if the certificate is missing or does not have the stated checksum."""
    document = yamlfile.read_document(path)
    description = document.validate(model)
    artefact = description.artefact
    if artefact is None or artefact.certificate is None or artefact.certificate.file is None:
        return description
    place = ("artefact", "certificate", "file")
    try:
        digest = hashlib.sha256(document.resolve(artefact.certificate.file).read_bytes()).hexdigest()
    except OSError as error:
        message = f"expected the certificate's file: {reason(error)}"
        raise InputError([document.problem(place, message)]) from error
    if artefact.certificate.sha256 not in (None, digest):
        message = (
            f"has the checksum {digest}, which differs from its `sha256`: it is not the certificate that is named"
        )
        raise InputError([document.problem(place, message)])
    hashed_file = {"file": Path(artefact.certificate.file.name), "sha256": digest}
    certificate = artefact.certificate.model_copy(update=hashed_file)
    return description.model_copy(update={"artefact": artefact.model_copy(update={"certificate": certificate})})


# -- words -------------------------------------------------------------------------------------------------------


def facts_of(used_artefact: UsedArtefact) -> dict[str, str]:
    """Return facts of an artefact, by the names that pages show."""
    artefact, certificate = used_artefact.artefact, used_artefact.artefact.certificate
    facts = {used_artefact.role: artefact.title, "certificate": NOT_TRACEABLE}
    if certificate is not None:
        due = f", due {certificate.due}" if certificate.due else ""
        facts["certificate"] = f"{certificate.number}, {certificate.laboratory}, {certificate.date}{due}"
        facts["certificate's checksum"] = certificate.sha256 or "no file was named"
    facts["certified at"] = f"{artefact.temperature_c:g} C"
    figures = (
        ("side of its squares", artefact.square_mm, "mm"),
        ("places of its corners", artefact.corner_um, "um"),
        ("flatness", artefact.flatness_um, "um"),
        ("expansion", artefact.expansion_ppm_per_k, "ppm/K"),
    )
    facts |= {name: value.words(unit) for name, value, unit in figures if value is not None}
    if artefact.reflectance is not None:
        facts["reflectance"] = (
            f"{artefact.reflectance.geometry}, {len(artefact.reflectance.values)} wavelengths "
            f"(k = {artefact.reflectance.k:g}, {artefact.reflectance.coverage:.0%})"
        )
    facts |= {f"taken: {name}": f"{value:.5g}" for name, value in used_artefact.figures.items()}
    if used_artefact.u_scale_ppm is not None:
        celsius = used_artefact.measured_c
        facts["measured at"] = (
            "not known" if celsius is None else f"{celsius:g} C, u {used_artefact.u_measured_k:g} K"
        ) + f" ({used_artefact.measured_by})"
        facts["corrected for expansion"] = f"{used_artefact.correction_ppm:+.2f} ppm"
        facts["u of its lengths"] = f"{used_artefact.u_scale_ppm:.2g} ppm"
    return facts


def sentence_of(used_artefact: UsedArtefact) -> str:
    """Return one line that names the thing and its certificate, or says that there is no certificate."""
    certificate = used_artefact.artefact.certificate
    certificate_words = (
        NOT_TRACEABLE
        if certificate is None
        else f"certificate {certificate.number} of {certificate.laboratory}, {certificate.date}"
    )
    return f"{used_artefact.role} {used_artefact.artefact.title}: {certificate_words}"
