"""Lambert plus GGX model of one point under known lights, and its derivatives.

The radiance towards v under a distant light of unit irradiance from l is

    (n l) (kd + ks D V)

with the normal n, the half vector h of l and v, GGX's distribution
D = alpha^2 / (pi ((n h)^2 (alpha^2 - 1) + 1)^2) (Walter et al. 2007, eq. 33) and the height-correlated Smith term
V = G / (4 (n l) (n v)) = 1 / (2 (n l) B + 2 (n v) A), A^2 = alpha^2 + (1 - alpha^2) (n l)^2, B the same of n v
(Heitz 2014, eq. 99). The Fresnel term is part of ks.

Rays are drawn from the lobe by Heitz, Sampling the GGX distribution of visible normals (2018).
"""

from __future__ import annotations

import math

from coupole.kernels import kernel

UNKNOWNS = 5
"""Number of unknowns of a fit: two tilts of the normal along its `tangents`, and the logarithms of kd, ks and
alpha."""


@kernel
def lobe(nl, nv, nh, alpha):  # type: ignore[no-untyped-def]
    """Return D V and its derivatives by n l, n v, n h and alpha. All cosines must be positive."""
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


@kernel
def tangents(x, y, z):  # type: ignore[no-untyped-def]
    """Return two unit vectors perpendicular to a unit vector (Duff et al. 2017)."""
    sign = 1.0 if z >= 0.0 else -1.0
    a = -1.0 / (sign + z)
    b = x * y * a
    return (1.0 + sign * x * x * a, sign * b, -sign * x), (b, sign + y * y * a, -y)


@kernel
def root_by_unknowns(normal, t1, t2, light, half, nv, v1, v2, kd, ks, alpha, row):  # type: ignore[no-untyped-def]
    """Return the square root of the radiance, and write its derivatives with respect to the unknowns to `row`; n l
    must be positive. The view is given by its components nv, v1, v2 along the normal and the tangents t1, t2."""
    nl = normal[0] * light[0] + normal[1] * light[1] + normal[2] * light[2]
    nh = normal[0] * half[0] + normal[1] * half[1] + normal[2] * half[2]
    value, by_nl, by_nv, by_nh, by_alpha = lobe(nl, nv, nh, alpha)
    root = math.sqrt(nl * (kd + ks * value))
    to_root = 0.5 / root
    by_light = kd + ks * value + nl * ks * by_nl
    by_view, by_half = nl * ks * by_nv, nl * ks * by_nh
    l1 = t1[0] * light[0] + t1[1] * light[1] + t1[2] * light[2]
    l2 = t2[0] * light[0] + t2[1] * light[1] + t2[2] * light[2]
    h1 = t1[0] * half[0] + t1[1] * half[1] + t1[2] * half[2]
    h2 = t2[0] * half[0] + t2[1] * half[1] + t2[2] * half[2]
    row[0] = to_root * (by_light * l1 + by_view * v1 + by_half * h1)
    row[1] = to_root * (by_light * l2 + by_view * v2 + by_half * h2)
    row[2] = to_root * nl * kd
    row[3] = to_root * nl * ks * value
    row[4] = to_root * nl * ks * by_alpha * alpha
    return root


@kernel(error_model="numpy")
def shine(nl, nv, nh, alpha):  # type: ignore[no-untyped-def]
    """Return D V, the specular term of GGX without ks, for pictures."""
    alpha2 = alpha * alpha
    t = nh * nh * (alpha2 - 1.0) + 1.0
    a = math.sqrt(alpha2 + (1.0 - alpha2) * nl * nl)
    b = math.sqrt(alpha2 + (1.0 - alpha2) * nv * nv)
    return 0.5 * alpha2 / (math.pi * t * t * (nl * b + nv * a))


@kernel(error_model="numpy")
def lobe_density(nv, nh, alpha):  # type: ignore[no-untyped-def]
    """Return the probability density, per sr, that a ray drawn from a lobe takes a direction (Heitz 2018, eq.
    17)."""
    alpha2 = alpha * alpha
    t = nh * nh * (alpha2 - 1.0) + 1.0
    return 0.5 * alpha2 / (math.pi * t * t * (nv + math.sqrt(alpha2 + (1.0 - alpha2) * nv * nv)))


@kernel(error_model="numpy")
def sample_reflection(normal, v0, v1, v2, nv, alpha, first, second, way):  # type: ignore[no-untyped-def]
    """Fill `way` [3] with the view (unit, nv to the normal) mirrored at a microfacet normal that is visible from
    it. Two numbers from 0 to 1 choose this normal; return its cosine (Heitz 2018, listing 1)."""
    x, y, z = normal[0], normal[1], normal[2]
    if abs(z) < 0.9:
        length = math.sqrt(x * x + y * y)
        t0, t1, t2 = -y / length, x / length, 0.0
    else:
        length = math.sqrt(y * y + z * z)
        t0, t1, t2 = 0.0, -z / length, y / length
    b0, b1, b2 = y * t2 - z * t1, z * t0 - x * t2, x * t1 - y * t0
    e0, e1 = alpha * (v0 * t0 + v1 * t1 + v2 * t2), alpha * (v0 * b0 + v1 * b1 + v2 * b2)
    length = math.sqrt(e0 * e0 + e1 * e1 + nv * nv)
    e0, e1, e2 = e0 / length, e1 / length, nv / length
    across = math.sqrt(e0 * e0 + e1 * e1)
    u0, u1 = (-e1 / across, e0 / across) if across > 1e-9 else (1.0, 0.0)
    w0, w1, w2 = -e2 * u1, e2 * u0, e0 * u1 - e1 * u0
    radius, angle = math.sqrt(first), 2.0 * math.pi * second
    p = radius * math.cos(angle)
    lean = 0.5 * (1.0 + e2)
    q = (1.0 - lean) * math.sqrt(1.0 - p * p) + lean * radius * math.sin(angle)
    up = math.sqrt(max(0.0, 1.0 - p * p - q * q))
    m0, m1 = alpha * (p * u0 + q * w0 + up * e0), alpha * (p * u1 + q * w1 + up * e1)
    m2 = max(1e-6, q * w2 + up * e2)
    length = math.sqrt(m0 * m0 + m1 * m1 + m2 * m2)
    m0, m1, m2 = m0 / length, m1 / length, m2 / length
    h0, h1, h2 = m0 * t0 + m1 * b0 + m2 * x, m0 * t1 + m1 * b1 + m2 * y, m0 * t2 + m1 * b2 + m2 * z
    vh = v0 * h0 + v1 * h1 + v2 * h2
    way[0], way[1], way[2] = 2.0 * vh * h0 - v0, 2.0 * vh * h1 - v1, 2.0 * vh * h2 - v2
    return m2
