"""The picture of a finding: before, after, and the difference."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from coupole.acquisition.watching.findings import Found
from coupole.viewing.raw_preview import png

_WIDTH_PX = 320
_GAP_PX = 8
_GAMMA = 1 / 2.2
_FULL_SHARE = 0.1
"""Least difference that the third part shows in full colour, as a share of the bright places."""


def finding_picture(finding: Found) -> bytes:
    """Return a PNG of three looks beside each other: before, after, and their difference. Red shows more light,
    blue shows less."""
    before, after = (
        np.maximum(np.nan_to_num(look.astype(float)), 0.0) for look in (finding.before, finding.after)
    )
    bright_dn = max(float(np.quantile(before, 0.99)), float(np.quantile(after, 0.99)), 1.0)
    difference = after - before
    full_dn = max(float(np.quantile(np.abs(difference), 0.99)), _FULL_SHARE * bright_dn)
    gap = np.full((before.shape[0], max(1, _GAP_PX * before.shape[1] // _WIDTH_PX), 3), 255, np.uint8)
    parts = [_grey(before / bright_dn), gap, _grey(after / bright_dn), gap, _red_and_blue(difference / full_dn)]
    picture = np.concatenate(parts, axis=1)
    times = max(1, _WIDTH_PX // before.shape[1])
    return png(np.ascontiguousarray(picture.repeat(times, axis=0).repeat(times, axis=1)))


def _grey(share: NDArray[np.float64]) -> NDArray[np.uint8]:
    codes = (255.0 * np.clip(share, 0.0, 1.0) ** _GAMMA).astype(np.uint8)
    return np.repeat(codes[..., None], 3, axis=2)


def _red_and_blue(share: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Return colours: white where nothing differs."""
    less = 255.0 * (1.0 - np.clip(np.abs(share), 0.0, 1.0))
    red, blue = np.where(share >= 0.0, 255.0, less), np.where(share <= 0.0, 255.0, less)
    return np.stack([red, less, blue], axis=-1).astype(np.uint8)
