"""Errors that are the user's to mend: printed as one line, without a traceback."""

from __future__ import annotations


class UserError(Exception):
    """Wrong input or a bench that cannot start; the message names the field, value and remedy."""


class PeerLost(Exception):
    """The other side never came, stopped answering, or does not fit this side."""
