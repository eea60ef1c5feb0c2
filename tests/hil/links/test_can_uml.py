"""Real SocketCAN and netem, in a kernel that has them: user-mode Linux, booted on the host's files.

Needs Debian's packages ``user-mode-linux``, ``kmod`` and ``iproute2``. The kernel is a process of
the user, but the tests inside write to the host's files, so they run only with GFMHIL_UML=1.
"""

import os

import pytest

pytestmark = [pytest.mark.apt, pytest.mark.uml]

# how Linux 6.1 ends before its first program on processors with AMX, whose registers take 11 kB
_LACKING = "ptrace set fp regs failed"


@pytest.mark.skipif(
    "GFMHIL_UML" not in os.environ, reason="boots a kernel; GFMHIL_UML=1 asks for it"
)
@pytest.mark.timeout(1500)
def test_socketcan_and_netem_inside_user_mode_linux(uml_kernel):
    status, said = uml_kernel.result(timeout=1450)
    if status == "" and _LACKING in said:
        pytest.skip("user-mode Linux of this version has no room for this processor's registers")
    assert status == "0", said
    assert " passed" in said
    print(said)
