"""The sealed record of a radiometric calibration, with its files and its picture."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from coupole.calibration.artefact import UsedArtefact
from coupole.calibration.light.frames import LightFrames, PlainSources
from coupole.calibration.record import Input, Limit, Noise, Parameter, Record, rows_of, seal_record
from coupole.calibration.report import Outcome
from coupole.calibration.request import Request
from coupole.calibration.rotations import Floats


@dataclass(frozen=True)
class Findings:
    """Findings of a radiometric calibration, for its record."""

    parameters: Sequence[Parameter]
    covariance: Floats
    """[p, p] covariance of the parameters, in their order."""
    limits: Sequence[Limit]
    files: Mapping[str, bytes] = field(default_factory=dict)
    """Maps and tables beside the record, by their names."""
    noise: Sequence[Noise] = ()
    fixed_figures: Mapping[str, float] = field(default_factory=dict)
    remarks: Sequence[str] = ()
    more_inputs: Sequence[tuple[str, str]] = ()
    """Names and SHA-256 of files that were read besides the frames."""
    artefacts: Sequence[UsedArtefact] = ()


def sealed_outcome(
    kind: str,
    request: Request,
    frames: LightFrames | PlainSources,
    size_px: tuple[int, int],
    findings: Findings,
    draw: Callable[[Record, Any], None],
) -> Outcome:
    """Return a record of a calibration with its files. `draw` gets the record and an empty figure."""
    contents = findings.files
    record = seal_record(
        kind=kind,
        **request.head(),
        simulated=frames.about.is_simulated,
        validity=request.validity(frames.about, size_px, frames.temperature_range_c),
        transforms={},
        parameters=tuple(findings.parameters),
        fixed=dict(findings.fixed_figures),
        covariance=rows_of(findings.covariance),
        files=tuple(Input(name=n, sha256=hashlib.sha256(content).hexdigest()) for n, content in contents.items()),
        noise=tuple(findings.noise),
        images=(),
        limits=tuple(findings.limits),
        remarks=tuple(findings.remarks),
        artefacts=tuple(findings.artefacts),
        inputs=tuple(Input(name=name, sha256=digest) for name, digest in (*frames.inputs, *findings.more_inputs)),
    )
    return Outcome(record, partial(draw, record), contents)
