"""`coupole calibrate dark`, `response`, `flat-field`, `led-power`, and `coupole budget`."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from coupole.commands.calibrating import DaysOption, LensOption, NameOption, OutOption, bar, calibrate
from coupole.commands.common import JsonOption, fail
from coupole.errors import CoupoleError, InputError, StorageError

if TYPE_CHECKING:
    from rich.console import Console

    from coupole.calibration.budget import Budget, Known, Spread
    from coupole.calibration.irradiance import Emission
    from coupole.calibration.optics import Intrinsics
    from coupole.calibration.report import Outcome
    from coupole.calibration.workflow import Wish

Runs = Annotated[list[Path], typer.Argument(help="Runs.", show_default=False, metavar="RUN...")]
DarkOption = Annotated[
    Path | None,
    typer.Option("--dark", help="A record of `calibrate dark`; the runs' own dark frames if not given."),
]
ResponseOption = Annotated[Path | None, typer.Option("--response", help="A record of `calibrate response`.")]
FlatOption = Annotated[Path | None, typer.Option("--flat", help="A record of `calibrate flat-field`.")]
EmissionOption = Annotated[str, typer.Option("--emission", help="lambertian, or paper (its cosine twice).")]
_SAMPLES = 24


def dark(
    runs: Runs,
    out: OutOption = Path("calibrations"),
    name: NameOption = None,
    lens: LensOption = None,
    valid_days: DaysOption = 90,
    as_json: JsonOption = False,
) -> None:
    """Offset, dark current and hot pixels from dark frames of two or more exposures."""
    from coupole.calibration.light_frames import open_light_frames
    from coupole.calibration.light_records import dark_outcome

    def work(console: Console, wish: Wish) -> Outcome:
        with bar(console, "dark frames") as progress:
            return dark_outcome(open_light_frames(runs), wish, progress)

    calibrate("dark", work, out=out, name=name, lens=lens, valid_days=valid_days, as_json=as_json)


def response(
    runs: Runs,
    dark_record: DarkOption = None,
    out: OutOption = Path("calibrations"),
    name: NameOption = None,
    lens: LensOption = None,
    valid_days: DaysOption = 365,
    as_json: JsonOption = False,
) -> None:
    """Gain, read noise, full well and linearity from a bracket of a scene that stands still, each frame twice."""
    from coupole.calibration.light_frames import open_light_frames
    from coupole.calibration.light_records import response_outcome

    def work(console: Console, wish: Wish) -> Outcome:
        with bar(console, "exposures") as progress:
            return response_outcome(open_light_frames(runs), wish, dark_record, progress)

    calibrate("response", work, out=out, name=name, lens=lens, valid_days=valid_days, as_json=as_json)


def flat_field(
    runs: Runs,
    panel_mm: Annotated[
        float, typer.Option("--panel-mm", min=50.0, help="From the camera to the panel that it looks at.")
    ] = 600.0,
    dark_record: DarkOption = None,
    response_record: ResponseOption = None,
    out: OutOption = Path("calibrations"),
    name: NameOption = None,
    lens: LensOption = None,
    valid_days: DaysOption = 180,
    as_json: JsonOption = False,
) -> None:
    """Fall-off of the lens, per channel, from views of a luminous panel, shifted and turned."""
    from coupole.calibration.flat_field_records import flat_field_outcome
    from coupole.calibration.light_frames import open_light_frames

    def work(console: Console, wish: Wish) -> Outcome:
        frames = open_light_frames(runs)
        with bar(console, "views of the panel") as progress:
            return flat_field_outcome(frames, wish, dark_record, response_record, panel_mm, progress)

    calibrate("flat-field", work, out=out, name=name, lens=lens, valid_days=valid_days, as_json=as_json)


def led_power(
    runs: Runs,
    tile: Annotated[Path, typer.Option("--tile", help="The tile's description (YAML).", show_default=False)],
    rig: Annotated[Path, typer.Option("--rig", help="The rig, for its LEDs and support.", show_default=False)],
    camera: Annotated[
        Path | None, typer.Option("--camera", help="A camera's record; the rig's lens if not given.")
    ] = None,
    dark_record: DarkOption = None,
    response_record: ResponseOption = None,
    flat: FlatOption = None,
    emission: EmissionOption = "lambertian",
    out: OutOption = Path("calibrations"),
    name: NameOption = None,
    lens: LensOption = None,
    valid_days: DaysOption = 90,
    as_json: JsonOption = False,
) -> None:
    """Power of each LED from views of a white tile whose place is known."""
    from coupole.calibration.led_power import Positions
    from coupole.calibration.led_power_records import Setting, led_power_outcome
    from coupole.calibration.light_frames import open_light_frames
    from coupole.calibration.spectralon import read_tile
    from coupole.job import read_cell

    def work(console: Console, wish: Wish) -> Outcome:
        frames = open_light_frames(runs)
        cell = read_cell(rig)
        shape = frames.frames[0].read().shape
        setting = Setting(
            read_tile(tile),
            cell.rig.support.base_from_support.matrix(),
            Positions(cell.leds.ids, cell.leds.positions_mm, cell.leds.normals),
            _lens(camera, frames.focal_px, shape),
            dark_record,
            response_record,
            flat,
            _emission(emission),
        )
        with bar(console, "frames of the tile") as progress:
            return led_power_outcome(frames, setting, wish, progress)

    calibrate("led-power", work, out=out, name=name, lens=lens, valid_days=valid_days, as_json=as_json)


def budget(
    records: Annotated[
        list[Path] | None,
        typer.Argument(help="Records: response, flat-field, led-power. Seed 003's figures where there is none."),
    ] = None,
    incidence_deg: Annotated[float, typer.Option("--incidence", min=0.0, max=75.0, help="Of the light.")] = 42.0,
    vertex_um: Annotated[float, typer.Option("--vertex-um", min=0.0, help="Limit of the scanner's error.")] = 30.0,
    edge_um: Annotated[float, typer.Option("--edge-um", min=1.0, help="Of the mesh's triangles.")] = 200.0,
    pixels: Annotated[int, typer.Option("--pixels", min=1, help="Of a triangle, per channel.")] = 5,
    emission: EmissionOption = "lambertian",
    out: Annotated[Path | None, typer.Option("--out", help="Write this PNG, and JSON beside it.")] = None,
    as_json: JsonOption = False,
) -> None:
    """What a reflectance is uncertain by, and what dominates it: Monte Carlo and linear, with a picture."""
    from coupole.calibration.budget import Geometry, Known, budget_of
    from coupole.calibration.budget_report import as_json as figures_of
    from coupole.calibration.budget_report import draw_budget, known_from
    from coupole.console import make_console

    console = make_console(quiet=as_json)
    try:
        known = replace(known_from(records or [], Known()), vertex_mm=vertex_um / 1e3, edge_mm=edge_um / 1e3)
        known = replace(known, pixels=pixels)
        with console.status("propagating distributions"):
            found = budget_of(known, Geometry(incidence_deg), emission=_emission(emission))
            spread = _spread(known)
        document = figures_of(found, spread)
        if out is not None:
            _write(out, draw_budget(found, spread), json.dumps(document, indent=1))
    except CoupoleError as error:
        fail(error, as_json=as_json)
        raise
    if as_json:
        print(json.dumps(document))
    else:
        _show(console, found, spread)


# -- helpers --------------------------------------------------------------------------------------------------


def _spread(known: Known) -> Spread:
    """Samples all over a dome: as many LEDs in each part of the sky above 20 degrees."""
    from coupole.calibration.budget import Geometry, spread_over

    steps = [(number + 0.5) / _SAMPLES for number in range(_SAMPLES)]
    cosines = [1.0 - step * (1.0 - math.cos(math.radians(70.0))) for step in steps]
    return spread_over(known, [Geometry(math.degrees(math.acos(cosine))) for cosine in cosines])


def _lens(record_path: Path | None, focal_px: float, shape: tuple[int, ...]) -> Intrinsics:
    from coupole.calibration.optics import Intrinsics
    from coupole.calibration.record import intrinsics_of, read_record

    if record_path is None:
        return Intrinsics(focal_px, focal_px, (shape[1] - 1) / 2.0, (shape[0] - 1) / 2.0)
    record = read_record(record_path)
    if record.kind != "camera":
        raise InputError(f"{record_path}: expected a camera's record, found one of the kind `{record.kind}`")
    return intrinsics_of(record)[0]


def _emission(name: str) -> Emission:
    if name == "lambertian":
        return "lambertian"
    if name == "paper":
        return "paper"
    raise InputError(f"--emission: expected lambertian or paper, found {name}")


def _write(picture: Path, png: bytes, text: str) -> None:
    try:
        picture.parent.mkdir(parents=True, exist_ok=True)
        picture.write_bytes(png)
        picture.with_suffix(".json").write_text(text + "\n", encoding="utf-8")
    except OSError as error:
        raise StorageError(f"{picture}: cannot write the budget: {error.strerror}. Free its disk.") from error


def _show(console: Console, found: Budget, spread: Spread) -> None:
    from rich.table import Table

    table = Table("source", "said by", "alone", "share of variance", "narrower without", box=None)
    for share in found.shares:
        table.add_row(
            share.source, share.said_by, f"{share.alone:.2%}", f"{share.linear:.1%}", f"{share.removed:.1%}"
        )
    console.print(table)
    for coverage in (0.68, 0.95):
        low, high = found.relative(coverage)
        short = found.relative(coverage, "shortest")
        console.print(f"{coverage:.0%}: [{low:+.2%}, {high:+.2%}], shortest [{short[0]:+.2%}, {short[1]:+.2%}]")
    verdict = "agrees" if all(v.passed for v in found.validations) else "does not agree (JCGM 101, section 8)"
    console.print(
        f"linear formula: {found.linear.result.u / found.nominal:.2%}, {verdict}; {found.numeric.trials} trials"
    )
    for what, (low, high) in (("best", spread.best), ("half of all", spread.half), ("95 % of all", spread.most)):
        console.print(f"samples over a dome, {what}: [{low:+.2%}, {high:+.2%}] at 68 %")
