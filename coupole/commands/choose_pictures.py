"""The command `coupole reflectance choose`: few pictures instead of all."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from coupole.commands.common import JsonOption
from coupole.commands.common import fail as fail_with
from coupole.commands.option_groups import flatten_options
from coupole.commands.reflectance_options import KnownPictures
from coupole.errors import CoupoleError, InputError


@flatten_options
def choose(
    count: Annotated[int, typer.Option("--count", min=6, help="Largest number of lights to choose.")],
    *,
    picture_options: KnownPictures,
    until: Annotated[
        float | None,
        typer.Option(
            "--until",
            min=1e-6,
            max=1.0,
            help="Stop when the expected error of pictures interpolated for the other lights is at most this "
            "(rms, as a share of the pictures' bright level).",
        ),
    ] = None,
    first: Annotated[int, typer.Option("--first", min=6, help="Lights to begin with, spread over the dome.")] = 6,
    at_a_time: Annotated[int, typer.Option("--at-a-time", min=1, help="Number of lights chosen at a time.")] = 1,
    to: Annotated[Path | None, typer.Option("--to", help="Write the choice into this file (JSON).")] = None,
    as_json: JsonOption = False,
) -> None:
    """Choose the few pictures under known distant lights that add most information; only these are read.

    Lights are counted from 0. Give the JSON's `left_out` to `coupole reflectance --leave-out`.
    """
    from coupole.viewing.terminal import make_console, step_bars

    console = make_console(quiet=as_json)
    try:
        from coupole.reflectance.picture_choice import HowMany, choose_pictures
        from coupole.storage.durable import write_synced

        if to is not None and not to.parent.is_dir():
            raise InputError(f"--to: expected a file in an existing folder; {to.parent} does not exist")
        pictures = picture_options.read()
        with step_bars(console) as say:
            choice = choose_pictures(
                pictures,
                HowMany(count, until, first, at_a_time),
                say=partial(say, "pictures that are read"),
            )
        if to is not None:
            write_synced(to, json.dumps(choice, indent=1) + "\n")
    except CoupoleError as error:
        fail_with(error, as_json=as_json)
        raise
    for step in choice["steps"]:
        following = ", ".join(f"{light} ({pictures.files[light].name})" for light in step["next"]) or "no more"
        console.print(
            f"{step['lights']:4d} lights, expected error {100 * step['relit_rms']:.2f} %; next {following}"
        )
    console.print(f"chosen: {','.join(map(str, choice['chosen']))}")
    if as_json:
        print(json.dumps(choice))
