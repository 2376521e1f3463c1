"""What clusters borrow and how they are judged, by triangles whose samples are known."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from triangle_cases import noisy_case, unit

from coupole.reflectance import run_clusters
from coupole.reflectance.cluster_file import Clusters
from coupole.reflectance.pair_harmonics import count_of
from coupole.reflectance.run_pictures import HeldOut
from coupole.reflectance.triangle_fit import TriangleMaterials, TriangleSamples, model_values

KD = np.array([[0.3, 0.3, 0.3], [0.05, 0.05, 0.05]])


def shared(normals: np.ndarray, kd: np.ndarray) -> TriangleMaterials:
    return TriangleMaterials(normals, kd, np.full(kd.shape, 1e-4), np.full(len(kd), 0.3), np.zeros(len(kd)))


def said(step: str, done: int, of: int) -> None:
    pass


@pytest.mark.parametrize(("without_view", "expected"), [(None, 0), ("side", 1)])
def test_a_view_that_is_left_out_does_not_tell_what_is_borrowed(without_view: str | None, expected: int) -> None:
    """Triangles are dark from the top, and bright in the samples, many more, from the side."""
    samples, _ = noisy_case(2)
    samples = samples.of_triangles(np.arange(3))
    names = np.array(["top", "side"])[samples.view_of]
    materials = shared(samples.normals[:2], KD)
    bright, dark = (
        model_values(samples, shared(samples.normals, np.repeat(KD[[n]], 3, axis=0))) for n in range(2)
    )
    values = np.where((names == "side")[:, None], bright, dark)
    values[:, np.flatnonzero(names == "top")[10:]] = np.nan
    samples = replace(samples, values=values.astype(np.float32))
    of_samples = {"leds": np.tile(np.arange(120), 2), "names": names}
    result: Any = SimpleNamespace(
        blocks=lambda budget: [slice(0, 3)],
        along_samples=lambda block, name: of_samples[name],
        samples=lambda block: samples,
    )
    cluster = np.full(3, -1, np.int64)
    borrowed = run_clusters._borrow(result, materials, cluster, [], without_view, 1 << 30, said)
    assert borrowed.all()
    assert cluster.tolist() == [expected] * 3


def test_ways_are_judged_where_all_of_them_have_a_value(monkeypatch: pytest.MonkeyPatch) -> None:
    """Light below the horizon of the fitted normal: GGX is 0 there, harmonics have no value."""
    normals = unit(np.array([[0.0, 0.0, 1.0]]))
    led_mm = np.array([[0.0, 0.0, 900.0], [900.0, 0.0, -50.0]])  # the second below the horizon
    values = np.full((1, 2, 3), 0.25, np.float32)
    samples = TriangleSamples(
        values, led_mm, np.zeros(2, np.int64), np.array([[0.0, 50, 400]]), np.zeros((1, 3)), normals, np.ones(1)
    )
    own = shared(normals, KD[:1])
    harmonics = np.zeros((1, count_of(2), 3), np.float32)
    clusters = Clusters(
        np.zeros(1, np.int32), np.zeros(1, np.bool_), own.kd, own.ks, own.alpha, own.residual, harmonics
    )
    block = np.zeros(1, np.int64), np.full((1, 2), 0.25, np.float32)
    part = HeldOut(slice(0, 1), np.zeros(1, np.int64), samples, np.ones((1, 2, 3)), [0, 1], (block,) * 3)
    monkeypatch.setattr(run_clusters, "held_out", lambda *_: [part])
    result: Any = SimpleNamespace(clusters=clusters, materials=lambda name, places: own)
    view: Any = SimpleNamespace(view="top", triangles=np.zeros(1))
    for found in run_clusters._mae(result, {}, [view], 1 << 30, said).values():
        assert found["own"] == found["clustered"] == pytest.approx(0.05, abs=5e-3)
        assert found["harmonics"] == pytest.approx(0.25)
        assert found["borrowed"] is None
