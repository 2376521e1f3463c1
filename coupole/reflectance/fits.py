"""The fits of a result of runs: one object for each fit, in one registry.

To add a fit, add an object to `MATERIALS` or `SLICES`, and the kernel that it calls. Kernels are imported where
they are called, because the command line reads the registry for its help, without numpy.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from coupole.reflectance.material_uncertainty import MaterialUncertainty
    from coupole.reflectance.slice_basis import Basis
    from coupole.reflectance.triangle_fit import TriangleMaterials, TriangleSamples


@dataclass(frozen=True)
class Fit:
    """Name, title and colour of a fit in reports and charts."""

    name: str
    """Name of the fit's file or folder in `fits/`, and its name for `--fit`."""
    title: str
    colour: str
    """Colour in charts, from Okabe and Ito's palette, which colour-blind readers can tell apart."""


@dataclass(frozen=True)
class MaterialFit(Fit):
    """A material for each triangle, fitted to the samples of all views; it is valid from all directions.

    Pictures under new light, exports and pages use its `kd`, `ks` and `alpha` as those of GGX: a material without
    a lobe has a `ks` of 0."""

    fits_normals: bool

    def fit(
        self, samples: TriangleSamples, sample_mask: NDArray[np.bool_], noise_um: float, threads: int | None
    ) -> TriangleMaterials:
        """Fit materials to the samples `sample_mask` [samples]; `noise_um` is the noise of the mesh's vertices."""
        from coupole.reflectance.triangle_fit import fit_triangles

        return fit_triangles(samples, sample_mask, noise_um if self.fits_normals else None, threads=threads)

    def uncertainty(
        self,
        samples: TriangleSamples,
        sample_mask: NDArray[np.bool_],
        materials: TriangleMaterials,
        noise_um: float,
        middle_mm: NDArray[np.float64],
        threads: int | None,
    ) -> MaterialUncertainty:
        """Compute covariances of the materials fitted to the samples `sample_mask` [samples]; `middle_mm` is the
        middle of the object. A fit with a form other than GGX must override this with its own
        covariances."""
        from coupole.reflectance.material_uncertainty import covariances

        return covariances(
            samples,
            sample_mask,
            materials,
            noise_um,
            fitted_normals=self.fits_normals,
            middle_mm=middle_mm,
            threads=threads,
        )

    def values(self, samples: TriangleSamples, materials: TriangleMaterials) -> NDArray[np.float32]:
        """[b, samples, channels] f cos_i, 1/sr, of materials."""
        from coupole.reflectance.triangle_fit import model_values

        return model_values(samples, materials)


@dataclass(frozen=True)
class ViewFit(Fit):
    """Coefficients for each triangle, fitted to the samples of one view; they are valid for that view."""

    basis_name: str
    """Name of its functions in `slice_basis.BASES`."""
    over: MaterialFit | None = None
    """Material fit to which this fit is added; this fit was made to the residuals of the material fit."""

    @property
    def basis(self) -> Basis:
        """Functions of the fit."""
        from coupole.reflectance.slice_basis import BASES

        return BASES[self.basis_name]

    @property
    def coefficients(self) -> int:
        """Number of coefficients of each channel; the last one is the share of `over`, if this is set."""
        from coupole.reflectance.slice_basis import COUNT

        return COUNT + (self.over is not None)

    def values(
        self, samples: TriangleSamples, coefficients: NDArray[np.float32], under: NDArray[np.float32] | None
    ) -> NDArray[np.float32]:
        """[b, samples, channels] f cos_i, 1/sr, with the values of `over` if this is set."""
        from coupole.reflectance.slice_fit import slice_values

        return slice_values(samples, coefficients, self.basis, under)


_F = TypeVar("_F", bound=Fit)


def _fits_by_name(*fits: _F) -> dict[str, _F]:
    return {fit.name: fit for fit in fits}


GGX = MaterialFit("ggx", "GGX, mesh's normals", "#999999", fits_normals=False)
GGX_NORMAL = MaterialFit("ggx_normal", "GGX, normals fitted", "#cc79a7", fits_normals=True)
MATERIALS = _fits_by_name(GGX, GGX_NORMAL)
"""Material fits by name, in the order in which they are made."""
SLICES = _fits_by_name(
    ViewFit("sh", "spherical harmonics", "#0072b2", "harmonics"),
    ViewFit("rbf", "radial functions", "#d55e00", "radial"),
    ViewFit(
        "ggx_rbf", "GGX, normals fitted, with radial functions of the residual", "#009e73", "residual", GGX_NORMAL
    ),
)
FITS: dict[str, MaterialFit | ViewFit] = {**MATERIALS, **SLICES}
CLUSTERED, PAIR_HARMONICS = "clusters", "harmonics"
"""Names of the fits that `coupole reflectance cluster` adds: materials of clusters, and harmonics of both
directions."""
TEXELS = "texels"
"""Name of the fit that `--texels` adds: materials of single pixels of each view."""
TEXEL_CLUSTERS = "texel_clusters"
"""Name of the fit that `coupole reflectance cluster --texels` adds: materials that texels share."""
OF_TEXELS = (TEXELS, TEXEL_CLUSTERS)
"""Fits with a material for each texel, which maps can show."""
ANYWHERE = (*MATERIALS, CLUSTERED, PAIR_HARMONICS, *OF_TEXELS)
"""Fits that are valid from all directions."""
RELIT = (*FITS, CLUSTERED, PAIR_HARMONICS, *OF_TEXELS)
"""All values that `--fit` of `coupole reflectance relight` accepts."""


def fitted_together() -> list[Sequence[ViewFit]]:
    """Return the fits of views in groups with the same functions; each group is fitted in one pass."""
    fits = sorted(SLICES.values(), key=lambda fit: not fit.basis.harmonic)
    return [list(group) for _, group in groupby(fits, key=lambda fit: fit.basis.harmonic)]
