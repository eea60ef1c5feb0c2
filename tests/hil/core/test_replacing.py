"""A file is written whole under its name, but not in place of a device or a pipe."""

import os
import stat
from pathlib import Path

import pytest

from gfm_hil.cli.main import main
from gfm_hil.core.files import replacing, write_text


def test_a_pipe_stays_one(tmp_path, capsys):
    pipe = tmp_path / "law.json"
    os.mkfifo(pipe)
    assert main(["schema", "law", "-o", str(pipe)]) == 2
    told = f"gfmhil: {pipe}: is a device or a pipe; give the name of a file\n"
    assert capsys.readouterr().err == told
    assert stat.S_ISFIFO(pipe.stat().st_mode)
    assert [*tmp_path.iterdir()] == [pipe]


def test_nothing_is_put_among_the_devices():
    """A device there, or a link to the standard output, would be gone for all."""
    with pytest.raises(OSError, match="is a device or a pipe"), replacing(Path("/dev/gfmhil-test")):
        pytest.fail("it was begun")


def test_a_link_is_replaced(tmp_path):
    (tmp_path / "link").symlink_to(tmp_path / "other")
    write_text(tmp_path / "link", "text")
    assert not (tmp_path / "link").is_symlink() and not (tmp_path / "other").exists()
