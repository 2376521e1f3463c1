"""The options of `coupole reflectance`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

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
        help="Of the disk under the object, which lights it too.",
    ),
]
KeepOption = Annotated[
    bool, typer.Option("--keep-inter-reflection", help="Leave in the samples what comes by way of other surfaces.")
]
MemoryOption = Annotated[
    str, typer.Option("--memory", help="For the samples that are fitted together: 500MB, 4GB.")
]
RefinedOption = Annotated[
    Path | None,
    typer.Option("--refined", help="Folder of `coupole reflectance refine`: its poses, lens and mesh hold."),
]
PosesOption = Annotated[
    Path | None,
    typer.Option(
        "--poses",
        help="Folder of COLMAP's, of one run, with images and camera of `coupole export RUN --to colmap`: its "
        "poses hold, brought onto the records' by a similarity (three views or more) or as they are; their "
        "uncertainty is the records', as COLMAP states none.",
        show_default=False,
    ),
]
SchedulerOption = Annotated[
    str | None,
    typer.Option("--scheduler", metavar="ADDRESS", help="Of a dask cluster that does the job: tcp://HOST:8786."),
]
PicturesOption = Annotated[
    Path | None,
    typer.Option(
        "--pictures",
        help="Folder of 8- or 16-bit pictures, linear (or see --srgb), in the order of its filenames.txt, else "
        "sorted.",
        show_default=False,
    ),
]
LightsOption = Annotated[
    Path | None,
    typer.Option(
        "--lights",
        help="Directions to the lights, one in each line (x right, y up, z to the camera), an .lp file, or "
        "relight's .dome or .relight.",
        show_default=False,
    ),
]
SrgbOption = Annotated[
    bool,
    typer.Option("--srgb", help="The pictures of --pictures are encoded for displays, as JPEGs of cameras are."),
]
IntensitiesOption = Annotated[
    Path | None,
    typer.Option("--intensities", help="One number or three (r g b) for each light; values are divided by them."),
]
UncalibratedOption = Annotated[
    bool,
    typer.Option(
        "--uncalibrated",
        help="Of a run without calibrations: one view as pictures under lights at their nominal places; relative "
        "values of single pixels.",
    ),
]
ViewOption = Annotated[str | None, typer.Option("--view", help="Of --uncalibrated; the first without it.")]
MaskOption = Annotated[Path | None, typer.Option("--mask", help="Picture that is black where nothing is fitted.")]
LeaveOutOption = Annotated[
    str,
    typer.Option(
        "--leave-out",
        help="Lights (of pictures, from 0) or LEDs (of runs; every twelfth without it) that are kept for the "
        "check: 4,12,20.",
        show_default=False,
    ),
]
