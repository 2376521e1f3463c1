"""The plan's object as the simulated camera sees it: its mesh with a material, or the true surface of a scan."""

from __future__ import annotations

from sim.scene.scene import load_surface
from sim.scene.surface import Material, Surface
from sim.world.config import MaterialConfig, MeasuredConfig, MeshConfig, Settings, SpecimenConfig


def surface_of(mesh: MeshConfig, settings: Settings) -> Surface:
    """The surface of an object in its own frame, mm, with its stickers. Raises InputError."""
    if settings.true_surface is not None:
        from sim.objects.plaque import plaque

        surface = plaque()
    else:
        material = _material(mesh, settings)
        surface = load_surface(mesh.path, mesh.unit, material, settings.detail, mesh.pictures_beside)
    return settings.stickers.on(surface) if settings.stickers else surface


def _material(mesh: MeshConfig, settings: Settings) -> Material | None:
    match config := mesh.material or settings.material:
        case None:
            return None
        case SpecimenConfig():
            from sim.objects.specimens import specimen

            return specimen(config.specimen)
        case MeasuredConfig():
            return _measured_material(config)
        case MaterialConfig():
            return Material(mesh.path.stem, config.diffuse, config.f0, config.roughness)


def _measured_material(config: MeasuredConfig) -> Material:
    from sim.objects.measured_files import alta_material, bsdf_material, merl_material

    if config.merl is not None:
        return merl_material(config.merl)
    return bsdf_material(config.bsdf) if config.bsdf is not None else alta_material(config.alta_files)
