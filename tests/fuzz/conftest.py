"""One reader for each parser, its corpus, and the requirements on every reader."""

import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from hypothesis import strategies as st

CORPUS = Path(__file__).with_name("corpus")
#: reads one input
Take = Callable[[bytes], None]
MOST_MEMORY = 400e6  # most additional bytes that reading any input may take


@dataclass(frozen=True)
class Parser:
    """A parser of foreign input."""

    name: str  # its folder in the corpus
    # opens it in an empty folder; yields a function that reads one input and catches the documented
    # exceptions
    open: Callable[[Path], AbstractContextManager[Take]]
    # strategy of inputs, made once the parser is open
    inputs: Callable[[], st.SearchStrategy[bytes]]


@dataclass
class Reader:
    """An open parser; ``read`` fails if an input raises an undocumented exception."""

    parser: Parser = field(repr=False)
    inputs: st.SearchStrategy[bytes] = field(repr=False)
    take: Take = field(repr=False)
    kept: Path

    def read(self, message: bytes) -> None:
        """Read an input; save one that fails, to be copied into the corpus."""
        try:
            self.take(message)
        except Exception as problem:
            self.kept.parent.mkdir(parents=True, exist_ok=True)
            self.kept.write_bytes(message)
            keep = f"cp {self.kept} tests/fuzz/corpus/{self.parser.name}/NAME"
            problem.add_note(f"to keep this input: {keep}")
            raise

    def corpus(self) -> list[Path]:
        """The inputs in the repository."""
        return sorted((CORPUS / self.parser.name).iterdir())


def peak() -> int:
    """Peak memory of this process since ``forget_peak``, bytes."""
    status = Path("/proc/self/status").read_text()
    return 1024 * int(status.partition("VmHWM:")[2].split()[0])


def forget_peak() -> None:
    """Reset the peak memory, proc_pid_clear_refs(5)."""
    Path("/proc/self/clear_refs").write_text("5")


@pytest.fixture(scope="module")
def reader(request: pytest.FixtureRequest) -> Iterator[Reader]:
    """The parser of the parameter, open; checks its memory at the end."""
    parser: Parser = request.param
    kept = Path(os.path.relpath(request.config.rootpath / ".hypothesis" / "failed" / parser.name))
    place = Path(tempfile.mkdtemp(prefix="gfmhil-fuzz-"))
    try:
        with parser.open(place) as take:
            found = Reader(parser, parser.inputs(), take, kept)
            forget_peak()
            before = peak()
            yield found
            assert peak() - before < MOST_MEMORY, f"{(peak() - before) / 1e6:.0f} MB"
    finally:
        shutil.rmtree(place)
