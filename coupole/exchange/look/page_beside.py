"""Makes the page to relight of a result of the views so far: `python -m coupole.exchange.look.page_beside PARENT
RESULT PAGE`. Its parent is the process beside an acquisition. This process has the low priority of its parent,
and ends when the parent ends.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

from coupole.errors import CoupoleError
from coupole.reflectance.beside.lowest_priority import end_with

MOST_BYTES = 150_000_000
"""Greatest size of a page. It must contain all its data, because the console serves the page alone."""


def main() -> None:
    """Write the page, with no data beside it. If it cannot be made, the exit code is 1."""
    parent, folder, page = int(sys.argv[1]), Path(sys.argv[2]), Path(sys.argv[3])
    end_with(parent)

    from coupole.exchange.look.look_of_runs import PageChoice, look_of_result
    from coupole.exchange.look.look_page import write_page

    try:
        look = look_of_result(folder, choice=PageChoice(planes=0))
        files = write_page(look, folder.name, page, MOST_BYTES)
    except (CoupoleError, OSError) as error:
        sys.exit(str(error))
    if len(files) > 1:
        for file in files:
            file.unlink()
        sys.exit(f"{page}: it would have more than {MOST_BYTES} bytes")
    os._exit(0)  # no thread is waited for


if __name__ == "__main__":
    main()
