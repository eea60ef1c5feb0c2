"""What is measured: run each module from the top folder, e.g. ``python -m benchmarks.kernel``."""

import os

# numba reads this when it is first imported; without it allocations are not counted
os.environ.setdefault("NUMBA_NRT_STATS", "1")
