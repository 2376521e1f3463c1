"""The record of a calibration: result, uncertainty, inputs and validity.

It is a YAML file with a SHA-256 of its own content, so that a record which was edited by hand is refused. Values
of a rigid transform are given in mm and KUKA's A B C. Their uncertainty is the uncertainty of a small step: `x_mm
y_mm z_mm` along the axes of the frame on the left of the transform's name, and `rx_deg ry_deg rz_deg` about the
axes of the frame on the right.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import AwareDatetime, Field

from coupole.calibration.artefact import UsedArtefact
from coupole.calibration.optics import NAMES, Intrinsics
from coupole.errors import InputError, StorageError, reason
from coupole.geometry import abc_from_rotation
from coupole.intake.input_files import InputFiles
from coupole.plan import yamlfile
from coupole.plan.base_model import Model, Name, Pose

Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Count = Annotated[int, Field(ge=0)]
Kind = Literal[
    "camera",
    "chromatic",
    "hand-eye",
    "leds",
    "mesh",
    "flat-field",
    "dark",
    "response",
    "led-power",
    "drift",
    "colour",
    "glare",
    "artefact-check",
]
SEAL = "# A calibration of Coupole"
"""First words of a record's file."""
_STEPS = ("x_mm", "y_mm", "z_mm", "rx_deg", "ry_deg", "rz_deg")
_MOST_ASYMMETRY = 1e-9


def _not_said(value: object) -> bool:
    return value is None


def _none_found(value: object) -> bool:
    return value == ()


class Parameter(Model):
    """One estimated figure."""

    name: Annotated[str, Field(min_length=1)]
    """Name with its unit: `fx_px`, `flange_from_camera.x_mm`."""
    value: float | None
    """None for the rotations of a small step, because the transform itself has the angles."""
    u: NotNegative
    """Standard uncertainty, in the name's unit."""
    degrees_of_freedom: Positive
    """Effective degrees of freedom of this uncertainty. Intervals follow Student's distribution."""
    dominated_by: str
    """Name of the largest source of its variance."""


class Noise(Model):
    """Stated and estimated noise of one kind of observation."""

    name: str
    unit: str
    stated: NotNegative
    found: NotNegative
    redundancy: float


class ImageResidual(Model):
    """Residual of one image."""

    name: str
    corners: Count
    rejected: Count
    rms_px: NotNegative


@dataclass(frozen=True)
class LedFault:
    """A fault of LEDs that the operator should check."""

    kind: str
    """`dead`, `swapped`, `miswired`, `astray`, `moved` (a board) or `few` (too few frames show it)."""
    leds: tuple[int, ...]
    """Ids of the LEDs; none for a board."""
    text: str
    """Text that says what was found and what to do."""

    @property
    def is_wrong(self) -> bool:
        """False for a board that was mounted anew, and for an LED with missing views."""
        return self.kind not in ("moved", "few")


class Limit(Model):
    """One acceptance limit and the figure that it limits."""

    what: str
    found: float
    limit: float
    unit: str
    name: str | None = Field(default=None, exclude_if=_not_said)
    """Name for `--limit`; None if an operator cannot set it."""
    usual: float | None = Field(default=None, exclude_if=_not_said)
    """Default of the limit if the operator set another one; otherwise None."""

    @property
    def is_met(self) -> bool:
        return self.found <= self.limit


class Comparison(Model):
    """A value that a calibrated cell measured on an artefact, with the certified value."""

    position: str
    """Place of the artefact: the name of its run or folder."""
    name: str
    """Name of the length, or of the channel."""
    unit: str
    certified_value: float
    expanded_u_certified: NotNegative
    """U of the certified value at the temperature of the measurement, k = 2."""
    measured_value: float
    expanded_u_measured: NotNegative
    """U of the measured value from the records in force, k = 2."""
    permissible: Positive | None = Field(default=None, exclude_if=_not_said)
    """Largest permissible error that the user stated (MPE), in the unit."""

    @property
    def error(self) -> float:
        """Measured minus certified, in the unit."""
        return self.measured_value - self.certified_value

    @property
    def en(self) -> float:
        """E_n of ISO 13528, 9.7: the error over both expanded uncertainties combined."""
        together = float(np.hypot(self.expanded_u_certified, self.expanded_u_measured))
        return abs(self.error) / max(together, 1e-300)


