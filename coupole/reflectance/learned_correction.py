"""Correction of the error of interpolation between lights, learnt from the lights themselves.

Shadows and highlights move as the light moves, but a weighted sum of pictures fades one picture into the next. If
a light is left out, the difference between its picture and the sum is known. A small network is trained on these
differences, from the kernels' values and from the nearest pictures at the pixel and around it. Each light is left
out together with its nearest neighbour: a new light is farther from the measured lights than these are from each
other.

The network sees values as shares of the pixel's mean, so its answer does not depend on exposure or albedo. The
corrected value never leaves the range of the kernels' and the nearest pictures' values.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from coupole.reflectance import light_interpolation
from coupole.reflectance.light_interpolation import KERNELS, left_without, nearest

Floats = NDArray[np.float32]

NEAR = 6
"""Number of pictures of the nearest lights that are used."""
AROUND = 4
"""Number of these pictures that are also used in the pixel's surroundings."""
SURROUNDINGS_PX = (3, 7, 5)
"""Widths of squares: two around the sum, one around the near pictures."""
MARGIN_PX = 3
LEFT_OUT_WITH = 1
HIDDEN = (48, 48)
_LEAK = 0.05
_BATCH = 4096
MOST_SAMPLES = 4_000_000
"""Largest number of samples that are kept for training."""
_MOST_STEPS, _LOOKS = 2500, 8
"""Training ends after the first number of steps, or when each sample has been used as often as the second
number."""
_RATE = 3e-3
_CLIPPED = 1.0
"""Differences beyond this multiple of the usual difference have no more weight than this."""
_DISTANCE_SCALE = 5.0


@dataclass(frozen=True)
class Strip:
    """Values in some rows of a picture, under some lights."""

    mask: NDArray[np.bool_]
    """[rows, w]"""
    values: Floats
    """[lights, pixels, 3] values of the mask's pixels, row by row."""
    level: Floats
    """[pixels] mean of a pixel's values, never 0; values are divided by it."""


def strip_of(mask: NDArray[np.bool_], values: Floats, least_level: float) -> Strip:
    return Strip(mask, values, values.mean(axis=(0, 2)) + np.float32(least_level))


@dataclass(frozen=True)
class Sight:
    """Input of the network for one light at the pixels of a strip, and the bounds of its output."""

    kernel_sum: Floats
    """[pixels, 3] weighted sum of pictures by the first kernel, as shares of the pixel's level."""
    features: Floats
    """[pixels * 3, features]"""
    low: Floats
    high: Floats


def look(
    strip: Strip, directions: NDArray[np.float64], direction: NDArray[np.float64], kernels: Sequence[str]
) -> Sight:
    """Return the input for a new light from the strip's values under lights in `directions`; the sum is by the
    first kernel."""
    weights = np.concatenate(
        [light_interpolation.weights(directions, direction[None], kernel) for kernel in kernels]
    )
    count = len(strip.level)
    flat = strip.values.reshape(len(directions), -1)
    sums = (weights.astype(np.float32) @ flat).reshape(len(kernels), count, 3) / strip.level[:, None]
    first_sum: Floats = sums[0]
    near = nearest(directions, direction, NEAR)
    near_pictures = strip.values[near] / strip.level[:, None]
    least, most = near_pictures.min(axis=0), near_pictures.max(axis=0)
    parts = [
        first_sum,
        *(other_sum - first_sum for other_sum in sums[1:]),
        *(light_picture - first_sum for light_picture in near_pictures),
    ]
    parts += [
        least - first_sum,
        most - first_sum,
        np.broadcast_to(first_sum.mean(axis=1, keepdims=True), first_sum.shape),
    ]
    parts += [mean_around(strip.mask, first_sum, width) - first_sum for width in SURROUNDINGS_PX[:2]]
    for place in near[:AROUND]:
        light_picture = strip.values[place] / strip.level[:, None]
        parts.append(mean_around(strip.mask, light_picture, SURROUNDINGS_PX[2]) - light_picture)
        distance = np.float32(_DISTANCE_SCALE * np.linalg.norm(directions[place] - direction))
        parts.append(np.broadcast_to(distance, first_sum.shape))
    features = np.stack(parts, axis=-1).astype(np.float32).reshape(count * 3, -1)
    return Sight(first_sum, features, np.minimum(least, sums.min(axis=0)), np.maximum(most, sums.max(axis=0)))


