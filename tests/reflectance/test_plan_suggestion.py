"""`coupole plan suggest` as its user has it, and the sums of what views tell."""

from __future__ import annotations

import math
from pathlib import Path

import cells
import numpy as np
import pytest
import trimesh
from cells import Ended
from places import REPO

from coupole.commands.suggest_plan import seconds_of
from coupole.errors import InputError
from coupole.preflight.job import read_job
from coupole.reflectance.suggestion.supposed_signal import CameraNoise
from coupole.reflectance.suggestion.view_choice import choose_views
from coupole.reflectance.suggestion.view_information import Information, ViewInformation

RELIEF, RECORDS = cells.COARSE_RELIEF, REPO / "configs/calibrations"
BUDGET_S, DOSE_LUX_H = 40.0, 0.6


def suggest(folder: Path, *options: str | Path, mesh: Path = RELIEF) -> Ended:
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        return cells.here("plan", "suggest", mesh, *options, "--json")


@pytest.fixture(scope="module")
def suggested(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Ended]:
    folder = tmp_path_factory.mktemp("suggested")
    options = ("--rig", "sim", "--calibrations", RECORDS, "--material", "glossy", "--views", "3")
    return folder, suggest(folder, *options, "--budget", f"{BUDGET_S:g}s", "--dose", f"{DOSE_LUX_H:g}")


def test_the_plan_can_be_run_within_time_and_light(suggested: tuple[Path, Ended]) -> None:
    folder, ended = suggested
    assert ended.code == 0, ended.err
    checked = cells.here("check", folder / "relief.yaml", "--json")
    assert checked.code == 0, checked.err
    assert checked.document["duration_s"] <= BUDGET_S
    assert checked.document["dose_lux_h"] <= DOSE_LUX_H
    job = read_job(folder / "relief.yaml")
    assert [view.name for view in job.plan.views] == ended.document["views"]
    assert 1 <= len(job.plan.views) <= 3
    assert len(job.schedule.bursts[0][0].shots) >= ended.document["leds"]


def test_it_says_what_is_to_be_expected_in_plan_page_and_json(suggested: tuple[Path, Ended]) -> None:
    folder, ended = suggested
    expected = ended.document["expected"]["glossy"]
    line = f"Expected if glossy, median standard uncertainty: normal {expected['normal_deg']:.2g} degrees"
    head = [text[2:] for text in (folder / "relief.yaml").read_text().splitlines() if text.startswith("# ")]
    assert line in " ".join(head)
    page = (folder / "relief.html").read_text()
    assert f"normals to {expected['normal_deg']:.2g} degrees" in page
    assert "Expected, not measured" in page


def test_what_exists_is_not_written_over(suggested: tuple[Path, Ended]) -> None:
    folder, _ = suggested
    before = (folder / "relief.yaml").read_bytes()
    ended = suggest(folder, "--calibrations", RECORDS)
    assert (ended.code, (folder / "relief.yaml").read_bytes()) == (2, before)
    assert "relief.yaml: exists already" in ended.err + ended.out


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--budget", "soon"), "expected a time such as 4h"),
        (("--material", "jelly"), "expected matt, glossy, metal or unknown; found 'jelly'"),
        (("--unit", "inch"), "--unit: expected mm, m, um; found 'inch'"),
        (("--name", "../up"), "expected letters, digits"),
        (("--rig", "nowhere.yaml"), "nowhere.yaml: no such file"),
        ((), "none is of the kind led-power"),
    ],
)
def test_wrong_options_are_told(options: tuple[str, ...], words: str, tmp_path: Path) -> None:
    ended = suggest(tmp_path, *options)
    assert ended.code == 2
    assert words in ended.err + ended.out
    assert not list(tmp_path.iterdir())