class Input(Model):
    """A file that the calibration was made from."""

    name: str
    """Path below the run's or the images' folder, with that folder's own name."""
    sha256: Sha256


class Validity(Model):
    """Conditions under which a record holds. A value of None was not known, and is not checked."""

    expires: AwareDatetime
    camera: str | None = None
    """Model and serial number."""
    lens: str | None = None
    size_px: tuple[Annotated[int, Field(gt=0)], Annotated[int, Field(gt=0)]] | None = None
    """Width and height of frames."""
    focal_length_mm: Positive | None = None
    focus_distance_mm: Positive | None = None
    focus_tolerance_mm: Positive = 2.0
    f_number: Positive | None = None
    temperature_c: tuple[float, float] | None = None
    """Lowest and highest temperature of the room."""


class Record(Model):
    """One calibration."""

    schema_version: Literal[1]
    kind: Kind
    name: Name
    created: AwareDatetime
    software: str
    simulated: bool
    """True if any image comes from a simulated camera."""
    validity: Validity
    transforms: dict[str, Pose]
    """Transforms by name, such as `flange_from_camera`; none for a camera."""
    parameters: Annotated[tuple[Parameter, ...], Field(min_length=1)]
    fixed: dict[str, float]
    """Figures that were not estimated, by name."""
    covariance: tuple[tuple[float, ...], ...]
    """[parameters, parameters], in the units of their names."""
    files: tuple[Input, ...] = ()
    """Tables and maps beside the record that are too large for it, with covariances if they have some."""
    noise: tuple[Noise, ...]
    images: tuple[ImageResidual, ...]
    limits: tuple[Limit, ...]
    """Acceptance limits; all must be met."""
    remarks: tuple[str, ...]
    """Remarks for the operator: methods that disagree, corners that were left out."""
    faults: tuple[LedFault, ...] = Field(default=(), exclude_if=_none_found)
    """Faults of LEDs; their texts are among the remarks."""
    artefacts: tuple[UsedArtefact, ...] = Field(default=(), exclude_if=_none_found)
    """Boards, tiles and charts from which the record was made, with their certificates. A record that is not
    traceable, or that rests on other records, has none."""
    comparisons: tuple[Comparison, ...] = Field(default=(), exclude_if=_none_found)
    """Values of a check with an independent artefact."""
    inputs: Annotated[tuple[Input, ...], Field(min_length=1)]
    sha256: Sha256

    @property
    def is_accepted(self) -> bool:
        """True if all limits are met."""
        return all(limit.is_met for limit in self.limits)

    @property
    def covariance_matrix(self) -> NDArray[np.float64]:
        """Covariance [parameters, parameters], in the units of their names."""
        return np.array(self.covariance)

    def value(self, name: str) -> float:
        """Return a figure that was estimated or held. Raises KeyError if there is none."""
        figures = {p.name: p.value for p in self.parameters if p.value is not None} | self.fixed
        return figures[name]


def seal_record(**content: Any) -> Record:
    """Return a record of this content, with its hash. Raises pydantic's ValidationError for invalid content."""
    draft = Record.model_construct(**content, schema_version=1, sha256="")
    plain = json.loads(draft.model_dump_json(exclude={"sha256"}))
    return Record.model_validate_json(json.dumps({**plain, "sha256": content_sha256(plain)}))


