"""Spectral pictures of a mesh with its parts and hypotheses. Existing pictures are not made again."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.appearance.render import pictures, variant
from coupole.appearance.render.colour import Eye
from coupole.appearance.render.objects import pieces, placed_piece
from coupole.appearance.render.pieces import Ball, Piece
from coupole.appearance.render.rendering import Spectral, open_renderer
from coupole.appearance.render.scene_file import Camera, PlainScene, with_plain_lights
from coupole.appearance.shapes.triangles import flat_normals, weld_corners
from coupole.errors import InputError, StorageError, reason
from coupole.heritage.restoration import labelled_pictures
from coupole.heritage.restoration.painted_mesh import Floats, PaintedMesh
from coupole.heritage.restoration.part_labels import Parts
from coupole.heritage.restoration.restoration_file import (
    Hypothesis,
    RestorationFile,
    Stage,
    cameras_of,
    named_files,
)
from coupole.heritage.restoration.seen_parts import SeenParts
from coupole.intake.plain_data import read_json
from coupole.plan.yamlfile import Document

Say = Callable[[str, int, int], None]


@dataclass(frozen=True, eq=False)
class Restoration:
    """All data from which pictures are made."""

    mesh: PaintedMesh
    parts: Parts
    document: Document
    restoration_file: RestorationFile
    hypotheses: tuple[Hypothesis, ...]
    lights_name: str | None = None
    """Name of the set of `other_lights` that is used; None for `lights`."""

    @property
    def folder(self) -> Path:
        """Folder to which paths of the restoration file are relative."""
        return self.document.path.parent

    @cached_property
    def corners_mm(self) -> Floats:
        """[triangles, 3, 3] corners in the scene's frame."""
        pose = self.restoration_file.object.scene_from_thing()
        return np.asarray(self.mesh.corners_mm @ pose[:3, :3].T + pose[:3, 3])

    @cached_property
    def cameras(self) -> tuple[Camera, ...]:
        points = self.corners_mm.reshape(-1, 3)
        return cameras_of(self.restoration_file, points.min(axis=0), points.max(axis=0))

    @cached_property
    def stage(self) -> Stage:
        """The scene without the object."""
        restoration_file = self.restoration_file
        return Stage(
            schema_version=1,
            name=restoration_file.name,
            cameras=self.cameras,
            objects=restoration_file.surroundings,
            lights=restoration_file.lights,
            observer=restoration_file.observer,
            bands=restoration_file.bands,
            samples=restoration_file.samples,
            noise=restoration_file.noise,
            depth=restoration_file.depth,
            seed=restoration_file.seed,
            display=restoration_file.display,
            outputs=restoration_file.outputs,
        )

    @cached_property
    def lit(self) -> PlainScene:
        """The scene with sun and sky instead of daylight. Raises InputError if they cannot be computed."""
        return with_plain_lights(self.stage, self.folder)

    @cached_property
    def eye(self) -> Eye:
        return pictures.eye_of(self.lit, self.folder)

    @cached_property
    def seen_parts(self) -> SeenParts:
        other_pieces = [
            piece for thing in self.restoration_file.surroundings for piece in pieces(thing, self.folder)
        ]
        around: list[Piece | Ball] = list(other_pieces)
        return SeenParts(self.corners_mm, self.parts.labels, around)

    @cached_property
    def _normals(self) -> Floats | None:
        return smooth_normals(self.mesh.corners_mm) if self.restoration_file.smooth else None

    def painted_parts(self, hypothesis: Hypothesis) -> list[Piece]:
        """Return the object's parts in the scene's frame."""
        corners, painted_pieces = self.mesh.corners_mm, []
        for row, name in enumerate(self.parts.names):
            of_part = self.parts.labels == row
            normals = None if self._normals is None else self._normals[of_part]
            piece = Piece(corners[of_part], hypothesis.materials[name], self.restoration_file.smooth, normals)
            painted_pieces.append(placed_piece(piece, self.restoration_file.object))
        return painted_pieces

    @cached_property
    def _digest(self) -> str:
        """Digest of the data that all pictures share: shape, parts, the scene without display and cameras, files,
        renderer."""
        hasher = hashlib.sha256(
            f"{self.mesh.digest()} {self.parts.names} {variant.spectral(is_polarised=False)}".encode()
        )
        hasher.update(self.parts.labels.tobytes())
        hasher.update(
            self.restoration_file.object.model_dump_json().encode() + str(self.restoration_file.smooth).encode()
        )
        hasher.update(self.stage.model_dump_json(exclude={"display", "cameras"}).encode())
        for path in named_files(self.restoration_file, self.document):
            hasher.update(path.read_bytes())
        return hasher.hexdigest()

    def digest(self, hypothesis: Hypothesis, camera: Camera) -> str:
        """Return the digest of the data from which one picture is made."""
        materials = {name: material.model_dump(mode="json") for name, material in hypothesis.materials.items()}
        description = f"{self._digest} {camera.model_dump_json()} {json.dumps(materials, sort_keys=True)}"
        return hashlib.sha256(description.encode()).hexdigest()


@dataclass(frozen=True)
class Made:
    """A picture on disk."""

    hypothesis: Hypothesis
    camera: Camera
    exr: Path
    about: dict[str, Any]
    """Digest, renderer, samples, noise, mean luminance."""
    is_new: bool

    def xyz(self) -> NDArray[np.float32]:
        """[h, w, 3] X, Y, Z in cd/m^2. Raises StorageError."""
        import OpenEXR

        try:
            with OpenEXR.File(str(self.exr), separate_channels=True) as file:
                planes = [np.asarray(file.channels()[name].pixels, np.float32) for name in "XYZ"]
        except (OSError, RuntimeError, KeyError) as error:
            raise StorageError(
                f"{self.exr}: cannot be read: {error}; remove this file, and it is made again"
            ) from error
        return np.stack(planes, axis=-1)


