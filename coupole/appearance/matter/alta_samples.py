"""Samples of reflectance from ALTA's text files (Belcour, Barla, Pacanowski 2013 on). The format is that of its
page of data file formats, and of its source where the source says more.

Lines that begin with # and a letter are the head. `DIM n m` is the number of inputs and of outputs of a sample.
`PARAM_IN` and `PARAM_OUT` name the kinds of inputs and outputs. `VS` tells which bounds follow the outputs: 0 for
none, 1 for a radius, 2 for a lower and an upper bound. With one number after VS, only the first output has bounds;
several numbers are for all outputs.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from coupole.appearance.matter.brdf import Brdf, half_vector
from coupole.appearance.spectra.grid import Array
from coupole.errors import InputError

PER_STERADIAN = "INV_STERADIAN"
_HEAD = re.compile(r"#\s?([A-Za-z]\w*)\s*(.*)")
_END = "ALTA END HEADER"
_OPEN = float(np.finfo(np.float32).max)
"""A bound of at least this size counts as no bound."""
_FEWEST = 8
"""Least number of samples between which values can be interpolated."""


@dataclass(frozen=True)
class AltaSamples:
    """Samples of one file."""

    path: Path
    given_in: str
    """Kind of the inputs, from PARAM_IN."""
    given_out: str | None
    """Kind of the outputs, from PARAM_OUT; None if the file does not name it."""
    inputs: Array
    """[n, inputs]"""
    values: Array
    """[n, outputs]"""
    low: Array
    """[n, outputs] lower bounds; NaN if the file has none."""
    high: Array
    """[n, outputs] upper bounds; NaN if the file has none, inf for an open bound."""

    def directions(self) -> tuple[Array, Array]:
        """Unit vectors [n, 3] to light and eye. Raises InputError for angles that do not give both directions."""
        if self.given_in not in WAYS:
            raise InputError(
                f"{self.path}: PARAM_IN {self.given_in}: expected one of {', '.join(WAYS)}, which give both "
                "directions; convert it with ALTA's data2data"
            )
        return WAYS[self.given_in][1](*self.inputs.T)


def read_alta(path: Path) -> AltaSamples:
    """Read a file. Raises InputError with line and column for a missing file, for a head without DIM or PARAM_IN,
    for a line whose number of values differs from that in the head, for words that are not numbers, and for a
    lower bound above the upper one.
    """
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except OSError as error:
        raise InputError(f"{path}: cannot read the samples: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: expected ALTA's text; found bytes that are not text") from error
    head, first = _head(path, lines)
    inputs, outputs = _dim(path, head)
    (given_in, line), given_out = head.get("PARAM_IN", ("", 0)), head.get("PARAM_OUT")
    if not given_in:
        raise InputError(f"{path}: expected a line `#PARAM_IN` with the name of the inputs, as {next(iter(WAYS))}")
    if given_in in WAYS and WAYS[given_in][0] != inputs:
        raise InputError(
            f"{path}:{line}:1: PARAM_IN {given_in} has {WAYS[given_in][0]} inputs; DIM says {inputs}. Correct one"
        )
    kinds = _kinds(path, head, outputs)
    rows, numbers = _rows(path, lines, first, inputs + outputs + sum(kinds))
    table = np.array(rows).reshape(len(rows), -1)
    values = table[:, inputs : inputs + outputs]
    low, high = _bounds(path, table[:, inputs + outputs :], values, kinds, numbers)
    return AltaSamples(path, given_in, given_out and given_out[0], table[:, :inputs], values, low, high)


# -- the text -------------------------------------------------------------------------------------------------


def _head(path: Path, lines: Sequence[str]) -> tuple[dict[str, tuple[str, int]], int]:
    """Return the values of the head's keys with their lines, and the number of lines before the samples."""
    fields: dict[str, tuple[str, int]] = {}
    for number, line in enumerate(lines, start=1):
        key = _HEAD.match(line)
        if line.lstrip("# ").startswith(_END) and fields:
            return fields, number
        if key is not None:
            fields[key[1].upper()] = key[2].strip().strip('"'), number
        elif fields and line.strip() and not line.startswith("#"):
            return fields, number - 1
    if "DIM" not in fields:
        raise InputError(f"{path}: expected ALTA's text with a line `#DIM inputs outputs`; found none")
    return fields, len(lines)


