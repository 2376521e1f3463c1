"""What a rig's `shading` switches on, and what a dry run makes of it."""

from __future__ import annotations

import cells
import pytest
from cells import CellFolder

from coupole.preflight.job import read_job
from coupole.preflight.simulated_world import world_config
from sim.world.config import Config, InterreflectionConfig

DETAIL = [{"period_mm": 1.0, "texture": 0.2}, {"period_mm": 30.0, "slope_deg": 2.0}]


def told(cell: CellFolder, *, dry_run: bool = False, **settings: object) -> Config:
    """The world of a cell whose rig has these settings."""
    cell.world_settings.pop("shading")
    cell.world_settings.update(settings)
    cell.write()
    job = read_job(cell.plan)
    return Config.model_validate(world_config(job.cell, job, job.cell.rig.sensor, dry_run=dry_run, speed=5.0))


def test_pixels_are_shaded_with_blur_and_interreflection_if_a_rig_does_not_say(cell: CellFolder) -> None:
    world = told(cell, detail=DETAIL)
    assert world.settings.shading == "pixel"
    assert world.rendered_camera.blur is True
    assert world.settings.light_between_surfaces == InterreflectionConfig()


def test_flat_shading_has_neither(cell: CellFolder) -> None:
    world = told(cell, shading="flat")
    assert world.rendered_camera.blur is False
    assert world.settings.light_between_surfaces is None


def test_what_a_rig_says_of_blur_and_interreflection_holds(cell: CellFolder) -> None:
    world = told(cell, shading="flat", camera={"blur": True}, interreflection={"bounces": 2})
    assert world.rendered_camera.blur is True
    assert world.settings.light_between_surfaces == InterreflectionConfig(bounces=2)


def test_interreflection_can_be_switched_off(cell: CellFolder) -> None:
    assert told(cell, interreflection=False).settings.light_between_surfaces is None


def test_a_dry_run_is_flat_whatever_the_rig_says(cell: CellFolder) -> None:
    world = told(cell, dry_run=True, shading="pixel", detail=DETAIL, interreflection={"bounces": 8})
    assert (world.settings.shading, world.settings.detail) == ("flat", ())
    assert world.rendered_camera.blur is False
    assert world.settings.light_between_surfaces is None


@pytest.mark.parametrize(
    ("settings", "told_of"),
    [
        ({"shading": "flat", "detail": DETAIL}, "needs `shading: pixel`"),
        ({"detail": [{"period_mm": 0.0}]}, "detail"),
        ({"detail": [{"period_mm": 1.0, "colour": 0.1}]}, "colour"),
        ({"shading": "phong"}, "shading"),
        ({"interreflection": {"samples": 64}}, "samples"),
    ],
)
def test_settings_that_are_not_possible_are_refused_by_name(
    cell: CellFolder, settings: dict[str, object], told_of: str
) -> None:
    cell.world_settings.pop("shading")
    cell.world_settings.update(settings)
    cell.write()
    ended = cells.here("acquire", cell.plan, "--yes")
    assert ended.code == 2
    assert told_of in ended.err
