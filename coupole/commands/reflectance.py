"""The command `coupole reflectance`: the main job and its steps."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated, Any

import typer

from coupole.commands.choose_pictures import choose
from coupole.commands.common import JobOrStep, JsonOption, ResultArgument
from coupole.commands.common import fail as fail_with
from coupole.commands.option_groups import flatten_options
from coupole.commands.refine import refine
from coupole.commands.reflectance_options import (
    LeaveOutOption,
    MemoryOption,
    OutOption,
    PicturesWithoutRecords,
    SamplesOfRuns,
    SchedulerOption,
    SourcesOfResult,
    TexelsOption,
    Workers,
    bytes_of,
)
from coupole.commands.relight import relight
from coupole.errors import CoupoleError, InputError

if TYPE_CHECKING:
    from coupole.reflectance.run_job import RunRequest
    from coupole.reflectance.texels.texel_forecast import TexelForecast
    from coupole.reflectance.texels.texel_size import TexelSize

Said = Callable[[str, int, int], None]
Made = tuple[dict[str, Any], list[str], Path]
"""Content of `result.json`, remarks, path of the report."""
JOB = "from"
"""Name of the main job in the list of steps; it is never typed."""


class FromOrStep(JobOrStep):
    """`coupole reflectance RUN` calls the main job."""

    job = JOB


reflectance_app = typer.Typer(
    cls=FromOrStep,
    help="Reflectance of an object's surface from runs, normals and materials from pictures under known lights, "
    "and pictures under new lights.\n\n"
    "`coupole reflectance RUN --out OUT` and `coupole reflectance --pictures FOLDER --lights FILE --out OUT` make "
    "results; "
    "`coupole reflectance from --help` lists its options. If the first word is the name of a step, this step is "
    "run.",
    no_args_is_help=True,
)


@reflectance_app.command(JOB)
@flatten_options
def from_runs_or_pictures(
    runs: Annotated[
        list[Path] | None,
        typer.Argument(help="Runs of one object; none with --pictures.", show_default=False),
    ] = None,
    out: OutOption = None,
    *,
    samples: SamplesOfRuns,
    workers: Workers,
    without: PicturesWithoutRecords,
    leave_out: LeaveOutOption = "",
    texels: TexelsOption = None,
    as_json: JsonOption = False,
) -> None:
    """Fit normals and materials to proven frames of runs, or to pictures under known distant lights; check them.

    A job that was stopped continues when you give the same command again.
    """
    from coupole.viewing.terminal import make_console, step_bars

    console = make_console(quiet=as_json)
    try:
        if out is None:
            raise InputError("--out: expected the folder of the result")
        _refuse_mixed(runs or [], samples, without)
        size = _texel_size(texels, runs or [], without)
        left_out, memory_bytes = _numbers(leave_out), workers.memory_bytes
        with step_bars(console) as say:
            if without.is_uncalibrated and runs:
                outcome = _of_uncalibrated(runs[0], without.view, left_out, out, say)
            elif without.pictures is not None:
                outcome = _of_pictures(without.pictures, without, left_out, out, say)
            else:
                request = replace(samples.request(runs or [], left_out), memory_bytes=memory_bytes)
                outcome = _of_runs(request, out, workers.scheduler, say, Texels(size, console.print))
    except CoupoleError as error:
        fail_with(error, as_json=as_json)
        raise
    about, remarks, page = outcome
    for remark in remarks:
        console.print(remark)
    console.print(f"report {page}")
    if as_json:
        print(json.dumps({name: value for name, value in about.items() if name not in {"inputs", "runs"}}))


def _of_pictures(
    pictures: Path, options: PicturesWithoutRecords, left_out: list[int], out: Path, say: Said
) -> Made:
    from coupole.reflectance.picture_job import fit_pictures
    from coupole.reflectance.picture_set import read_pictures
    from coupole.reflectance.result_pages import reflectance_page

    if options.lights is None:
        raise InputError("--lights: expected the file of the lights' directions")
    picture_set = read_pictures(
        pictures, options.lights, intensities=options.intensities, mask=options.mask, srgb=options.srgb
    )
    about = fit_pictures(picture_set, out, left_out=left_out, say=say)
    return about, list(reflectance_page.remarks(about)), reflectance_page.write(out)


def _refuse_mixed(runs: list[Path], samples: SamplesOfRuns, without: PicturesWithoutRecords) -> None:
    """Raise InputError for options that do not go together."""
    if bool(runs) == (without.pictures is not None):
        raise InputError("expected runs, or --pictures with --lights; see coupole reflectance from --help")
    is_uncalibrated = without.is_uncalibrated
    if (is_uncalibrated and (samples.calibrations or len(runs) != 1)) or (without.view and not is_uncalibrated):
        raise InputError(
            "--uncalibrated: expected one run and no --calibrations; --view is for --uncalibrated only"
        )
    if (samples.refined_folder or samples.poses) and (is_uncalibrated or without.pictures is not None):
        raise InputError("--refined, --poses: are for calibrated runs")
    if without.pictures is None and any((without.lights, without.srgb, without.intensities, without.mask)):
        raise InputError("--lights, --srgb, --intensities, --mask: need --pictures, not runs")


def _texel_size(text: str | None, runs: list[Path], without: PicturesWithoutRecords) -> TexelSize | None:
    """Return the size of texels that `--texels` names. Raises InputError."""
    if text is None:
        return None
    from coupole.commands.texels_told import read_size

    size = read_size(text)
    if not runs or without.is_uncalibrated:
        raise InputError("--texels: is for calibrated runs; pixels of pictures are fitted one by one anyway")
    return size


def _of_uncalibrated(run: Path, view: str | None, left_out: list[int], out: Path, say: Said) -> Made:
    from coupole.reflectance import uncalibrated
    from coupole.reflectance.picture_job import fit_pictures
    from coupole.reflectance.picture_set import read_pictures
    from coupole.reflectance.result_pages import reflectance_page

    folder = out.with_name(f"{out.name}-pictures")
    view_pictures = uncalibrated.write_pictures(run, view, folder, say)
    if wrong := sorted(set(left_out) - set(view_pictures.leds)):
        raise InputError(f"--leave-out: no frame under LED {wrong[0]} in this view")
    lights, intensities, mask = (folder / name for name in uncalibrated.FILES)
    picture_set = read_pictures(folder, lights, intensities=intensities, mask=mask)
    picture_set = replace(picture_set, uncalibrated_run=run.resolve().name, simulated=view_pictures.is_simulated)
    about = fit_pictures(picture_set, out, left_out=[view_pictures.leds.index(led) for led in left_out], say=say)
    return about, list(reflectance_page.remarks(about)), reflectance_page.write(out)


@dataclass(frozen=True)
class Texels:
    """Requested texels, and the function that prints how long they will take and what they need."""

    size: TexelSize | None
    print_line: Callable[[str], None]

    def tell(self, forecast: TexelForecast) -> None:
        from coupole.commands.texels_told import lines_of

        for line in lines_of(forecast, os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")):
            self.print_line(line)


def _of_runs(request: RunRequest, out: Path, scheduler: str | None, say: Said, texels: Texels) -> Made:
    from coupole.reflectance.result_pages import run_reflectance_page
    from coupole.reflectance.whole_result import fit_runs

    about = fit_runs(request, out, scheduler, say, texels=texels.size, tell=texels.tell)
    return about, list(run_reflectance_page.remarks(about)), run_reflectance_page.write(out)


def _numbers(text: str) -> list[int]:
    words = [word for word in text.replace(" ", "").split(",") if word]
    try:
        return [int(word) for word in words]
    except ValueError as error:
        raise InputError(f"--leave-out: expected numbers separated by commas, got {text!r}") from error


@reflectance_app.command()
@flatten_options
def extract(
    runs: Annotated[list[Path], typer.Argument(help="Runs of one object.", show_default=False)],
    out: Annotated[Path, typer.Option("--out", help="Folder of the result.", show_default=False)],
    samples: SamplesOfRuns,
    leave_out: LeaveOutOption = "",
    scheduler: SchedulerOption = None,
    as_json: JsonOption = False,
) -> None:
    """Compute only the first step: samples of reflectance of each triangle under each LED, from proven frames."""

    def step(say: Said) -> dict[str, Any]:
        from coupole.reflectance.run_job import extract_runs
        from coupole.reflectance.run_result import RunResult

        request = samples.request(runs, _numbers(leave_out))
        extract_runs(request, out, scheduler=scheduler, say=say)
        return {"views": RunResult(out).summaries}

    _do(step, as_json=as_json, closing_words=f"samples {out}\nnext: coupole reflectance fit {quote(str(out))}")


@reflectance_app.command()
@flatten_options
def fit(
    result: ResultArgument,
    workers: Workers,
    as_json: JsonOption = False,
) -> None:
    """The second step alone: materials of each triangle, and the slice of reflectance that each view has seen."""

    def step(say: Said) -> dict[str, Any]:
        from coupole.reflectance.fits import FITS
        from coupole.reflectance.run_fits import fit_result

        fit_result(result, workers.memory_bytes, scheduler=workers.scheduler, say=say)
        return {"fits": list(FITS)}

    _do(
        step,
        as_json=as_json,
        closing_words=f"all fits {result}\nnext: coupole reflectance check {quote(str(result))}",
    )


@reflectance_app.command()
def check(result: ResultArgument, memory: MemoryOption = "2GB", as_json: JsonOption = False) -> None:
    """Run only the third step: the errors of the fits under the LEDs that were left out, and the report."""

    def step(say: Said) -> dict[str, Any]:
        from coupole.reflectance.result_pages import run_reflectance_page
        from coupole.reflectance.run_check import check_result

        about = check_result(result, bytes_of(memory), say=say)
        return {**about, "report": str(run_reflectance_page.write(result))}

    _do(step, as_json=as_json)


@reflectance_app.command()
@flatten_options
def ablate(
    result: ResultArgument,
    runs: Annotated[
        list[Path] | None,
        typer.Argument(help="With --texels, the runs of the result.", show_default=False),
    ] = None,
    *,
    texels: Annotated[
        bool,
        typer.Option(
            "--texels",
            help="Errors of the result's texels instead of those of its fits. The frames of the runs are read "
            "again: give the runs, and --mesh, --calibrations, --refined and --poses as for the result.",
        ),
    ] = False,
    sources: SourcesOfResult,
    memory: MemoryOption = "2GB",
    as_json: JsonOption = False,
) -> None:
    """Compute the errors of the fits with fewer LEDs, without grazing light, with fewer coefficients: one page.
    With --texels, compute the errors of texels with fewer LEDs and without grazing light, beside those of their
    triangles.
    """

    def step(say: Said) -> dict[str, Any]:
        if texels:
            from coupole.commands.texel_steps import ablate_texels_of

            return ablate_texels_of(result, runs or [], sources, bytes_of(memory), say)
        if runs or sources.has_any:
            raise InputError("RUNS, --mesh, --calibrations, --refined, --poses: are for --texels")
        from coupole.reflectance.result_pages import ablation_page
        from coupole.reflectance.run_ablation import ablate_result

        document = ablate_result(result, say=say)
        return {**document, "report": str(ablation_page.write(result, document))}

    _do(step, as_json=as_json)


@reflectance_app.command()
def cluster(
    result: ResultArgument,
    clusters: Annotated[
        int | None,
        typer.Option(
            "--clusters",
            min=1,
            help="Largest number of clusters; by default one for each 400 triangles or texels, 16 to 1000.",
        ),
    ] = None,
    degrees: Annotated[
        int,
        typer.Option(
            "--degrees", min=2, max=17, help="Order of the harmonics of pairs: 220 functions for 10, 969 for 17."
        ),
    ] = 10,
    without_view: Annotated[
        str | None,
        typer.Option(
            "--without-view", help="Leave the samples of this view out, and measure the error with them."
        ),
    ] = None,
    texels: Annotated[
        bool,
        typer.Option("--texels", help="Group the texels of the result instead of its triangles."),
    ] = False,
    memory: MemoryOption = "2GB",
    as_json: JsonOption = False,
) -> None:
    """Find a few materials for all triangles, each from the samples of triangles that look alike. Triangles with
    too few samples borrow a material. Each material also has harmonics of pairs of directions, which assume no
    model. With --texels, find a few materials for all texels: means of the texels that look alike.
    """

    def step(say: Said) -> dict[str, Any]:
        if texels:
            from coupole.commands.texel_steps import cluster_texels_of

            return cluster_texels_of(result, clusters, bytes_of(memory), degrees, without_view, say)
        from coupole.reflectance.result_pages import cluster_page
        from coupole.reflectance.run_clusters import cluster_result

        document = cluster_result(
            result, clusters, bytes_of(memory), degrees=degrees, without_view=without_view, say=say
        )
        return {**document, "report": str(cluster_page.write(result, document))}

    _do(step, as_json=as_json)


def _do(step: Callable[[Said], dict[str, Any]], *, as_json: bool, closing_words: str = "") -> None:
    """Run one step with progress bars. Print its result for `--json`, and otherwise its report or the words
    `closing_words`."""
    from coupole.viewing.terminal import make_console, step_bars

    try:
        with step_bars(make_console(quiet=as_json)) as say:
            document = step(say)
    except CoupoleError as error:
        fail_with(error, as_json=as_json)
        raise
    if as_json:
        print(json.dumps(document))
    else:
        print(f"report {document['report']}" if "report" in document else closing_words)


reflectance_app.command()(choose)
reflectance_app.command()(refine)
reflectance_app.command()(relight)
