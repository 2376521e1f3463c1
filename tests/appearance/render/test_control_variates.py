"""Bands that take their noise from a guide: against pictures whose truth is known, and against plain rendering."""

from collections.abc import Iterable, Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from spectral_scenes import camera, everywhere, illuminant, plane, rendered, scene

from coupole.appearance.render.control_variates import Guide, batch_sizes
from coupole.appearance.render.rendering import Renderer, open_renderer

SHAPE = (24, 20)
LIMIT = 0.02


@given(st.integers(1, 70), st.integers(1, 5000))
def test_batches_have_all_paths_and_grow(first: int, most: int) -> None:
    sizes = list(batch_sizes(first, most))
    assert sum(sizes) == max(most, 2)
    assert len(sizes) >= 2
    assert min(sizes) >= 1
    assert len(sizes) <= 9 + 4 * max(1.0, np.log2(most) + 1.0)
    assert all(b in (a, 2 * a) for a, b in pairwise(sizes[1:-1]))


def batches(
    sizes: list[int], shared: float, own: float, seed: int, truth: NDArray[np.float64]
) -> Iterator[tuple[int, NDArray[np.float64]]]:
    """Mean pictures of batches: `truth` times what a path brings, of which `shared` is the same in all groups of a
    seed, and `own` is new in each band."""
    paths, noise = np.random.default_rng(7), np.random.default_rng(seed)
    for size in sizes:
        common = paths.gamma(size, 1.0 / size, SHAPE)[..., None] - 1.0
        alone = noise.gamma(size, 1.0 / size, (*SHAPE, 4)) - 1.0
        yield size, truth * (1.0 + shared * common + own * alone)


def counted(
    batches: Iterable[tuple[int, NDArray[np.float64]]], taken: list[int]
) -> Iterator[tuple[int, NDArray[np.float64]]]:
    """The same batches; the sizes of those that were asked for are put into `taken`."""
    for size, picture in batches:
        taken.append(size)
        yield size, picture


def guide_of(folder: Path, sizes: list[int]) -> Guide:
    guide = Guide(folder / "guide", *SHAPE)
    for size, picture in batches(sizes, 1.0, 0.0, 0, np.ones(4)):
        guide.add(size, picture)
        if guide.is_enough(LIMIT):
            break
    return guide


@pytest.mark.parametrize(("shared", "own", "most"), [(1.0, 0.02, 0.05), (0.3, 0.1, 0.1), (2.0, 0.1, 0.1)])
def test_a_band_with_few_paths_is_as_exact_as_the_guide_with_many(
    tmp_path: Path, shared: float, own: float, most: float
) -> None:
    sizes = list(batch_sizes(16, 6000))
    guide = guide_of(tmp_path, sizes)
    assert 0.6 * LIMIT < guide.moments.noise() <= LIMIT
    truth = np.array([0.1, 1.0, 3.0, 40.0])
    taken: list[int] = []
    follower = guide.correct(counted(batches(guide.sizes, shared, own, 1, truth), taken), LIMIT)
    assert sum(taken) <= most * guide.moments.paths
    assert follower.residual_noise <= 0.43 * LIMIT
    error = follower.picture / truth - 1.0
    stated = np.hypot(shared * guide.moments.noise(), follower.residual_noise)
    assert np.sqrt((error**2).mean()) == pytest.approx(stated, rel=0.25)
    assert abs(error.mean()) < 4.0 * stated / np.sqrt(np.prod(SHAPE))


def test_a_band_that_the_guide_does_not_explain_gets_all_paths(tmp_path: Path) -> None:
    guide = guide_of(tmp_path, list(batch_sizes(16, 6000)))
    pictures = list(batches(guide.sizes, 0.0, 1.0, 1, np.ones(4)))
    taken: list[int] = []
    follower = guide.correct(counted(pictures, taken), LIMIT)
    assert sum(taken) == guide.moments.paths
    mean = sum(size * picture for size, picture in pictures) / guide.moments.paths
    np.testing.assert_allclose(follower.picture, mean, rtol=1e-6)


def test_a_band_that_is_dark_stays_dark(tmp_path: Path) -> None:
    guide = guide_of(tmp_path, list(batch_sizes(16, 6000)))
    follower = guide.correct(batches(guide.sizes, 1.0, 0.0, 1, np.zeros(4)), LIMIT)
    assert not follower.picture.any()
    assert follower.residual_noise == 0.0


LAMP = {
    "kind": "area",
    "position_mm": [-200, 60, 300],
    "target_mm": [0, 0, 0],
    "width_mm": 60,
    "height_mm": 60,
    "luminance_cd_m2": 20000,
    "spectrum": illuminant("A"),
}


@pytest.fixture
def paths(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Paths through a pixel that each call of Mitsuba traced."""
    paths: list[int] = []
    picture = Renderer._picture

    def count(self: Renderer, scene: object, number: int, part: int, camera: object) -> object:
        paths.append(number)
        return picture(self, scene, number, part, camera)  # type: ignore[arg-type]

    monkeypatch.setattr(Renderer, "_picture", count)
    return paths


def test_a_picture_with_a_noise_limit_agrees_with_one_of_all_paths(paths: list[int]) -> None:
    """Gold under a lamp and a sky of other colours: what is noise in the red is steady in the blue."""
    lights = [LAMP, everywhere(illuminant("D65"), 400.0)]
    gold = {"kind": "gilt", "thickness_nm": 100, "uncovered": 0.1, "roughness": 0.3}
    most = {"samples": 2048, "bands": {"step_nm": 20}, "cameras": [camera(55.0, width_px=16, height_px=16)]}
    guided = rendered(scene([plane(gold)], lights, noise=LIMIT, **most))
    assert guided.noise is not None
    assert guided.noise <= LIMIT
    assert sum(paths) < 0.5 * 6 * guided.samples  # of six groups of bands
    true = rendered(scene([plane(gold)], lights, seed=99, **most)).radiance
    off = guided.radiance / true - 1.0
    of_truth = LIMIT * np.sqrt(guided.samples / 2048)
    assert np.sqrt((off**2).mean(axis=(0, 1))).max() < 1.3 * np.hypot(guided.noise, of_truth)
    assert np.abs(off.mean(axis=(0, 1))).max() < 4.0 * np.hypot(guided.noise, of_truth) / 16.0


def test_pictures_behind_polarisers_have_all_paths_in_all_bands(paths: list[int]) -> None:
    """They are subtracted: what the bands of one lack in noise would be noise of the difference."""
    grey = {"kind": "diffuse", "reflectance": {"kind": "constant", "value": 0.5}}
    many = {"samples": 64, "bands": {"step_nm": 40}, "polarisation": True}
    told: list[tuple[int, int]] = []
    wanted = scene([plane(grey)], [LAMP], noise=0.3, **many)
    with open_renderer(wanted, Path()) as renderer:
        rendering = renderer.render(wanted.cameras[0], lambda done, total: told.append((done, total)))
    assert sum(paths) == 4 * 3 * rendering.samples  # four filters, three groups of bands
    shares = [done / total for done, total in told]
    assert shares == sorted(shares)
    assert shares[-1] == 1.0
