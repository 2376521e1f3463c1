"""Writes the LED table of a simulated dome: 1080 LEDs on 180 flat boards of 6, or another number.

    python tools/make_dome.py [--output configs/domes/coupole.csv] [--radius-mm 1500] ...
    python tools/make_dome.py --output configs/domes/text-dome.csv --boards 64 --rows 1 --columns 1

Boards follow a Fibonacci spiral of equal areas between two elevations (Swinbank and Purser, "Fibonacci
grids", 2006, on a zone instead of a sphere); the arm hangs through the open top. Each board is a grid (2 x 3)
of LEDs that faces the support's centre; its LEDs share its normal. The same options give the same bytes.
"""

from __future__ import annotations

import argparse
import math
import random
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from coupole.geometry import Transform, transform

BOARDS, ROWS, COLUMNS = 180, 2, 3
PITCH_MM = 60.0
LOWEST_DEG, HIGHEST_DEG = 5.0, 74.0
"""Elevations of the zone that carries boards, seen from the support's centre."""
FLUX_LM, FLUX_SPREAD = 1800.0, 0.02
"""Mean flux of an LED and its relative standard deviation."""
GOLDEN_ANGLE_RAD = math.pi * (3.0 - math.sqrt(5.0))
DEFAULT_OUTPUT = Path(__file__).resolve().parents[1] / "configs" / "domes" / "coupole.csv"

HEADER = """\
# LEDs of a dome, in the frame of the robot's base. Simulated geometry, not a calibration.
# Positions in mm, normals of unit length towards the support's centre, flux in lumen.
id,board,x_mm,y_mm,z_mm,nx,ny,nz,flux_lm
"""


def board_normals(boards: int) -> Iterator[np.ndarray]:
    """Unit vectors from each board to the support's centre, in the support frame."""
    low, high = math.sin(math.radians(LOWEST_DEG)), math.sin(math.radians(HIGHEST_DEG))
    for board in range(boards):
        z = low + (high - low) * (board + 0.5) / boards
        azimuth_rad = board * GOLDEN_ANGLE_RAD
        ring = math.sqrt(1.0 - z * z)
        yield -np.array([ring * math.cos(azimuth_rad), ring * math.sin(azimuth_rad), z])


def leds(radius_mm: float, boards: int, rows: int, columns: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Position (mm) and normal of each LED in the support frame, board by board, row by row."""
    for normal in board_normals(boards):
        along = np.cross([0.0, 0.0, 1.0], normal)
        along /= np.linalg.norm(along)
        across = np.cross(normal, along)
        for row in range(rows):
            for column in range(columns):
                right_mm = (column - (columns - 1) / 2) * PITCH_MM
                up_mm = (row - (rows - 1) / 2) * PITCH_MM
                yield -radius_mm * normal + right_mm * along + up_mm * across, normal


def dome_csv(
    radius_mm: float, seed: int, base_from_support: Transform, boards: int, rows: int, columns: int
) -> str:
    """The table as text; `seed` chooses the spread of the fluxes."""
    dice = random.Random(seed)
    rotation, translation = base_from_support[:3, :3], base_from_support[:3, 3]
    lines = []
    for led, (position_mm, normal) in enumerate(leds(radius_mm, boards, rows, columns)):
        x, y, z = rotation @ position_mm + translation
        nx, ny, nz = rotation @ normal
        flux_lm = dice.gauss(FLUX_LM, FLUX_LM * FLUX_SPREAD)
        board = led // (rows * columns)
        lines.append(f"{led},{board},{x:z.3f},{y:z.3f},{z:z.3f},{nx:z.6f},{ny:z.6f},{nz:z.6f},{flux_lm:.1f}\n")
    return HEADER + "".join(lines)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description="Write the LED table of a simulated dome.")
    parser.add_argument("--output", type=Path, default=DEFAULT_OUTPUT)
    parser.add_argument("--radius-mm", type=float, default=1500.0)
    parser.add_argument("--boards", type=int, default=BOARDS)
    parser.add_argument("--rows", type=int, default=ROWS, help="of LEDs on a board")
    parser.add_argument("--columns", type=int, default=COLUMNS)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--translation-mm", type=float, nargs=3, default=(200.0, 0.0, 1450.0), help="of base_from_support"
    )
    parser.add_argument("--abc-deg", type=float, nargs=3, default=(0.0, 0.0, 180.0), help="of base_from_support")
    options = parser.parse_args(arguments)
    base_from_support = transform(tuple(options.translation_mm), tuple(options.abc_deg))
    grid = (options.boards, options.rows, options.columns)
    text = dome_csv(options.radius_mm, options.seed, base_from_support, *grid)
    options.output.write_text(text, encoding="ascii", newline="\n")


if __name__ == "__main__":
    main()
