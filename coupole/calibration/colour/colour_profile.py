"""The profile of a camera from a chart. It converts balanced channels, which are 1, 1, 1 for perfect white, to XYZ
under D50.

There are two forms: a matrix [3, 3], and a root-polynomial of degree 2 (Finlayson, Mackiewicz and Hurlbert, Color
correction using root-polynomial regression, IEEE Trans. Image Processing 24, 2015). Its terms r, g, b, sqrt(rg),
sqrt(rb), sqrt(gb) scale with the exposure, like the terms of a matrix. Both forms keep white exactly. First they
are found by least squares in XYZ, weighted by the slope of L*. Then the sum of squares of CIEDE2000 is minimised,
with a weak prior at the first solution.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np

from coupole.calibration.colour.colorimetry import D50_WHITE, de00, de00_parts, lab_of, xyz_of
from coupole.calibration.rotations import Floats
from coupole.errors import InputError

Form = Literal["matrix", "root-polynomial"]
FORMS: tuple[Form, ...] = ("matrix", "root-polynomial")
_HELD = 0.3
"""Weight of a coefficient's departure from the first solution, as CIEDE2000 for a change of 1."""
_LAB_STEP, _LOG_STEP = 1e-3, 1e-5
_WORTH = 0.95
"""A root-polynomial is used if its mean error on left-out patches is less than this share of the matrix's
error."""
_LARGEST_CONDITION = 1e6


@dataclass(frozen=True)
class Balanced:
    """Signals of the patches as the camera saw them, on the same scale as the patches' colours."""

    signal: Floats
    """[patches, 3] red, green, blue above dark under uniform light, in any unit."""
    u: Floats
    """[patches, 3] standard uncertainty of each signal from noise; these errors are independent."""
    xyz: Floats
    """[patches, 3] under D50."""
    u_lab: float
    """Standard uncertainty of each of the patches' L*, a*, b*."""
    neutral: tuple[int, ...]
    """Numbers of the grey patches."""
    white: Floats | None = None
    """[3] signal of the perfect white, if it is known from elsewhere; None: it comes from the grey patches."""
    light_u: Floats | None = None
    """[patches, effects] relative changes of signals. Each effect is one standard uncertainty of an independent
    error of the light, which all patches share. None: the light is known."""

    def without(self, patch: int) -> Balanced:
        keep = np.arange(len(self.signal)) != patch
        grey = tuple(n - (n > patch) for n in self.neutral if n != patch)
        light_u = None if self.light_u is None else self.light_u[keep]
        return Balanced(self.signal[keep], self.u[keep], self.xyz[keep], self.u_lab, grey, self.white, light_u)

    def white_signal(self) -> Floats:
        """Signal [3] of the perfect white: the signal of the greys divided by their Y, weighted by Y."""
        if self.white is not None:
            return self.white
        luminance = self.xyz[list(self.neutral), 1]
        return np.asarray(luminance @ self.signal[list(self.neutral)] / (luminance @ luminance))


@dataclass(frozen=True)
class Profile:
    """Conversion of signals to XYZ under D50."""

    form: Form
    coefficients: Floats
    """[3, terms]; each row sums to X, Y or Z of the white."""
    white_signal: Floats
    """[3] signal of the perfect white."""

    def xyz(self, signal: Floats) -> Floats:
        """Return [n, 3] for signals [n, 3]."""
        return self.xyz_of_balanced(signal / self.white_signal)

    def xyz_of_balanced(self, balanced_channels: Floats) -> Floats:
        """Return [n, 3] for channels [n, 3] that are 1, 1, 1 for white."""
        return np.asarray(terms_of(balanced_channels, self.form) @ self.coefficients.T)


def terms_of(balanced_channels: Floats, form: Form) -> Floats:
    """Return [n, 3] or [n, 6] terms. Roots of negative products, which come from noise, are 0."""
    if form == "matrix":
        return balanced_channels
    r, g, b = np.maximum(balanced_channels, 0.0).T
    return np.column_stack([balanced_channels, np.sqrt(r * g), np.sqrt(r * b), np.sqrt(g * b)])


def fit_profile(patch_signals: Balanced, form: Form) -> Profile:
    """Find the profile of patches. Raises InputError if no grey patch is left, or if the channels do not
    distinguish colours."""
    if not patch_signals.neutral and patch_signals.white is None:
        raise InputError("colour: no grey patch can be used; the channels cannot be balanced. Expose anew")
    white = patch_signals.white_signal()
    terms = terms_of(patch_signals.signal / white, form)
    first = _least_squares(terms, patch_signals.xyz)
    return Profile(form, _least_de00(terms, lab_of(patch_signals.xyz), first), white)


