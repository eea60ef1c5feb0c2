"""Rate limit of commands: a token bucket."""

import threading
import time
from collections.abc import Callable

from gfm_hil.core.errors import UserError


class Rate:
    """A limit on commands: ``burst`` at once, and ``per_s`` a second in the long run.

    Args:
        who: whose commands these are, for the refusal.
        per_s, burst: the limit.
        clock: monotonic time, s.
    """

    def __init__(
        self, who: str, per_s: float, burst: int, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._who, self._per_s, self._burst, self._clock = who, per_s, burst, clock
        self._left, self._since = float(burst), clock()
        self._lock = threading.Lock()
        self.refused = 0

    def take(self) -> None:
        """Count one command. Raises UserError: it exceeds the limit; the caller must not carry it
        out."""
        with self._lock:
            now = self._clock()
            gained = (now - self._since) * self._per_s
            self._left, self._since = min(self._left + gained, self._burst), now
            if self._left < 1.0:
                self.refused += 1
                raise UserError(
                    f"more than {self._per_s:g} commands a second from {self._who}: "
                    f"{self.refused} refused so far"
                )
            self._left -= 1.0
