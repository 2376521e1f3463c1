"""Lambert plus GGX of one point under known lights, and its derivatives.

The radiance towards v under a distant light of unit irradiance from l, divided by nothing else, is

    (n l) (kd + ks D V)

with the normal n, the half vector h of l and v, GGX's distribution
D = alpha^2 / (pi ((n h)^2 (alpha^2 - 1) + 1)^2) (Walter et al. 2007, eq. 33) and the height-correlated Smith term
V = G / (4 (n l) (n v)) = 1 / (2 (n l) B + 2 (n v) A), A^2 = alpha^2 + (1 - alpha^2) (n l)^2, B the same of n v
(Heitz 2014, eq. 99). The Fresnel term is part of ks.
"""

from __future__ import annotations

import math

import numba

KD, KS, ALPHA = range(3)


@numba.njit(cache=True, nogil=True)
def lobe(nl, nv, nh, alpha):  # type: ignore[no-untyped-def]
    """D V and its derivatives by n l, n v, n h and alpha. All cosines must be positive."""
    alpha2 = alpha * alpha
    t = nh * nh * (alpha2 - 1.0) + 1.0
    d = alpha2 / (math.pi * t * t)
    a = math.sqrt(alpha2 + (1.0 - alpha2) * nl * nl)
    b = math.sqrt(alpha2 + (1.0 - alpha2) * nv * nv)
    s = nl * b + nv * a
    value = 0.5 * d / s
    by_nl = -value / s * (b + nv * (1.0 - alpha2) * nl / a)
    by_nv = -value / s * (a + nl * (1.0 - alpha2) * nv / b)
    by_nh = -4.0 * nh * (alpha2 - 1.0) / t * value
    by_alpha = value * (2.0 / alpha - 4.0 * alpha * nh * nh / t)
    by_alpha -= value / s * alpha * (nl * (1.0 - nv * nv) / b + nv * (1.0 - nl * nl) / a)
    return value, by_nl, by_nv, by_nh, by_alpha


@numba.njit(cache=True, nogil=True, error_model="numpy")
def shine(nl, nv, nh, alpha):  # type: ignore[no-untyped-def]
    """D V alone, for pictures."""
    alpha2 = alpha * alpha
    t = nh * nh * (alpha2 - 1.0) + 1.0
    a = math.sqrt(alpha2 + (1.0 - alpha2) * nl * nl)
    b = math.sqrt(alpha2 + (1.0 - alpha2) * nv * nv)
    return 0.5 * alpha2 / (math.pi * t * t * (nl * b + nv * a))
