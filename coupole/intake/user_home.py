"""The home folder of the user. It is the same in each working folder, because what is kept there, such as the
light on an object, must be found again."""

from __future__ import annotations

import os
import pwd
from pathlib import Path

from coupole.errors import InputError


def user_home() -> Path:
    """Return the folder that HOME names. If HOME is missing, empty or relative, return the home folder of the
    user's entry in passwd. Raises InputError if that names none either."""
    for home in (os.environ.get("HOME", ""), _home_in_passwd()):
        if Path(home).is_absolute():
            return Path(home)
    raise InputError(
        f"HOME: expected the absolute path of a folder, found {os.environ.get('HOME', '')!r}; user {os.getuid()} "
        "has no home in passwd either"
    )


def with_home(path: Path) -> Path:
    """Return a path whose first part may be `~` or `~user`, with the home folder in its place. Raises InputError
    if there is no such user, or no home."""
    if path.parts[:1] == ("~",):
        return user_home().joinpath(*path.parts[1:])
    try:
        return path.expanduser()
    except RuntimeError as error:
        raise InputError(f"{path}: {error}") from error


def _home_in_passwd() -> str:
    try:
        return pwd.getpwuid(os.getuid()).pw_dir
    except KeyError:
        return ""
