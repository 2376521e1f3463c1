"""GGX's lobe beside Mitsuba's."""

import math

import numpy as np
import pytest

from coupole.reflectance.ggx import lobe


def unit(theta_deg: float, phi_deg: float) -> np.ndarray:
    theta, phi = math.radians(theta_deg), math.radians(phi_deg)
    return np.array([math.sin(theta) * math.cos(phi), math.sin(theta) * math.sin(phi), math.cos(theta)])


@pytest.mark.parametrize("alpha", [0.05, 0.2, 0.6, 1.0])
@pytest.mark.parametrize("view", [(0, 0), (35, 10), (70, 200)])
@pytest.mark.parametrize("light", [(5, 40), (40, 190), (75, 20)])
def test_the_lobe_is_that_of_an_independent_renderer(
    alpha: float, view: tuple[float, float], light: tuple[float, float]
) -> None:
    import mitsuba as mi

    mi.set_variant("scalar_rgb")
    mirror = mi.load_dict({"type": "roughconductor", "material": "none", "distribution": "ggx", "alpha": alpha})
    v, l = unit(*view), unit(*light)  # noqa: E741
    place = mi.SurfaceInteraction3f()
    place.wi = mi.Vector3f(*v)
    theirs = mirror.eval(mi.BSDFContext(), place, mi.Vector3f(*l))[0]
    a, b = (0.5 * (math.sqrt(1 + (alpha * math.hypot(d[0], d[1]) / d[2]) ** 2) - 1) for d in (v, l))
    theirs *= (1 + a) * (1 + b) / (1 + a + b)  # theirs hide light and view each by itself; ours both by height
    h = (v + l) / np.linalg.norm(v + l)
    assert l[2] * lobe(l[2], v[2], h[2], alpha)[0] == pytest.approx(theirs, rel=2e-4)


def test_its_derivatives_are_those_of_small_steps() -> None:
    at = np.array([0.6, 0.7, 0.95, 0.3])
    for number, derivative in enumerate(lobe(*at)[1:]):
        step = np.zeros(4)
        step[number] = 1e-6
        assert derivative == pytest.approx((lobe(*(at + step))[0] - lobe(*(at - step))[0]) / 2e-6, rel=1e-6)
