"""A result of `coupole reflectance` read from Python: arrays on the mesh or on the picture, new lights,
exports."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError
from coupole.exchange.formats import Source, Writer, format_named
from coupole.reflectance import picture_result, run_relighting, run_result
from coupole.reflectance.fits import MATERIALS
from coupole.reflectance.new_light.light_kinds import AnyLight, DistantLight, LedLight
from coupole.reflectance.new_light.pictured_surface import FreeCamera
from coupole.scripting import relit_result
from coupole.storage import so_far

if TYPE_CHECKING:
    from coupole.reflectance.triangle_fit import TriangleMaterials

Vector = tuple[float, float, float]
SAMPLES = 256
"""Number of rays to each area light and environment."""


@dataclass(frozen=True)
class Materials:
    """GGX materials of the faces of a mesh, or of the fitted pixels of a picture; NaN where no material was
    fitted."""

    normals: NDArray[np.float64]
    """[n, 3] unit normals: base frame for a mesh; x right, y up, z to the camera for a picture."""
    kd: NDArray[np.float64]
    """[n, channels] diffuse reflectance by channel, 1/sr."""
    ks: NDArray[np.float64]
    """[n, channels] specular factor; f = kd + ks D V."""
    alpha: NDArray[np.float64]
    """[n] GGX's roughness."""


