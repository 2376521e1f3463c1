"""Common parts of all `coupole calibrate` commands: options; writing, printing and refusing a record."""

from __future__ import annotations

import inspect
import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from coupole.calibration.acceptance import Allowed, parse_limits, words_of
from coupole.commands.common import JsonOption, fail
from coupole.commands.option_groups import flatten_options
from coupole.errors import CalibrationRefused, CoupoleError, InputError

if TYPE_CHECKING:
    from rich.console import Console

    from coupole.calibration.calibrated_arm import CalibratedArm
    from coupole.calibration.light.irradiance import Emission
    from coupole.calibration.record import Record
    from coupole.calibration.report import Outcome
    from coupole.calibration.request import Request
    from coupole.plan.cell import Cell

    Work = Callable[[Console, Request], Outcome]
    """The calibration itself, with its options already set."""
else:
    Work = Callable

_SUFFIXES = (".yaml", ".html", ".png", ".csv", ".h5", ".icc")
"""Suffixes of a record and of the files beside it."""
_MOST_FAULTS = 5
"""Greatest number of faults that a refusal names; the record contains all of them."""
Paths = Annotated[
    list[Path],
    typer.Argument(help="Runs, or one folder of pictures.", show_default=False, metavar="RUN_OR_FOLDER..."),
]
OutOption = Annotated[Path, typer.Option("--out", help="Folder for the record, its page and its picture.")]
NameOption = Annotated[
    str | None, typer.Option("--name", help="Name of the record; by default its kind and date.")
]
LensOption = Annotated[str | None, typer.Option("--lens", help="Description of the lens, as text.")]
EmissionOption = Annotated[
    str, typer.Option("--emission", help="Emission of LEDs: lambertian, or paper (squared cosine).")
]
DaysOption = Annotated[int, typer.Option("--valid-days", min=1, max=3650, help="Days until the record expires.")]


def emission_of(name: str) -> Emission:
    """Return the emission profile of this name. Raises InputError if there is none."""
    if name == "lambertian":
        return "lambertian"
    if name == "paper":
        return "paper"
    raise InputError(f"--emission: expected lambertian or paper, found {name}")


def rig_of(run: Path) -> Path:
    """Return a run's rig: the run's own copy or, if the run has no copies, the file that it names, if that file is
    unchanged."""
    from coupole.storage.durable import sha256
    from coupole.storage.run import Run

    folder = Run(run)
    path, rig_entry = folder.rig_path, folder.about["rig"]
    is_unchanged = path.is_file() and ("stored" in rig_entry or sha256(path) == rig_entry["sha256"])
    if not is_unchanged:
        raise InputError(f"{run}: its rig {path} is missing or has changed since the run; name a rig with --rig")
    return path


def arm_of(cell: Cell, hand_eye: Path) -> CalibratedArm | None:
    """Return the rig's arm with the axis zeros of a hand-eye record; None if the record has none. Raises
    InputError if the rig's driver has no model of the arm."""
    from coupole.calibration.calibrated_arm import has_axis_zeros, read_arm
    from coupole.plan.rig_devices import planning_arm

    if not has_axis_zeros(hand_eye):
        return None
    arm = planning_arm(cell.rig)
    if arm is None:
        raise InputError(
            f"{hand_eye}: this record was made with a model of the arm, but the rig's robot has none; give --rig "
            "with the rig of the record"
        )
    return read_arm(hand_eye, arm)


def calibration(
    kind: str, *, limits: Sequence[Allowed] = (), valid_days: int = 180, lens: bool = True
) -> Callable[[Callable[..., Work]], Callable[..., None]]:
    """Decorator: make a command from a function that takes the calibration's options and returns the work to do.

    The options may be in dataclasses (`option_groups`). Every command also has `--out`, `--name`, `--valid-days`
    and `--json`. It has `--limit` if the calibration has `limits`, and `--lens` if its records belong to one lens.
    """
    words = f"Set an acceptance limit; repeat for more. The usual limits are {words_of(limits)}."
    common: list[tuple[str, Any, Any]] = [
        ("out", OutOption, Path("calibrations")),
        ("name", NameOption, None),
        *([("lens", LensOption, None)] if lens else []),
        ("valid_days", DaysOption, valid_days),
        *([("limit", _limit_option(words), None)] if limits else []),
        ("as_json", JsonOption, False),
    ]

    def command(work_with: Callable[..., Work]) -> Callable[..., None]:
        flat = flatten_options(work_with)

        @wraps(flat)
        def run(*arguments: Any, **options: Any) -> None:
            common_options = {name: options.pop(name, default) for name, _, default in common}
            _calibrate(kind, flat(*arguments, **options), _CommonOptions(**common_options), limits)

        signature = inspect.signature(flat)
        common_parameters = [
            inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=kind_of)
            for name, kind_of, default in common
        ]
        run.__signature__ = signature.replace(  # type: ignore[attr-defined]
            parameters=[*signature.parameters.values(), *common_parameters], return_annotation=None
        )
        run.__annotations__ = {
            parameter.name: parameter.annotation
            for parameter in (*signature.parameters.values(), *common_parameters)
        }
        return run

    return command


def _limit_option(words: str) -> Any:
    return Annotated[list[str] | None, typer.Option("--limit", metavar="NAME=VALUE", help=words)]


