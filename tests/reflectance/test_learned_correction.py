import numpy as np
import pytest
from picture_cases import ball_on_a_plane, lights_in_rings

from coupole.reflectance import learned_correction as learned
from coupole.reflectance.learned_correction import Lesson, Network


def test_gradients_are_those_of_small_steps() -> None:
    generator = np.random.default_rng(2)
    network = learned.initial_network(7, generator)
    for matrix, _ in network.layers:
        matrix[...] += generator.normal(0, 0.1, matrix.shape).astype(np.float32)
    features = generator.normal(size=(20, 7)).astype(np.float32)
    wanted = generator.normal(size=(20, 1)).astype(np.float32)

    def cost() -> float:
        return float(np.sum((network.forward(features)[-1].astype(np.float64) - wanted) ** 2))

    outputs = network.forward(features)
    found = network.gradients(outputs, 2 * (outputs[-1] - wanted))
    for (matrix, offset), (by_matrix, by_offset) in zip(network.layers, found, strict=True):
        for part, by_part in ((matrix, by_matrix), (offset, by_offset)):
            place = np.unravel_index(np.argmax(np.abs(by_part)), part.shape)
            before, step = part[place], 1e-2
            part[place] = before + step
            above = cost()
            part[place] = before - step
            below = cost()
            part[place] = before
            assert by_part[place] == pytest.approx((above - below) / (2 * step), rel=2e-2)


def test_what_can_be_learnt_is_learnt_whatever_the_features_scales() -> None:
    generator = np.random.default_rng(3)
    features = (generator.normal(size=(40_000, 3)) * [1, 100, 0.01] + [5, 0, -2]).astype(np.float32)
    wanted = np.abs(features[:, 1] / 100).astype(np.float32)
    network = learned.train([Lesson(features, wanted, np.ones(len(wanted), np.float32))])
    rms = np.sqrt(np.mean((network(features) - wanted) ** 2))
    assert rms < 0.2 * wanted.std()


def test_the_answer_stays_between_what_is_there() -> None:
    lights = lights_in_rings()
    _, pictures = ball_on_a_plane(lights)
    mask = np.ones(pictures.shape[1:3], dtype=bool)
    strip = learned.strip_of(mask, pictures.reshape(len(lights), -1, 3).astype(np.float32), 1e-3)
    sight = learned.look(strip, lights, lights[4] + [0.05, 0, 0], learned.all_kernels("linear"))
    wild = Network([(np.full((sight.features.shape[1], 1), 50.0, np.float32), np.zeros(1, np.float32))])
    made = learned.corrected_values(strip, sight, wild)
    assert np.all(made <= np.maximum(sight.high, 0) * strip.level[:, None] * (1 + 1e-6))
    assert made.min() >= 0
