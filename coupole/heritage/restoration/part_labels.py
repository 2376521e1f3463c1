"""Parts of the triangles of a mesh, by the rules of a parts file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError, Problem
from coupole.heritage.restoration.nearest_faces import nearest_faces
from coupole.heritage.restoration.painted_mesh import Floats, PaintedMesh
from coupole.heritage.restoration.parts_file import (
    Box,
    HalfSpace,
    PartsFile,
    Picked,
    PickedFile,
    Rule,
    Texture,
    VertexColours,
    read_picked,
)
from coupole.plan.yamlfile import Document

Labels = NDArray[np.int16]
NONE = -1
_SHOWN = 5
_TRIED = 2000
"""Number of points of a painted mesh with which its frame is checked."""
_NEAR_SHARE, _MOST_FAR = 0.05, 0.5
"""Distance, as a share of the mesh's size, within which a painted mesh lies on it; and share of the points that
may lie farther away."""


@dataclass(frozen=True, eq=False)
class Parts:
    """The part of every triangle."""

    names: tuple[str, ...]
    labels: Labels
    """[triangles] for each triangle the row of its part in `names`."""
    remarks: tuple[str, ...] = ()

    def counts(self) -> dict[str, int]:
        """Number of triangles of each part."""
        label_counts = np.bincount(self.labels, minlength=len(self.names))
        return {name: int(count) for name, count in zip(self.names, label_counts, strict=True)}


def parts_of(mesh: PaintedMesh, document: Document, parts_file: PartsFile) -> Parts:
    """Assign all triangles to parts. Raises InputError with all problems: data that the mesh lacks, parts without
    a triangle, triangles without a part."""
    names: list[str] = []
    labels: Labels = np.full(len(mesh.triangles), NONE, np.int16)
    places: dict[str, int] = {}
    remarks: list[str] = []
    problems: list[Problem] = []
    for number, rule in enumerate(parts_file.rules):
        try:
            rule_names, rule_labels, unknown = _by_rule(mesh, rule, document)
        except InputError as error:
            problems.append(document.problem(("rules", number), str(error)))
            continue
        for name in rule_names:
            places.setdefault(name, number)
            if name not in names:
                names.append(name)
        rows = np.array([names.index(name) for name in rule_names], np.int16)
        is_labelled, new = rule_labels >= 0, np.where(rule_labels >= 0, rows[rule_labels], labels).astype(np.int16)
        remarks += _overlaps(names, labels, new, number)
        remarks += [f"rule {number + 1} ({rule.kind}): {unknown}"] if unknown else []
        labels = np.where(is_labelled, new, labels)
    labels = _with_rest(parts_file, names, labels, document, problems)
    counts = np.bincount(labels[labels >= 0], minlength=len(names))
    for name, count in zip(names, counts, strict=True):
        if count == 0 and not problems:
            at = ("rules", places[name]) if name in places else ("rest",)
            message = (
                f"the part {name!r} has no triangle: no rule gives it a triangle, or later rules took all of "
                f"them; {_remark_text(remarks)}"
            )
            problems.append(document.problem(at, message))
    if problems:
        raise InputError(problems)
    return Parts(tuple(names), labels, tuple(remarks))


# -- helpers --------------------------------------------------------------------------------------------------


def _remark_text(remarks: Sequence[str]) -> str:
    return "; ".join(remarks) or "correct its rule, or leave it out"


def _with_rest(
    parts_file: PartsFile, names: list[str], labels: Labels, document: Document, problems: list[Problem]
) -> Labels:
    none = labels == NONE
    if parts_file.rest is not None:
        if parts_file.rest not in names:
            names.append(parts_file.rest)
        return np.where(none, names.index(parts_file.rest), labels).astype(np.int16)
    if none.any() and not problems:
        message = f"{int(none.sum())} of {len(labels)} triangles have no part; name a part for them as `rest`"
        problems.append(document.problem(("rules",), message))
    return labels


def _overlaps(names: list[str], before: Labels, after: Labels, number: int) -> list[str]:
    """Return a sentence for each part that loses triangles to a later rule."""
    is_taken = (before >= 0) & (after != before)
    pairs, counts = np.unique(np.stack([before[is_taken], after[is_taken]]), axis=1, return_counts=True)
    return [
        f"rule {number + 1} comes later, and takes {count} triangles of {names[old]!r} for {names[new]!r}"
        for (old, new), count in zip(pairs.T, counts, strict=True)
    ]


def _by_rule(mesh: PaintedMesh, rule: Rule, document: Document) -> tuple[list[str], NDArray[np.int64], str]:
    """Return the names, the index of a name or `NONE` for each triangle, and a remark about colours without a
    part."""
    match rule:
        case VertexColours():
            if mesh.srgb is None:
                raise InputError(f"{mesh.path}: its vertices have no colours; choose another kind of rule")
            labels, unknown = _by_colour(mesh.srgb, rule.colours, rule.tolerance)
            return list(rule.colours), _majority(labels[mesh.triangles]), unknown
        case Texture():
            labels, unknown = _by_colour(_texture_colours(mesh, rule, document), rule.colours, rule.tolerance)
            return list(rule.colours), labels, unknown
        case Box():
            middles = mesh.middles_mm
            inside = ((middles >= rule.low_mm) & (middles <= rule.high_mm)).all(axis=1)
            return [rule.part], np.where(inside, 0, NONE), ""
        case HalfSpace():
            beyond = (mesh.middles_mm - rule.point_mm) @ np.asarray(rule.normal) >= 0
            return [rule.part], np.where(beyond, 0, NONE), ""
        case PickedFile():
            picked_parts = read_picked(document.resolve(rule.path))
            _expect_one_frame(mesh, picked_parts, document.resolve(rule.path))
            faces = nearest_faces(
                mesh, picked_parts.vertices_mm.astype(np.float64), picked_parts.triangles.astype(np.int64)
            )
            return list(picked_parts.names), picked_parts.parts[faces].astype(np.int64) - 1, ""


def _expect_one_frame(mesh: PaintedMesh, picked_parts: Picked, path: Path) -> None:
    """Raise InputError if the painted mesh and this one lie in different places (another frame or unit)."""
    from scipy.spatial import cKDTree

    step = max(1, len(picked_parts.vertices_mm) // _TRIED)
    away_mm = cKDTree(mesh.vertices_mm).query(picked_parts.vertices_mm[::step])[0]
    size_mm = float(np.linalg.norm(np.ptp(mesh.vertices_mm, axis=0)))
    far = float(np.mean(away_mm > _NEAR_SHARE * size_mm))
    if far > _MOST_FAR:
        raise InputError(
            f"{path}: was painted on a mesh that lies elsewhere: {100 * far:.0f} % of it is more than "
            f"{_NEAR_SHARE * size_mm:.3g} mm from {mesh.path}. Both must be in one frame and one unit: register "
            "the scans with --control, check --unit, or paint this mesh"
        )


def _by_colour(srgb: NDArray[np.uint8], table: dict[str, str], tolerance: float) -> tuple[NDArray[np.int64], str]:
    """Return for each colour [n, 3] the nearest row of the table, or `NONE`; and a remark about colours without a
    row."""
    part_colours = np.array([list(bytes.fromhex(code[1:])) for code in table.values()], float)
    colours, colour_rows, counts = np.unique(srgb, axis=0, return_inverse=True, return_counts=True)
    distance = np.full(len(colours), np.inf)
    rows = np.full(len(colours), NONE)
    for row, part_colour in enumerate(part_colours):
        here = np.linalg.norm(colours - part_colour, axis=1)
        rows[here < distance] = row
        distance = np.minimum(distance, here)
    rows[distance > tolerance] = NONE
    strays = np.flatnonzero(rows == NONE)
    remark = ""
    if len(strays):
        most = strays[np.argsort(-counts[strays], kind="stable")][:_SHOWN]
        codes = ", ".join(f"#{bytes(colours[k].tolist()).hex()} ({counts[k]})" for k in most)
        remark = (
            f"{int(counts[strays].sum())} of {len(srgb)} places differ from every part's colour by more than "
            f"{tolerance:g}, most often {codes}"
        )
    return np.asarray(rows[colour_rows.reshape(-1)], np.int64), remark


def _majority(corners: NDArray[np.int64]) -> NDArray[np.int64]:
    """[m] value that two of the three corners [m, 3] have. If all three differ, it is the first one that is
    known."""
    a, b, c = corners.T
    first = np.where(a >= 0, a, np.where(b >= 0, b, c))
    return np.asarray(np.where((a == b) | (a == c), a, np.where(b == c, b, first)), np.int64)


def _texture_colours(mesh: PaintedMesh, rule: Texture, document: Document) -> NDArray[np.uint8]:
    """[m, 3] the picture's colour at the middle of each triangle, from the nearest pixel."""
    picture = mesh.texture if rule.image is None else _picture(document.resolve(rule.image))
    if mesh.uv is None:
        raise InputError(f"{mesh.path}: its corners have no places in a picture (UV); choose another kind of rule")
    if picture is None:
        raise InputError(f"{mesh.path}: names no picture; name the picture as `image`")
    middles: Floats = mesh.uv[mesh.triangles].mean(axis=1) % 1.0
    height, width = picture.shape[:2]
    column = np.minimum((middles[:, 0] * width).astype(int), width - 1)
    row = np.minimum(((1.0 - middles[:, 1]) * height).astype(int), height - 1)
    return np.asarray(picture[row, column])


def _picture(path: Path) -> NDArray[np.uint8]:
    from PIL import Image

    try:
        with Image.open(path) as image:
            pixels: Any = np.asarray(image.convert("RGB"))
    except (OSError, ValueError, Image.DecompressionBombError) as error:
        raise InputError(f"{path}: expected a picture of labels (PNG); {error}") from error
    return np.asarray(pixels, np.uint8)