@dataclass(frozen=True)
class _CommonOptions:
    """Options of all calibrations."""

    out: Path
    name: str | None
    valid_days: int
    as_json: bool
    lens: str | None = None
    """Description of the lens; None also if the records are of different lenses."""
    limit: Sequence[str] | None = None
    """Settings of the calibration's limits, as NAME=VALUE."""


def _calibrate(kind: str, work: Work, options: _CommonOptions, limits: Sequence[Allowed]) -> None:
    """Do the work, write record, files and report, print the result, refuse a record that exceeds its limits."""
    from coupole.calibration.request import Request
    from coupole.viewing.terminal import make_console

    console, as_json, name = make_console(quiet=options.as_json), options.as_json, options.name
    now = datetime.now(UTC)
    try:
        _refuse_name(name)
        wanted_limits = parse_limits(options.limit or (), limits)
        request = Request(
            name or f"{kind}-{now:%Y%m%d}", now, options.valid_days, options.lens, limits=wanted_limits
        )
        record_path = options.out / f"{request.name}.yaml"
        for path in (options.out / f"{request.name}{suffix}" for suffix in _SUFFIXES):
            if path.exists():
                raise InputError(f"{path}: exists already. Choose another --name or --out.")
        outcome = work(console, request)
        from coupole.calibration.report import write_outcome  # its imports take long, so options are refused first

        page, picture = write_outcome(record_path, outcome)
    except CoupoleError as error:
        fail(error, as_json=as_json)
        raise
    record = outcome.record
    _show(console, record)
    console.print(f"record {record_path}, report {page}")
    if as_json:
        files = {
            "record": str(record_path.resolve()),
            "report": str(page.resolve()),
            "picture": str(picture.resolve()),
        }
        print(json.dumps(files | _figures(record)))
    if not record.is_accepted:
        raise CalibrationRefused(
            [
                f"{record_path}: not accepted: {limit.what} is {limit.found:.3g} {limit.unit}, at most "
                f"{limit.limit:.3g} is allowed"
                for limit in record.limits
                if not limit.is_met
            ]
            + [fault.text for fault in record.faults if fault.is_wrong][:_MOST_FAULTS]
        )


def _refuse_name(name: str | None) -> None:
    """Raise InputError for a name that is not valid for a record."""
    from pydantic import TypeAdapter, ValidationError

    from coupole.plan.base_model import Name

    try:
        TypeAdapter(Name | None).validate_python(name)
    except ValidationError as error:
        raise InputError(
            f"--name {name}: expected letters, digits, dots, dashes and underscores, as in camera-335mm"
        ) from error


@contextmanager
def bar(console: Console, step_name: str) -> Iterator[Callable[[int, int], None]]:
    """Show a progress bar; yield the function that advances it, which takes the number of finished parts and of
    all parts."""
    from rich.progress import Progress

    with Progress(console=console, disable=not console.is_terminal) as bars:
        task = bars.add_task(step_name)
        yield lambda count, total: bars.update(task, completed=count, total=total)


def _show(console: Console, record: Record) -> None:
    """Print the figures as text."""
    from rich.table import Table

    from coupole.calibration.traceability import trace_of

    for name, pose in record.transforms.items():
        shift = " ".join(f"{v:.4f}" for v in pose.translation_mm)
        console.print(f"{name}: {shift} mm, A B C {' '.join(f'{v:.5f}' for v in pose.abc_deg)} deg")
    table = Table("parameter", "value", "u (k = 1)", "most of it from", box=None)
    for p in record.parameters:
        table.add_row(p.name, "" if p.value is None else f"{p.value:.6g}", f"{p.u:.2g}", p.dominated_by)
    console.print(table)
    for remark in record.remarks:
        console.print(f"[yellow]{remark}[/]")
    for line in trace_of(record):
        console.print(f"traceability: {line}")
    for limit in record.limits:
        colour, how = ("green", "met") if limit.is_met else ("red", "missed")
        usual = "" if limit.usual is None else f", usually {limit.usual:.3g}"
        name = "" if limit.name is None else f", --limit {limit.name}"
        console.print(
            f"[{colour}]{how}[/] {limit.what}: {limit.found:.3g} {limit.unit} "
            f"(at most {limit.limit:.3g}{usual}{name})"
        )


def _figures(record: Record) -> dict[str, Any]:
    """The figures, for JSON."""
    from coupole.calibration.traceability import trace_of

    return {
        "kind": record.kind,
        "accepted": record.is_accepted,
        "sha256": record.sha256,
        "images": len(record.images),
        "corners": sum(image.corners for image in record.images),
        "rejected": sum(image.rejected for image in record.images),
        "parameters": {p.name: {"value": p.value, "u": p.u} for p in record.parameters},
        "transforms": {name: pose.model_dump() for name, pose in record.transforms.items()},
        "noise": {n.name: {"found": n.found, "stated": n.stated, "unit": n.unit} for n in record.noise},
        "limits": [{**limit.model_dump(), "passed": limit.is_met} for limit in record.limits],
        "artefacts": [item.model_dump(mode="json") for item in record.artefacts],
        "traceability": list(trace_of(record)),
        "comparisons": [{**v.model_dump(), "error": v.error, "en": v.en} for v in record.comparisons],
        "faults": [asdict(fault) for fault in record.faults],
        "remarks": list(record.remarks),
    }
