"""Settings for the whole suite."""

import os

from hypothesis import settings

# Figures are drawn without a display.
os.environ.setdefault("MPLBACKEND", "Agg")

# The first example may compile a kernel, which takes longer than hypothesis' deadline.
settings.register_profile("gfmhil", deadline=None)
settings.load_profile("gfmhil")