def _dim(path: Path, head: dict[str, tuple[str, int]]) -> tuple[int, int]:
    if "DIM" not in head:
        raise InputError(f"{path}: expected a line `#DIM inputs outputs` before the samples; found none")
    if head.get("FORMAT", ("", 0))[0] == "binary":
        raise InputError(f"{path}:{head['FORMAT'][1]}:1: expected ALTA's text; found its binary format")
    text, line = head["DIM"]
    words = text.split()
    if len(words) != 2 or not all(word.isdecimal() and len(word) < 5 and int(word) > 0 for word in words):
        raise InputError(f"{path}:{line}:1: #DIM: expected two whole numbers, 1 to 9999; found {text[:40]!r}")
    return int(words[0]), int(words[1])


def _kinds(path: Path, head: dict[str, tuple[str, int]], outputs: int) -> list[int]:
    """Return the number of bounds of each output: 0, 1 or 2."""
    text, line = head.get("VS", ("0", 0))
    words = text.split()
    if len(words) not in (1, outputs) or not all(word in ("0", "1", "2") for word in words):
        raise InputError(f"{path}:{line}:1: #VS: expected 0, 1 or 2, once or for each output; found {text!r}")
    kinds = [int(word) for word in words]
    return kinds + [0] * (outputs - len(kinds))


def _rows(path: Path, lines: Sequence[str], first: int, width: int) -> tuple[list[list[float]], list[int]]:
    """Return the numbers of the samples, and their line numbers from 1."""
    rows: list[list[float]] = []
    numbers: list[int] = []
    for number, line in enumerate(lines[first:], start=first + 1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        try:
            row = [float(word) for word in words]
        except ValueError:
            row = []
        if len(row) != width or not np.isfinite(row).all():
            raise InputError(f"{path}:{number}:{_wrong(line, width)}")
        rows.append(row)
        numbers.append(number)
    if not rows:
        raise InputError(f"{path}: expected samples after the head; found none")
    return rows, numbers


def _wrong(line: str, width: int) -> str:
    """Return the column of the first error in a line, and a description of the error."""
    words = list(re.finditer(r"\S+", line))
    for word in words:
        try:
            usable = np.isfinite(float(word[0]))
        except ValueError:
            usable = False
        if not usable:
            return f"{word.start() + 1}: expected a number; found {word[0]!r}"
    beyond = words[width].start() if len(words) > width else len(line.rstrip())
    return f"{beyond + 1}: expected {width} numbers in the line, by DIM and VS; found {len(words)}"


def _bounds(
    path: Path, table: Array, values: Array, kinds: Sequence[int], numbers: Sequence[int]
) -> tuple[Array, Array]:
    """Return lower and upper bounds [n, outputs], NaN for no bound."""
    low, high = np.full(values.shape, np.nan), np.full(values.shape, np.nan)
    column = 0
    for output, kind in enumerate(kinds):
        if kind == 1:
            low[:, output], high[:, output] = (values[:, output] + s * table[:, column] for s in (-1.0, 1.0))
        elif kind == 2:
            low[:, output], high[:, output] = table[:, column], table[:, column + 1]
        column += kind
    high[high >= _OPEN * (1.0 - 1e-6)] = np.inf
    low[low <= -_OPEN * (1.0 - 1e-6)] = -np.inf
    if (wrong := low > high).any():
        row, output = np.argwhere(wrong)[0]
        raise InputError(
            f"{path}:{numbers[row]}:1: expected a lower and an upper bound; found {low[row, output]:g} and "
            f"{high[row, output]:g}. Is VS right?"
        )
    return low, high


# -- directions -----------------------------------------------------------------------------------------------


def _way(theta: Array, phi: Array) -> Array:
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)


def _about_half(theta_h: Array, phi_h: Array, theta_d: Array, phi_d: Array) -> tuple[Array, Array]:
    """Return the directions to light and eye; ALTA's difference vector is the eye's."""
    about = _way(theta_d, phi_d)
    cosine, sine = np.cos(theta_h), np.sin(theta_h)

    def about_half_vector(x: Array, y: Array, z: Array) -> Array:
        along = cosine * x + sine * z
        across, up = y, cosine * z - sine * x
        return np.stack(
            [np.cos(phi_h) * along - np.sin(phi_h) * across, np.sin(phi_h) * along + np.cos(phi_h) * across, up],
            axis=-1,
        )

    x, y, z = about.T
    return about_half_vector(-x, -y, z), about_half_vector(x, y, z)


def _directions_of_projection(theta_l: Array, along: Array, across: Array) -> tuple[Array, Array]:
    light = _way(theta_l, np.zeros_like(theta_l))
    return light, _way(np.hypot(along, across), np.arctan2(across, along))


