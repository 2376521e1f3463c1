"""The record of a check: the records and the artefact, values beside certified ones, E_n, acceptance."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from coupole.calibration.acceptance import against_limits
from coupole.calibration.artefact import Artefact, UsedArtefact
from coupole.calibration.check.acceptance import CHECK
from coupole.calibration.check.board_lengths import Lengths
from coupole.calibration.check.drawing import comparison_section, draw_comparisons
from coupole.calibration.check.permissible import Permissible
from coupole.calibration.check.tile_reflectance import MeasuredTile
from coupole.calibration.in_force import InForce, read_in_force
from coupole.calibration.light.records import limit_of, record_input
from coupole.calibration.record import Comparison, Input, Kind, Limit, Parameter, Record, rows_of, seal_record
from coupole.calibration.report import Outcome
from coupole.calibration.request import Request
from coupole.calibration.rotations import Floats
from coupole.calibration.sources import About
from coupole.errors import InputError

K = 2.0
"""Coverage factor of all expanded uncertainties here."""
_MANY = 1e6
"""Degrees of freedom of figures with a stated uncertainty."""


@dataclass(frozen=True)
class Checked:
    """Values of a check, and their mean relative error with its uncertainty."""

    comparisons: tuple[Comparison, ...]
    parameters: tuple[Parameter, ...]
    covariance: Floats
    """[parameters, parameters]."""
    mean_en: float
    remarks: tuple[str, ...]


@dataclass(frozen=True)
class Pictures:
    """Camera of the check's pictures, and the files that the check read."""

    about: About
    size_px: tuple[int, int]
    inputs: tuple[tuple[str, str], ...]


def records_in_force(paths: Sequence[Path]) -> tuple[InForce, ...]:
    """Return all records except the records of other checks."""
    return tuple(item for item in read_in_force(paths) if item.record.kind != "artefact-check")


def records_by_kind(items: Sequence[InForce], kinds: Sequence[Kind]) -> dict[Kind, InForce]:
    """Return records of some kinds. Raises InputError for two records of one kind."""
    records: dict[Kind, InForce] = {}
    for item in items:
        if item.record.kind not in kinds:
            continue
        if earlier := records.get(item.record.kind):
            raise InputError(
                f"{item.path}: a second record of the kind `{item.record.kind}`, beside {earlier.path}"
            )
        records[item.record.kind] = item
    return records


def refuse_dependent(artefact: Artefact | None, path: Path, items: Sequence[InForce]) -> Artefact:
    """Return the artefact of a description. Raises InputError if the artefact has no certificate, or if it was
    used in a fit of the records."""
    if artefact is None or artefact.certificate is None:
        raise InputError(
            f"{path}: a check needs the artefact's identity and certificate: expected a block `artefact` with "
            "name, serial and certificate"
        )
    for item in items:
        for used_artefact in item.record.artefacts:
            if used_artefact.artefact.serial.strip().casefold() == artefact.serial.strip().casefold():
                raise InputError(
                    f"{path}: {artefact.title} took part in the {item.record.kind} record {item.path}, so it is "
                    "not independent of it. Take another artefact"
                )
    return artefact


def refuse_used_images(items: Sequence[InForce], inputs: Sequence[tuple[str, str]]) -> None:
    """Raise InputError if a record was made from some of these images, because these then check nothing."""
    for item in items:
        image_hashes = {line.sha256 for line in item.record.inputs if "/" in line.name}
        if common := [name for name, sha256 in inputs if "/" in name and sha256 in image_hashes]:
            raise InputError(
                f"{item.path}: was made from the same images ({common[0]}), so the comparison would check "
                "nothing. Acquire others"
            )


# -- a board ----------------------------------------------------------------------------------------------------


def compare_lengths(
    position_lengths: Sequence[Lengths], covariance: Floats, u_scale: float, permissible: Permissible | None
) -> Checked:
    """Return lengths of all positions beside the certified ones.

    `covariance` is the covariance of the record's figures (`CameraPrior.covariance`). `u_scale` is the relative
    standard uncertainty of the board's certified lengths at the temperature of the measurement.
    """
    comparisons, slopes, noises, certified_own = [], [], [], []
    for part in position_lengths:
        u_measured = np.sqrt(
            np.diag(part.noise_covariance) + np.einsum("ni,ij,nj->n", part.by_record, covariance, part.by_record)
        )
        u_certified = np.hypot(u_scale * part.certified_mm, part.u_certified_mm)
        comparisons += [
            Comparison(
                position=part.position,
                name=name,
                unit="mm",
                certified_value=float(part.certified_mm[n]),
                expanded_u_certified=float(K * u_certified[n]),
                measured_value=float(part.measured_mm[n]),
                expanded_u_measured=float(K * u_measured[n]),
                permissible=None if permissible is None else permissible.at(float(part.certified_mm[n])),
            )
            for n, name in enumerate(part.names)
        ]
        mean = part.certified_mm / np.sum(part.certified_mm**2)
        slopes.append(mean @ part.by_record)
        noises.append(float(mean @ part.noise_covariance @ mean))
        certified_own.append(float(np.sum((mean * part.u_certified_mm) ** 2)))
    errors = np.array(
        [
            part.certified_mm @ (part.measured_mm - part.certified_mm) / np.sum(part.certified_mm**2)
            for part in position_lengths
        ]
    )
    together = np.array(slopes) @ covariance @ np.array(slopes).T + np.diag(noises)
    together = together + u_scale**2 + np.diag(certified_own)
    names = [f"length_error_ppm.{part.position}" for part in position_lengths]
    ratios = ", ".join(f"{part.position} {part.residual_ratio:.2f}" for part in position_lengths)
    remark = f"residuals of corners divided by the record's noise: {ratios}"
    return _check_of(comparisons, names, 1e6 * errors, 1e12 * together, (remark,))


