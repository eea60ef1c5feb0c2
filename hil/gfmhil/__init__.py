"""The public API: run scenarios, compare laws, change gains, load runs, run conformity tests, from
Python::

    import gfmhil

    run = gfmhil.run("pref_step", law="vsg-2")
    run.signals["p"], run.metrics, run.plot()

Runs stay in memory and print nothing. Errors are ``UserError`` and ``LawError``, in one line.
"""

import ast
from importlib import import_module
from pathlib import Path
from typing import Any

from gfm_hil.core import blas as _blas  # noqa: F401  before NumPy is first imported

# the stub beside this file says in which module each name is
_STUB = ast.parse(Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8"))
_HOMES = {
    name.name: str(line.module)
    for line in _STUB.body
    if isinstance(line, ast.ImportFrom)
    for name in line.names
}
__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    """Load what is asked for, when it is."""
    if name not in _HOMES:
        raise AttributeError(f"module 'gfmhil' has no attribute {name!r}")
    if _HOMES[name] == __name__:
        return import_module(f"{__name__}.{name}")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return __all__
