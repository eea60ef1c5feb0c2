"""The command ``gfmhil``: one module a command."""

from gfm_hil.cli.main import main, program

__all__ = ["main", "program"]
