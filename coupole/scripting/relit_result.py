"""Results of runs and of pictures, opened to be relit."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from coupole.errors import InputError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from coupole.reflectance.new_light.light_kinds import AnyLight
    from coupole.reflectance.new_light.pictured_surface import FreeCamera

Say = Callable[[int, int], None]


@dataclass(frozen=True)
class Relit:
    """A result that can be relit."""

    picture: Callable[[Sequence[AnyLight], Say], NDArray[np.float32]]
    """Function of lights; returns a picture [h, w, 3]."""
    about: dict[str, Any]
    """Description for `--json` and for a video's comment."""
    uncertainty: Callable[[Sequence[AnyLight], Say], NDArray[np.float32]] | None = None
    """Function of lights; returns the standard uncertainty [h, w, 3] of their picture. None if it cannot be
    stated."""
    half_width_95: Callable[[Sequence[AnyLight], Say], NDArray[np.float32]] | None = None
    """Function of lights; returns the half width [h, w, 3] of the 95 % interval of their picture. None if it
    cannot be stated."""
    has_colours: bool = True
    """False for a camera with one channel."""


def open_result(
    result: Path, view: str | None, fit: str | None, camera: FreeCamera | None, samples: int, *, uncertain: bool
) -> Relit:
    """Open the result in a folder, of runs or of pictures. `samples` is the number of rays to an area or an
    environment. Raises InputError if there is no result, or if it does not have this view, fit, camera or
    uncertainty.
    """
    from coupole.reflectance import fits, relit_uncertainty, run_relighting, run_result
    from coupole.storage import so_far

    result = so_far.as_it_is_now(result)
    if (result / run_result.OBJECT).exists():
        if uncertain:
            fit = fit or run_relighting.best_with_texels(run_result.RunResult(result), fits.MATERIALS)
            relit_uncertainty.refuse_uncertain(run_result.RunResult(result), fit)
        return _of_runs(result, view, fit, camera, samples)
    options = (("--view", view), ("--fit", fit), ("--from", camera))
    for option, value in options:
        if value is not None:
            raise InputError(f"{option}: a result of pictures has one view and one way to relight it")
    return _of_pictures(result, samples, uncertain=uncertain)


def _of_runs(result: Path, view: str | None, fit: str | None, camera: FreeCamera | None, samples: int) -> Relit:
    import numpy as np

    from coupole.reflectance import relit_uncertainty, run_intervals, run_relighting, run_result
    from coupole.storage import so_far

    if camera is not None and view is not None:
        raise InputError("--view: a free camera (--from) is not a view of the run; give one of the two")
    about = run_result.read_about(result)
    folder = run_result.RunResult(result)
    if camera is None:
        scene = run_relighting.scene_of_view(folder, view, fit)
    else:
        scene = run_relighting.scene_from(folder, camera, fit)

    def of_three(picture: NDArray[np.float32]) -> NDArray[np.float32]:
        return picture if picture.shape[2] == 3 else np.repeat(picture, 3, axis=2)

    return Relit(
        lambda lights, say: of_three(scene.picture(lights, samples, say=say)),
        {"fit": scene.fit, "simulated": bool(about["simulated"])} | so_far.figures(about),
        lambda lights, say: of_three(relit_uncertainty.uncertainty_of_picture(scene, lights, samples, say=say)),
        lambda lights, say: of_three(run_intervals.half_width_of_picture(scene, lights, samples, say=say)),
        has_colours=folder.channels == 3,
    )


def _of_pictures(result: Path, samples: int, *, uncertain: bool) -> Relit:
    from coupole.reflectance import relighting, relit_intervals
    from coupole.reflectance.picture_result import PictureResult

    picture_folder = PictureResult(result)
    picture_folder.about  # noqa: B018  refuses what is no result
    interpolation = relighting.read_interpolation(result)
    if uncertain:
        relit_intervals.refuse_uncalibrated(picture_folder)

    def picture(lights: Sequence[AnyLight], say: Say) -> NDArray[np.float32]:
        return relighting.relit_by(picture_folder, interpolation, lights, samples, say=say)

    def half_width(level: str) -> Callable[[Sequence[AnyLight], Say], NDArray[np.float32]]:
        def of_lights(lights: Sequence[AnyLight], say: Say) -> NDArray[np.float32]:
            beams = relighting.beams_of(lights, samples)
            return relit_intervals.half_width_picture(picture_folder, interpolation, beams, level, say=say)

        return of_lights

    return Relit(picture, {}, half_width("68"), half_width("95"))
