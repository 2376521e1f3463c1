"""Proves `coupole sphere-brdf` on spheres of known finishes under ten lights, by Mitsuba and by formulas.

    python tools/prove_finishes.py [--radius-px R] [--noise SHARE]

Mitsuba renders gold of two roughnesses (its own rough conductor, an orthographic camera, directional lights). The
other spheres are formulas, averaged over 3 x 3 places in each pixel. All have noise. The MERL file is read back
and compared with the finish itself: at mirror directions, and at half vectors up to 15 degrees from the normal
with both directions at least 12 degrees above the horizon. The last rows have errors of the set-up: a centre or a
radius half a pixel off, or lights one degree off. Exits with 1 if the error of a peak up to 60 degrees is more
than 3 % on a sphere without such an error of the set-up, but not with `--smallest`.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT)]

from coupole.appearance.matter import brdf, merl_table  # noqa: E402
from coupole.appearance.optics import fresnel, indices  # noqa: E402
from coupole.exchange.bracket import sphere_brdf  # noqa: E402
from coupole.exchange.of_results.merl import encode_reflectance  # noqa: E402
from smallest import add_smallest  # noqa: E402

PEAKS_DEG = (2, 10, 20, 30, 40, 50, 60)
LIMIT = 0.03
WHITE = np.array([2.0, 1.5, 1.0])
_EYE = np.array([0.0, 0.0, 1.0])
_GOLD = fresnel.of_index(indices.gold()[[54, 34, 14]])
_PLACES = (-1.0 / 3.0, 0.0, 1.0 / 3.0)


def lights() -> list[np.ndarray]:
    """Return ten directions to lights, 5 to 140 degrees from the camera, around it."""
    angles = enumerate(np.radians(np.arange(5.0, 150.0, 15.0)))
    return [np.array([np.sin(a) * np.cos(n), np.sin(a) * np.sin(n), np.cos(a)]) for n, a in angles]


def lacquer_on_gold(wi: np.ndarray, wo: np.ndarray) -> np.ndarray:
    """Beckmann facets over a rough diffuse ground."""
    ground = brdf.oren_nayar(wi, wo, reflectance=[0.1, 0.05, 0.02], roughness=0.5)
    return brdf.cook_torrance(wi, wo, slope=0.2, fresnel=_GOLD) + ground


def two_facets(wi: np.ndarray, wo: np.ndarray) -> np.ndarray:
    """Two kinds of facets, of two shapes."""
    narrow = brdf.cook_torrance(wi, wo, slope=0.12, fresnel=_GOLD)
    return 0.6 * narrow + 0.4 * brdf.ggx(wi, wo, roughness=0.4, fresnel=_GOLD) + 0.002


def powder(wi: np.ndarray, wo: np.ndarray) -> np.ndarray:
    """GGX facets, with a small diffuse part."""
    return brdf.ggx(wi, wo, roughness=0.25, fresnel=_GOLD) + 0.01


class Mitsuba:
    """A finish of Mitsuba, which also renders its spheres."""

    def __init__(self, roughness: float, samples: int) -> None:
        import mitsuba

        mitsuba.set_variant("scalar_rgb")
        self._mitsuba, self._samples = mitsuba, samples
        self._about = {"type": "roughconductor", "material": "Au", "distribution": "ggx", "alpha": roughness}
        self._bsdf = mitsuba.load_dict(self._about)

    def __call__(self, wi: np.ndarray, wo: np.ndarray) -> np.ndarray:
        """1/sr [n, 3]."""
        mi, values = self._mitsuba, []
        for way_in, way_out in zip(wi, wo, strict=True):
            place = mi.SurfaceInteraction3f()
            place.wi = mi.Vector3f(*way_out.tolist())
            value = self._bsdf.eval(mi.BSDFContext(), place, mi.Vector3f(*way_in.tolist()))
            values.append(np.array(value).ravel() / way_in[2])
        return np.array(values)

    def photograph(self, to_light: np.ndarray, radius_px: float) -> np.ndarray:
        """[side, side, 3] of irradiance 1 at a plane that faces the light."""
        mi, side = self._mitsuba, _side(radius_px)
        look = mi.ScalarTransform4f().look_at(origin=[0, 0, 5], target=[0, 0, 0], up=[0, 1, 0])
        half = 0.5 * side / radius_px
        film = {"type": "hdrfilm", "width": side, "height": side, "rfilter": {"type": "box"}}
        scale = mi.ScalarTransform4f().scale([half, half, 1.0])
        scene = {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 2},
            "sensor": {"type": "orthographic", "to_world": look @ scale, "film": film},
            "light": {"type": "directional", "direction": (-to_light).tolist(), "irradiance": 1.0},
            "sphere": {"type": "sphere", "bsdf": self._about},
        }
        picture = mi.render(mi.load_dict(scene), spp=self._samples, seed=1)
        return np.asarray(np.array(picture)[..., :3] * np.pi / 0.99)


def formula_photograph(finish: Callable[..., np.ndarray], to_light: np.ndarray, radius_px: float) -> np.ndarray:
    """[side, side, 3] picture of a finish by a formula of the angles to the normal and between the two
    directions."""
    side = _side(radius_px)
    total = np.zeros((side * side, 3))
    for du in _PLACES:
        for dv in _PLACES:
            v, u = np.mgrid[:side, :side].astype(float)
            x, y = (u + du - side // 2) / radius_px, (side // 2 - v - dv) / radius_px
            z = np.sqrt(np.maximum(1.0 - x**2 - y**2, 0.0))
            n = np.stack([x, y, z], axis=2).reshape(-1, 3)
            z_i, z_o = n @ to_light, n @ _EYE
            lit = (z_i > 0.0) & (z_o > 0.0)
            sine_i, sine_o = np.sqrt(1.0 - z_i[lit] ** 2), np.sqrt(np.maximum(1.0 - z_o[lit] ** 2, 0.0))
            between = (to_light @ _EYE - z_i[lit] * z_o[lit]) / np.maximum(sine_i * sine_o, 1e-12)
            cosine = np.clip(between, -1.0, 1.0)
            wi = np.stack([sine_i, 0.0 * sine_i, z_i[lit]], axis=1)
            wo = np.stack([sine_o * cosine, sine_o * np.sqrt(1.0 - cosine**2), z_o[lit]], axis=1)
            total[lit] += finish(wi, wo) * wi[:, 2:]
    return total.reshape(side, side, 3) * np.pi / 0.99 / len(_PLACES) ** 2


def _side(radius_px: float) -> int:
    return 2 * int(radius_px + 5.0) + 1


def measure(
    finish: Any,
    radius_px: float,
    noise: float,
    *,
    centre_off_px: float,
    radius_off_px: float,
    light_off_deg: float,
) -> Callable[..., np.ndarray]:
    """Return the finish as its MERL file contains it."""
    rng, pictures = np.random.default_rng(1), []
    take = getattr(finish, "photograph", partial(formula_photograph, finish))
    for to_light in lights():
        picture = take(to_light, radius_px) * WHITE
        pictures.append((picture * rng.normal(1.0, noise, picture.shape)).astype(np.float32))
    turn = np.radians(light_off_deg)
    about_x = np.array([[1, 0, 0], [0, np.cos(turn), -np.sin(turn)], [0, np.sin(turn), np.cos(turn)]])
    middle = _side(radius_px) // 2 + centre_off_px
    sample = sphere_brdf.SphereSample(
        photographs=tuple(
            sphere_brdf.Lit(path=Path(f"{n}.exr"), to_light=tuple(about_x @ way)) for n, way in enumerate(lights())
        ),
        centre_px=(middle, middle),
        radius_px=radius_px + radius_off_px,
        white=sphere_brdf.White(values=tuple(WHITE)),
    )
    result = sphere_brdf.finish_of(sphere_brdf.samples_of(sample, pictures))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "finish.binary"
        path.write_bytes(encode_reflectance(sphere_brdf.finish_function(result)))
        return merl_table.read_merl(path)


def peak_errors(table: Callable[..., np.ndarray], finish: Any) -> np.ndarray:
    """Relative errors [angles] of the channel with the greatest error."""
    angle = np.radians(np.array(PEAKS_DEG, float))
    zero = np.zeros_like(angle)
    wi = np.stack([np.sin(angle), zero, np.cos(angle)], axis=1)
    off = table(wi, wi * [-1.0, 1.0, 1.0]) / finish(wi, wi * [-1.0, 1.0, 1.0]) - 1.0
    return np.asarray(off[np.arange(len(off)), np.argmax(np.abs(off), axis=1)])


def error_about_peaks(table: Callable[..., np.ndarray], finish: Any) -> float:
    """99 % quantile of the relative errors of directions whose half vector is within 15 degrees of the normal."""
    rng = np.random.default_rng(2)
    theta_h, theta_d, phi = (
        np.radians(15.0) * rng.random(3000),
        np.radians(70.0) * rng.random(3000),
        rng.random(3000),
    )
    half = np.stack([np.sin(theta_h), 0.0 * phi, np.cos(theta_h)], axis=1)
    first = np.stack([np.cos(theta_h), 0.0 * phi, -np.sin(theta_h)], axis=1)
    turn = 2.0 * np.pi * phi[:, None]
    across = np.cos(turn) * first + np.sin(turn) * np.array([0.0, 1.0, 0.0])
    wi, wo = (np.cos(theta_d)[:, None] * half + sign * np.sin(theta_d)[:, None] * across for sign in (1.0, -1.0))
    above = np.minimum(wi[:, 2], wo[:, 2]) > np.sin(np.radians(12.0))
    return float(np.quantile(np.abs(table(wi[above], wo[above]) / finish(wi[above], wo[above]) - 1.0), 0.99))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--radius-px", type=float, default=55.0)
    parser.add_argument("--noise", type=float, default=0.01, help="of values, relative")
    parser.add_argument("--samples", type=int, default=64, help="of Mitsuba, in a pixel")
    add_smallest(parser, radius_px=12.0, samples=4)
    options = parser.parse_args()
    straight = {"centre_off_px": 0.0, "radius_off_px": 0.0, "light_off_deg": 0.0}
    spheres: list[tuple[str, Any, dict[str, float]]] = [
        (f"Mitsuba, gold, alpha {alpha:g}", Mitsuba(alpha, options.samples), {}) for alpha in (0.25, 0.1)
    ]
    spheres += [("powdered", powder, {}), ("lacquered", lacquer_on_gold, {}), ("worn", two_facets, {})]
    spheres += [
        ("powdered, centre 0.5 px off", powder, {"centre_off_px": 0.5}),
        ("powdered, radius 0.5 px off", powder, {"radius_off_px": 0.5}),
        ("powdered, lights 1 degree off", powder, {"light_off_deg": 1.0}),
    ]
    worst = 0.0
    print(
        "sphere | peaks at " + ", ".join(f"{angle}" for angle in PEAKS_DEG) + " degrees, % off | 99 % about them"
    )
    for name, finish, mistake in spheres[:: len(spheres) - 1] if options.smallest else spheres:
        table = measure(finish, options.radius_px, options.noise, **(straight | mistake))
        peaks = peak_errors(table, finish)
        about = error_about_peaks(table, finish)
        print(f"{name} | " + ", ".join(f"{100 * peak:+.1f}" for peak in peaks) + f" | {100 * about:.1f}")
        worst = worst if mistake else max(worst, float(np.abs(peaks).max()))
    print(f"peaks up to {PEAKS_DEG[-1]} degrees without mistakes: off by up to {100 * worst:.1f} %")
    return int(not options.smallest and worst > LIMIT)


if __name__ == "__main__":
    sys.exit(main())
