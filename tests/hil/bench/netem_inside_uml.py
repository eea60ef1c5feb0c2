"""Two network namespaces with netem between them: ``test_can_uml`` runs it inside user-mode Linux.

With GFMHIL_TEST_BUS it runs on the loopback device instead, to compile everything where that is
faster, and judges nothing.
"""

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from .test_bench import bench

GFMHIL = [sys.executable, "-m", "gfm_hil"]
COMPILES = "GFMHIL_TEST_BUS" in os.environ
FAR = "127.0.0.1" if COMPILES else "10.9.0.2"

pytestmark = pytest.mark.timeout(700)


def sh(line: str) -> None:
    subprocess.run(line.split(), check=True)


@pytest.fixture
def into_far() -> Iterator[str]:
    """The words before a command of the other namespace, which ``veth`` joins to this one."""
    if COMPILES:
        yield ""
        return
    with subprocess.Popen(["unshare", "-n", "sleep", "1000"]) as holder:
        into = f"nsenter -t {holder.pid} -n "
        try:
            while Path(f"/proc/{holder.pid}/ns/net").samefile("/proc/1/ns/net"):
                time.sleep(0.1)
            sh(f"ip link add near type veth peer name far netns {holder.pid}")
            for words, device, address in (("", "near", "10.9.0.1"), (into, "far", FAR)):
                sh(f"{words}ip addr add {address}/24 dev {device}")
                sh(f"{words}ip link set {device} up")
            yield into
        finally:
            holder.kill()  # its namespace and the devices go with it


@pytest.mark.parametrize("there", ["delay 1ms", "delay 1ms 0.3ms loss 1%"])
def test_one_way_delays_and_losses_are_those_of_netem(there, into_far, tmp_path, capsys):
    """1 ms there and 0.2 ms back. What user-mode Linux itself takes is that of both ways."""
    if not COMPILES:
        sh(f"tc qdisc add dev near root netem {there}")
        sh(f"{into_far}tc qdisc add dev far root netem delay 0.2ms")
    endpoint = f"udp://{FAR}:7001"
    command = [*into_far.split(), *GFMHIL, "bench", "answer", endpoint, "--policy", "other"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stderr is not None and "answering" in process.stderr.readline()
            found = bench(
                tmp_path, capsys, "latency", "--to", endpoint, "--mode", "lockstep", "--load",
                "idle", "--policy", "other", "--seconds", "0.2" if COMPILES else "5",
            )  # fmt: skip
        finally:
            process.terminate()
    (row,) = [row for row in found["results"] if row["peer"] == "to"]
    assert (row["clock"], row["within_us"]) == ("one clock", 0.0)
    if not COMPILES:
        ways = row["there"]["p50_us"], row["back"]["p50_us"]
        assert ways[0] >= 1000 and ways[1] >= 200
        assert ways[0] - ways[1] == pytest.approx(800, abs=150)
        wanted = 1.0 if "loss" in there else 0.0
        deviation = 100 * (0.01 * 0.99 / row["sent"]) ** 0.5
        assert row["lost_pct"] == pytest.approx(wanted, abs=5 * deviation if wanted else 0)
        print(there, row["sent"], ways, row["lost_pct_95"])
