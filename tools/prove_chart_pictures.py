"""Proves that intervals of colour profiles from plain pictures of a chart hold as often as stated.

    python tools/prove_chart_pictures.py [--charts 100] [--jobs 2] [--only card]

Each random chart has its own paints, measured colours with errors, camera, lamp at a finite distance, vignetting,
noise, perspective and rotation. Separate code of the tests draws its picture
(`tests/calibration/drawn_charts.py`). The true matrix is found by colour-science from the true spectra under even
light. Exits with 1 unless 93 to 97 % of the coefficients are within their 95 % intervals, with a picture of a
white card and without it. At least 93 % of colours that are not on the chart must be within the stated bound.
"""

from __future__ import annotations

import argparse
import os
import sys
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "tests"), str(ROOT / "tests" / "calibration")]

import numpy as np  # noqa: E402
from drawn_charts import varied  # noqa: E402
from judged_charts import Judged, judge  # noqa: E402

from smallest import add_smallest  # noqa: E402

LOW, HIGH = 0.93, 0.97


def judged_chart(with_white: bool, seed: int) -> Judged:
    """Return the comparison of one chart, by its seed."""
    return judge(varied(seed), with_white=with_white)


def main() -> int:
    """Run the proof; see the module's text."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--charts", type=int, default=100, help="number of drawn charts")
    parser.add_argument("--first", type=int, default=0, help="seed of the first one")
    parser.add_argument("--jobs", type=int, default=2, help="charts at the same time")
    parser.add_argument("--only", choices=("card", "patches"), help="origin of the light; by default both")
    add_smallest(parser, charts=1, jobs=1)
    options = parser.parse_args()
    seeds = range(options.first, options.first + options.charts)
    is_good = True
    with ProcessPoolExecutor(options.jobs, mp_context=get_context("spawn")) as pool:
        for with_white in {"card": (True,), "patches": (False,)}.get(options.only, (True, False)):
            charts = list(pool.map(partial(judged_chart, with_white), seeds))
            within = float(np.mean([np.abs(chart.errors) <= chart.factor for chart in charts]))
            rms = float(np.sqrt(np.mean([chart.errors**2 for chart in charts])))
            new = float(np.mean([chart.within_bound for chart in charts]))
            bound = float(np.median([chart.bound_de00 for chart in charts]))
            print(
                f"{'with a white card' if with_white else 'light found from the patches'}: {within:.1%} of "
                f"{9 * len(charts)} coefficients within 95 % intervals, rms(error/u) {rms:.2f}; {new:.1%} of new "
                f"colours within the bound, which is {bound:.1f} CIEDE2000 in the median",
                flush=True,
            )
            is_good &= LOW <= within <= HIGH and new >= LOW
    return 0 if is_good or options.smallest else 1


if __name__ == "__main__":
    sys.exit(main())
