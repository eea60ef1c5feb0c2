"""Settings for the whole suite."""

import os

from hypothesis import settings

pytest_plugins = ["tests.attacks"]

# One thread in BLAS: small matrices, and both processors are busy (see gfm_hil.core.blas).
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Figures are drawn without a display.
os.environ.setdefault("MPLBACKEND", "Agg")

# The first example may compile a kernel, which takes longer than hypothesis' deadline.
settings.register_profile("gfmhil", deadline=None)
settings.load_profile("gfmhil")
# Fuzzing of any length, see CONTRIBUTING.md. An input that exceeds the deadline is a bug.
settings.register_profile("fuzz", deadline=60_000, max_examples=20_000)