# -- a tile -----------------------------------------------------------------------------------------------------


def compare_reflectances(tile: MeasuredTile) -> Checked:
    """Return reflectances of all places and channels beside the certified ones. The errors of the certified ones
    are fully correlated."""
    u = np.sqrt(np.diag(tile.covariance)).reshape(tile.reflectance.shape) * tile.reflectance
    comparisons = [
        Comparison(
            position=place,
            name=channel,
            unit="1",
            certified_value=float(tile.certified_reflectance[p, c]),
            expanded_u_certified=float(K * tile.u_certified[p, c]),
            measured_value=float(tile.reflectance[p, c]),
            expanded_u_measured=float(K * u[p, c]),
        )
        for p, place in enumerate(tile.places)
        for c, channel in enumerate(tile.channels)
    ]
    errors = np.log(tile.reflectance / tile.certified_reflectance).ravel()
    u_certified = (tile.u_certified / tile.certified_reflectance).ravel()
    names = [f"ln_reflectance_error.{place}.{channel}" for place in tile.places for channel in tile.channels]
    remark = f"residuals of readings divided by their noise: {tile.residual_ratio:.2f}"
    return _check_of(comparisons, names, errors, tile.covariance + np.outer(u_certified, u_certified), (remark,))


# -- the record -------------------------------------------------------------------------------------------------


def _check_of(
    comparisons: Sequence[Comparison],
    names: Sequence[str],
    errors: Floats,
    covariance: Floats,
    remarks: tuple[str, ...],
) -> Checked:
    """Return values with a parameter for each position, and E_n of their mean."""
    parameters = tuple(
        Parameter(
            name=name,
            value=float(error),
            u=float(np.sqrt(covariance[n, n])),
            degrees_of_freedom=_MANY,
            dominated_by="records in force, artefact's certificate",
        )
        for n, (name, error) in enumerate(zip(names, errors, strict=True))
    )
    mean_en = abs(float(errors.mean())) / (K * float(np.sqrt(covariance.mean())))
    return Checked(tuple(comparisons), parameters, covariance, mean_en, remarks)


def check_outcome(
    check: Checked,
    artefact: UsedArtefact,
    pictures: Pictures,
    records: Mapping[Kind, InForce],
    request: Request,
) -> Outcome:
    """Return the record of a check, with its picture and the table on its page."""
    inputs = (*pictures.inputs, *(line for item in records.values() for line in record_input(item.path)))
    record = seal_record(
        kind="artefact-check",
        **request.head(),
        simulated=pictures.about.is_simulated or any(item.record.simulated for item in records.values()),
        validity=request.validity(pictures.about, pictures.size_px, pictures.about.temperature_c),
        transforms={},
        parameters=check.parameters,
        fixed={"coverage_factor": K},
        covariance=rows_of(check.covariance),
        noise=(),
        images=(),
        limits=limits_of(check, request.limits),
        remarks=(*check.remarks, *_against(records)),
        artefacts=(artefact,),
        comparisons=check.comparisons,
        inputs=tuple(Input(name=name, sha256=digest) for name, digest in inputs),
    )
    draw: Callable[..., None] = partial(draw_comparisons, record)
    return Outcome(record, draw, sections=(comparison_section(record),))


def limits_of(check: Checked, operator_limits: Mapping[str, float]) -> tuple[Limit, ...]:
    """Return the acceptance limits of a check. `operator_limits` are the limits that the operator set."""
    values = np.array([value.en for value in check.comparisons])
    figures = {
        "mean_en": check.mean_en,
        "worst_en": float(values.max()),
        "share": float(np.mean(values > 1.0)),
    }
    limits = against_limits(CHECK, operator_limits, figures)
    shares = [abs(v.error) / v.permissible for v in check.comparisons if v.permissible is not None]
    return (*limits, limit_of("largest error of a length over its MPE", max(shares), 1.0)) if shares else limits


def _against(records: Mapping[Kind, InForce]) -> list[str]:
    return [f"checked: {kind} record {item.record.name}, {item.record.sha256}" for kind, item in records.items()]


def needed_record(records: Mapping[Kind, InForce], kind: Kind) -> Record:
    """Return the record of a kind. Raises InputError if there is none."""
    if kind not in records:
        raise InputError(
            f"--records: expected a record of the kind `{kind}`; found {', '.join(records) or 'none'}"
        )
    return records[kind].record
