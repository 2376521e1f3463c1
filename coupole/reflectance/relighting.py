"""Pictures under new lights, from a result of pictures under known lights."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError
from coupole.reflectance import learned_correction as learned
from coupole.reflectance import light_interpolation
from coupole.reflectance.learned_correction import MARGIN_PX, Network, Strip
from coupole.reflectance.light_gains import SUSPECT, gain_between
from coupole.reflectance.light_interpolation import KERNELS, left_without
from coupole.reflectance.new_light.environment import OF_PICTURES, read_environment
from coupole.reflectance.new_light.light_kinds import AnyLight, DistantLight, EnvironmentLight
from coupole.reflectance.picture_result import INTERPOLATION, PictureResult, open_result_file
from coupole.storage.hdf5_file import hdf5_file

Floats = NDArray[np.float32]
Beams = Sequence[tuple[NDArray[np.float64], NDArray[np.float64]]]
"""Directions [3] to distant lights, and their strengths [3]."""

STRIP_PIXELS = 60_000
"""Number of pixels in a strip, in which pictures are made. A strip has more only if a row has more."""
_TAUGHT_PIXELS = 60_000
"""Number of pixels from which the correction is learnt, in strips drawn at random."""
_TAUGHT_ROWS = 32
_KERNEL_PIXELS = 20_000
LEAST_LEVEL = 1e-3
"""Least level of a pixel, as a share of the 99.9 % quantile of all values. Darker pixels are treated as if they
had this level."""


@dataclass(frozen=True)
class Interpolation:
    """Data from which pictures under lights between the measured ones are made."""

    lights: NDArray[np.int64]
    """Numbers of the result's lights that are used, in rising order."""
    gains: NDArray[np.float64]
    """[lights] gains of their pictures; values are divided by them."""
    kernel: str
    left_out_rms: dict[str, float]
    """Rms error of each kernel for a left-out light, in full scales."""
    peak: float
    """99.9 % quantile of the values."""
    network: Network | None

    def write(self, path: Path) -> None:
        with hdf5_file(path, "w") as file:
            file.attrs.update(kernel=self.kernel, peak=self.peak)
            file["lights"], file["gains"] = self.lights, self.gains
            for kernel, rms in self.left_out_rms.items():
                file.attrs[f"left out rms, {kernel}"] = rms
            for number, (matrix, offset) in enumerate(self.network.layers if self.network else ()):
                file[f"network/{number}/matrix"], file[f"network/{number}/offset"] = matrix, offset


def read_interpolation(folder: Path) -> Interpolation:
    """Read the interpolation of a result folder. Raises InputError."""
    with open_result_file(folder / INTERPOLATION) as file:
        layers = [
            (np.asarray(file[f"network/{number}/matrix"]), np.asarray(file[f"network/{number}/offset"]))
            for number in range(len(file["network"]) if "network" in file else 0)
        ]
        return Interpolation(
            np.asarray(file["lights"]),
            np.asarray(file["gains"]),
            str(file.attrs["kernel"]),
            {kernel: float(file.attrs[f"left out rms, {kernel}"]) for kernel in KERNELS},
            float(file.attrs["peak"]),
            Network(layers) if layers else None,
        )


