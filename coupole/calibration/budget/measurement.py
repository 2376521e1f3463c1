"""The measurement equation: from a pixel's value to a reflectance (Lucat et al. 2025, Eq. 3).

Camera and LEDs are calibrated in the same digital numbers (`calibration.light.led_power`). So the constants of Eq.
1, with pi, are both in the numerator and in the denominator, and

    f = V / (t g Phi_k e(x, n, l_k, n_k)),        e = E / Phi of `coupole.calibration.light.irradiance`, in m^-2,

Here V is the linearised signal above dark (DN), t the exposure (s), g the flat field, and Phi_k the LED's power
(DN s^-1 m^2 sr). The emission profile enters through e: `lambertian`, or `paper`, which has the emitter's cosine
twice. If a pixel is projected onto the wrong place of the mesh, it brings its neighbour's value. So a change of
albedo along the surface enters f as well.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from coupole.calibration.light.irradiance import Emission, irradiance_per_flux
from coupole.calibration.rotations import Floats

VERTICES = tuple(f"vertex{i}.{axis}_mm" for i in range(3) for axis in "xyz")
LED_PLACE = tuple(f"led.{axis}_mm" for axis in "xyz")
LED_TURN = ("led.turn1_deg", "led.turn2_deg")
SEEN_OFF = ("lens.x_mm", "camera.x_mm")
"""Error of a pixel's place on the mesh, along the steepest change of albedo."""
MESH_STEP = (*(f"mesh.{axis}_mm" for axis in "xyz"), *(f"mesh.r{axis}_deg" for axis in "xyz"))


def reflectance(
    signal_dn: ArrayLike,
    exposure_s: ArrayLike,
    flat: ArrayLike,
    power: ArrayLike,
    lit_per_m2: ArrayLike,
) -> Floats:
    """Return f in 1/sr; all arguments are broadcast. `lit_per_m2` is the surface's irradiance over the LED's flux
    (`irradiance_per_flux`). f is infinite for an LED below the horizon."""
    factors = (signal_dn, exposure_s, flat, power, lit_per_m2)
    signal, t, g, phi, lit = (np.asarray(value, float) for value in factors)
    with np.errstate(divide="ignore"):
        value: Floats = signal / (t * g * phi * lit)
    return value


def reflectance_of(q: Mapping[str, Floats], led_normal: Floats, *, emission: Emission = "lambertian") -> Floats:
    """Evaluate the measurement equation for a sample on a triangle. `q` has the quantities [trials] by name.

    Point and normal are computed from the triangle's `VERTICES` in the base frame, moved by `MESH_STEP` (a small
    step of base_from_mesh about the triangle's middle). The LED's normal [3] is turned by `LED_TURN` about two
    axes across it. `response`, `flat_field`, `power.own`, `power.common` and `drift` are factors about 1.
    `veil_dn` is the remaining glare over the pixel. The mesh's step along x and `SEEN_OFF` are the error of the
    seen place on the surface. The albedo changes there by `contrast_per_mm`.
    """
    corners = np.stack([q[name] for name in VERTICES], axis=-1)
    corners = corners.reshape(*corners.shape[:-1], 3, 3)
    point = corners.mean(axis=-2)
    normal = np.cross(corners[..., 1, :] - corners[..., 0, :], corners[..., 2, :] - corners[..., 0, :])
    normal = normal / np.linalg.norm(normal, axis=-1, keepdims=True)
    step = np.stack([q[name] for name in MESH_STEP], axis=-1)
    point = point + step[..., :3]
    normal = _turned_vectors(normal, np.radians(step[..., 3:]))
    led = np.stack([q[name] for name in LED_PLACE], axis=-1)
    across = np.linalg.svd(led_normal[None])[2][1:]
    turns = np.radians(np.stack([q[name] for name in LED_TURN], axis=-1)) @ across
    beside_mm = q[SEEN_OFF[0]] + q[SEEN_OFF[1]] - step[..., 0]
    power = q["power_dn_m2_sr_per_s"] * q["power.own"] * q["power.common"] * q["drift"]
    led_axis = _turned_vectors(np.broadcast_to(led_normal, led.shape), turns)
    return reflectance(
        (q["signal_dn"] * (1.0 + q["contrast_per_mm"] * beside_mm) - q["veil_dn"]) * q["response"],
        q["exposure_s"],
        q["flat"] * q["flat_field"],
        power,
        irradiance_per_flux(point, normal, led, led_axis, emission=emission),
    )


def _turned_vectors(vectors: Floats, turns_rad: Floats) -> Floats:
    """Return vectors [..., 3] turned by small rotation vectors [..., 3], to second order, with unit length."""
    once = np.cross(turns_rad, vectors)
    turned_vectors = vectors + once + 0.5 * np.cross(turns_rad, once)
    result: Floats = turned_vectors / np.linalg.norm(turned_vectors, axis=-1, keepdims=True)
    return result
