"""Every format of `coupole export`, in one table for command line, completion, console and exporters.

A format of frames is a module of this folder with `encode(picture)`, which returns the file's bytes. A format of
results is a module of `of_results` with `write(surface, folder)`, which returns the written files. A format of
views is a module of `rti` with `write(view, path, say)`, which writes one file for each view and returns the rms
error of its pictures; formats with other files are in `rti/export_views.py`.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from pathlib import Path

from coupole.errors import InputError


class Source(Enum):
    """Kinds of sources that can be exported, with their names in messages."""

    RUN = "a run"
    RESULT = "a result"
    PICTURES = "a result of pictures"
    RESTORATION = "a restoration"


class Writer(Enum):
    """Kinds of writers, named by the content of one file."""

    FRAMES = "a frame in each file"
    VIEWS = "a view with all its lights"
    POSES = "all views with their poses"
    RESULT = "a result"
    CRATE = "the whole folder"


@dataclass(frozen=True)
class Format:
    """One format; `options` are the options of the command line that only some formats have."""

    name: str
    gives: str
    """Description of the format, in words for a list."""
    writer: Writer
    sources: tuple[Source, ...]
    options: tuple[str, ...] = ()


RESTORATION_RESULT = "result.json"
"""Result file of `coupole restore`. Results of reflectance also have a file of this name, but with other files
beside it."""
MAPS = ("texel-mm", "map-px", "uv")
"""Options of formats with maps."""
_RUN, _PICTURES_TOO = (Source.RUN,), (Source.RUN, Source.PICTURES)
_OF_FRAMES = ("views", "shots", "sensor-spectra", "led-spectrum", "calibrations")
_OF_A_CRATE = ("licence", "author", "publisher", "name", "identifier", "in-place")


def _views(name: str, gives: str, *options: str, sources: tuple[Source, ...] = _PICTURES_TOO) -> Format:
    return Format(name, gives, Writer.VIEWS, sources, ("views", *options))


def _result(name: str, gives: str, *options: str) -> Format:
    return Format(name, gives, Writer.RESULT, (Source.RESULT,), ("fit", *options))


_TABLE = (
    Format("dng", "RAW frames as DNG, for RAW converters", Writer.FRAMES, _RUN, _OF_FRAMES),
    Format("tiff", "frames as TIFF", Writer.FRAMES, _RUN, (*_OF_FRAMES, "for-the-eye", "linear")),
    _views("lp", "pictures under each LED with directions, for programs that fit them", sources=_RUN),
    _views("dome", "relight's file of the LEDs' places", sources=_RUN),
    _views("relight", "relight's planes of coefficients for browsers (OpenLIME)", "basis", "planes"),
    _views("ptm", "a polynomial texture map, PTM 1.2 LRGB"),
    _views("rti", "hemispherical harmonics, HSH 1.2"),
    _views("iiif", "IIIF: a manifest and tiled pictures", "base-url"),
    Format("colmap", "views with their poses, for COLMAP", Writer.POSES, _RUN, ("refined", "calibrations")),
    _result("ply", "the mesh, with each triangle's material, normal and uncertainties"),
    _result("gltf", "a .glb for viewers and browsers, with maps of colour, normal, roughness and specular", *MAPS),
    _result("obj", "an OBJ with maps, for modelling programs", *MAPS),
    _result("usd", "a .usdz with maps, for USD programs and telephones", *MAPS),
    _result(
        "ktx2", "maps as KTX 2.0 textures with mip levels, for programs that load textures, and an OBJ", *MAPS
    ),
    _result("materialx", "a MaterialX document of OpenPBR, with maps and mesh", *MAPS),
    _result("exr", "a multi-part OpenEXR for each view: material, normal, place and uncertainties of each pixel"),
    _result("bsdf", "tables of materials in RGL's tensor format, for Mitsuba", "triangle", "adaptive"),
    _result("merl", "tables of materials as the MERL database has them", "triangle"),
    _result("bird", "samples of triangles as JSON of the BiRD project, with standard uncertainties", "triangle"),
    _result("alta", "tables of materials as text for ALTA, with 95 % bounds", "triangle"),
    Format(
        "rocrate",
        "the whole folder as a research crate (RO-Crate), with a licence",
        Writer.CRATE,
        (Source.RUN, Source.RESULT, Source.RESTORATION),
        _OF_A_CRATE,
    ),
)
FORMATS = {one.name: one for one in _TABLE}
"""Formats by name."""


def source_of(folder: Path) -> Source:
    """Return the kind of source of a folder, by its files."""
    if (folder / "object.h5").exists():
        return Source.RESULT
    if (folder / "normals.npy").exists():
        return Source.PICTURES
    return Source.RESTORATION if (folder / RESTORATION_RESULT).exists() else Source.RUN


def formats_of(source: Source, writer: Writer | None = None) -> list[str]:
    """Return the names of the formats for a kind of source, of one writer or of all."""
    return [
        entry.name
        for entry in FORMATS.values()
        if source in entry.sources and (writer is None or writer is entry.writer)
    ]


def format_named(name: str, source: Source, writer: Writer | None = None) -> Format:
    """Return the format of this name. Raises InputError if there is no such format for the source (and the
    writer).
    """
    names = formats_of(source, writer)
    if name not in names:
        sources = [kind.value for kind in FORMATS[name].sources] if name in FORMATS else []
        why = f"; {name} is for {' or '.join(sources)}" if sources and source.value not in sources else ""
        raise InputError(f"--to: expected one of {', '.join(names)} for {source.value}; found {name}{why}")
    return FORMATS[name]


def refuse_others_options(export_format: Format, option_names: list[str]) -> None:
    """Raise InputError for the first of these options (names without dashes) that only other formats have."""
    for option in option_names:
        takers = [entry.name for entry in FORMATS.values() if option in entry.options]
        if takers and export_format.name not in takers:
            raise InputError(f"--{option}: is for --to {', '.join(takers)}; found --to {export_format.name}")
