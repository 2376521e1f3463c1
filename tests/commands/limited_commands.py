"""A command under a limit of the system, as `ulimit` sets it."""

from __future__ import annotations

import resource
import sys

from coupole.commands import cli


def run_limited(limit: str, value: str, *arguments: str) -> None:
    """Run `coupole` with these arguments in this process; `limit` is a name such as `RLIMIT_NOFILE`."""
    resource.setrlimit(getattr(resource, limit), (int(value), int(value)))
    sys.argv = ["coupole", *arguments]
    cli.main()