def learn(
    result: PictureResult,
    lights: NDArray[np.int64],
    gains: NDArray[np.float64],
    *,
    say: Callable[[int, int], None] = lambda done, of: None,
) -> Interpolation:
    """Choose the kernel and learn the correction by leaving lights out. Pictures with a suspect gain are used for
    interpolation, but their differences are not learnt."""
    taught = list(_taught(result, lights, gains))
    every = np.concatenate([values for _, values in taught], axis=1)
    peak = float(np.quantile(every, 0.999))
    directions = result.directions[lights]
    rms = left_out_rms(every[:, :: max(1, every.shape[1] // _KERNEL_PIXELS)], directions)
    kernel = min(KERNELS, key=lambda name: rms[name])
    sound = np.flatnonzero(np.abs(gains - 1.0) <= SUSPECT)
    if (
        len(lights) <= learned.NEAR + learned.LEFT_OUT_WITH
    ):  # a lesson would have fewer near pictures than are asked
        return Interpolation(lights, gains, kernel, rms, peak, None)
    share, generator = learned.MOST_SAMPLES / (every.size + 1), np.random.default_rng(0)
    lessons_of_strips = []
    for mask, values in taught:
        strip = learned.strip_of(mask, values, LEAST_LEVEL * peak)
        kernels = learned.all_kernels(kernel)
        lessons_of_strips.append(
            list(learned.lessons(strip, directions, sound.tolist(), kernels, share=share, generator=generator))
        )
    by_light = [learned.join_lessons(parts) for parts in zip(*lessons_of_strips, strict=True)]
    network = learned.train(by_light, say=say) if by_light else None
    return Interpolation(lights, gains, kernel, rms, peak, network)


def left_out_rms(values: Floats, directions: NDArray[np.float64]) -> dict[str, float]:
    """Return the rms error of each kernel, from values [lights, pixels, 3], over all lights. Each light is left
    out with its nearest neighbour."""
    flat = values.reshape(len(values), -1)
    squares = dict.fromkeys(KERNELS, 0.0)
    for light in range(len(values)):
        other_lights = left_without(directions, light, learned.LEFT_OUT_WITH)
        for kernel in KERNELS:
            row = light_interpolation.weights(directions[other_lights], directions[light][None], kernel)[0]
            squares[kernel] += float(np.mean((row.astype(np.float32) @ flat[other_lights] - flat[light]) ** 2))
    return {kernel: float(np.sqrt(square / len(values))) for kernel, square in squares.items()}


def relit(result: PictureResult, interpolation: Interpolation, direction: NDArray[np.float64]) -> Floats:
    """[h, w, 3] linear, in full scales divided by the intensities, 0 outside the mask; `direction` [3], of any
    length, points to a distant light."""
    unit = direction / np.linalg.norm(direction)
    lights = interpolation.lights
    directions = result.directions[lights]
    kernels = learned.all_kernels(interpolation.kernel)
    gain = np.float32(gain_between(directions, interpolation.gains, unit))
    picture = np.zeros((*result.mask.shape, 3), np.float32)
    for top, bottom in strips(result.mask):
        above, below = max(0, top - MARGIN_PX), min(len(result.mask), bottom + MARGIN_PX)
        strip = strip_between(result, interpolation, above, below)
        sight = learned.look(strip, directions, unit, kernels)
        strip_picture = np.zeros((below - above, result.mask.shape[1], 3), np.float32)
        strip_picture[strip.mask] = gain * learned.corrected_values(strip, sight, interpolation.network)
        picture[top:bottom] = strip_picture[top - above : bottom - above]
    return picture


def relit_by(
    result: PictureResult,
    interpolation: Interpolation,
    lights: Sequence[AnyLight],
    samples: int,
    *,
    say: Callable[[int, int], None] = lambda done, of: None,
) -> Floats:
    """Return the same as `relit` under several lights, in the form of `beams_of`."""
    picture = np.zeros((*result.mask.shape, 3), np.float32)
    beams = beams_of(lights, samples)
    for number, (way, rgb) in enumerate(beams):
        picture += relit(result, interpolation, way) * rgb.astype(np.float32)
        say(number + 1, len(beams))
    return picture


def beams_of(lights: Sequence[AnyLight], samples: int) -> Beams:
    """Return lights as distant beams, with `samples` directions for each environment; directions behind the object
    are left out. Raises InputError for lights with places, because pictures contain no distances."""
    beams: list[tuple[NDArray[np.float64], NDArray[np.float64]]] = []
    for light in lights:
        match light:
            case DistantLight():
                beams.append((np.array(light.towards), light.rgb))
            case EnvironmentLight():
                environment = read_environment(light.file, OF_PICTURES, light.rgb, light.turn_deg)
                if not environment.radiance.any():
                    continue
                ways, radiances, densities = environment.sample(samples)
                strengths = radiances / (np.pi * densities[:, None])
                beams += [(way, rgb) for way, rgb in zip(ways, strengths, strict=True) if way[2] > 0.0]
            case _:
                raise InputError(
                    f"a light of the kind {light.kind}: a result of pictures has no distances, so its lights are "
                    "distant; expected direction or environment"
                )
    return beams


def strip_between(result: PictureResult, interpolation: Interpolation, top: int, bottom: int) -> Strip:
    """Return the values of some rows, divided by the pictures' gains."""
    values = _rows(result, interpolation.lights, interpolation.gains, top, bottom)
    return learned.strip_of(result.mask[top:bottom], values, LEAST_LEVEL * interpolation.peak)


def strips(mask: NDArray[np.bool_]) -> Iterator[tuple[int, int]]:
    """Yield the first row and the end of strips with about `STRIP_PIXELS` pixels of the mask each. Rows without
    such pixels are left out."""
    counts = np.count_nonzero(mask, axis=1)
    top, pixels = 0, 0
    for row, count in enumerate(counts):
        if pixels and pixels + count > STRIP_PIXELS:
            yield top, row
            top, pixels = row, 0
        pixels += int(count)
    if pixels:
        yield top, len(mask)


def _rows(
    result: PictureResult, lights: NDArray[np.int64], gains: NDArray[np.float64], top: int, bottom: int
) -> Floats:
    before, within = np.count_nonzero(result.mask[:top]), np.count_nonzero(result.mask[top:bottom])
    values = result.values(lights, slice(before, before + within))
    values /= gains[:, None, None].astype(np.float32)
    return values


def _taught(
    result: PictureResult, lights: NDArray[np.int64], gains: NDArray[np.float64]
) -> Iterator[tuple[NDArray[np.bool_], Floats]]:
    """Yield strips of rows, drawn at random, until they have enough pixels; a small picture is used whole."""
    mask = result.mask
    tops = [top for top in range(0, len(mask), _TAUGHT_ROWS) if mask[top : top + _TAUGHT_ROWS].any()]
    np.random.default_rng(0).shuffle(tops)
    pixels = 0
    for top in tops:
        if pixels >= _TAUGHT_PIXELS:
            return
        part = mask[top : top + _TAUGHT_ROWS]
        pixels += int(np.count_nonzero(part))
        yield part, _rows(result, lights, gains, top, top + _TAUGHT_ROWS)
