"""gfmhil dbc."""

from __future__ import annotations

from pathlib import Path

import pytest

from gfm_hil.cli import main
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


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--out", "nowhere/link.dbc"], "--out nowhere/link.dbc: No such file or directory"),
        (["--budget", "--T_s", "0"], "--T_s 0: must be more than 0 s"),
    ],
)
def test_wrong_input_is_one_line(arguments, said, capsys, tmp_path: Path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["dbc", *arguments]) == 2
    assert capsys.readouterr().err == f"gfmhil: {said}\n"
