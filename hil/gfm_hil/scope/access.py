"""Who may see a scope, and who may touch: hosts, origins, the token, and the page's policy."""

from __future__ import annotations

import hmac
import ipaddress
import re
import secrets
import socket
from collections.abc import Iterable
from urllib.parse import urlsplit

from websockets.datastructures import Headers

#: sent with every answer: nothing from elsewhere, nothing inline, in nobody's frame
HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; "
    "img-src 'self'; connect-src 'self'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'",
    "Cache-Control": "no-store",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}


_AUTHORITY = re.compile(r"(\[[0-9a-f:.]+\]|[a-z0-9._-]+)(:\d+)?")  # of RFC 3986, no user


class Access:
    """The rules of one server.

    Args:
        names: hosts, beside addresses, localhost and this machine's name, by which it is reached.
        operators: names of those who may control; each gets a token of his own.

    Attributes:
        tokens: by the name of the operator.
    """

    def __init__(self, names: Iterable[str] = (), operators: Iterable[str] = ("operator",)) -> None:
        self._names = {"localhost", socket.gethostname().lower(), *(n.lower() for n in names)}
        self.tokens = {name: secrets.token_urlsafe(16) for name in operators}

    def refusal(self, headers: Headers) -> str:
        """Why a request is refused; empty if it is not.

        A page of somebody else's must not reach the scope through the browser of whoever looks at
        it: not by its own address (the origin differs) and not by a name of its own that it lets
        point here (a name that is not ours). Addresses cannot be made to point elsewhere.
        """
        hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
        if len(hosts) != 1 or not self._ours(hosts[0]):
            return f"Host = {hosts}: not a name of this scope (--name adds one)"
        if any(urlsplit(origin).netloc.lower() != hosts[0].lower() for origin in origins):
            return f"Origin = {origins}: not this scope's own page"
        return ""

    def _ours(self, authority: str) -> bool:
        found = _AUTHORITY.fullmatch(authority.lower())
        if found is None:
            return False
        host = found[1].strip("[]")
        try:
            ipaddress.ip_address(host)
        except ValueError:
            return host in self._names
        return True

    @property
    def token(self) -> str:
        """Of the first operator."""
        return next(iter(self.tokens.values()))

    def operator(self, token: str) -> str:
        """The name of the operator who was given this token; empty if there is none."""
        given = token.encode()
        names = [
            n for n, known in self.tokens.items() if hmac.compare_digest(given, known.encode())
        ]
        return names[0] if names else ""
