"""Strangers by name: effects for which calibrations have no parameter, drawn for a random cell by its seed.

Each is as large as in real cells of this kind. Effects of the lens are given in pixels of frames 1024 px wide, and
scale with the width.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

Drawn = dict[str, Any]
Draw = Callable[[np.random.Generator], Drawn]
OF_WIDTH_PX = 1024
_LED_LOBE = ((0, 1.0), (15, 0.985), (30, 0.92), (45, 0.78), (60, 0.55), (75, 0.25), (85, 0.06), (90, 0.0))
"""An emission wider than the cosine, as of a power LED under a silicone dome (assumed)."""


def _normals(random: np.random.Generator, *sigmas: float) -> tuple[float, ...]:
    return tuple(float(sigma * random.standard_normal()) for sigma in sigmas)


def _rational(random: np.random.Generator) -> Drawn:
    return {"lens": {"rational": (float(random.uniform(0.5, 1.5)), *_normals(random, 0.1, 0.3))}}


def _prism(random: np.random.Generator) -> Drawn:
    s1, s3, s2, s4 = _normals(random, 5e-4, 5e-4, 2e-3, 2e-3)
    return {"lens": {"prism": (s1, s2, s3, s4)}}


def _coma(random: np.random.Generator) -> Drawn:
    return {"lens": {"coma_px": float(random.uniform(0.3, 0.8)), "coma_deg": float(random.uniform(0.0, 360.0))}}


def _bend(random: np.random.Generator) -> Drawn:
    sign = 1.0 if random.random() < 0.5 else -1.0
    return {"target": {"board_bend_um": 50.0 * sign, "board_bend_deg": float(random.uniform(0.0, 180.0))}}


def _backlash(random: np.random.Generator) -> Drawn:
    return {"arm": {"backlash_deg": tuple(np.abs(_normals(random, *[0.006] * 6)).tolist())}}


def _sag(random: np.random.Generator) -> Drawn:
    share = float(random.uniform(0.5, 1.5))
    return {"arm": {"sag_deg_per_nm": tuple(share * axis for axis in (0.0, 5e-5, 8e-5, 2e-4, 2e-4, 2e-4))}}


def _ripple(random: np.random.Generator) -> Drawn:
    phases = tuple(random.uniform(0.0, 360.0, 6).tolist())
    return {"arm": {"ripple_deg": (0.004,) * 6, "ripple_phase_deg": phases}}


STRANGERS: dict[str, Draw] = {
    "rational": _rational,
    "prism": _prism,
    "stop": lambda random: {"lens": {"stop_shift_mm": _normals(random, 0.4, 0.4)}},
    "breathing": lambda random: {"lens": {"breathing": _normals(random, 1e-3)[0]}},
    "coma": _coma,
    "lobe": lambda random: {"light": {"lobe": _LED_LOBE}},
    "dies": lambda random: {"light": {"die_tilt_deg": 2.0, "seed": int(random.integers(1 << 30))}},
    "primary": lambda random: {"light": {"primary_lens_mm": _normals(random, 0.2)[0]}},
    "bend": _bend,
    "tile": lambda random: {"target": {"tile_lobe": 0.02, "tile_stain": float(random.uniform(0.01, 0.05))}},
    "backlash": _backlash,
    "sag": _sag,
    "ripple": _ripple,
    "tails": lambda random: {"sensor": {"tails_dn": 12.0, "seed": int(random.integers(1 << 30))}},
    "exponents": lambda random: {"light": {"exponent_spread": 0.2, "seed": int(random.integers(1 << 30))}},
    "warming": lambda random: {"light": {"warming": 0.01, "warming_frames": float(random.uniform(100.0, 1000.0))}},
    "gain": lambda random: {"sensor": {"gain_drift": 0.01, "seed": int(random.integers(1 << 30))}},
}
"""The rig's `world.settings.strangers` by name."""


def draw_stranger(name: str | None, seed: int, width_px: int) -> Drawn:
    """Return the stranger of a cell; nothing without a name."""
    if name is None:
        return {}
    stranger = STRANGERS[name](np.random.default_rng((seed, 5)))
    if "coma_px" in stranger.get("lens", {}):
        stranger["lens"]["coma_px"] *= width_px / OF_WIDTH_PX
    return stranger
