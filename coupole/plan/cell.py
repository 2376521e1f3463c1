"""The cell: a rig file, read and checked with all files that it names."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path

from coupole.errors import InputError, Problem, reason
from coupole.intake.input_files import InputFiles
from coupole.intake.user_home import user_home
from coupole.plan import yamlfile
from coupole.plan.arm_description import arm_named
from coupole.plan.led_table import LedTable, read_led_table
from coupole.plan.link_meshes import missing_link_meshes
from coupole.plan.rig import Rig
from coupole.plan.rig_devices import described_arm, driver_problems, renamed_drivers
from coupole.plan.rig_units import doubt_of_dome, doubts_of
from coupole.plan.shipped_files import file_of, place_to_write
from coupole.plan.yamlfile import Document


@dataclass(frozen=True)
class Cell:
    """A rig file that was read, with its dome."""

    rig: Rig
    document: Document
    leds: LedTable
    remarks: tuple[str, ...] = ()
    """Warnings about a valid file."""
    led_damage_w_per_lm: float | None = None
    """Damaging power of the LEDs' light (`coupole.appearance.spectra.damage`); None if their spectrum is not
    known."""
    panel_damage_w_per_lm: float | None = None
    files: InputFiles = field(default_factory=InputFiles, repr=False, compare=False)
    """Files that were read. Code that needs one of these files again gets the same bytes."""

    @property
    def leds_path(self) -> Path:
        return self.document.resolve(self.rig.dome.leds)

    @property
    def link_meshes(self) -> Path | None:
        """Folder of the link meshes: the rig's, or otherwise the arm's."""
        if self.rig.link_meshes is not None:
            return self.document.resolve(self.rig.link_meshes)
        arm = described_arm(self.rig)
        return arm.link_meshes if arm else None

    @property
    def storage_folder(self) -> Path:
        return place_to_write(self.document.resolve(self.rig.storage.folder))

    @property
    def state_folder(self) -> Path:
        """Folder for facts about the cell that do not depend on the acquisition."""
        folder = self.rig.storage.state
        return self.document.resolve(folder) if folder is not None else self.storage_folder / "state"

    @property
    def ledger_folder(self) -> Path:
        """Folder of the objects' dose ledgers."""
        return self.document.resolve(self.rig.ledger) if self.rig.ledger is not None else users_ledger_folder()

    @property
    def controllers_folder(self) -> Path:
        """Folder for facts about controllers of arms (`coupole.plan.controller_places`)."""
        folder = self.rig.controllers
        return self.document.resolve(folder) if folder is not None else users_data_folder() / "controllers"

    @property
    def former_ledger_folder(self) -> Path:
        """Folder in which version 0.1 kept the dose ledgers."""
        return self.storage_folder / "ledger"


def users_ledger_folder() -> Path:
    """Return the ledger folder for rigs that do not name one."""
    return users_data_folder() / "ledger"


def users_data_folder() -> Path:
    """Return Coupole's folder in the user's data folder. It follows the XDG Base Directory Specification, which
    ignores a relative path. Raises InputError if the user has no home folder."""
    folder = Path(os.environ.get("XDG_DATA_HOME", ""))
    return (folder if folder.is_absolute() else user_home() / ".local/share") / "coupole"


def read_cell(path: Path, files: InputFiles | None = None) -> Cell:
    """Read a rig, given by its path or by the name of a shipped one, and its dome, into `files` if they are given.
    Raises InputError with all problems."""
    files = InputFiles() if files is None else files
    document = yamlfile.read_document(file_of(path, "rigs"), files)
    rig, problems = document.problems(Rig)
    if rig is None:
        raise InputError(problems)
    arm, problems = arm_named(document, rig.arm, rig.robot.driver, rig.robot.settings, files)
    if problems:
        raise InputError(problems)
    rig = rig.model_copy(update={"arm": arm})
    doubts, problems = doubts_of(rig), driver_problems(document, rig)
    leds: LedTable | None = None
    leds_path = document.resolve(rig.dome.leds)
    if not files.there(leds_path):
        problems.append(document.problem(("dome", "leds"), f"expected the dome's CSV; there is no {leds_path}"))
    else:
        try:
            leds = read_led_table(leds_path, files)
            doubts += doubt_of_dome(leds)
        except InputError as error:
            problems += error.problems
    if rig.storage.pixels == "packed12" and (rig.sensor.bit_depth > 12 or rig.sensor.width_px % 2):
        why = f"expected an even width and 12 bits at most, found {rig.sensor.width_px} and {rig.sensor.bit_depth}"
        problems.append(document.problem(("storage", "pixels"), f"frames cannot be packed: {why}"))
    problems += [document.problem(doubt.at, doubt.message) for doubt in doubts if doubt.is_refused]
    led_w_per_lm = _damage_w_per_lm(document, "spectrum", rig.dome.spectrum, files, problems)
    panel_w_per_lm = _damage_w_per_lm(document, "panel_spectrum", rig.dome.panel_spectrum, files, problems)
    if problems or leds is None:
        raise InputError(problems)
    remarks = [str(document.problem(doubt.at, doubt.message)) for doubt in doubts]
    cell = Cell(rig, document, leds, (*renamed_drivers(document), *remarks), led_w_per_lm, panel_w_per_lm, files)
    if cell.link_meshes is not None and (missing := missing_link_meshes(cell.link_meshes, files)):
        at = ("link_meshes",) if rig.link_meshes else ("arm",)
        raise InputError([document.problem(at, f"expected the links' meshes; there is no {missing[0]}")])
    return cell


def _damage_w_per_lm(
    document: Document, key: str, spectrum_file: Path | None, files: InputFiles, problems: list[Problem]
) -> float | None:
    """Return the damaging power per lumen of the lamps whose spectrum is in this file; None if no file is given,
    or if a problem was added to `problems`."""
    if spectrum_file is None:
        return None
    from coupole.appearance.spectra.damage import damage_w_per_lm
    from coupole.appearance.spectra.measured import decode_text, parse_spectrum

    path = document.resolve(spectrum_file)
    try:
        return damage_w_per_lm(
            parse_spectrum(decode_text(files.read_bytes(path)), str(path), name=path.stem, unit="power")
        )
    except (OSError, UnicodeDecodeError) as error:
        problems.append(document.problem(("dome", key), f"cannot read the spectrum {path}: {reason(error)}"))
    except InputError as error:
        problems += error.problems or [document.problem(("dome", key), str(error))]
    return None