class Result:
    """A result folder of runs: a mesh with materials for its faces, and their uncertainty."""

    folder: Path
    """The result's folder, absolute."""
    about: Mapping[str, Any]
    """Contents of result.json: software, runs, errors of the fits."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.about = folder, run_result.read_about(folder)
        self._result = run_result.RunResult(folder)

    def __repr__(self) -> str:
        return f"<result {self.folder.name}: {len(self.faces)} faces, views {', '.join(self.views)}>"

    @property
    def is_simulated(self) -> bool:
        """True if its frames come from a simulated cell."""
        return bool(self.about["simulated"])

    @property
    def views(self) -> tuple[str, ...]:
        """Names of the measured views."""
        return tuple(view.view for view in self._result.views)

    @property
    def fits(self) -> tuple[str, ...]:
        """Names of the fits of materials that the result has."""
        return tuple(name for name in MATERIALS if self._result.materials_path(name).exists())

    @property
    def base_from_support(self) -> NDArray[np.float64]:
        """[4, 4] transform from support to base coordinates, mm."""
        return self._result.base_from_support

    @property
    def vertices_mm(self) -> NDArray[np.float32]:
        """[vertices, 3] vertices of the mesh, base frame, mm. Corners with the same coordinates are one vertex."""
        return self._mesh[0]

    @property
    def faces(self) -> NDArray[np.int64]:
        """[faces, 3] for each face the rows of its corners in `vertices_mm`. Faces are in the order of the mesh's
        file.
        """
        return self._mesh[1]

    @cached_property
    def is_seen(self) -> NDArray[np.bool_]:
        """[faces] True for faces that at least one view sees."""
        mask = np.zeros(len(self._result.corners_mm), bool)
        mask[self._result.triangles] = True
        return mask

    def materials(self, fit: str | None = None) -> Materials:
        """Materials of all faces by a fit: one of `fits`, or by default the fit with the smallest error in the
        check.

        Raises InputError if the result has no such fit.
        """
        of_seen: TriangleMaterials = self._result.materials(self._fit(fit))
        names = [field.name for field in fields(Materials)]
        return Materials(*(self._on_faces(getattr(of_seen, name)) for name in names))

    def normals(self, fit: str | None = None) -> NDArray[np.float64]:
        """[faces, 3] fitted unit normals, base frame; NaN where no normal was fitted."""
        return self.materials(fit).normals

    def covariances(self, fit: str | None = None) -> NDArray[np.float64]:
        """[faces, 5, 5] covariance of tilts (rad) along two tangents of the normal and of the logarithms of kd, ks
        (the channels' mean) and alpha; NaN where no material was fitted. Uncertainties that triangles share are
        not included."""
        return self._on_faces(self._result.material_covariances(self._fit(fit)))

    def relight(
        self,
        lights: Sequence[AnyLight] = (),
        *,
        direction: Vector | None = None,
        led: int | None = None,
        view: str | None = None,
        camera: FreeCamera | None = None,
        fit: str | None = None,
        samples: int = SAMPLES,
    ) -> NDArray[np.float32]:
        """[height, width, 3] linear picture under the sum of the lights, like the picture of `coupole reflectance
        relight`. 1 is a white diffuser in full light; for LEDs, 1 is the full range of the camera.

        `direction` (to a distant light, support frame, z up) and `led` (number of an LED of the run) are short
        forms of lights of `coupole.lights`. `view` is a measured view, by default the first; a `camera` replaces
        the view and may be anywhere. `samples` are rays to each area light and environment. Raises InputError if
        there is no light, or if view or fit are unknown.
        """
        scene = relit_result.open_result(self.folder, view, fit, camera, samples, uncertain=False)
        return scene.picture(_lights(lights, direction, led), _say_nothing)

    def relight_uncertainty(
        self,
        lights: Sequence[AnyLight] = (),
        *,
        direction: Vector | None = None,
        led: int | None = None,
        view: str | None = None,
        camera: FreeCamera | None = None,
        fit: str | None = None,
        samples: int = SAMPLES,
    ) -> NDArray[np.float32]:
        """[height, width, 3] standard uncertainty (68 %) of the picture that `relight` makes with the same
        arguments and a fit of materials. Raises InputError like `relight`, and for a fit that states no
        uncertainty."""
        scene = relit_result.open_result(self.folder, view, fit, camera, samples, uncertain=True)
        assert scene.uncertainty is not None
        return scene.uncertainty(_lights(lights, direction, led), _say_nothing)

    def to(
        self, name: str, out: str | os.PathLike[str], *, fit: str | None = None, overwrite: bool = False
    ) -> list[Path]:
        """Write the result in a format of `coupole export` (ply, gltf, obj, usd, ktx2, materialx, exr, bsdf,
        merl, bird, alta) into the folder `out`; return its files. Raises InputError for any other format, and if
        the folder contains files (unless `overwrite`); StorageError."""
        from coupole.exchange.of_results.export_result import export_result

        return export_result(self.folder, name, Path(out), fit=fit, overwrite=overwrite)

    @cached_property
    def _mesh(self) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
        corners = self._result.corners_mm.reshape(-1, 3)
        vertices, places = np.unique(corners, axis=0, return_inverse=True)
        return vertices, places.reshape(-1, 3).astype(np.int64)

    def _fit(self, name: str | None) -> str:
        """Return the fit of this name. Raises InputError if there is none."""
        if name is not None and name not in self.fits:
            raise InputError(f"{self.folder}: expected a fit of {', '.join(self.fits)}; found {name}")
        return name or run_relighting.best_fit(self._result, self.fits)

    def _on_faces(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return [faces, ...] values. They are given for the faces that a view sees; the other faces get NaN."""
        all_values = np.full((len(self._result.corners_mm), *values.shape[1:]), np.nan)
        all_values[self._result.triangles] = values
        return all_values


class PicturesResult:
    """A result folder of pictures under known lights (`coupole reflectance --pictures`): values of pixels."""

    folder: Path
    """The result's folder, absolute."""
    about: Mapping[str, Any]
    """Contents of result.json."""

    def __init__(self, folder: Path) -> None:
        self._result = picture_result.PictureResult(folder)
        self.folder, self.about = folder, self._result.about

    def __repr__(self) -> str:
        return f"<result of pictures {self.folder.name}>"

    @property
    def mask(self) -> NDArray[np.bool_]:
        """[height, width] True for pixels with a fitted material."""
        return self._result.mask

    @property
    def light_directions(self) -> NDArray[np.float64]:
        """[lights, 3] unit vectors to all lights: x right, y up, z to the camera."""
        return self._result.directions

    def materials(self) -> dict[str, NDArray[np.float32]]:
        """Pictures [height, width, ...] of the fitted quantities, by the names of docs/reference/result-folder.md;
        NaN outside the mask."""
        with picture_result.open_result_file(self.folder / picture_result.MATERIALS) as file:
            arrays = {name: np.asarray(data, np.float32) for name, data in file.items()}
        pixels = int(self.mask.sum())
        return {
            name: self._result.picture(array, np.nan) for name, array in arrays.items() if len(array) == pixels
        }

    def normals(self) -> NDArray[np.float32]:
        """[height, width, 3] unit normals: x right, y up, z to the camera."""
        return np.asarray(np.load(self.folder / picture_result.NORMALS), np.float32)

    def relight(
        self, lights: Sequence[AnyLight] = (), *, direction: Vector | None = None, samples: int = SAMPLES
    ) -> NDArray[np.float32]:
        """[height, width, 3] linear picture under the sum of the lights. `direction` is a short form of a distant
        light (x right, y up, z to the camera). Raises InputError if there is no light, or a light of a kind that
        pictures cannot have.
        """
        scene = relit_result.open_result(self.folder, None, None, None, samples, uncertain=False)
        return scene.picture(_lights(lights, direction, None), _say_nothing)

    def to(self, name: str, out: str | os.PathLike[str], *, overwrite: bool = False) -> list[Path]:
        """Write the result in a format of `coupole export` (relight, ptm, rti, iiif) into the folder `out`; return
        the files. Raises InputError for any other format, and if the files exist (unless `overwrite`)."""
        from coupole.exchange.rti.export_views import export_views

        format_named(name, Source.PICTURES, Writer.VIEWS)
        return export_views(self.folder, name, Path(out), [], overwrite=overwrite, say=lambda *_: None).paths


def open_result(path: str | os.PathLike[str]) -> Result | PicturesResult:
    """Open the folder of a result of `coupole reflectance RUN` (a `Result`) or of `--pictures` (a
    `PicturesResult`).

    Raises InputError if the folder contains neither.
    """
    folder = so_far.as_it_is_now(Path(path).resolve())
    if (folder / run_result.OBJECT).exists():
        return Result(folder)
    if (folder / picture_result.SAMPLES).exists():
        return PicturesResult(folder)
    raise InputError(f"{folder}: holds no result (`coupole reflectance RUN --out FOLDER` makes one)")


def _lights(lights: Sequence[AnyLight], direction: Vector | None, led: int | None) -> list[AnyLight]:
    """Return the list of all lights. Raises InputError if there is none."""
    whole = list(lights)
    whole += [] if direction is None else [DistantLight(towards=direction)]
    whole += [] if led is None else [LedLight(number=led)]
    if not whole:
        raise InputError("expected a light: `direction`, `led`, or lights of coupole.lights")
    return whole


def _say_nothing(count: int, of: int) -> None:
    """Ignore the progress."""
