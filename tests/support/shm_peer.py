"""One side of a shared-memory link as a separate process: ``shm_peer.py side endpoint what n``.

``hold`` opens its end and sleeps until it is killed. ``flood`` sends n messages while it receives
the other side's n, all in compiled code, and prints how many arrived and how many were wrong.
"""

import sys
import time

import numpy as np
from numba import njit

from gfm_hil.links import open_link
from gfm_hil.links.ring import LONGEST
from gfm_hil.realtime.clock import yield_processor


@njit
def fill(words, k, salt):
    """Write message k of a side, all words different; returns its length in bytes."""
    x = np.uint64(2 * k + salt + 1) * np.uint64(0x9E3779B97F4A7C15)
    for i in range(len(words)):
        x ^= x >> np.uint64(29)
        x *= np.uint64(0xBF58476D1CE4E5B9)
        words[i] = x
    return 1 + np.int64(x >> np.uint64(33)) % LONGEST


@njit
def flood(send, receive, handle, mine, n):
    words, expected = np.empty(LONGEST // 8, np.uint64), np.empty(LONGEST // 8, np.uint64)
    out, should, got = words.view(np.uint8), expected.view(np.uint8), np.empty(LONGEST, np.uint8)
    sent = received = wrong = 0
    size = fill(words, 0, mine)
    expected_size = fill(expected, 0, 1 - mine)
    while sent < n or received < n:
        idle = True
        if sent < n and send(handle, out[:size]):
            sent += 1
            size = fill(words, sent, mine)
            idle = False
        came = receive(handle, got)
        if came:
            same = came == expected_size
            for i in range(came):
                same = same and got[i] == should[i]
            wrong += not same
            received += 1
            expected_size = fill(expected, received, 1 - mine)
            idle = False
        if idle:
            yield_processor()
    return received, wrong


def main() -> None:
    role, endpoint, what, n = sys.argv[1:]
    link = open_link("shm", role, endpoint)
    print("ready", flush=True)
    if what == "hold":
        time.sleep(600)
    while not (role == "controller" or link.send(b"here")):
        time.sleep(0.001)
    while role == "controller" and not link.wait(1):
        pass
    if role == "controller":
        link.receive()
    port = link.port
    mine = int(role == "plant")
    print(*flood(port.send, port.receive, port.handle, mine, int(n)), flush=True)
    link.close()


if __name__ == "__main__":
    main()