def render_all(restoration: Restoration, out: Path, say: Say) -> list[Made]:
    """Make and return spectral pictures of each hypothesis from each camera, in `out`/HYPOTHESIS/CAMERA.exr.

    Raises InputError for a scene that cannot be rendered, StorageError if the disk cannot be written.
    """
    renderings: list[Made] = []
    try:
        for hypothesis in restoration.hypotheses:
            renderings += _of_one(restoration, hypothesis, out / hypothesis.name, say)
    except OSError as error:
        raise StorageError(f"{out}: {reason(error)}. Choose another folder, or free space.") from error
    return renderings


def smooth_normals(corners_mm: Floats) -> Floats:
    """[triangles, 3, 3] unit normals at the corners: means over all triangles at a place, weighted by area."""
    points, faces = weld_corners(corners_mm)
    cross = np.cross(corners_mm[:, 1] - corners_mm[:, 0], corners_mm[:, 2] - corners_mm[:, 0])
    sums = np.stack([np.bincount(faces.ravel(), np.repeat(column, 3), len(points)) for column in cross.T], axis=1)
    length = np.linalg.norm(sums, axis=1, keepdims=True)
    units = np.divide(sums, length, out=np.zeros_like(sums), where=length > 0)[faces]
    has_no_normal = np.linalg.norm(units, axis=2) == 0
    units[has_no_normal] = np.repeat(flat_normals(corners_mm)[:, None], 3, axis=1)[has_no_normal]
    return np.asarray(units)


# -- helpers --------------------------------------------------------------------------------------------------


def _of_one(restoration: Restoration, hypothesis: Hypothesis, folder: Path, say: Say) -> list[Made]:
    folder.mkdir(parents=True, exist_ok=True)
    texts = labelled_pictures.for_exr(labelled_pictures.metadata_texts([hypothesis]))
    about_of_camera = {
        camera.name: _noted_summary(restoration, hypothesis, camera, folder) for camera in restoration.cameras
    }
    new_cameras = [camera for camera in restoration.cameras if about_of_camera[camera.name] is None]
    step = f"rendering {hypothesis.name}"
    if new_cameras:
        say(step, 0, len(new_cameras))
        with open_renderer(
            restoration.stage, restoration.folder, restoration.painted_parts(hypothesis)
        ) as renderer:
            written_by = f"Mitsuba {renderer.version}, {renderer.variant_name}"
            for number, camera in enumerate(new_cameras):

                def passes(done_count: int, total: int, number: int = number) -> None:
                    say(step, number * total + done_count, len(new_cameras) * total)

                picture = renderer.render(camera, passes)
                about_of_camera[camera.name] = _write(
                    restoration, (hypothesis, camera), picture, folder, written_by
                )
    renderings = []
    for camera in restoration.cameras:
        path = folder / f"{camera.name}.exr"
        labelled_pictures.restamp_exr(path, texts)
        renderings.append(
            Made(hypothesis, camera, path, about_of_camera[camera.name] or {}, camera in new_cameras)
        )
    return renderings


def _noted_summary(
    restoration: Restoration, hypothesis: Hypothesis, camera: Camera, folder: Path
) -> dict[str, Any] | None:
    """Return the noted summary of the same picture, if the picture exists."""
    path = folder / f"{camera.name}.json"
    if not path.is_file() or not path.with_suffix(".exr").is_file():
        return None
    try:
        about: dict[str, Any] = read_json(path, allow_nan=True)
    except (OSError, InputError):
        return None
    return about if about.get("of") == restoration.digest(hypothesis, camera) else None


def _write(
    restoration: Restoration,
    of: tuple[Hypothesis, Camera],
    spectral_picture: Spectral,
    folder: Path,
    written_by: str,
) -> dict[str, Any]:
    hypothesis, camera = of
    beside = folder / f"{camera.name}.json"
    beside.unlink(missing_ok=True)
    xyz = restoration.eye.tristimulus(spectral_picture.radiance)
    about = (
        f"{restoration.restoration_file.name}, hypothesis {hypothesis.name}: {pictures.SYNTHETIC}; {written_by}"
    )
    texts = labelled_pictures.for_exr(labelled_pictures.metadata_texts([hypothesis]))
    pictures.write_exr(folder / f"{camera.name}.exr", restoration.lit, spectral_picture, xyz, about, texts)
    record = {
        "of": restoration.digest(hypothesis, camera),
        "renderer": written_by,
        "samples": spectral_picture.samples,
        "noise": None if spectral_picture.noise is None else round(spectral_picture.noise, 5),
        "mean_cd_m2": round(float(restoration.eye.luminance(spectral_picture.radiance).mean()), 6),
    }
    beside.write_text(json.dumps(record) + "\n", encoding="utf-8")
    return record


def common_white(restoration: Restoration, made_pictures: Sequence[Made]) -> float:
    """Return the luminance in cd/m^2 that all pictures show as white. Raises InputError if the pictures are
    black."""
    display = restoration.restoration_file.display
    if display.white_cd_m2 is not None:
        return display.white_cd_m2
    some = [rendering.xyz()[::2, ::2, 1].ravel() for rendering in made_pictures]
    white = float(np.quantile(np.concatenate(some), 1.0 - display.clipped))
    if white <= 0.0:
        raise InputError(
            f"{restoration.document.path}: expected some light in the pictures, found none; check its lights"
        )
    return white
