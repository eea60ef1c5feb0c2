"""The files that tests write, compile or read row by row: TOML, C, CSV and tables."""

from pathlib import Path

FILES = Path(__file__).parents[1] / "files"


def text_of(name: str) -> str:
    """The text of a file in tests/files."""
    return (FILES / name).read_text("utf-8")
