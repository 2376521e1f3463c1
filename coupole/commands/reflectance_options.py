"""The options of `coupole reflectance`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from coupole.commands.common import MeshOption, RecordsOption
from coupole.errors import InputError

if TYPE_CHECKING:
    from coupole.reflectance.picture_set import PictureSet
    from coupole.reflectance.run_job import RunRequest

OutOption = Annotated[Path | None, typer.Option("--out", help="Folder of the result.", show_default=False)]
NoiseOption = Annotated[
    float, typer.Option("--scan-noise-um", min=0.1, help="Standard uncertainty of the mesh's vertices.")
]
SupportOption = Annotated[
    float,
    typer.Option(
        "--support-reflectance",
        min=0.0,
        max=0.95,
        help="Albedo of the disk under the object; the disk reflects light onto the object.",
    ),
]
KeepOption = Annotated[
    bool,
    typer.Option("--keep-inter-reflection", help="Do not subtract the light that arrives from other surfaces."),
]
MemoryOption = Annotated[
    str, typer.Option("--memory", help="Memory for the samples that are fitted together, such as 500MB or 4GB.")
]
RefinedOption = Annotated[
    Path | None,
    typer.Option("--refined", help="Folder of `coupole reflectance refine`; its poses, lens and mesh are used."),
]
PosesOption = Annotated[
    Path | None,
    typer.Option(
        "--poses",
        help="Folder of COLMAP for one run, with images and camera of `coupole export RUN --to "
        "colmap`. Its poses are used: aligned to the records' poses by a similarity (three "
        "views or more), or as they are. They have the uncertainty of the records, because COLMAP states none.",
        show_default=False,
    ),
]
SchedulerOption = Annotated[
    str | None,
    typer.Option(
        "--scheduler", metavar="ADDRESS", help="Address of a dask cluster that does the job: tcp://HOST:8786."
    ),
]
PicturesOption = Annotated[
    Path | None,
    typer.Option(
        "--pictures",
        help="Folder of 8- or 16-bit pictures, linear (or see --srgb), in the order of its "
        "filenames.txt, otherwise sorted by name.",
        show_default=False,
    ),
]
LightsOption = Annotated[
    Path | None,
    typer.Option(
        "--lights",
        help="Directions to the lights: a file with one in each line (x right, y up, z to the "
        "camera), an .lp file, or relight's .dome or .relight.",
        show_default=False,
    ),
]
SrgbOption = Annotated[
    bool,
    typer.Option("--srgb", help="The pictures of --pictures are encoded for displays, as JPEGs of cameras are."),
]
IntensitiesOption = Annotated[
    Path | None,
    typer.Option(
        "--intensities",
        help="Intensities of the lights, one number or three (r g b) for each; pixel values are divided by them.",
    ),
]
UncalibratedOption = Annotated[
    bool,
    typer.Option(
        "--uncalibrated",
        help="For a run without calibrations: treat one view as pictures under lights at their "
        "nominal places; the values of pixels are relative.",
    ),
]
ViewOption = Annotated[str | None, typer.Option("--view", help="View for --uncalibrated; by default the first.")]
MaskOption = Annotated[
    Path | None, typer.Option("--mask", help="Mask: a picture that is black where nothing is fitted.")
]
LeaveOutOption = Annotated[
    str,
    typer.Option(
        "--leave-out",
        help="Lights (of pictures, counted from 0) or LEDs (of runs; by default every twelfth) that"
        " are left out of the fit and kept for the check, such as 4,12,20.",
        show_default=False,
    ),
]


TexelsOption = Annotated[
    str | None,
    typer.Option(
        "--texels",
        metavar="auto|MM",
        help="Add materials of texels, for detail that is finer than the mesh's triangles: normal, kd, ks and "
        "roughness of each, with uncertainty. auto: one for each pixel of each view; a number such as 0.2: one "
        "for each texel of this width on the surface, in mm. Memory, disk and time are told "
        "before the work begins.",
        show_default=False,
    ),
]


@dataclass(frozen=True)
class SamplesOfRuns:
    """Options that control how samples of reflectance are extracted from frames of runs."""

    mesh: MeshOption = None
    calibrations: RecordsOption = None
    scan_noise_um: NoiseOption = 30.0
    support_reflectance: SupportOption = 0.0
    keep_inter_reflection: KeepOption = False
    refined_folder: RefinedOption = None
    poses: PosesOption = None

    def request(self, runs: Sequence[Path], left_out: Sequence[int]) -> RunRequest:
        """Return the request for these runs. LEDs that are left out are kept for the check."""
        from coupole.calibration.record import records_named
        from coupole.reflectance.run_job import RunRequest

        return RunRequest(
            tuple(runs), self.mesh, records_named(self.calibrations or []), tuple(left_out), self.scan_noise_um,
            support_reflectance=self.support_reflectance, keep_inter_reflection=self.keep_inter_reflection,
            refined_folder=self.refined_folder, poses=self.poses,
        )  # fmt: skip


@dataclass(frozen=True)
class SourcesOfResult:
    """Runs of a complete result, and the files that gave their geometry."""

    mesh: MeshOption = None
    calibrations: RecordsOption = None
    refined_folder: RefinedOption = None
    poses: PosesOption = None

    @property
    def has_any(self) -> bool:
        return any((self.mesh, self.calibrations, self.refined_folder, self.poses))

    def request(self, runs: Sequence[Path], out: Path, memory_bytes: int) -> RunRequest:
        """Return the request by which the result was made; what is not a file is in its settings. Raises
        InputError if there is no result."""
        from coupole.calibration.record import records_named
        from coupole.reflectance.result_folder import read_settings
        from coupole.reflectance.run_job import RunRequest

        settings = read_settings(out)
        return RunRequest(
            tuple(runs), self.mesh, records_named(self.calibrations or []), tuple(settings["left_out"]),
            settings["scan_noise_um"], memory_bytes, settings["support_reflectance"], not settings["subtracted"],
            self.refined_folder, self.poses,
        )  # fmt: skip


@dataclass(frozen=True)
class PicturesWithoutRecords:
    """Pictures under known lights, or a view of a run without records."""

    pictures: PicturesOption = None
    lights: LightsOption = None
    srgb: SrgbOption = False
    intensities: IntensitiesOption = None
    mask: MaskOption = None
    is_uncalibrated: UncalibratedOption = False
    view: ViewOption = None


@dataclass(frozen=True)
class KnownPictures:
    """Pictures under known lights."""

    pictures: PicturesOption = None
    lights: LightsOption = None
    srgb: SrgbOption = False
    intensities: IntensitiesOption = None
    mask: MaskOption = None

    def read(self) -> PictureSet:
        """Read the set, without its pictures. Raises InputError."""
        from coupole.reflectance.picture_set import read_pictures

        if self.pictures is None or self.lights is None:
            raise InputError("expected --pictures with the folder, and --lights with the file of the directions")
        return read_pictures(
            self.pictures, self.lights, intensities=self.intensities, mask=self.mask, srgb=self.srgb
        )


@dataclass(frozen=True)
class Workers:
    """Memory that fits may use on this machine, or the cluster that does them."""

    memory: MemoryOption = "2GB"
    scheduler: SchedulerOption = None

    @property
    def memory_bytes(self) -> int:
        """Memory in bytes. Raises InputError if the text is not a size."""
        return bytes_of(self.memory)


def bytes_of(text: str) -> int:
    """Return the bytes of a size such as 500MB or 4GB. Raises InputError."""
    units = {"GB": 10**9, "MB": 10**6}
    try:
        size = float(text[:-2]) * units[text[-2:].upper()]
    except (KeyError, ValueError) as error:
        raise InputError(f"--memory: expected a size such as 500MB or 4GB, got {text!r}") from error
    if not 50e6 <= size < 1e15:
        raise InputError(f"--memory: expected 50MB or more, got {text!r}")
    return int(size)
