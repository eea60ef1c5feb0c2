"""A controller of your own: droop with a low-pass on p, in plain Python over ZeroMQ.

It imports nothing of gfmhil. It knows the handshake and the two frames, which
docs/own-controller.md describes. A controller in any other language needs no more than that.

Usage: controller.py ENDPOINT SCENARIO
"""

import json
import struct
import sys
import tomllib
import zlib
from pathlib import Path

import zmq

NAME = "droop in Python"
GREETING = b"GFMHIL "
HEADER = "<HBBBBHIQ"  # magic, table version, data id, state, reason, spare, sequence, tick
MAGIC, VERSION, Y_ID, U_ID = 0x4647, 4, 1, 2
RUNNING, SAFE, STOPPED = 2, 3, 4

D_p, k_34, T = 0.01, 0.005, 0.02  # p.u., p.u., s
SILENCE_MS = 20_000  # then the plant counts as gone


class Droop:
    """omega_u follows the filtered p, E_u follows q.

    Args:
        references: P_ref, omega_g, Q_ref, V_ref in p.u.
        T_s: sampling time, s.
    """

    def __init__(self, references, T_s):
        self.ref, self.share, self.p = dict(references), T_s / T, None

    def step(self, v_dc, p, omega_u, q, V):
        """One tick: measurements in, (i_u, omega_u, E_u) out, p.u."""
        self.p = p if self.p is None else self.p + self.share * (p - self.p)
        frequency = 1.0 + D_p * (self.ref["P_ref"] - self.p)
        voltage = self.ref["V_ref"] + k_34 * (self.ref["Q_ref"] - q)
        return self.ref["P_ref"], frequency, voltage  # the rig's DC source regulates itself


def greet(socket):
    """Answer the plant's greeting until it starts; the answer repeats what the plant runs."""
    while True:
        message = receive(socket)
        if not message.startswith(GREETING):
            continue
        said = json.loads(message.removeprefix(GREETING))
        if said["kind"] == "start":
            return
        boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
        answer = {**said, "role": "controller", "boot": boot, "name": NAME}
        socket.send(GREETING + json.dumps(answer).encode())


def receive(socket):
    if not socket.poll(SILENCE_MS):
        sys.exit("the plant is gone")
    return socket.recv()


def read_y(message):
    """(state, tick, values) of a good frame, or None."""
    if len(message) != struct.calcsize(HEADER + "5dI"):
        return None
    *header, tick, v_dc, p, omega_u, q, V, crc = struct.unpack(HEADER + "5dI", message)
    magic, version, data_id, state = header[:4]
    good = zlib.crc32(message[:-4]) == crc and (magic, version, data_id) == (MAGIC, VERSION, Y_ID)
    return (state, tick, (v_dc, p, omega_u, q, V)) if good else None


def write_u(state, sequence, tick, values):
    body = struct.pack(HEADER + "3d", MAGIC, VERSION, U_ID, state, 0, 0, sequence, tick, *values)
    return body + struct.pack("<I", zlib.crc32(body))


def steps(scenario):
    """New references by their tick, as the test has them."""
    found = {}
    for event in scenario.get("events", []):
        if event["type"] == "reference":
            tick = event["tick"] if "tick" in event else round(event["t"] / scenario["T_s"])
            new = {k: v for k, v in event.items() if k not in ("type", "tick", "t", "ramp_s")}
            found.setdefault(tick, {}).update(new)
    return found


def main(endpoint, scenario_file):
    scenario = tomllib.loads(Path(scenario_file).read_text())
    law, new = Droop(scenario["references"], scenario["T_s"]), steps(scenario)
    socket = zmq.Context.instance().socket(zmq.PAIR)
    socket.bind(endpoint)
    greet(socket)
    sequence, last, u = 0, -1, None
    while True:
        frame = read_y(receive(socket))
        if frame is None:
            continue  # damaged: in lockstep the plant sends it again
        state, tick, y = frame
        if state in (SAFE, STOPPED):  # the plant tripped, or the run is over: a last word
            socket.send(write_u(STOPPED, sequence, last, u or (0.0, 1.0, 1.0)))
            return
        if tick > last:  # else the plant asks again: the answer was lost
            for k in range(last + 1, tick + 1):
                law.ref.update(new.get(k, {}))
            last, u = tick, law.step(*y)
        socket.send(write_u(RUNNING, sequence, last, u))
        sequence = (sequence + 1) % 2**32


if __name__ == "__main__":
    main(*sys.argv[1:])
