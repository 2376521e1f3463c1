"""Gold leaf on bole (Callet et al. 2010, section 5): Eq. 7 with all terms defined.

    R = f R_bole + (1 - f) (R(d) + T_in T_out R_b/(1 - R_int R_b))

f is the share of the surface that is bare because of holes and cracks, R(d) the reflectance of a leaf of thickness
d, T_in its transmittance, T_out and R_int its transmittance and reflectance for the bole's diffuse light from
below, and R_b the bole's reflectance inside its binder. The paper's "R_gold - T_p + R_plasmon" has no definition
of R_plasmon; a thin film includes all three (docs/decisions/0010). For thickness 0 the result is the bole under
the face of its binder. For thick leaves it is bulk gold.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from coupole.appearance.matter import layered
from coupole.appearance.matter.glossy_face import InternalReflectance
from coupole.appearance.optics import effective_medium, indices
from coupole.appearance.optics.thin_film import Film
from coupole.appearance.spectra.grid import Array, Complex, within


@dataclass(frozen=True)
class Gilt:
    """A gilded surface, ready for `reflectances`."""

    leaf: layered.Sheet
    bare: layered.Sheet
    """Surface without leaf: the bole's binder against air."""
    bole: InternalReflectance
    """[bands]."""
    bare_share: float
    """f: share of the surface without leaf."""


def leaf_index(
    metal: Complex, holes_share: float, *, flatness: float = 20.0, filling: float = indices.EGG_WHITE
) -> Complex:
    """Effective index of a leaf of `metal` with a share of nanoscopic lens-shaped holes filled with egg white, for
    light along its normal (Eqs 2-5). `flatness` is the ratio of a hole's width to its height."""
    depolarisation = effective_medium.depolarisation_in_plane(flatness)
    return effective_medium.maxwell_garnett(metal, filling, holes_share, depolarisation)


def gilt(
    index: Complex,
    thickness_nm: float,
    bole: InternalReflectance,
    *,
    bare_share: float = 0.0,
    binder_index: float = indices.EGG_WHITE,
) -> Gilt:
    """A leaf of `index` and thickness on a bole [bands]; under the leaf there is no air.

    For a bole measured in air, use `glossy_face.face(binder_index).inside(measured)`.
    """
    return Gilt(
        leaf=layered.sheet([Film(index, thickness_nm)], binder_index),
        bare=layered.sheet([], binder_index),
        bole=bole,
        bare_share=float(within("uncovered", bare_share, 0.0, 1.0)),
    )


def reflectances(gilt_surface: Gilt) -> tuple[Array, Array]:
    """Specular and diffuse reflectance [bands] of a smooth gilt for light along the normal."""
    parts = []
    for share, sheet in (
        (1.0 - gilt_surface.bare_share, gilt_surface.leaf),
        (gilt_surface.bare_share, gilt_surface.bare),
    ):
        entering = sheet.transmittance[-1]
        diffuse = entering * layered.emerging(sheet, gilt_surface.bole)
        parts.append(share * np.stack([sheet.normal_reflectance, diffuse]))
    specular, diffuse = parts[0] + parts[1]
    return specular, diffuse
