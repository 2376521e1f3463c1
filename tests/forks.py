"""Processes that begin with what tests import already: forks of a server that has it."""

from __future__ import annotations

import multiprocessing
from multiprocessing.context import ForkServerContext


def fork_context() -> ForkServerContext:
    """For `Process`; what it runs is a function of a test's module."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["cells", "coupole.acquisition.session", "coupole.preflight.job"])
    return context
