"""Measures errors of the corners of boards, without and with noise, beside those of other detectors.

    python tools/prove_corners.py [--boards 6] [--pictures FOLDER]

Separate code of the tests draws boards of 36 corners (`tests/calibration/corner_boards.py`) for each kind of blur,
tilt, contrast and colour pattern. The rms error without noise is printed for five methods: our fit, the same fit
with one round Gaussian blur ("before"), OpenCV's `cornerSubPix` and `findChessboardCornersSB` (Duda and Frese,
BMVC 2018), and the saddle of a quadratic in the smoothed image (as in Placht, ECCV 2014, and Ha, ICCV 2017;
written here). The largest mean error by quarter of a pixel is in brackets. With noise, our error over the stated u
is printed. With `--pictures`, the two diagonal halves of the pixels of grey pictures of a 9 x 6 board (PNG) are
compared. Exits with 1 unless rms(error/u) is 0.8 to 1.25 in each stratum.
"""

from __future__ import annotations

import argparse
import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "calibration")]

import cv2  # noqa: E402
import numpy as np  # noqa: E402
from corner_boards import CORNERS, Drawn, Floats, Stratum, draw, with_noise  # noqa: E402

from coupole.calibration.grey_image import Picture  # noqa: E402
from coupole.calibration.lens.corner_fit import Blur, Corners, fit_corners  # noqa: E402
from smallest import add_smallest  # noqa: E402

LOW, HIGH = 0.8, 1.25
PHASES = 4
STRATA = (
    Stratum("sharp", blur="round 0.25"),
    Stratum("round blur"),
    Stratum("round blur, no tilt", tilt_deg=0.0),
    Stratum("round blur, tilted 40", tilt_deg=40.0),
    Stratum("round blur, tilted 55", tilt_deg=55.0),
    Stratum("wide blur", blur="round 1.5"),
    Stratum("defocus", blur="disk 2"),
    Stratum("elliptic blur", blur="ellipse 1.4 0.6"),
    Stratum("elliptic blur, tilted 55", blur="ellipse 1.4 0.6", tilt_deg=55.0),
    Stratum("coma of 3 px", blur="streak 3"),
    Stratum("coma of 3 px, tilted 40", blur="streak 3", tilt_deg=40.0),
    Stratum("low contrast", white_dn=500.0),
    Stratum("green of RAW", pattern="GBRG"),
    Stratum("red of RAW", pattern="GBRG", channel="red"),
    Stratum("red of RAW, elliptic blur", pattern="GBRG", channel="red", blur="ellipse 1.4 0.6"),
)
METHODS = ("ours", "before", "cornerSubPix", "SB", "saddle")


@dataclass(frozen=True)
class Errors:
    """Errors [n, 2] of a stratum: without noise by method, with the places of the corners; and with noise, divided
    by u."""

    plain_px: dict[str, Floats]
    corners: dict[str, Floats]
    over_u: Floats


def errors_of(stratum: Stratum, boards: int) -> Errors:
    """Draw boards and find their corners by all methods."""
    plain: dict[str, list[Floats]] = {method: [] for method in METHODS}
    places: dict[str, list[Floats]] = {method: [] for method in METHODS}
    over_u = []
    for seed in range(boards):
        board = draw(stratum, seed)
        starts = board.corners + np.random.default_rng(seed).uniform(-0.7, 0.7, board.corners.shape)
        for method, corners_px in _corners_by_method(stratum, board, starts).items():
            is_found = np.isfinite(corners_px[:, 0])
            plain[method].append((corners_px - board.corners)[is_found])
            places[method].append(board.corners[is_found])
        noisy = _fit_of(stratum, with_noise(board.values, seed), starts, radius_of(board.corners), "own")
        error = (noisy.pixels - board.corners)[noisy.fits]
        factor = np.linalg.cholesky(noisy.covariance_px2[noisy.fits])
        over_u.append(np.linalg.solve(factor, error[..., None])[..., 0])
    return Errors(
        {method: np.concatenate(errors) for method, errors in plain.items()},
        {method: np.concatenate(corners) for method, corners in places.items()},
        np.concatenate(over_u),
    )


def radius_of(corners: Floats) -> float:
    """Radius of the windows, px: a third of the distance to the nearest corner."""
    apart = np.linalg.norm(corners[:, None] - corners[None], axis=-1)
    np.fill_diagonal(apart, np.inf)
    return float(np.clip(np.percentile(apart.min(axis=1), 5) / 3.0, 2.0, 11.0))


def _fit_of(stratum: Stratum, values: Floats, starts: Floats, radius_px: float, blur: Blur) -> Corners:
    pixels, mask = Picture(values, stratum.pattern, 4095.0).values_and_mask(stratum.channel)
    return fit_corners(pixels, mask, starts, radius_px, blur=blur)


def _corners_by_method(stratum: Stratum, board: Drawn, starts: Floats) -> dict[str, Floats]:
    """Corners [36, 2] by each method; NaN where it finds none."""
    radius_px = radius_of(board.corners)
    grey = Picture(board.values, stratum.pattern, 4095.0).plane(stratum.channel).astype(np.float32)
    corners_px = {
        name: np.where(fit.fits[:, None], fit.pixels, np.nan)
        for name, fit in (
            ("ours", _fit_of(stratum, board.values, starts, radius_px, "own")),
            ("before", _fit_of(stratum, board.values, starts, radius_px, "round")),
        )
    }
    side_px = max(2, int(radius_px / np.sqrt(2.0)))
    until = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-4)
    points = starts.astype(np.float32).reshape(-1, 1, 2)
    refined_px = cv2.cornerSubPix(grey, points.copy(), (side_px, side_px), (-1, -1), until)
    corners_px["cornerSubPix"] = np.asarray(refined_px, np.float64).reshape(-1, 2)
    corners_px["SB"] = _by_sector_based(grey, board.corners)
    corners_px["saddle"] = np.array([_saddle(grey, start, side_px) for start in starts])
    return corners_px