def content_sha256(plain: dict[str, Any]) -> str:
    """Return the hash of a record's content as JSON (keys sorted, no spaces), without its own hash."""
    rest = {key: value for key, value in plain.items() if key != "sha256"}
    return hashlib.sha256(json.dumps(rest, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def write_record(path: Path, record: Record) -> None:
    """Write a record atomically. Raises StorageError."""
    write_sealed(
        path,
        json.loads(record.model_dump_json()),
        f"{SEAL}. It carries its own checksum: do not edit it, calibrate again.",
    )


def write_sealed(path: Path, plain: dict[str, Any], head: str) -> None:
    """Write a record's content as YAML, atomically, below a comment `head`. Raises StorageError."""
    partial = path.with_name(f".{path.name}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        partial.write_text(f"{head}\n" + "".join(_lines(plain)), encoding="utf-8")
        partial.replace(path)
    except OSError as error:
        raise StorageError(
            f"{path}: cannot write the record: {error.strerror}. Free space for it, make its folder writable, or "
            "mount it."
        ) from error
    finally:
        partial.unlink(missing_ok=True)


def read_record(path: Path, files: InputFiles | None = None) -> Record:
    """Read a record with the files beside it, from `files` if they are given. Raises InputError with all problems:
    wrong keys, an edited record, an invalid covariance."""
    files = InputFiles() if files is None else files
    document = yamlfile.read_document(path, files)
    record = document.validate(Record)
    plain = json.loads(record.model_dump_json())
    if content_sha256(plain) != record.sha256:
        message = "the record was edited after it was made: its content has another checksum. Calibrate anew."
        raise InputError([document.problem(("sha256",), message)])
    problems = [document.problem(("covariance",), message) for message in _covariance_problems(record)]
    problems += [document.problem(("files",), message) for message in _file_problems(record, path.parent, files)]
    if problems:
        raise InputError(problems)
    return record


def records_named(paths: list[Path]) -> tuple[Path, ...]:
    """Return the named records, and the records in named folders."""
    records: list[Path] = []
    for path in paths:
        if path.is_dir():
            files = sorted(path.glob("*.yaml"))
            records += [file for file in files if file.read_text(encoding="utf-8").startswith(SEAL)]
        else:
            records.append(path)
    return tuple(records)


def rows_of(matrix: NDArray[np.float64]) -> tuple[tuple[float, ...], ...]:
    """Return a covariance in the form of records, exactly symmetric."""
    symmetric = 0.5 * (matrix + matrix.T)
    return tuple(tuple(map(float, row)) for row in symmetric)


def pose_of(transform: NDArray[np.float64]) -> Pose:
    """Return a transform [4, 4] in the form of records."""
    x, y, z = map(float, transform[:3, 3])
    return Pose(translation_mm=(x, y, z), abc_deg=abc_from_rotation(transform[:3, :3]))


def step_names(transform: str) -> tuple[str, ...]:
    """Return the names of the six parameters of a transform's small step."""
    return tuple(f"{transform}.{step}" for step in _STEPS)


def _covariance_problems(record: Record) -> Iterator[str]:
    count = len(record.parameters)
    if [len(row) for row in record.covariance] != [count] * count:
        yield f"expected {count} rows of {count} numbers, one for each parameter"
        return
    covariance = record.covariance_matrix
    scale = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    if not np.allclose(scale, [p.u for p in record.parameters], rtol=1e-6, atol=1e-150):
        yield "its diagonal is not the square of the parameters' `u`"
    correlation = covariance / scale / scale[:, None]
    if np.abs(correlation - correlation.T).max() > _MOST_ASYMMETRY:
        yield "expected a symmetric matrix"
    elif np.linalg.eigvalsh(correlation)[0] < -_MOST_ASYMMETRY * count:
        yield "expected a matrix without negative eigenvalues"


def _file_problems(record: Record, folder: Path, files: InputFiles) -> Iterator[str]:
    for file in record.files:
        try:
            sha256 = files.sha256(folder / file.name)
        except OSError as error:
            yield f"expected {file.name} beside the record: {reason(error)}"
            continue
        if sha256 != file.sha256:
            yield f"{file.name} beside the record was changed after it was made: it has another checksum"


def _lines(plain: dict[str, Any]) -> Iterator[str]:
    """Yield the YAML of a record, one line for each parameter, image and row. Inside a line it is JSON, which is
    part of YAML."""
    for key, value in plain.items():
        if isinstance(value, list) and value and isinstance(value[0], dict | list):
            yield f"{key}:\n" + "".join(f"  - {json.dumps(item, ensure_ascii=False)}\n" for item in value)
        elif isinstance(value, dict) and value:
            yield f"{key}:\n" + "".join(f"  {k}: {json.dumps(v, ensure_ascii=False)}\n" for k, v in value.items())
        else:
            yield f"{key}: {json.dumps(value, ensure_ascii=False)}\n"


def intrinsics_of(record: Record) -> tuple[Intrinsics, tuple[str, ...]]:
    """Return the lens of a record, and its estimated parameters in the order of the covariance."""
    values = {p.name: p.value for p in record.parameters} | dict(record.fixed)
    value_of = {name.removesuffix("_px"): value for name, value in values.items()}
    lens = Intrinsics(**{name: float(value_of.get(name) or 0.0) for name in NAMES})
    return lens, tuple(n for p in record.parameters if (n := p.name.removesuffix("_px")) in NAMES)