def _free(coefficients: Floats) -> Floats:
    """Return the coefficients without the last one of each row, which keeps white."""
    return np.asarray(coefficients[:, :-1])


def _whole(free: Floats) -> Floats:
    return np.column_stack([free, D50_WHITE - free.sum(axis=1)])


def _least_squares(terms: Floats, xyz: Floats) -> Floats:
    """Return [3, terms], by least squares in XYZ. The weights make relative errors of dark patches count, as in
    L*."""
    weight = 1.0 / (0.01 + xyz[:, 1]) ** (2.0 / 3.0)
    design = (terms[:, :-1] - terms[:, -1:]) * weight[:, None]
    if np.linalg.cond(design) > _LARGEST_CONDITION:
        raise InputError(
            "colour: the channels are too similar on this chart to distinguish its colours; expected a colour "
            "camera and patches of many hues"
        )
    target = (xyz - terms[:, -1:] * D50_WHITE) * weight[:, None]
    free, *_ = np.linalg.lstsq(design, target)
    return _whole(np.asarray(free.T))


def _least_de00(terms: Floats, lab: Floats, first: Floats) -> Floats:
    """Return [3, terms] with the least sum of squares of CIEDE2000."""
    from scipy.optimize import least_squares

    shape = _free(first).shape
    fit = least_squares(partial(_residuals, terms, lab, first, shape), _free(first).ravel(), method="lm")
    return _whole(fit.x.reshape(shape))


def _residuals(terms: Floats, lab: Floats, first: Floats, shape: tuple[int, int], free: Floats) -> Floats:
    """Return residuals: CIEDE2000's parts of all patches, and departures from the first solution."""
    coefficients = _whole(free.reshape(shape))
    parts = de00_parts(lab_of(terms @ coefficients.T), lab).ravel()
    return np.concatenate([parts, _HELD * (coefficients - first).ravel()])


# -- how good it is -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class LeftOut:
    """CIEDE2000 of patches, each with a profile that was made without this patch."""

    de: Floats
    """[patches]."""

    @property
    def mean(self) -> float:
        return float(self.de.mean())

    def quantile(self, share: float) -> float:
        return float(np.quantile(self.de, share))

    @property
    def worst(self) -> float:
        return float(self.de.max())

    def bound(self, share: float) -> tuple[float, float]:
        """Return a bound of CIEDE2000 for a share of further colours like the patches', and the share for which
        the bound is valid. The bound is the smallest order statistic k for which k / (n + 1) is at least the
        share. If there is none, it is the largest of the n patches (split conformal prediction: Vovk, Gammerman
        and Shafer, Algorithmic Learning in a Random World, 2005)."""
        count = len(self.de)
        place = min(int(np.ceil(share * (count + 1))), count)
        return float(np.sort(self.de)[place - 1]), min(share, place / (count + 1))


def leave_out(
    patch_signals: Balanced,
    form: Form,
    tell: Callable[[], None] = lambda: None,
    seen_without: Sequence[Balanced] | None = None,
) -> LeftOut:
    """Predict each patch by the profile of the others, with their balance. `tell` is called after each patch.

    `seen_without` has, for each patch, the signals of all patches under a light that was found without this patch.
    Raises InputError if there is only one grey patch.
    """
    de = np.empty(len(patch_signals.signal))
    lab = lab_of(patch_signals.xyz)
    for patch in range(len(de)):
        all_signals = patch_signals if seen_without is None else seen_without[patch]
        profile = fit_profile(all_signals.without(patch), form)
        de[patch] = de00(lab_of(profile.xyz(all_signals.signal[[patch]])), lab[[patch]])[0]
        tell()
    return LeftOut(de)


def better(matrix: LeftOut, roots: LeftOut) -> Form:
    """Return the form with the smaller error for left-out patches. It is the matrix, unless the other form is
    clearly better.
    """
    return "root-polynomial" if roots.mean < _WORTH * matrix.mean and roots.worst < matrix.worst else "matrix"


# -- uncertainty ----------------------------------------------------------------------------------------------


