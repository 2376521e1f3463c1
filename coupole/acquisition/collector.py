"""Python's collector of reference cycles, kept out of motions and bursts.

A full collection looks at every object and stops all threads meanwhile. This takes 0.1 to 0.3 s with the 500,000
objects of a session of 300,000 frames. In a motion, this time is a lapse of attention (`coupole.supervision`); in
a burst, the box is not queried during this time. So a session collects only at rest and in the dark, when it
requests a collection, and examines each object once.
"""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def collected_when_asked() -> Iterator[Callable[[], None]]:
    """Collect cycles only by calls of the yielded function, while the context lasts. Objects that survive such a
    call are examined again only after the context.
    """
    was_enabled = gc.isenabled()
    gc.disable()

    def collect() -> None:
        gc.collect()
        gc.freeze()

    try:
        yield collect
    finally:
        gc.unfreeze()
        if was_enabled:
            gc.enable()