def test_a_budget_for_not_one_view_is_refused_and_what_takes_seconds_is_told_when_it_begins(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    ended = cells.here("plan", "suggest", RELIEF, "--calibrations", RECORDS, "--budget", "1s")
    assert ended.code == 3
    assert "allows not one view" in ended.err
    lines = ended.err.splitlines()
    assert lines[:2] == ["reading mesh and cell ...", "views that the arm can take ..."]
    assert "reading" not in cells.here("plan", "suggest", RELIEF, "--json").err


def test_a_mesh_elsewhere_is_put_on_the_middle_and_one_view_tells_less_of_it(
    suggested: tuple[Path, Ended], tmp_path: Path
) -> None:
    import trimesh

    mesh = trimesh.load(RELIEF, process=False)
    elsewhere = mesh.vertices + np.array((900.0, 0.0, 300.0))
    trimesh.Trimesh(elsewhere, mesh.faces, process=False).export(tmp_path / "far.ply")
    options = ("--calibrations", RECORDS, "--material", "matt", "--views", "1", "--budget", "8s")
    ended = suggest(tmp_path, *options, "--centre", mesh=tmp_path / "far.ply")
    assert ended.code == 0, ended.err
    assert ended.document["known_share"] < suggested[1].document["known_share"]
    corners_mm = read_job(tmp_path / "far.yaml").shape.corners_mm.reshape(-1, 3)
    low, high = corners_mm.min(axis=0), corners_mm.max(axis=0)
    np.testing.assert_allclose([*(low + high)[:2], low[2]], 0.0, atol=2e-3)


def test_a_mesh_that_the_camera_does_not_resolve_is_told_with_a_remedy(tmp_path: Path) -> None:
    import trimesh

    mesh = trimesh.load(RELIEF, process=False)
    for _ in range(3):
        mesh = mesh.subdivide()
    mesh.export(tmp_path / "fine.ply")
    options = ("--calibrations", RECORDS, "--material", "matt", "--views", "1", "--budget", "8s")
    ended = suggest(tmp_path, *options, mesh=tmp_path / "fine.ply")
    assert ended.code == 0, ended.err
    assert ended.document["known_share"] < 0.3
    page = (tmp_path / "fine.html").read_text()
    assert "smaller than the camera's pixels. Simplify the mesh to about" in page.replace("&#39;", "'").replace(
        "&#x27;", "'"
    )


@pytest.mark.parametrize(("text", "seconds"), [("4h", 14400.0), ("90min", 5400.0), (" 1.5 s ", 1.5)])
def test_times(text: str, seconds: float) -> None:
    assert seconds_of(text) == seconds


@pytest.mark.parametrize("text", ["0h", "-1s", "4", "h", "4 days", ""])
def test_what_is_no_time(text: str) -> None:
    with pytest.raises(InputError):
        seconds_of(text)


def test_noise_of_a_mean_is_that_of_counted_electrons() -> None:
    """8 pixels of which half have the channel, 900 electrons each, no read noise: 1 over the electrons."""
    gain_dn, electrons = 0.5, 900.0
    noise = CameraNoise(np.zeros(1), np.array([gain_dn]), 10.0, 4000.0, np.array([0.5]))

    def variance(signal_dn: float, *exposures_us: int) -> float:
        return float(noise.relative_variances(np.array([signal_dn / 0.01]), np.array([4.0]), exposures_us)[0])

    assert variance(gain_dn * electrons, 10_000) == pytest.approx(1.0 / (4 * electrons))
    assert variance(gain_dn * electrons, 10_000, 20_000) == pytest.approx(1.0 / (4 * electrons * 3.0))
    assert math.isinf(variance(5.0, 10_000))
    assert math.isinf(variance(5000.0, 10_000))


def test_triangles_of_less_than_a_tile_lack_channels() -> None:
    """As a lattice of Bayer tiles under squares of one, four and six pixels has it; a camera of one channel lacks
    none."""
    random, zeros = np.random.default_rng(1), np.zeros(3)
    noise = CameraNoise(zeros, zeros, 0.0, 1.0, np.array([0.25, 0.5, 0.25]))
    for pixels, share in ((1.0, 0.0), (2.5, 0.25), (3.0, 0.5), (4.0, 1.0), (6.3, 1.0)):
        drawn = noise.drawn_pixels(np.full(20_000, pixels), random)
        assert (drawn > 0).all(axis=1).mean() == pytest.approx(share, abs=0.02)
        np.testing.assert_allclose(drawn.mean(axis=0), pixels * noise.channel_share, rtol=0.03)
    mono = CameraNoise(zeros, zeros, 0.0, 1.0, np.array([1.0]))
    assert mono.drawn_pixels(np.full(20_000, 0.3), random).mean() == pytest.approx(0.3, abs=0.02)


def told(known: list[float]) -> ViewInformation:
    """What a view tells that knows each part that it sees so well, with noise as the weights have it."""
    parts = np.flatnonzero(known)
    bread = np.array(known)[parts][None, :, None, None] * np.eye(5)
    return ViewInformation(parts, bread, bread)


def test_the_view_that_shows_the_rest_comes_second() -> None:
    prior = Information(np.tile(np.eye(5), (2, 1, 1)), np.tile(np.eye(5), (2, 1, 1)))
    views = [[told([1000.0, 0.0])], [told([900.0, 0.0])], [told([0.0, 50.0])], [told([0.01, 0.01])]]
    choice = choose_views(views, 0, [prior], np.ones(2), 3)
    assert choice.views == (0, 2, 1)
    assert choice.value == pytest.approx(0.5 * 5 * 0.5 * (math.log(1901.0) + math.log(51.0)))
    assert choose_views(views, 0, [prior], np.ones(2), 4).views == (0, 2, 1)  # the fourth tells nothing
    np.testing.assert_array_equal(prior.bread, np.tile(np.eye(5), (2, 1, 1)))  # what was known before stays


def test_light_without_a_bound_in_numbers_is_refused(tmp_path: Path) -> None:
    ended = suggest(tmp_path, "--rig", "sim", "--dose", "inf")
    assert ended.code == 2, ended.err
    assert "--dose: expected a number of lux h" in ended.err


@pytest.mark.parametrize(
    ("cut", "words"),
    [
        (False, "is 0.1 mm large; expected 1 to 2960 mm. Is its unit right? `--unit m` makes it"),
        (True, "was cut off"),
    ],
)
def test_a_mesh_that_cannot_be_is_told_without_places_in_a_plan_that_is_not_written(
    cut: bool, words: str, tmp_path: Path
) -> None:
    mesh = tmp_path / "tiny.ply"
    trimesh.creation.icosphere(2, 0.05).export(mesh)
    mesh.write_bytes(mesh.read_bytes()[: 300 if cut else None])
    ended = suggest(tmp_path, "--rig", "sim", mesh=mesh)
    assert ended.code == 2, ended.err
    assert words in ended.err
    assert "tiny.yaml" not in ended.err
