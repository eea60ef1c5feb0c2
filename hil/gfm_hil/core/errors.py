"""Errors that the user can fix: printed as one line, without a traceback."""

import contextlib
import importlib.util
from collections.abc import Iterator

from gfm_runtime.mistakes import lines as lines


class UserError(Exception):
    """Wrong input, or a bench that cannot start; the message names field, value and remedy."""


class Unfinished(Exception):
    """The run is over, but its folder could not be completed; no recorded data is lost."""


class PeerLost(Exception):
    """The other side never connected, stopped answering, or is not compatible with this side."""


@contextlib.contextmanager
def naming(where: object) -> Iterator[None]:
    """Make a UserError, which names ``where``, of an OSError in this context."""
    try:
        yield
    except OSError as problem:
        raise UserError(f"{where}: {problem.strerror or problem}") from None


def need(module: str, package: str, what: str, extra: str) -> None:
    """Raise UserError if the package that ``what`` needs is not installed."""
    if importlib.util.find_spec(module) is None:
        raise UserError(f"{what} needs {package}: pip install 'gfmhil[{extra}]'")