def mean_around(mask: NDArray[np.bool_], values: Floats, width_px: int) -> Floats:
    """[pixels, 3] means over squares, of the mask's pixels only."""
    import cv2

    picture = np.zeros((*mask.shape, values.shape[-1]), np.float32)
    picture[mask] = values
    share = cv2.blur(mask.astype(np.float32), (width_px, width_px))[mask]
    sums = cv2.blur(picture, (width_px, width_px))[mask]
    return np.asarray(sums / np.maximum(share, 1e-6)[:, None], dtype=np.float32)


class Network:
    """A perceptron with leaky ramps. `layers` are pairs of a matrix and an offset; the first layer includes the
    scaling of the features."""

    def __init__(self, layers: Sequence[tuple[Floats, Floats]]) -> None:
        self.layers = tuple(layers)

    def __call__(self, features: Floats) -> Floats:
        """[n] outputs from features [n, m]."""
        return self.forward(features)[-1][:, 0]

    def forward(self, features: Floats) -> list[Floats]:
        """Return the outputs of all layers, the features first."""
        outputs = [features]
        for number, (matrix, offset) in enumerate(self.layers):
            output = outputs[-1] @ matrix + offset
            last = number == len(self.layers) - 1
            outputs.append(output if last else np.maximum(output, np.float32(_LEAK) * output))
        return outputs

    def gradients(self, outputs: list[Floats], slope: Floats) -> list[tuple[Floats, Floats]]:
        """Return, by matrices and offsets, the gradients of a cost with the derivative `slope` [n, 1] by the last
        output."""
        gradients = []
        for number in range(len(self.layers) - 1, -1, -1):
            gradients.append((outputs[number].T @ slope, slope.sum(axis=0)))
            if number:
                ramp = np.where(outputs[number] > 0, np.float32(1.0), np.float32(_LEAK))
                slope = (slope @ self.layers[number][0].T) * ramp
        return gradients[::-1]


def initial_network(features: int, generator: np.random.Generator) -> Network:
    """Return a network with an output near 0 (He et al. 2015 for the spread of its first weights)."""
    sizes = (features, *HIDDEN, 1)
    layers = []
    for number, (rows, columns) in enumerate(pairwise(sizes)):
        deviation = np.sqrt(2.0 / rows) * (0.01 if number == len(HIDDEN) else 1.0)
        layers.append(
            (generator.normal(0.0, deviation, (rows, columns)).astype(np.float32), np.zeros(columns, np.float32))
        )
    return Network(layers)


class _Adam:
    """Optimiser that makes the steps of Kingma and Ba (2015)."""

    def __init__(self, network: Network) -> None:
        self._parts = [part for layer in network.layers for part in layer]
        self._mean = [np.zeros_like(part) for part in self._parts]
        self._square = [np.zeros_like(part) for part in self._parts]
        self._count = 0

    def step(self, gradients: list[tuple[Floats, Floats]], rate: float) -> None:
        self._count += 1
        flat = [part for layer in gradients for part in layer]
        for part, mean, square, slope in zip(self._parts, self._mean, self._square, flat, strict=True):
            mean[...] += np.float32(0.1) * (slope - mean)
            square[...] += np.float32(0.001) * (slope * slope - square)
            size = np.sqrt(square / (1.0 - 0.999**self._count)) + 1e-8
            part[...] -= (rate / (1.0 - 0.9**self._count) * mean / size).astype(np.float32)


