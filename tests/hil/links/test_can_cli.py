"""gfmhil dbc."""

import pytest

from gfm_hil.cli import main
from gfm_hil.core.errors import UserError
from gfm_hil.links.can.dbc import read_dbc, write_dbc


def test_the_file_is_the_one_that_the_link_runs_by(tmp_path, capsys):
    for flags, fd in ([], True), (["--classic"], False):
        out = tmp_path / "link.dbc"
        assert main(["dbc", *flags, "--out", str(out)]) == 0
        assert out.read_text(encoding="utf-8") == write_dbc(fd)
        assert main(["dbc", *flags]) == 0
        assert read_dbc(capsys.readouterr().out).get_message_by_name("Commands").is_fd == fd


def test_the_budget(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    assert main(["dbc", "--budget"]) == 0
    rows = {line[:13].strip(): line[13:].split() for line in capsys.readouterr().out.splitlines()}
    assert rows["FD 1/8"] == ["12+8", "51.0", "46.1", "97.1", "10296", "1", "97%"]
    assert rows["classic 1"] == ["8+6+8", "246.0", "133.0", "379.0", "2639", "4", "95%"]
    assert main(["dbc", "--budget", "--inner"]) == 0
    rows = {line[:13].strip(): line[13:].split() for line in capsys.readouterr().out.splitlines()}
    assert rows["FD 1/8"][0] == "24+12" and rows["FD 1/8"][5] == "2"
    assert rows["classic 1"][0] == "8+8+8+6+8+4" and rows["classic 1"][5] == "8"


def test_an_inner_stage_must_fit_the_bus_too(make):
    """24 and 12 bytes at 1/8 Mbit/s: 66.8 and 51.0 us."""
    link = {"type": "can"}
    make(law="vsg-2", link=link)
    why = r"link\.options: y \(66\.8 µs\) and u \(51\.0 µs\) .* 118% .* fits: every = 2"
    with pytest.raises(UserError, match=why):
        make(law="vsg-2", inner="cascaded", link=link)
    make(law="vsg-2", inner="cascaded", link={**link, "options": {"every": 2}})
