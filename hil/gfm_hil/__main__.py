"""``python -m gfm_hil`` is ``gfmhil``."""

from gfm_hil.cli import program

raise SystemExit(program())
