"""Maps of pigments from image cubes whose truth is known."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from cubes import NM, SHAPES, areas, batch, write_cube, write_library
from PIL import Image
from places import REPO, SHARED_DATA
from spectral.io import envi

from coupole.appearance.spectra.envi_cube import Cube, open_cube
from coupole.appearance.spectra.measured import Measured
from coupole.appearance.spectra.spectra_library import LibrarySpectrum, read_library
from coupole.commands.identify import identify
from coupole.errors import InputError
from coupole.heritage.analysis.identification import identify as identify_spectrum
from coupole.heritage.analysis.pigment_classes import read_classes, shipped_classes
from coupole.heritage.analysis.references import References, make_references
from coupole.heritage.analysis.spectral_features import BANDS_NM
from coupole.heritage.pigment_maps.image_identification import (
    FIRST_CLASS,
    NOT_LOOKED_AT,
    UNKNOWN,
    ImageFinding,
    band_matrix,
    identify_image,
)
from coupole.heritage.pigment_maps.pixel_regions import find_regions, noise_of_neighbours

SIDE = 24
PIGMENTS = SHARED_DATA / "pigments" / "KremerHistorical.rs"
MISSING = "red lead"


@pytest.fixture(scope="module")
def references(tmp_path_factory: pytest.TempPathFactory) -> References:
    """Five of the six shapes: red lead is not in the library."""
    library, classes = write_library(tmp_path_factory.mktemp("library"), [s for s in SHAPES if s != MISSING])
    return make_references(read_library(library), read_classes(classes))


@pytest.fixture(scope="module")
def cube(tmp_path_factory: pytest.TempPathFactory) -> Cube:
    """Six areas side by side, one of each shape."""
    return open_cube(write_cube(tmp_path_factory.mktemp("cube") / "panel.hdr", areas(SHAPES, SIDE)[0]))


def silent(step: str, count: int, of: int) -> None:
    """Say nothing."""


@pytest.fixture(scope="module")
def whole(cube: Cube, references: References, tmp_path_factory: pytest.TempPathFactory) -> ImageFinding:
    return identify_image(cube, references, tmp_path_factory.mktemp("state") / "whole", silent)


def test_each_area_has_its_class_and_the_missing_one_is_not_here(whole: ImageFinding) -> None:
    for number, shape in enumerate(SHAPES):
        codes = whole.codes[:, number * SIDE : (number + 1) * SIDE]
        wanted = UNKNOWN if shape == MISSING else FIRST_CLASS + whole.names[FIRST_CLASS:].index(shape)
        assert (codes == wanted).mean() > 0.99, shape
    assert MISSING not in whole.names
    assert whole.looked_at == SIDE * SIDE * len(SHAPES)
    assert sum(whole.pixels_of(code) for code in range(len(whole.names))) == whole.codes.size


def test_regions_are_areas_with_their_means_and_pixels_agree(whole: ImageFinding) -> None:
    assert len(whole.regions) == len(SHAPES)
    for region in whole.regions:
        first = np.flatnonzero((whole.region_numbers == region.number).any(axis=0))[0] // SIDE
        truth = np.interp(NM, np.arange(380.0, 781.0, 5.0), batch(SHAPES[first], 99))
        assert np.abs(region.mean - truth).max() < 0.005
        assert 0.003 < np.median(region.deviation) < 0.02
        assert region.agreement > 0.95
        assert region.draws_alike > 0.95
        mine = whole.confidence[whole.region_numbers == region.number]
        assert np.all((mine >= 0.0) & (mine <= 1.0))
        assert mine.mean() > 0.5


class Stopped(Exception):
    """Stands for Ctrl-C."""


@pytest.mark.parametrize("step", ["sample", "regions", "pixels"])
def test_an_interrupted_job_continues_and_gives_the_same(
    whole: ImageFinding, references: References, tmp_path: Path, step: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("coupole.appearance.spectra.envi_cube._BLOCK_VALUES", 6 * SIDE * len(NM) * 5)
    cube = open_cube(write_cube(tmp_path / "panel.hdr", areas(SHAPES, SIDE)[0]))
    assert cube.rows_at_once == 5

    def stop(name: str, count: int, of: int) -> None:
        if name == step and count >= of // 2:
            raise Stopped

    with pytest.raises(Stopped):
        identify_image(cube, references, tmp_path / "state", stop)
    reads = []
    monkeypatch.setattr(
        Cube, "read_rows", lambda self, a, b, read=Cube.read_rows: reads.append((a, b)) or read(self, a, b)
    )
    again = identify_image(cube, references, tmp_path / "state", silent)

    np.testing.assert_array_equal(again.codes, whole.codes)
    np.testing.assert_allclose(again.confidence, whole.confidence, atol=1e-4)
    assert not (tmp_path / "state").exists()
    blocks = [read for read in reads if read[1] - read[0] > 1]
    assert len(blocks) == {"sample": 2 * 5, "regions": 5 + 2, "pixels": 2}[step]


def test_a_state_of_another_question_is_not_used(references: References, tmp_path: Path) -> None:
    first = open_cube(write_cube(tmp_path / "one.hdr", areas(SHAPES[:2], SIDE)[0]))
    second = open_cube(write_cube(tmp_path / "two.hdr", areas(SHAPES[2:4], SIDE)[0]))

    def stop(name: str, count: int, of: int) -> None:
        if name == "pixels":
            raise Stopped

    with pytest.raises(Stopped):
        identify_image(first, references, tmp_path / "state", stop)

    found = identify_image(second, references, tmp_path / "state", silent)

    assert set(found.names[FIRST_CLASS:]) == set(SHAPES[2:4])


def test_masked_and_empty_pixels_are_not_looked_at(references: References, tmp_path: Path) -> None:
    reflectance = areas(SHAPES[:2], SIDE)[0]
    reflectance[:3] = 0.0
    cube = open_cube(write_cube(tmp_path / "panel.hdr", reflectance))
    mask = np.ones((SIDE, 2 * SIDE), bool)
    mask[:, SIDE:] = False

    found = identify_image(cube, references, tmp_path / "state", silent, mask=mask)

    assert (found.codes[3:, :SIDE] == FIRST_CLASS).all()
    assert found.names[FIRST_CLASS:] == (SHAPES[0],)
    assert (found.codes[:3] == NOT_LOOKED_AT).all()
    assert (found.codes[:, SIDE:] == NOT_LOOKED_AT).all()
    assert np.isnan(found.confidence[:, SIDE:]).all()
    with pytest.raises(InputError, match="expected pixels to look at, found none"):
        identify_image(cube, references, tmp_path / "state", silent, mask=np.zeros_like(mask))


def test_pixels_unlike_all_regions_are_not_identified(references: References, tmp_path: Path) -> None:
    # Three pixels of a pigment that the sample of 240 rows of 400 does not need to contain.
    reflectance = np.tile(areas(SHAPES[:1], SIDE)[0], (25, 1, 1))
    odd = np.interp(NM, np.arange(380.0, 781.0, 5.0), batch("vermilion", 99))
    reflectance[[100, 300, 500], 7] = odd
    cube = open_cube(write_cube(tmp_path / "panel.hdr", reflectance))

    found = identify_image(cube, references, tmp_path / "state", silent)

    assert (found.codes[[100, 300, 500], 7] == 1).all()
    assert (found.codes == FIRST_CLASS).mean() > 0.99


def test_radiances_and_percent_are_refused(references: References, tmp_path: Path) -> None:
    reflectance = areas(SHAPES[:1], SIDE)[0]
    percent = open_cube(write_cube(tmp_path / "a.hdr", reflectance, metadata={"reflectance scale factor": 100}))
    dark = open_cube(write_cube(tmp_path / "b.hdr", reflectance, metadata={"reflectance scale factor": 1e8}))

    for cube in (percent, dark):
        with pytest.raises(InputError, match=r"expected reflectances as fractions .* divided by a white"):
            identify_image(cube, references, tmp_path / "state", silent)


def test_the_matrix_of_bands_resamples_as_spectra_are() -> None:
    covered, matrix = band_matrix(NM)
    truth = np.interp(NM, np.arange(380.0, 781.0, 5.0), batch("azurite", 1))

    from coupole.heritage.analysis.spectral_features import on_bands

    expected = on_bands(Measured("one", NM, truth, ()))
    np.testing.assert_allclose(truth @ matrix, expected[covered], atol=1e-12)
    assert BANDS_NM[covered][0] == 400.0
    assert BANDS_NM[covered][-1] == 780.0
    coarse, lines = band_matrix(np.arange(400.0, 781.0, 20.0))
    np.testing.assert_allclose(np.full(20, 0.3) @ lines, np.full(len(coarse), 0.3))


def test_noise_is_that_of_the_pixels_and_edges_count_little() -> None:
    random = np.random.default_rng(4)
    row = np.where(np.arange(4000)[:, None] < 2000, 0.2, 0.7) + 0.01 * random.standard_normal((4000, 8))

    noise = noise_of_neighbours(row[:-1], row[1:])

    np.testing.assert_allclose(noise, 0.01, rtol=0.08)


def test_regions_do_not_split_noise_or_shading() -> None:
    random = np.random.default_rng(5)
    one, other = random.uniform(0.2, 0.6, (2, 30))
    spectra = np.concatenate([np.tile(one, (900, 1)), np.tile(other, (300, 1))])
    sample = spectra * (1.0 + 0.03 * random.standard_normal((1200, 1))) + 0.004 * random.standard_normal(
        (1200, 30)
    )

    regions = find_regions(sample, np.full(30, 0.004), 40)
    numbers, is_like, clean = regions.places(sample)

    assert len(regions.centres) == 2
    assert len(set(numbers[:900])) == len(set(numbers[900:])) == 1
    assert is_like.mean() > 0.99
    assert np.abs(clean - spectra).std() < np.abs(sample - spectra).std()


def test_quick_probabilities_are_those_of_the_model(references: References) -> None:
    of_bands = references.of_bands("", references.reflectance[0])
    random = np.random.default_rng(6)
    spectra = np.clip(of_bands.reflectance + 0.02 * random.standard_normal(of_bands.reflectance.shape), 0.0, 1.0)

    quick, slow = of_bands.model.quick_probabilities(spectra), of_bands.model.probabilities(spectra)

    np.testing.assert_allclose(quick, slow, atol=1e-3)


def test_the_command_writes_maps_that_others_read(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    library, classes = write_library(tmp_path / "library", SHAPES[:3])
    said = {"description": "Synthetic panel", "sensor type": "x9"}
    header = write_cube(tmp_path / "panel.hdr", areas(SHAPES[:4], SIDE)[0], metadata=said)
    mask = np.full((SIDE, 4 * SIDE), 255, np.uint8)
    mask[:2] = 0
    Image.fromarray(mask).save(tmp_path / "mask.png")
    out = tmp_path / "seen"

    identify(
        [header], library=library, classes=classes, report=out, mask=tmp_path / "mask.png",
        area=f"0:{SIDE},0:{4 * SIDE - 1}", as_json=True,
    )  # fmt: skip

    told = json.loads(capsys.readouterr().out)
    seen = envi.open(str(out / "classes.hdr"))
    codes = np.asarray(seen.open_memmap())[:, :, 0]
    names = seen.metadata["class names"]
    for number, shape in enumerate(SHAPES[:3]):
        assert names[codes[SIDE // 2, number * SIDE + SIDE // 2]] == shape
    assert (codes[2:, 3 * SIDE : 4 * SIDE - 1] == names.index("not in the library")).mean() > 0.99
    assert (codes[:2] == 0).all()
    assert (codes[:, -1] == 0).all()
    confidence = np.asarray(envi.open(str(out / "confidence.hdr")).open_memmap())[2:, :-1, 0]
    assert np.isfinite(confidence).mean() > 0.99
    shares = {code["name"]: code["pixels"] for code in told["codes"]}
    assert shares == {name: int((codes == number).sum()) for number, name in enumerate(names)}
    with Image.open(out / "classes.png") as picture:
        assert picture.height > picture.width * SIDE // (4 * SIDE)
        assert picture.getpixel((picture.width // 8, picture.width // 8)) == (
            tuple(map(int, seen.metadata["class lookup"][3 * codes[SIDE // 2, 1] :][:3]))
        )
    record = json.loads((out / "identification.json").read_text())
    assert record["simulated"]
    assert record["facts"] == {"instrument": "x9", "object": "Synthetic panel"}
    page = (out / "identification.html").read_text()
    assert "The data are simulated" in page
    assert "not in the library" in page
    assert len((out / "regions.csv").read_text().splitlines()) == 1 + len(NM)
    assert not (out / ".identify").exists()


def test_options_of_cubes_are_for_cubes(tmp_path: Path) -> None:
    library, classes = write_library(tmp_path / "library", SHAPES[:2])
    named = {"library": library, "classes": classes}
    header = write_cube(tmp_path / "panel.hdr", areas(SHAPES[:2], 4)[0])
    Image.new("L", (3, 3)).save(tmp_path / "small.png")

    with pytest.raises(InputError, match="an image needs --report"):
        identify([header], **named)
    with pytest.raises(InputError, match="expected one image cube and nothing else"):
        identify([header, library], **named, report=tmp_path / "seen")
    with pytest.raises(InputError, match="expected an image cube"):
        identify([library], **named, scale=100.0)
    with pytest.raises(InputError, match="--area 0:5,0:2: expected rows and columns"):
        identify([header], **named, report=tmp_path / "seen", area="0:5,0:2")
    with pytest.raises(InputError, match=r"expected a picture of 8 x 4 pixels, .* found 3 x 3"):
        identify([header], **named, report=tmp_path / "seen", mask=tmp_path / "small.png")


@pytest.mark.skipif(not PIGMENTS.is_file(), reason="shared data are not here")
def test_areas_of_published_spectra_that_the_library_does_not_contain(tmp_path: Path) -> None:
    # Two spectra of each of eight classes; the library has the others of seven of these classes.
    spectra = read_library(PIGMENTS)
    table = shipped_classes(spectra)
    of_class: dict[str, list[LibrarySpectrum]] = {}
    for spectrum in spectra:
        of_class.setdefault(table[spectrum.name].class_name, []).append(spectrum)
    classes = sorted((name for name in of_class if name), key=lambda name: (-len(of_class[name]), name))[:8]
    missing = classes[5]
    used = [(name, spectrum) for name in classes for spectrum in of_class[name][1:3]]
    names = {spectrum.name for _, spectrum in used}
    rest = [one for one in spectra if one.name not in names and table[one.name].class_name != missing]
    random = np.random.default_rng(9)
    columns = [
        np.interp(NM, one.wavelengths_nm, one.reflectance) * (1.0 + 0.02 * random.standard_normal((SIDE, SIDE, 1)))
        for _, one in used
    ]
    panel = np.concatenate(columns, axis=1)
    header = write_cube(tmp_path / "panel.hdr", panel + 0.004 * random.standard_normal(panel.shape))

    references = make_references(rest, table)
    found = identify_image(open_cube(header), references, tmp_path / "state", silent)

    right = wrong = alike = 0
    for number, (name, spectrum) in enumerate(used):
        codes = found.codes[:, number * SIDE : (number + 1) * SIDE]
        says = np.array(found.names)[codes]
        truth = np.interp(NM, spectrum.wavelengths_nm, spectrum.reflectance)
        alone = identify_spectrum(Measured("alone", NM, truth, ()), references)
        if name == missing:
            assert (codes == UNKNOWN).mean() > 0.99
        alike += int((says == {"match": alone.class_name}.get(alone.verdict, says)).sum())
        right += int((says == name).sum())
        is_part = np.array([name in each for each in found.names])[
            codes
        ]  # of a mixture, such as an ochre's two irons
        wrong += int(((codes >= FIRST_CLASS) & ~is_part).sum())
    # Of spectra that it does not contain, the library matches about half (docs/reference/materials.md).
    assert right > 0.3 * found.codes.size
    assert wrong < 0.02 * found.codes.size
    assert alike > 0.98 * found.codes.size


MEASURED = """
import sys
from pathlib import Path
from coupole.commands.identify import identify
identify([Path(sys.argv[1])], library=Path(sys.argv[2]), classes=Path(sys.argv[3]), report=Path(sys.argv[4]))
print(next(line for line in Path("/proc/self/status").read_text().splitlines() if "VmHWM" in line).split()[1])
"""


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="needs Linux's count of memory")
def test_memory_does_not_grow_with_the_cube(tmp_path: Path) -> None:
    # 31 and 92 MB; blocks of 8 MB. The maps of the larger one, with their pictures, are 1 MB.
    library, classes = write_library(tmp_path / "library", SHAPES[:3])
    panel = np.repeat(areas(SHAPES[:2], 40)[0], 5, axis=2)
    said = {"wavelength": [f"{nm:.4f}" for nm in np.linspace(400.0, 780.0, panel.shape[2])]}
    peaks = []
    for name, times in (("small", 10), ("large", 30)):
        header = write_cube(
            tmp_path / f"{name}.hdr", np.tile(panel, (times, 1, 1)), interleave="bsq", metadata=said
        )
        arguments = [str(path) for path in (header, library, classes, tmp_path / name)]
        ended = subprocess.run(
            [sys.executable, "-c", MEASURED, *arguments], capture_output=True, text=True, check=True, cwd=REPO
        )
        peaks.append(int(ended.stdout.split()[-1]) / 1024)

    assert (tmp_path / "large.dat").stat().st_size > 92e6
    assert peaks[1] - peaks[0] < 25.0
    assert peaks[1] < 600.0
