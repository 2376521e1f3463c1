"""What a cable shades in part is left out, and little else: on samples of which it is known what was shaded."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from triangle_cases import noisy_case

from coupole.reflectance.contradictions import Neighbours, contradiction_mask
from coupole.reflectance.triangle_fit import TriangleMaterials, TriangleSamples, fit_triangles

NOISE = np.float16(0.01)


@pytest.fixture(scope="module")
def shiny() -> TriangleSamples:
    return noisy_case(1, leds=300)[0]


def found(samples: TriangleSamples, fitted: TriangleMaterials | None = None) -> np.ndarray:
    materials = fitted or fit_triangles(samples, np.ones(len(samples.led_mm), bool), 30.0)
    beside = Neighbours.of(samples.led_mm, samples.centres_mm.mean(axis=0))
    return contradiction_mask(samples, materials, np.full(samples.values.shape, NOISE), beside)


def test_of_what_nothing_shades_nothing_is_left_out(shiny: TriangleSamples) -> None:
    assert found(shiny).mean() < 1e-3


def test_of_samples_that_lost_more_than_half_of_their_light_many_are_found(shiny: TriangleSamples) -> None:
    """A strip of LEDs as a cable hides it, from every second triangle; where a lobe is most of the light
    nothing is said."""
    ways = shiny.led_mm - shiny.centres_mm.mean(axis=0)
    strip = np.abs(ways[:, 0] - 0.4 * ways[:, 2]) < 0.015 * np.linalg.norm(ways, axis=1)
    assert 3 < strip.sum() < 12
    values = shiny.values.copy()
    values[::2, strip] *= 0.4
    lit = np.isfinite(values).any(axis=2)
    dark = found(replace(shiny, values=values))
    assert dark[::2][:, strip][lit[::2][:, strip]].mean() > 0.4
    assert dark[1::2].mean() < 1e-3
    assert dark[:, ~strip].mean() < 2e-3


def test_a_triangle_that_is_darker_throughout_contradicts_nothing(shiny: TriangleSamples) -> None:
    """The material is what is wrong of it, not the light."""
    materials = fit_triangles(shiny, np.ones(len(shiny.led_mm), bool), 30.0)
    assert not found(replace(shiny, values=0.5 * shiny.values), materials).any()


def test_one_channel_alone_is_no_shadow(shiny: TriangleSamples) -> None:
    values = shiny.values.copy()
    values[:, 100:110, 1] *= 0.3
    assert found(replace(shiny, values=values)).mean() < 1e-3


def test_nothing_is_left_out_where_noise_is_not_known_or_there_is_one_led(shiny: TriangleSamples) -> None:
    values = shiny.values.copy()
    values[::2, 20] *= 0.4
    dim = replace(shiny, values=values)
    materials = fit_triangles(dim, np.ones(len(shiny.led_mm), bool), 30.0)
    beside = Neighbours.of(shiny.led_mm, shiny.centres_mm.mean(axis=0))
    assert contradiction_mask(dim, materials, np.full(values.shape, NOISE), beside).any()
    assert not contradiction_mask(dim, materials, np.full(values.shape, np.nan, np.float16), beside).any()
    alone = replace(dim, values=values[:, 20:21], led_mm=shiny.led_mm[20:21], view_of=shiny.view_of[20:21])
    beside = Neighbours.of(alone.led_mm, alone.centres_mm.mean(axis=0))
    assert not contradiction_mask(alone, materials, np.full(alone.values.shape, NOISE), beside).any()