@dataclass(frozen=True)
class Lesson:
    """A strip without one light, and the values under that light."""

    features: Floats
    targets: Floats
    """[n] amounts to be added to the sum, as shares of the level."""
    importance: Floats
    """[n] square of the level."""


def lessons(
    strip: Strip,
    directions: NDArray[np.float64],
    lights: Sequence[int],
    kernels: Sequence[str],
    *,
    share: float,
    generator: np.random.Generator,
) -> Iterator[Lesson]:
    """Yield the lesson of each of these lights, with a share of the pixels drawn at random."""
    for light in lights:
        other_lights = left_without(directions, light, LEFT_OUT_WITH)
        sight = look(
            Strip(strip.mask, strip.values[other_lights], strip.level),
            directions[other_lights],
            directions[light],
            kernels,
        )
        targets = (strip.values[light] / strip.level[:, None] - sight.kernel_sum).ravel()
        pixels = np.flatnonzero(generator.random(len(targets)) < share)
        yield Lesson(sight.features[pixels], targets[pixels], np.repeat(strip.level**2, 3)[pixels])


def join_lessons(parts: Sequence[Lesson]) -> Lesson:
    """Join the training samples of one light from several strips."""
    return Lesson(
        np.concatenate([part.features for part in parts]),
        np.concatenate([part.targets for part in parts]),
        np.concatenate([part.importance for part in parts]),
    )


def train(
    lessons_of_lights: Sequence[Lesson], *, seed: int = 0, say: Callable[[int, int], None] = lambda done, of: None
) -> Network:
    """Return a network trained on lessons of all lights. All lights have the same weight, however difficult they
    are."""
    features = np.concatenate([lesson.features for lesson in lessons_of_lights])
    targets = np.concatenate([lesson.targets for lesson in lessons_of_lights])
    errors = [float(np.mean(lesson.importance * lesson.targets**2)) for lesson in lessons_of_lights]
    common = float(np.median(errors)) + 1e-20
    roots = np.concatenate(
        [
            np.sqrt(lesson.importance / (error + common))
            for lesson, error in zip(lessons_of_lights, errors, strict=True)
        ]
    ).astype(np.float32)
    roots /= np.sqrt(np.mean(roots**2))
    np.minimum(roots, np.float32(np.sqrt(20.0)), out=roots)
    middle, deviation = features.mean(axis=0), features.std(axis=0) + np.float32(1e-6)
    generator = np.random.default_rng(seed)
    network = initial_network(features.shape[1], generator)
    adam = _Adam(network)
    steps = min(_MOST_STEPS, 1 + _LOOKS * len(targets) // _BATCH)
    for number in range(steps):
        batch = generator.integers(0, len(targets), _BATCH)
        outputs = network.forward((features[batch] - middle) / deviation)
        root = roots[batch][:, None]
        off = np.clip(root * (outputs[-1] - targets[batch][:, None]), -_CLIPPED, _CLIPPED)
        rate = 0.5 * _RATE * (1.0 + np.cos(np.pi * number / steps))
        adam.step(network.gradients(outputs, 2.0 / _BATCH * root * off), rate)
        if number % 50 == 0:
            say(number, steps)
    first, offset = network.layers[0]
    first_layer = (first / deviation[:, None], offset - (middle / deviation) @ first)
    return Network([first_layer, *network.layers[1:]])


def corrected_values(strip: Strip, sight: Sight, network: Network | None) -> Floats:
    """[pixels, 3] values of the new light, not below 0; without a network, the sum alone."""
    values: Floats = sight.kernel_sum
    if network is not None:
        values = np.clip(values + network(sight.features).reshape(values.shape), sight.low, sight.high)
    return np.maximum(values, 0.0) * strip.level[:, None]


def all_kernels(first: str) -> tuple[str, ...]:
    """Return the kernel of the sum first, then the other kernels."""
    return (first, *(kernel for kernel in KERNELS if kernel != first))
