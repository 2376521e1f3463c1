"""Tables of RGL's format: files written by Mitsuba's own writer, evaluated by its own material."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lazily import lazily

from coupole.appearance.matter.rgl_table import read_bsdf
from coupole.errors import InputError

mitsuba: Any = lazily("mitsuba")
tensor_io: Any = lazily("mitsuba.python.tensor_io")

WAVELENGTHS_NM = np.array([410.0, 433.0, 560.0, 690.0], np.float32)
PARTS = {
    "isotropic": [0.0],
    "all round": np.linspace(-np.pi, np.pi, 5),
    "half": np.linspace(-np.pi, 0.0, 4),
    "quarter": np.linspace(-np.pi, -0.5 * np.pi, 3),
}


def made_up(azimuths: Any, *, spectral: bool, jacobian: bool = True) -> dict[str, Any]:
    """Any values: where one is read in another's place, it shows. Isotropic ones have a mirror image of themselves
    on the other side, as Mitsuba may mirror directions to them: what tells it how is not set then."""
    random = np.random.default_rng(5)
    grid = len(azimuths), 5
    isotropic = len(azimuths) == 1

    def plane(*shape: int) -> np.ndarray:
        found = random.uniform(0.2, 2.0, shape).astype(np.float32)
        return found + found[..., ::-1, :] if isotropic else found

    values = plane(*grid, 4 if spectral else 3, 8, 8)
    return {
        "theta_i": np.array([0.1, 0.3, 0.8, 1.1, 1.5], np.float32),
        "phi_i": np.array(azimuths, np.float32),
        "ndf": plane(9, 12),
        "sigma": np.repeat(plane(2, 5)[:1], 6, axis=0) if isotropic else plane(6, 5),
        "vndf": plane(*grid, 10, 14),
        "luminance": values.mean(axis=2),
        **({"wavelengths": WAVELENGTHS_NM, "spectra": values} if spectral else {"rgb": values}),
        "description": "made up",
        "jacobian": np.array([jacobian], np.uint8),
    }


def written(path: Path, fields: dict[str, Any]) -> Path:
    tensor_io.write(str(path), **fields)
    return path


def directions(count: int, seed: int) -> np.ndarray:
    ways = np.random.default_rng(seed).normal(size=(count, 3))
    ways[:, 2] = np.abs(ways[:, 2]) + 0.02
    found: np.ndarray = ways / np.linalg.norm(ways, axis=1, keepdims=True)
    return found


def by_mitsuba(path: Path, ways_in: np.ndarray, ways_out: np.ndarray) -> np.ndarray:
    """It gives f times the cosine of the way out."""
    bsdf = mitsuba.load_dict({"type": "measured", "filename": str(path)})
    interaction, context = mitsuba.SurfaceInteraction3f(), mitsuba.BSDFContext()
    if "spectral" in mitsuba.variant():
        interaction.wavelengths = WAVELENGTHS_NM.tolist()
    found = []
    for way_in, way_out in zip(ways_in, ways_out, strict=True):
        interaction.wi = mitsuba.Vector3f(*way_in)
        found.append(np.array(bsdf.eval(context, interaction, mitsuba.Vector3f(*way_out))))
    return np.array(found) / ways_out[:, 2:]


@pytest.mark.parametrize("spectral", [False, True])
@pytest.mark.parametrize("part", PARTS)
def test_a_table_gives_what_mitsuba_makes_of_it(part: str, spectral: bool, tmp_path: Path) -> None:
    """Half of the tables are multiplied by the normals' density, half are not."""
    mitsuba.set_variant("scalar_spectral" if spectral else "scalar_rgb")
    path = written(tmp_path / "a.bsdf", made_up(PARTS[part], spectral=spectral, jacobian=part != "half"))
    ways_in, ways_out = directions(300, 1), directions(300, 2)
    table = read_bsdf(path)
    assert table.isotropic == (part == "isotropic")
    off = np.abs(table(ways_in, ways_out) / by_mitsuba(path, ways_in, ways_out) - 1.0)
    assert np.median(off) < 1e-6  # Mitsuba's single precision; 3e-7 were found
    assert off.max() < 1e-4


def test_directions_keep_their_shape_and_below_the_horizon_there_is_nothing(tmp_path: Path) -> None:
    table = read_bsdf(written(tmp_path / "a.bsdf", made_up([0.0], spectral=False)))
    ways_in, ways_out = directions(12, 1).reshape(3, 4, 3), directions(4, 2)
    found = table(ways_in, ways_out)
    assert found.shape == (3, 4, 3)
    np.testing.assert_array_equal(found[1, 2], table(ways_in[1, 2], ways_out[2]))
    assert (table(ways_in, ways_out * [1, 1, -1]) == 0).all()
    assert (table(ways_in * [1, 1, -1], ways_out) == 0).all()


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"vndf": None}, "found no field `vndf`"),
        ({"rgb": None}, "found no field `rgb`"),
        ({"jacobian": None}, "field `jacobian`: expected one number"),
        ({"theta_i": np.array([0.0, 0.5, 0.5, 1.0, 1.5], np.float32)}, "field `theta_i`: expected rising values"),
        ({"sigma": np.ones((4, 4))}, "field `sigma`: expected float32, n x n; found float64, 4 x 4"),
        ({"vndf": np.ones((1, 4, 8, 8), np.float32)}, "expected float32, 1 x 5 x n x n; found float32, 1 x 4"),
        ({"ndf": np.full((4, 4), np.nan, np.float32)}, "field `ndf`: contains values that are not numbers"),
        ({"vndf": np.zeros((1, 5, 4, 4), np.float32)}, "`vndf` or `sigma` is 0"),
        ({"vndf": np.full((1, 5, 4, 4), -1, np.float32)}, "`vndf`: expected planes of 2 x 2 or more"),
    ],
)
def test_a_table_that_cannot_be_used_is_refused(change: dict[str, Any], why: str, tmp_path: Path) -> None:
    fields = made_up([0.0], spectral=False) | change
    path = written(tmp_path / "a.bsdf", {name: value for name, value in fields.items() if value is not None})
    with pytest.raises(InputError, match=re.escape(why)) as refused:
        read_bsdf(path)
    assert str(path) in str(refused.value)


def test_another_file_or_a_part_of_one_is_refused(tmp_path: Path) -> None:
    path = written(tmp_path / "a.bsdf", made_up([0.0], spectral=False))
    data = path.read_bytes()
    for content, why in (
        (data[:-4000], "was cut short"),
        (data[:40], "was cut short"),
        (b"<scene/>" * 9, "begins with `tensor_file`; found b'<scene/>"),
    ):
        path.write_bytes(content)
        with pytest.raises(InputError, match=re.escape(why)):
            read_bsdf(path)
    with pytest.raises(InputError, match="cannot read the material"):
        read_bsdf(tmp_path / "none.bsdf")
