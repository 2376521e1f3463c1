"""Makie taken apart, nashiji put together, and lacquer between them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from coupole.appearance.matter import lacquer, makie, nashiji
from coupole.appearance.matter.nashiji import Slab
from coupole.errors import InputError

METAL = np.array([0.55, 0.42, 0.16])
LACQUERS = np.array([[0.45, 0.05, 0.04], [0.03, 0.30, 0.06], [0.60, 0.62, 0.58]])
"""Red, green and white."""
SMALL = Slab(size_mm=(5.0, 5.0))
SHARE = st.floats(0.0, 1.0)


def unit(*xyz: float) -> np.ndarray:
    return np.array(xyz) / np.linalg.norm(xyz)


@settings(deadline=None, max_examples=40)
@given(p=SHARE, which=st.integers(0, 2))
def test_metal_over_one_lacquer_is_taken_apart_exactly(p: float, which: int) -> None:
    picture = p * METAL + (1.0 - p) * LACQUERS[which]

    found = makie.decompose(picture, METAL, LACQUERS)

    assert found.alpha == pytest.approx(p, abs=1e-9)
    assert found.residual == pytest.approx((1.0 - p) * LACQUERS[which], abs=1e-9)


@settings(deadline=None, max_examples=40)
@given(p=st.floats(0.0, 0.7), q=st.tuples(SHARE, SHARE, SHARE))
def test_alpha_is_never_too_small_and_the_rest_never_needs_negative_lacquer(
    p: float, q: tuple[float, float, float]
) -> None:
    weights = (1.0 - p) * np.array(q) / max(sum(q), 1e-9)
    picture = p * METAL + weights @ LACQUERS

    found = makie.decompose(picture, METAL, LACQUERS)

    assert found.alpha >= p - 1e-9
    assert np.all(np.linalg.solve(LACQUERS.T, found.residual) >= -1e-9)


@settings(deadline=None, max_examples=40)
@given(p=SHARE, q=st.tuples(st.floats(0.01, 1.0), st.floats(0.01, 1.0), st.floats(0.01, 1.0)))
def test_inside_the_drawing_alpha_is_exact_though_all_lacquers_meet(
    p: float, q: tuple[float, float, float]
) -> None:
    weights = (1.0 - p) * np.array(q) / sum(q)

    found = makie.decompose(p * METAL + weights @ LACQUERS, METAL, LACQUERS, region="inside")

    assert found.alpha == pytest.approx(p, abs=1e-9)


@settings(deadline=None, max_examples=40)
@given(p=SHARE, q=SHARE, count=st.integers(1, 2))
def test_with_one_or_two_lacquers_any_mixture_is_taken_apart(p: float, q: float, count: int) -> None:
    weights = np.array([q, 1.0 - q])[:count]

    found = makie.decompose(p * METAL + weights @ LACQUERS[:count], METAL, LACQUERS[:count])

    assert found.alpha == pytest.approx(p, abs=1e-9)
    assert found.residual == pytest.approx(weights @ LACQUERS[:count], abs=1e-9)


def test_a_pixel_brighter_than_metal_is_clamped_and_counted() -> None:
    picture = np.stack([1.3 * METAL, 0.5 * METAL + 0.5 * LACQUERS[0]])

    found = makie.decompose(picture, METAL, LACQUERS)

    assert found.alpha == pytest.approx([1.0, 0.5])
    assert found.clamped_share == 0.5


def test_a_whole_picture_is_taken_apart_as_its_pixels_are() -> None:
    rng = np.random.default_rng(6)
    alpha = rng.uniform(0.0, 1.0, (12, 9))
    lacquer_of = rng.integers(0, 3, (12, 9))
    picture = alpha[..., None] * METAL + (1.0 - alpha[..., None]) * LACQUERS[lacquer_of]

    found = makie.decompose(picture, METAL, LACQUERS)

    assert found.alpha == pytest.approx(alpha, abs=1e-9)
    assert found.residual + found.alpha[..., None] * METAL == pytest.approx(picture)


def test_lacquers_of_dependent_colours_are_refused() -> None:
    with pytest.raises(InputError, match="lie in one plane"):
        makie.decompose(METAL, METAL, [LACQUERS[0], LACQUERS[1], LACQUERS[0] + LACQUERS[1]])


def test_a_metal_that_averages_the_lacquers_cannot_be_told_by_the_sum() -> None:
    with pytest.raises(InputError, match="sum to 1"):
        makie.decompose(METAL, LACQUERS.mean(axis=0), LACQUERS, region="inside")


def test_lacquer_takes_more_on_a_slanted_way() -> None:
    absorption = lacquer.urushi_absorption()

    straight, slanted = lacquer.transmittance(0.2, np.array([1.0, 0.3]), absorption)

    assert np.all(slanted < straight)
    assert straight == pytest.approx(np.exp(-0.2 * absorption))
    # Snell: the way inside is depth over sqrt(1 - sin^2/n^2).
    assert slanted == pytest.approx(np.exp(-0.2 * absorption / np.sqrt(1.0 - (1.0 - 0.09) / 1.53**2)))


@settings(deadline=None, max_examples=40)
@given(absorption=st.floats(0.0, 30.0), thickness_mm=st.floats(0.02, 0.3))
def test_absorption_comes_back_from_a_films_transmittance(absorption: float, thickness_mm: float) -> None:
    f, inside = (0.53 / 2.53) ** 2, np.exp(-absorption * thickness_mm)
    measured = (1.0 - f) ** 2 * inside / (1.0 - (f * inside) ** 2)

    assert lacquer.absorption_from(measured, thickness_mm) == pytest.approx(absorption, rel=1e-6, abs=1e-9)


def test_the_same_seed_gives_the_same_flakes() -> None:
    one, again, other = (nashiji.flakes(Slab(size_mm=(5.0, 5.0), seed=seed)) for seed in (3, 3, 4))

    assert np.array_equal(one.centres_mm, again.centres_mm)
    assert len(one.centres_mm) != len(other.centres_mm) or not np.array_equal(one.centres_mm, other.centres_mm)


@settings(deadline=None, max_examples=20)
@given(tilt_deg=st.floats(0.0, 25.0), seed=st.integers(0, 1000), thickness=st.floats(0.0005, 0.02))
def test_every_flake_is_in_the_lacquer(tilt_deg: float, seed: int, thickness: float) -> None:
    slab = Slab(size_mm=(3.0, 3.0), depth_mm=3.0, tilt_deg=tilt_deg, seed=seed, flake_thickness_mm=thickness)

    corners, _ = nashiji.triangulate(nashiji.flakes(slab))

    assert np.all(corners[:, 2] <= 1e-12)
    assert np.all(corners[:, 2] >= -3.0 - 1e-12)


def test_flakes_too_steep_for_the_lacquer_are_refused() -> None:
    with pytest.raises(InputError, match="make the lacquer deeper"):
        nashiji.flakes(Slab(depth_mm=0.05, tilt_deg=20.0))


def test_flakes_are_closed_surfaces_that_face_outwards() -> None:
    import trimesh

    found = nashiji.flakes(SMALL)

    mesh = trimesh.Trimesh(*nashiji.triangulate(found), process=False)

    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.volume > 0.0
    assert mesh.body_count == len(found.centres_mm)


def test_corners_lie_on_their_superquadric() -> None:
    found = nashiji.flakes(SMALL)
    corners, _ = nashiji.triangulate(found)
    away = corners.reshape(len(found.centres_mm), -1, 3) - found.centres_mm[:, None]
    local = np.einsum("nij,nmi->nmj", found.slab_from_flake, away) / found.half_axes_mm[:, None]

    e1, e2 = found.slab.roundness
    x, y, z = np.moveaxis(np.abs(local), -1, 0)
    inside_out = (x ** (2.0 / e2) + y ** (2.0 / e2)) ** (e2 / e1) + z ** (2.0 / e1)
    assert inside_out == pytest.approx(1.0, abs=1e-6)


def test_flakes_have_the_density_tilt_and_size_that_were_asked_for() -> None:
    found = nashiji.flakes(Slab(size_mm=(40.0, 40.0)))

    assert len(found.centres_mm) == pytest.approx(9600, rel=0.05)
    slopes = found.normals[:, :2] / found.normals[:, 2:]
    assert np.degrees(np.arctan(np.sqrt(np.mean(np.sum(slopes**2, axis=1))))) == pytest.approx(8.0, rel=0.05)
    radius = np.sqrt(found.half_axes_mm[:, 0] * found.half_axes_mm[:, 1])
    assert np.median(radius) == pytest.approx(0.12, rel=0.02)
