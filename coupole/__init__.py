"""Acquisition controller of La Coupole: plans in, proven frames out."""

import os

# Matrices here are small and many: OpenBLAS's threads cost more than they bring (six times on a busy machine of
# two cores, adjusting a mesh's pose), and simulator and stream want the cores. Set before numpy is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

__version__ = "0.2.0"
