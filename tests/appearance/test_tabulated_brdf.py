"""The table in specular coordinates: how few entries do."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import RegularGridInterpolator

from coupole.appearance.matter import brdf, hemisphere, tabulated
from coupole.appearance.matter.brdf import Brdf
from coupole.appearance.optics import fresnel, indices
from coupole.appearance.spectra.grid import Array
from coupole.errors import InputError

GOLD = indices.gold()[[14, 34, 54]]


def lobe(roughness: float) -> Brdf:
    return partial(brdf.ggx, roughness=roughness, fresnel=fresnel.of_index(GOLD))


def directions_about(wi: Array, roughness: float) -> Array:
    """Ways out, half of them in and about the lobe, half anywhere, none within 3 degrees of the horizon."""
    rng = np.random.default_rng(2)
    incidence = np.full(4000, np.arccos(wi[2]))
    _, near = tabulated.from_specular(
        incidence, np.abs(rng.normal(0.0, 3.0 * roughness, 4000)), rng.uniform(-np.pi, np.pi, 4000)
    )
    anywhere = hemisphere.directions(rng.uniform(0.05, 1.0, 4000), rng.uniform(0.0, 2.0 * np.pi, 4000))
    return np.concatenate([near[near[:, 2] > 0.05], anywhere])


def worst_over_peak(found: Array, true: Array) -> float:
    return float(np.abs(found - true).max() / true.max())


def uniform_grid_error(f: Brdf, wi: Array, wo: Array, side: int) -> float:
    """Of a table uniform in the polar angles of wo, `side` by `side` entries over half the azimuths."""
    polar, azimuth = np.linspace(0.0, 0.5 * np.pi - 1e-3, side), np.linspace(0.0, np.pi, side)
    grid = hemisphere.directions(np.cos(polar)[:, None], azimuth)
    values = f(np.broadcast_to(wi, grid.shape), grid)
    look_up = RegularGridInterpolator((polar, azimuth), values)
    at = np.stack([np.arccos(wo[:, 2]), np.abs(np.arctan2(wo[:, 1], wo[:, 0]))], axis=1)
    return worst_over_peak(look_up(at), f(np.broadcast_to(wi, wo.shape), wo))


@pytest.mark.parametrize(("roughness", "side"), [(0.1, 173), (0.05, 316)])
def test_280_entries_do_better_than_a_uniform_grid_of_30_or_100_thousand(roughness: float, side: int) -> None:
    f, wi = lobe(roughness), np.array([np.sin(np.pi / 4), 0.0, np.cos(np.pi / 4)])
    wo = directions_about(wi, roughness)
    table = tabulated.tabulate(f, np.array([45.0]), theta_nodes=40, phi_nodes=7)

    assert table.log_cosines.shape[1] * table.log_cosines.shape[2] == 280
    coordinates = tabulated.specular_coordinates(np.broadcast_to(wi, wo.shape), wo)
    found = tabulated.look_up(*coordinates, table)
    ours = worst_over_peak(found, f(np.broadcast_to(wi, wo.shape), wo))
    assert ours < uniform_grid_error(f, wi, wo, side)
    assert ours < 2e-3


def test_more_entries_miss_less() -> None:
    f, wi = lobe(0.1), np.array([0.6, 0.0, 0.8])
    wo = directions_about(wi, 0.1)
    true = f(np.broadcast_to(wi, wo.shape), wo)
    incidence_deg = np.degrees(np.arccos([0.8]))
    coordinates = tabulated.specular_coordinates(np.broadcast_to(wi, wo.shape), wo)

    errors = [
        worst_over_peak(
            tabulated.look_up(*coordinates, tabulated.tabulate(f, incidence_deg, theta_nodes=t, phi_nodes=p)), true
        )
        for t, p in ((15, 5), (30, 7), (60, 9))
    ]

    assert errors[0] > 2.0 * errors[1] > 4.0 * errors[2]


def test_a_whole_table_gives_back_its_source_at_any_angle() -> None:
    f = lobe(0.15)
    table = tabulated.tabulate(f, np.arange(0.0, 81.0, 2.5))
    rng = np.random.default_rng(4)
    wi, wo = (hemisphere.directions(rng.uniform(0.35, 1.0, 3000), rng.uniform(0.0, 6.3, 3000)) for _ in range(2))

    assert worst_over_peak(tabulated.tabulated_brdf(wi, wo, table=table), f(wi, wo)) < 3e-3


@settings(deadline=None, max_examples=40)
@given(
    incidence=st.floats(0.01, 1.5),
    theta=st.floats(0.01, 3.0),
    phi=st.floats(0.0, np.pi),
    azimuth=st.floats(0.0, 6.28),
)
def test_specular_coordinates_come_back_at_any_azimuth(
    incidence: float, theta: float, phi: float, azimuth: float
) -> None:
    wi, wo = tabulated.from_specular(np.array([incidence]), np.array([theta]), np.array([phi]))
    turn = np.array(
        [[np.cos(azimuth), -np.sin(azimuth), 0.0], [np.sin(azimuth), np.cos(azimuth), 0.0], [0.0, 0.0, 1.0]]
    )

    found = tabulated.specular_coordinates(wi @ turn.T, wo @ turn.T)

    assert np.concatenate(found) == pytest.approx([incidence, theta, phi], abs=1e-6)


def test_the_mirror_direction_is_theta_zero() -> None:
    wi, wo = np.array([[0.36, 0.48, 0.8]]), np.array([[-0.36, -0.48, 0.8]])

    assert tabulated.specular_coordinates(wi, wo)[1] == pytest.approx(0.0, abs=1e-9)


@settings(deadline=None, max_examples=40)
@given(half_angle=st.floats(0.05, 0.7), polar=st.floats(0.01, 0.7), azimuth=st.floats(-np.pi, np.pi))
def test_theta_on_a_sphere_follows_the_papers_curves(half_angle: float, polar: float, azimuth: float) -> None:
    # Light and eye at +- half_angle in the plane y = 0; normal at (polar, azimuth) about their middle, so that
    # sin(theta/2) = sin(polar) sqrt(1 - sin(half_angle)^2 sin(azimuth)^2).
    light = np.array([np.sin(half_angle), 0.0, np.cos(half_angle)])
    eye = light * [-1.0, 1.0, 1.0]
    normal = hemisphere.directions(np.cos(np.array(polar)), np.array(azimuth))
    mirrored = 2.0 * (light @ normal) * normal - light

    theta = np.arctan2(np.linalg.norm(np.cross(mirrored, eye)), mirrored @ eye)

    expected = np.sin(polar) * np.sqrt(1.0 - (np.sin(half_angle) * np.sin(azimuth)) ** 2)
    assert np.sin(0.5 * theta) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("incidence_deg", [[30.0, 20.0], [0.0, 90.0], [-5.0, 10.0]])
def test_angles_that_make_no_table_are_refused(incidence_deg: list[float]) -> None:
    with pytest.raises(InputError, match="below 90"):
        tabulated.tabulate(lobe(0.2), np.array(incidence_deg))
