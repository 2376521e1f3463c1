"""Export of a run's views, or the view of a result of pictures, to programs that relight or show pictures."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from threadpoolctl import threadpool_limits

from coupole.errors import InputError
from coupole.exchange.formats import Source, Writer, format_named, source_of
from coupole.exchange.kept_frames import refuse_discarded_lights
from coupole.exchange.rti import iiif, relight_web, rti_pictures
from coupole.exchange.rti.lit_views import LitView, Said, chosen_views, lit_views, refuse_few_lights
from coupole.exchange.target_folder import refuse_standing, writing_into
from coupole.reflectance.uncalibrated import lights_of_view
from coupole.storage.run import Run

_HERE = "coupole.exchange.rti"


@dataclass(frozen=True)
class HowShown:
    """Options that the formats leave open."""

    basis: str = relight_web.BASES[0]
    planes: int = relight_web.PLANES[0]
    base_url: str = iiif.EXAMPLE_URL


@dataclass
class Written:
    """Written files, and for each view the rms error of its file against its pictures, in steps of 8 bits."""

    paths: list[Path] = field(default_factory=list)
    misses_dn: dict[str, float] = field(default_factory=dict)


def export_views(
    source: Path,
    to: str,
    out: Path,
    views: Sequence[str],
    how: HowShown = HowShown(),  # the default is frozen
    *,
    overwrite: bool,
    say: Said,
) -> Written:
    """Write the views of a run that match one of the patterns, or a result of pictures, into `out`.

    Raises InputError, before anything is written, if format or options do not fit the source, if there is no such
    view, if frames were discarded, if there are too few lights, or if files exist (unless `overwrite`);
    StorageError for damaged frames or a disk that cannot be written.
    """
    kind = source_of(source)
    of_result = kind is Source.PICTURES
    format_named(to, kind, Writer.VIEWS)
    if of_result and views:
        raise InputError("--views: are for runs; a result of pictures has one view")
    if to == "iiif":
        iiif.checked_base(how.base_url)
    names = [source.resolve().name] if of_result else chosen_views(Run(source), views)
    if not overwrite:
        refuse_standing([_first_file(out, to, name) for name in names])
    if not of_result:
        _refuse_incomplete(Run(source), names, to)
    if to == "lp":
        return Written(rti_pictures.export_rti(source, out, names, say))
    export = Written()
    with writing_into(out), threadpool_limits(1, "blas"):  # its threads would only wait for each other
        if to == "dome":
            export.paths = [rti_pictures.write_dome(Run(source), name, out / f"{name}.dome") for name in names]
        elif to == "iiif":
            export.paths = iiif.write(lit_views(source, views, out, say), out, how.base_url, say)
        else:
            for view in lit_views(source, views, out, say):
                paths, misses_dn = _write(view, to, out, how, say)
                export.paths += paths
                export.misses_dn[view.name] = misses_dn
    return export


def _refuse_incomplete(run: Run, views: Sequence[str], to: str) -> None:
    """Raise InputError if one of these views cannot be written: its frames were discarded (a `dome` needs none),
    or too few LEDs are in front of its camera."""
    if to != "dome":
        refuse_discarded_lights(run, views, to)
    for view in views:
        lights_mm = lights_of_view(run.folder, view).lights_mm
        if to not in ("dome", "lp"):  # these two also have lights behind the picture's plane
            refuse_few_lights(view, lights_mm)


def _first_file(out: Path, to: str, name: str) -> Path:
    match to:
        case "relight":
            return out / name / "info.json"
        case "iiif":
            return out / iiif.MANIFEST
        case "lp":
            return out / name / f"{name}.lp"
        case _:
            return out / f"{name}.{to}"


def _write(view: LitView, to: str, out: Path, how: HowShown, say: Said) -> tuple[list[Path], float]:
    """Write the files of one view; return them with their error. A format with one file for each view is the
    module of that name."""
    if to == "relight":
        folder = out / view.name
        folder.mkdir(exist_ok=True)
        return relight_web.write(view, folder, how.basis, how.planes, say)
    path = out / f"{view.name}.{to}"
    misses_dn: float = importlib.import_module(f"{_HERE}.{to}").write(view, path, say)
    return [path], misses_dn
