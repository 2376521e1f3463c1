"""What spots of LEDs say of causes that a plain adjustment lacks, and of views that contradict each other."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from domes import Dome, dome
from scipy.spatial.transform import Rotation
from synthesis import Array
from test_led_record import found

from coupole.calibration import optics
from coupole.calibration.adjustment import coverage_factor
from coupole.calibration.leds.adjustment import LedGeometry, adjust_leds
from coupole.calibration.leds.boards import board_poses, boards_of
from coupole.calibration.leds.drawing import draw_leds
from coupole.calibration.leds.equations import SPOTS, LedState, Problem, Stated, at_centres, problem_of
from coupole.calibration.leds.left_out import views_left_out
from coupole.calibration.leds.matching import Matching, match_leds
from coupole.calibration.leds.normal_equations import centres_by_own, reduced_normal
from coupole.calibration.leds.suspects import MODES, OVAL, PRIMARY, Mode, judge, shifts_px
from coupole.calibration.report import Outcome, write_outcome
from sim.render.emitter import square
from sim.strangers.light_stranger import LightStranger


def through_lenses(lens_mm: float) -> Callable[[Array, Array, Array], Array]:
    """The die's image by the simulator's primary lens."""
    stranger = LightStranger(primary_lens_mm=lens_mm)

    def image(centre_mm: Array, normal: Array, eye_mm: Array) -> Array:
        die = square(centre_mm, normal, side_mm=7.0, flux_lm=1.0)
        return np.asarray(stranger.seen_from(die, eye_mm).centre_mm)

    return image


def matched(made: Dome) -> Matching:
    return match_leds(
        made.seen,
        made.base_from_camera,
        made.prior.lens,
        made.table.ids,
        boards_of(made.table),
        tolerance_px=20.0,
    )


def geometry_of(made: Dome, modes: tuple[Mode, ...] = MODES) -> LedGeometry:
    boards, matching = boards_of(made.table), matched(made)
    seen = matching.sightings
    problem = problem_of(seen, seen.led, boards, made.base_from_flange, made.prior, Stated(), modes)
    return adjust_leds(problem, board_poses(boards, matching.by_place_mm))


def held(geometry: LedGeometry, made: Dome) -> float:
    """Share of the coordinates in their 95 % intervals."""
    u = np.sqrt(np.einsum("nii->ni", geometry.centre_covariance))
    off = np.abs(geometry.centres_mm - made.true_mm)
    return float(np.mean(off < coverage_factor(geometry.degrees)[:, None] * u))


def test_the_suspected_shift_is_that_of_the_simulators_primary_lens() -> None:
    random = np.random.default_rng(1)
    lens = np.array([7120.0, 7121.0, 2049.0, 1533.0, -0.05, 0.02, 2e-4, -3e-4, 0.0])
    turns = Rotation.random(20, random_state=1).as_matrix()
    in_camera = random.uniform(-300, 300, (20, 3)) + np.array([0.0, 0.0, 1300.0])
    image, size_mm = through_lenses(0.01), 0.01
    moved = np.stack([image(p, turn[:, 2], np.zeros(3)) for p, turn in zip(in_camera, turns, strict=True)])
    projection = optics.project(in_camera, lens)
    expected_px = (optics.project(moved, lens).pixels - projection.pixels) / size_mm
    shifts = shifts_px(MODES[:1], in_camera, turns, projection, lens[2:4])
    assert np.allclose(shifts[:, :, 0], expected_px, rtol=1e-4, atol=1e-4)


def test_intervals_hold_though_lenses_shift_the_images_of_all_dies() -> None:
    made = [dome(seed, image=through_lenses(0.4)) for seed in (1, 2)]
    with_suspects, plain = ([geometry_of(one, modes) for one in made] for modes in (MODES, ()))
    assert np.mean([held(*pair) for pair in zip(plain, made, strict=True)]) < 0.6
    assert np.mean([held(*pair) for pair in zip(with_suspects, made, strict=True)]) > 0.85


def test_without_a_cause_none_is_named_and_uncertainties_stay_as_they_are() -> None:
    made = [dome(seed) for seed in (1, 2, 3)]
    with_suspects, plain = ([geometry_of(one, modes) for one in made] for modes in (MODES, ()))
    assert not [suspect for one in with_suspects for suspect in one.suspects if suspect.is_named]
    u_mm, u_plain_mm = (
        [np.median(np.trace(one.centre_covariance, axis1=1, axis2=2)) ** 0.5 for one in several]
        for several in (with_suspects, plain)
    )
    assert np.median(np.divide(u_mm, u_plain_mm)) < 1.35


def test_a_primary_lens_is_named_in_the_record_and_on_its_page(tmp_path: Path) -> None:
    result = found(dome(1, views=16, image=through_lenses(0.8)))
    write_outcome(tmp_path / "leds-test.yaml", Outcome(result.record, partial(draw_leds, result), result.files))
    assert any(remark.startswith("lenses on the dies shift their images") for remark in result.record.remarks)
    assert "lenses on the dies shift their images" in (tmp_path / "leds-test.html").read_text()
    assert [suspect.name for suspect in result.geometry.suspects if suspect.is_named] == [PRIMARY]


@pytest.mark.parametrize(("estimate", "amplitude"), [(0.0, 0.1), (0.075, 0.125), (0.5, 0.26**0.5)])
def test_a_primary_lens_has_the_amplitude_of_estimate_and_uncertainty(estimate: float, amplitude: float) -> None:
    (suspect,) = judge(MODES[:1], np.array([estimate]), np.array([[0.01]]), 50.0)
    assert suspect.amplitude == pytest.approx(amplitude)
    assert suspect.is_named == (estimate > 0.4)


def test_a_shift_away_from_the_camera_is_no_lens_and_refused_where_it_is_sure() -> None:
    (away,) = judge(MODES[:1], np.array([-0.5]), np.array([[0.01]]), 50.0)
    assert away.amplitude == pytest.approx(0.1)
    assert away.away == pytest.approx(5.0)
    result = found(dome(1, views=16, image=through_lenses(-0.8)))
    assert [limit.name for limit in result.record.limits if not limit.is_met] == ["image_away"]
    assert any("away from the camera" in remark for remark in result.record.remarks)


def test_other_suspects_have_the_most_likely_amplitude() -> None:
    """With equal variances it is that of the mean square less the variance."""
    modes = [mode for mode in MODES if mode.suspect == OVAL]
    (clear,) = judge(modes, np.array([0.3, -0.4]), 0.01 * np.eye(2), 50.0)
    assert clear.amplitude**2 == pytest.approx(0.125 - 0.01, rel=0.03)
    (none,) = judge(modes, np.array([0.05, -0.05]), 0.01 * np.eye(2), 50.0)
    assert none.amplitude < 1e-5


def test_views_left_out_move_the_leds_as_an_adjustment_without_them_would() -> None:
    made = dome(1, views=8)
    geometry = geometry_of(made, ())
    boards, seen = boards_of(made.table), matched(made).sightings
    problem = problem_of(seen, seen.led, boards, made.base_from_flange, made.prior, Stated(), ())
    problem, state = at_centres(problem, geometry.state), geometry.state
    everything = np.ones(len(seen.led))
    full = centres_step(problem, state, geometry.noise, everything)
    moves = [
        full - centres_step(problem, state, geometry.noise, (problem.view != view).astype(float))
        for view in range(8)
    ]
    by_refits = sum(move[:, :, None] * move[:, None, :] for move in moves) * 7 / 8
    reduced = reduced_normal(problem, state, geometry.noise, everything)
    closed = views_left_out(problem, state, geometry.noise, everything > 0, reduced).centre_covariance
    is_seen = np.isin(np.arange(len(closed)), seen.led)
    assert np.allclose(closed[is_seen], by_refits[is_seen], rtol=0.02, atol=0.02 * np.abs(by_refits).max())


def test_the_freedom_that_spots_use_is_the_trace_of_their_part_of_the_hat_matrix() -> None:
    made = dome(1, views=8)
    geometry = geometry_of(made, ())
    boards, seen = boards_of(made.table), matched(made).sightings
    problem = problem_of(seen, seen.led, boards, made.base_from_flange, made.prior, Stated(), ())
    problem, keep = at_centres(problem, geometry.state), geometry.accepted_mask
    reduced = reduced_normal(problem, geometry.state, geometry.noise, keep.astype(float))
    own_at = np.cumsum([0, *(len(part.side) for part in reduced.parts)])
    shared = own_at[-1] + np.arange(problem.shared_count)
    whole = np.zeros((own_at[-1] + problem.shared_count,) * 2)
    jacobians = []
    whole[np.ix_(shared, shared)] = reduced.matrix  # to which what the elimination of the boards took off is added
    for part, first, end in zip(reduced.parts, own_at, own_at[1:], strict=False):
        own, columns = np.arange(first, end), shared[part.columns]
        whole[np.ix_(own, own)] = part.own_normal
        whole[np.ix_(own, columns)], whole[np.ix_(columns, own)] = part.cross, part.cross.T
        whole[np.ix_(columns, columns)] += part.cross.T @ np.linalg.solve(part.own_normal, part.cross)
        jacobians.append((part.jacobian, np.concatenate([own, columns])))
    covariance = np.linalg.inv(whole)
    used = sum(np.sum((j @ covariance[np.ix_(at, at)]) * j) for j, at in jacobians)
    assert geometry.redundancy[SPOTS] == pytest.approx(2 * keep.sum() - used, rel=1e-3)


def centres_step(problem: Problem, state: LedState, noise: Array, weights: Array) -> Array:
    """[n, 3] step of the centres by one more adjustment with these weights of the spots."""
    reduced = reduced_normal(problem, state, noise, weights)
    shared = np.linalg.solve(reduced.matrix, reduced.side)
    steps = np.zeros((len(problem.boards.places_mm), 3))
    for board, part in enumerate(reduced.parts):
        steps[problem.boards.rows_of(board)] = centres_by_own(problem, state, board) @ part.own_step(shared)
    return steps


def test_views_that_contradict_each_other_beyond_their_uncertainty_are_refused() -> None:
    result = found(dome(1), limits={"left_out": 0.1})
    limit = next(limit for limit in result.record.limits if limit.name == "left_out")
    assert 0.5 < limit.found < 2.0
    assert not result.record.is_accepted
    assert any("Views contradict each other by more than noise" in remark for remark in result.record.remarks)
