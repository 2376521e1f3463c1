"""The table of formats: what it says is what modules, command line and console do."""

from __future__ import annotations

import importlib
import inspect

import cells
import pytest

from coupole.commands.completion import formats
from coupole.commands.export_options import ExportOptions
from coupole.errors import InputError
from coupole.exchange.formats import FORMATS, Source, Writer, format_named, formats_of, refuse_others_options


@pytest.mark.parametrize(
    "name", [name for name, one in FORMATS.items() if one.writer in (Writer.FRAMES, Writer.RESULT)]
)
def test_a_format_of_frames_or_results_is_a_module_of_its_name(name: str) -> None:
    frames = FORMATS[name].writer is Writer.FRAMES
    module = importlib.import_module(f"coupole.exchange.{'' if frames else 'of_results.'}{name}")
    given = list(inspect.signature(module.encode if frames else module.write).parameters)
    assert given[: 1 if frames else 2] == (["picture"] if frames else ["surface", "folder"])


def test_each_option_of_the_command_is_some_formats_and_each_formats_option_the_commands() -> None:
    known = {name.replace("_", "-") for name in vars(ExportOptions())}
    assert {option for one in FORMATS.values() for option in one.options} == known


def test_completion_and_help_have_every_format() -> None:
    assert {name for name, _ in formats("")} == set(FORMATS)
    assert formats("bs") == [("bsdf", FORMATS["bsdf"].gives)]
    told = " ".join(cells.here("export", "--help").out.split())
    assert all(name in told for name in FORMATS)


def test_a_format_that_the_source_does_not_have_is_refused_with_those_that_it_has() -> None:
    of_pictures, of_frames = formats_of(Source.PICTURES), formats_of(Source.RUN, Writer.FRAMES)
    assert {"ptm", "iiif"} < {*of_pictures}
    assert {"dng", "tiff"} <= {*of_frames}
    with pytest.raises(
        InputError, match=rf"one of {', '.join(of_pictures)} for a result of pictures; found ply; ply is "
    ):
        format_named("ply", Source.PICTURES)
    with pytest.raises(InputError, match=rf"one of {', '.join(of_frames)} for a run; found lp$"):
        format_named("lp", Source.RUN, Writer.FRAMES)
    assert formats_of(Source.RESULT)[-1] == "rocrate"


def test_an_option_of_other_formats_is_refused_with_their_names() -> None:
    refuse_others_options(FORMATS["bsdf"], ["adaptive", "fit"])
    with pytest.raises(InputError, match=r"^--adaptive: is for --to bsdf; found --to merl$"):
        refuse_others_options(FORMATS["merl"], ["fit", "adaptive"])
