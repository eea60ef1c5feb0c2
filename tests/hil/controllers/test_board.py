"""The example of a bare-metal board, in QEMU with its UART on a pseudo terminal."""

import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest

from gfm_hil.cli import main
from gfm_hil.recording.run import Run

from ...support.firmware import bench
from ...support.processes import write

BOARD = Path(__file__).parents[3] / "examples" / "board_c"
QEMU = ("qemu-system-arm", "-machine", "mps2-an386", "-display", "none", "-monitor", "none")


@pytest.mark.compilers
@pytest.mark.timeout(900)
def test_a_board_controls_the_plant_over_its_uart(tmp_path):
    """Each u on the line has the bits of the float32 kernel at the y that the plant sent."""
    place = tmp_path / "board"
    shutil.copytree(BOARD, place, ignore=shutil.ignore_patterns("law", "*.elf"))
    warnings = ["make", "board.elf", f"GFMHIL={sys.executable} -m gfm_hil"]
    made = subprocess.run(warnings, cwd=place, capture_output=True, text=True, check=False)
    assert (made.returncode, made.stderr) == (0, "")
    command = [*QEMU, "-serial", "pty", "-kernel", "board.elf"]
    with subprocess.Popen(command, cwd=place, stdout=subprocess.PIPE, text=True) as machine:
        try:
            assert machine.stdout is not None
            device = re.search(r"/dev/pts/\d+", machine.stdout.readline())
            assert device is not None
            link = tomllib.loads((BOARD / "scenario.toml").read_text())["link"]
            step = {"tick": 50, "type": "grid-phase-jump", "degrees": 2.0}
            file = write(tmp_path, law="vsg-2", link=link, duration=0.02, events=[step])
            for name in ("first", "again"):  # the board is ready for the next run
                plant = ["plant", file, "--endpoint", f"serial://{device[0]}", "--quiet"]
                assert main([*plant, "--out", str(tmp_path / name)]) == 0
        finally:
            machine.kill()
    runs = [Run.load(tmp_path / name).columns for name in ("first", "again")]
    y, found = (
        np.column_stack([runs[0][f"{letter}_{name}"][:] for name in names])
        for letter, names in (
            ("y", ("v_dc", "p", "omega_u", "q", "V")),
            ("u", ("i_u", "omega_u", "E_u")),
        )
    )
    ref, rest = np.array([1.0, 0.5, 1.0, 0.0, 1.0]), np.array([0.5, 1.0, 1.0])
    law = bench("vsg-2", "none", "float32", ref, y[0], rest)
    u = np.zeros(3)
    for k in range(len(y)):
        law.step(y[k], u)
        assert u.tobytes() == found[k].tobytes(), k
    assert len(y) == 200 and np.ptp(y[:, 1]) > 0.05
    for name, column in runs[0].items():
        assert column[:].tobytes() == runs[1][name][:].tobytes(), name