def covariance_of(patch_signals: Balanced, profile: Profile) -> tuple[Floats, Floats, Floats]:
    """Return covariances [3 terms, 3 terms] of the coefficients, row by row. The first is from the noise of
    signals, the second from the patches' own uncertainty, and the third from the uncertainty of the light.

    Let J and K be the derivatives of the misses with respect to the coefficients and to the data. Then dm =
    -(J'J)^-1 J'K dd (the implicit function theorem on the normal equations, with Gauss and Newton's
    approximation). Errors that the form itself cannot follow (metamerism) are not noise; `leave_out` shows them.
    """
    lab = lab_of(patch_signals.xyz)
    signal = patch_signals.signal / profile.white_signal
    free = _free(profile.coefficients)

    def parts(balanced_channels: Floats, free: Floats, lab: Floats) -> Floats:
        coefficients = _whole(free)
        return de00_parts(lab_of(terms_of(balanced_channels, profile.form) @ coefficients.T), lab)

    rows = []
    for n in range(free.size):
        step = np.zeros(free.size)
        step[n] = _LOG_STEP
        change = step.reshape(free.shape)
        rows.append((parts(signal, free + change, lab) - parts(signal, free - change, lab)).ravel())
    design = np.column_stack(rows) / (2.0 * _LOG_STEP)
    inverse = np.linalg.inv(design.T @ design + _HELD**2 * np.eye(free.size))
    gain = inverse @ design.T
    full = np.asarray(np.kron(np.eye(3), np.vstack([np.eye(free.shape[1]), -np.ones(free.shape[1])])), np.float64)
    by_noise: list[Floats] = [
        gain @ column for column in _by_noise(patch_signals, profile, signal, parts, free, lab)
    ]
    by_chart: list[Floats] = [gain @ column for column in _by_chart(patch_signals, signal, parts, free, lab)]
    by_light: list[Floats] = [gain @ column for column in _by_light(patch_signals, signal, parts, free, lab)]
    return _outer(by_noise, full), _outer(by_chart, full), _outer(by_light, full)


Parts = Callable[[Floats, Floats, Floats], Floats]


def _by_noise(
    patch_signals: Balanced, profile: Profile, balanced_channels: Floats, parts: Parts, free: Floats, lab: Floats
) -> Sequence[Floats]:
    """Return changes of the errors by one standard uncertainty of each signal. They include the change of the
    balance."""
    columns = []
    grey = list(patch_signals.neutral)
    luminance = patch_signals.xyz[grey, 1]
    share = (
        dict(zip(grey, luminance / (luminance @ luminance), strict=True)) if patch_signals.white is None else {}
    )
    for patch in range(len(balanced_channels)):
        for channel in range(3):
            step = np.zeros_like(balanced_channels)
            u = patch_signals.u[patch, channel] / profile.white_signal[channel]
            step[patch, channel] = u
            step[:, channel] -= balanced_channels[:, channel] * share.get(patch, 0.0) * u
            columns.append(
                0.5
                * (parts(balanced_channels + step, free, lab) - parts(balanced_channels - step, free, lab)).ravel()
            )
    return columns


def _by_chart(
    patch_signals: Balanced, balanced_channels: Floats, parts: Parts, free: Floats, lab: Floats
) -> Sequence[Floats]:
    """Return the same changes for the patches' L*, a*, b*. The L* of a grey patch changes the balance too."""
    columns = []
    grey = list(patch_signals.neutral)
    for patch in range(len(lab)):
        for axis in range(3):
            moved_parts = []
            for sign in (1.0, -1.0):
                moved_lab = lab.copy()
                moved_lab[patch, axis] += sign * _LAB_STEP
                here = balanced_channels
                if patch_signals.white is None and patch in grey:
                    luminance = xyz_of(moved_lab)[grey, 1]
                    white = luminance @ balanced_channels[grey] / (luminance @ luminance)
                    first = patch_signals.xyz[grey, 1]
                    here = balanced_channels * (first @ balanced_channels[grey] / (first @ first)) / white
                moved_parts.append(parts(here, free, moved_lab))
            columns.append((patch_signals.u_lab / (2.0 * _LAB_STEP)) * (moved_parts[0] - moved_parts[1]).ravel())
    return columns


def _by_light(
    patch_signals: Balanced, balanced_channels: Floats, parts: Parts, free: Floats, lab: Floats
) -> Sequence[Floats]:
    """Return the same changes for each error of the light, including the change of the balance."""
    columns = []
    grey = list(patch_signals.neutral)
    luminance = patch_signals.xyz[grey, 1]
    for change in np.zeros((0, 0)) if patch_signals.light_u is None else patch_signals.light_u.T:
        step = balanced_channels * change[:, None]
        if patch_signals.white is None:
            step -= balanced_channels * (luminance @ step[grey] / (luminance @ luminance))
        columns.append(
            0.5 * (parts(balanced_channels + step, free, lab) - parts(balanced_channels - step, free, lab)).ravel()
        )
    return columns


def _outer(columns: Sequence[Floats], full: Floats) -> Floats:
    if not columns:
        return np.zeros((len(full), len(full)))
    matrix = np.column_stack(columns)
    return np.asarray(full @ (matrix @ matrix.T) @ full.T)