WAYS: dict[str, tuple[int, Callable[..., tuple[Array, Array]]]] = {
    "ISOTROPIC_TL_TV_PROJ_DPHI": (3, _directions_of_projection),
    "ISOTROPIC_TV_TL_DPHI": (3, lambda eye, led, dphi: (_way(led, dphi), _way(eye, 0.0 * eye))),
    "RUSIN_TH_TD": (2, lambda h, d: _about_half(h, 0.0 * h, d, 0.0 * h + 0.5 * np.pi)),
    "COS_TH_TD": (2, lambda h, d: _about_half(np.arccos(h), 0.0 * h, np.arccos(d), 0.0 * h)),
    "RUSIN_TH_TD_PD": (3, lambda h, d, phi: _about_half(h, 0.0 * h, d, phi)),
    "RUSIN_TH_PH_TD_PD": (4, _about_half),
    "SPHERICAL_TL_PL_TV_PV": (4, lambda led, phi_led, eye, phi_eye: (_way(led, phi_led), _way(eye, phi_eye))),
    "CARTESIAN": (6, lambda *all_six: (np.stack(all_six[3:], axis=-1), np.stack(all_six[:3], axis=-1))),
}
"""Number of inputs of each parametrisation that gives both directions, and its function for the directions to
light and eye; rad."""


# -- between samples ------------------------------------------------------------------------------------------


def interpolated_brdf(samples: AltaSamples) -> Brdf:
    """Return the reflectance [..., outputs] of an isotropic, reciprocal material, interpolated between its
    samples.

    Each pair of directions is a point. Its coordinates are the root of theta_h, and the light's position about the
    half vector: theta_d at the azimuth phi_d. The azimuth is folded to 0 to 90 degrees, because exchange and
    mirror image of the directions allow it. Between the four samples around a point (Delaunay's tetrahedra) values
    are linear; outside of all tetrahedra the nearest sample is used. Samples at one point are averaged, and values
    below 0 become 0. Raises InputError for values that are not f in 1/sr, for too few samples, and for samples in
    one plane.
    """
    from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator
    from scipy.spatial import QhullError

    if samples.given_out not in (None, PER_STERADIAN):
        raise InputError(f"{samples.path}: PARAM_OUT: expected {PER_STERADIAN}; found {samples.given_out}")
    light, eye = samples.directions()
    above = (light[:, 2] > 0.0) & (eye[:, 2] > 0.0)
    if above.sum() < _FEWEST:
        raise InputError(f"{samples.path}: expected {_FEWEST} samples above the surface; found {above.sum()}")
    points, values = _merge_points(_place(light[above], eye[above]), np.maximum(samples.values[above], 0.0))
    try:
        between = LinearNDInterpolator(points, values)
    except QhullError as error:
        raise InputError(
            f"{samples.path}: its samples leave nothing to interpolate: their angles lie in one plane. Measure, "
            "or export, more angles of light and eye"
        ) from error
    return partial(_between, between=between, nearest=NearestNDInterpolator(points, values))


def _merge_points(points: Array, values: Array) -> tuple[Array, Array]:
    """Return the different points, and the mean of the values at each."""
    _, first, group = np.unique(np.round(points, 6), axis=0, return_index=True, return_inverse=True)
    total = np.zeros((len(first), values.shape[1]))
    np.add.at(total, group.ravel(), values)
    return points[first], total / np.bincount(group.ravel())[:, None]


def _place(light: Array, eye: Array) -> Array:
    """[..., 3] coordinates of pairs of unit directions."""
    half, _ = half_vector(light, eye)
    theta_h = np.arctan2(np.hypot(half[..., 0], half[..., 1]), half[..., 2])
    across = np.linalg.norm(light - eye, axis=-1)
    theta_d = np.arcsin(np.minimum(0.5 * across, 1.0))
    # The light's azimuth about the half vector, from the side of the normal.
    flat = half * half[..., 2:] - np.array([0.0, 0.0, 1.0])
    length = np.linalg.norm(flat, axis=-1, keepdims=True)
    flat = np.where(length > 1e-9, flat / np.maximum(length, 1e-12), [1.0, 0.0, 0.0])
    aside = np.cross(half, flat)
    apart = light - eye
    phi_d = np.arctan2(np.abs(np.sum(apart * aside, axis=-1)), np.abs(np.sum(apart * flat, axis=-1)))
    return np.stack([np.sqrt(theta_h), theta_d * np.cos(phi_d), theta_d * np.sin(phi_d)], axis=-1)


def _between(
    wi: Array, wo: Array, *, between: Callable[[Array], Array], nearest: Callable[[Array], Array]
) -> Array:
    wi, wo = np.broadcast_arrays(wi, wo)
    at = _place(wi, wo)
    values = between(at)
    values = np.where(np.isnan(values), nearest(at), values)
    above = (wi[..., 2] > 0.0) & (wo[..., 2] > 0.0)
    return np.where(above[..., None], values, 0.0)
