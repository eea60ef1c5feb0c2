"""Access to a scope: hosts, origins, the token for control, and the page's security policy."""

from __future__ import annotations

import hmac
import ipaddress
import re
import secrets
import socket
from collections.abc import Iterable
from urllib.parse import urlsplit

from websockets.datastructures import Headers

#: headers of every answer: no foreign content, no inline code, no embedding in frames
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
    """Access rules of one server.

    Args:
        names: host names of the server besides addresses, localhost and this machine's name.
        operators: names of the operators who may control; each gets a token.

    Attributes:
        tokens: by the name of the operator.
    """

    def __init__(self, names: Iterable[str] = (), operators: Iterable[str] = ("operator",)) -> None:
        self._names = {"localhost", socket.gethostname().lower(), *(n.lower() for n in names)}
        self.tokens = {name: secrets.token_urlsafe(16) for name in operators}

    def refusal(self, headers: Headers) -> str:
        """Why a request is refused; empty if it is accepted.

        A foreign page in a user's browser must not reach the scope: not from its own address (the
        origin differs), and not through DNS rebinding, a foreign name that resolves to this server
        (the host is not ours). An address in place of a name cannot be rebound.
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

    def operator(self, token: str) -> str:
        """The name of the operator with this token; empty if there is none."""
        given = token.encode()
        names = [
            n for n, known in self.tokens.items() if hmac.compare_digest(given, known.encode())
        ]
        return names[0] if names else ""
