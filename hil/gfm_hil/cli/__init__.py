"""The command ``gfmhil``: one module a command."""

from gfm_hil.cli.main import main

__all__ = ["main"]
