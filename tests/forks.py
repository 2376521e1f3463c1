"""Processes that begin with what tests import already: forks of a server that has it."""

from __future__ import annotations

import multiprocessing
import os
import sys
from multiprocessing import forkserver
from multiprocessing.context import ForkServerContext
from unittest import mock

MODULES = (
    "cells",
    "happenings",
    "coupole.commands.cli",
    "coupole.acquisition.session",
    "coupole.motion.annealing",
    "coupole.motion.distances",
    "coupole.viewing.report",
    "drivers.kuka.rsi.driver",
    "drivers.ledbox.driver",
    "drivers.ledbox.scpi",
    "sim.devices.memory_camera",
    "sim.world.client",
)
"""What an `acquire` on the simulated cell imports, and the tests that fork it."""


def fork_context() -> ForkServerContext:
    """For `Process`; what it runs is a function of a test's module."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(list(MODULES))
    # Python's server does not look where its parent does, and leaves out in silence what it does not find.
    with mock.patch.dict(os.environ, PYTHONPATH=os.pathsep.join(sys.path)):
        forkserver.ensure_running()
    return context
