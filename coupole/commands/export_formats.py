"""Formats of `coupole export --to`, by what is exported."""

from __future__ import annotations

from coupole.exchange import COLMAP, CRATE, FORMATS
from coupole.exchange.of_results import FORMATS as OF_RESULTS
from coupole.exchange.rti import FORMATS as OF_VIEWS
from coupole.exchange.rti import OF_RUNS_ONLY

OF_RUNS = (*FORMATS, *OF_VIEWS, COLMAP, CRATE)
OF_RESULTS_OF_RUNS = (*OF_RESULTS, CRATE)
OF_PICTURES = tuple(name for name in OF_VIEWS if name not in OF_RUNS_ONLY)
"""Of results of pictures."""