def _by_sector_based(grey: Any, corners: Floats) -> Floats:
    """Return the corners of OpenCV's `findChessboardCornersSB`, in the order of the true ones."""
    picture = np.clip(np.rint(255.0 * grey / grey.max()), 0, 255).astype(np.uint8)
    is_found, seen_px = cv2.findChessboardCornersSB(picture, (CORNERS, CORNERS), flags=cv2.CALIB_CB_ACCURACY)
    if not is_found:
        return np.full(corners.shape, np.nan)
    points = np.asarray(seen_px, np.float64).reshape(-1, 2)
    apart = np.linalg.norm(points[None] - corners[:, None], axis=-1)
    nearest = points[apart.argmin(axis=1)]
    return np.where((apart.min(axis=1) < 2.0)[:, None], nearest, np.nan)


def _saddle(grey: Any, start: Floats, half_px: int) -> Floats:
    """Return the saddle of the quadratic that fits a window, smoothed by a cone; NaN if it has no saddle."""
    x, y = np.meshgrid(*2 * [np.arange(-half_px, half_px + 1)])
    cone = np.maximum(half_px + 1.0 - np.hypot(x, y), 0.0)
    first = np.maximum(np.rint(start).astype(int) - 3 * half_px, 0)
    part = grey[first[1] : first[1] + 6 * half_px + 1, first[0] : first[0] + 6 * half_px + 1]
    smooth = cv2.filter2D(part.astype(np.float64), -1, cone / cone.sum())
    place = start - first
    design = np.stack([x**2, x * y, y**2, x, y, np.ones_like(x)], axis=-1).reshape(-1, 6).astype(np.float64)
    for _ in range(20):
        window = cv2.getRectSubPix(smooth.astype(np.float32), 2 * (2 * half_px + 1,), place.tolist())
        a, b, c, d, e, _ = np.linalg.lstsq(design, np.asarray(window, np.float64).ravel(), rcond=None)[0]
        if 4.0 * a * c - b * b >= 0.0:
            return np.full(2, np.nan)
        step = -np.linalg.solve([[2.0 * a, b], [b, 2.0 * c]], [d, e])
        place = place + np.clip(step, -1.0, 1.0)
        if np.abs(step).max() < 1e-4:
            break
    return np.asarray(place + first)


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2))) if values.size else float("nan")


def _by_phase(errors: Floats, corners: Floats) -> float:
    """Return the largest mean error of corners whose coordinate lies in the same quarter of a pixel."""
    quarter = np.floor(PHASES * (corners % 1.0)).astype(int)
    means = [errors[quarter == number].mean() for number in range(PHASES) if (quarter == number).any()]
    return float(np.abs(means).max()) if means else float("nan")


def print_halves(folder: Path) -> None:
    """Compare the corners of both diagonal halves of the pixels of real pictures."""
    half = np.array([[True, False], [False, True]])
    for path in sorted(folder.glob("*.png")):
        grey = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        is_found, seen_px = cv2.findChessboardCorners(grey, (9, 6)) if grey is not None else (False, None)
        if not is_found:
            print(f"{path.name}: no board of 9 x 6 corners")
            continue
        starts = np.asarray(seen_px, np.float64).reshape(-1, 2)
        first, second = (fit_corners(np.asarray(grey), mask, starts, radius_of(starts)) for mask in (half, ~half))
        in_both = first.fits & second.fits
        apart = first.pixels[in_both] - second.pixels[in_both]
        factor = np.linalg.cholesky(first.covariance_px2[in_both] + second.covariance_px2[in_both])
        over_u = np.linalg.solve(factor, apart[..., None])
        print(
            f"{path.name}: halves of {in_both.sum()} corners differ by {_rms(apart):.4f} px rms, "
            f"{_rms(over_u):.2f} of the stated uncertainty"
        )


def main() -> int:
    """Run the proof; see the module's text."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--boards", type=int, default=6, help="boards of each stratum")
    parser.add_argument("--strata", type=int, default=len(STRATA), help="number of strata")
    parser.add_argument("--first", type=int, default=0, help="number of the first one")
    parser.add_argument("--pictures", type=Path, help="folder of real pictures, PNG, of a board of 9 x 6 corners")
    add_smallest(parser, boards=1, strata=1)
    options = parser.parse_args()
    print("error without noise, rms px (largest mean by quarter of a pixel)")
    print(f"| stratum | {' | '.join(METHODS)} | error/u with noise |\n|---{'|---' * (len(METHODS) + 1)}|")
    is_good = True
    for stratum in STRATA[options.first : options.first + options.strata]:
        errors = errors_of(stratum, options.boards)
        cells = []
        for method in METHODS:
            plain_px = errors.plain_px[method]
            cells.append(f"{_rms(plain_px):.4f} ({_by_phase(plain_px, errors.corners[method]):.4f})")
        ratio = _rms(errors.over_u)
        print(f"| {stratum.name} | {' | '.join(cells)} | {ratio:.2f} |", flush=True)
        is_good &= LOW <= ratio <= HIGH
    if options.pictures is not None:
        print_halves(options.pictures)
    return 0 if is_good or options.smallest else 1


if __name__ == "__main__":
    sys.exit(main())
