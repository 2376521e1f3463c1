"""The object's surface as views of a run are judged on it, without calibration records.

Views are compared with each other before a result exists. So only the geometry is exact here: which parts a view
shows, which LEDs light them, and at which angles. Power of the LEDs, exposure and noise are usual values: the
exposure suits a white surface.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from coupole.geometry import apply, inverse
from coupole.plan.rig import Sensor
from coupole.preflight.job import Job
from coupole.reflectance.extraction.radiance import RANGE_LEFT_OUT
from coupole.reflectance.suggestion.supposed_signal import (
    CameraNoise,
    Surface,
    triangles_of_parts,
    upright_per_flux,
)

Floats = NDArray[np.float64]

_WHITE_REACHES = 0.6
"""Share of the camera's range that white reaches under the brightest LEDs, in the plan's longest exposure."""
_FULL_WELL_E = 10_000.0
_READ_NOISE = 1e-3
"""Noise of a dark pixel, as a share of the camera's range."""
_U_LED_POWER, _U_LED_MM = 0.01, 0.5


def supposed_surface(job: Job) -> Surface:
    """Return the parts of the job's object, and the light that reaches them without shadows."""
    rig, leds, patches = job.cell.rig, job.cell.leds, job.motion.occlusions.patches
    support_from_base = inverse(rig.support.base_from_support.matrix())
    leds_mm = apply(support_from_base, leds.positions_mm)
    axes = leds.normals @ support_from_base[:3, :3].T
    upright = upright_per_flux(patches.points_mm, leds_mm, axes, rig.dome.emission) * leds.flux_lm
    triangles, areas_mm2 = triangles_of_parts(patches, job.shape.corners_mm)
    of_1_dn = Surface(
        patches.points_mm,
        patches.normals,
        areas_mm2,
        triangles,
        leds_mm,
        upright[:, :, None],
        np.full(len(leds_mm), _U_LED_POWER),
        0.0,
        _U_LED_MM,
        _usual_noise(rig.sensor),
    )
    brightest = float(np.quantile(of_1_dn.signal_per_f, 0.99))
    longest_s = max(job.plan.exposure.exposures_us) * 1e-6
    dn_per_s = _WHITE_REACHES * (rig.sensor.white_dn - rig.sensor.black_dn) * np.pi / (brightest * longest_s)
    return replace(of_1_dn, signal_upright=of_1_dn.signal_upright * dn_per_s)


def _usual_noise(sensor: Sensor) -> CameraNoise:
    range_dn = sensor.white_dn - sensor.black_dn
    left_out_dn = RANGE_LEFT_OUT * range_dn
    in_dark_dn2, gain_dn = (_READ_NOISE * range_dn) ** 2, range_dn / _FULL_WELL_E
    return CameraNoise(
        np.array([in_dark_dn2]), np.array([gain_dn]), left_out_dn, range_dn - left_out_dn, np.ones(1)
    )
