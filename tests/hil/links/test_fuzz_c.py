"""The parsers in C: equal to the bench's own, and under a fuzzer with sanitizers."""

import ctypes
import json
import os
import shutil
import struct
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import gfm_hil.controllers
from gfm_hil.engine.handshake import _Hello
from gfm_hil.links.base import LONGEST
from gfm_hil.links.frame import FrameReader, FrameWriter
from gfm_hil.links.serial.framing import encoded
from gfm_runtime.firmware import make_modules, sources
from gfm_runtime.firmware.check import HARNESS
from gfm_runtime.firmware.folder import selftest
from gfm_runtime.firmware.loop import _states

from ...support.files import text_of
from ...support.firmware import STAGED, T_S, cc, exported
from ...support.laws import LAWS
from ...support.links import Unstuffer

pytestmark = [
    pytest.mark.compilers,
    pytest.mark.timeout(0 if "GFMHIL_FUZZ_RUNS" in os.environ else 240),
]

HEADERS = Path(gfm_hil.controllers.__file__).parent
EXAMPLES = Path(__file__).parents[3] / "examples"
DRIVERS = Path(__file__).parents[2] / "support" / "fuzz_c"
STRICT = ["-std=c99", "-Wall", "-Wextra", "-Wconversion", "-pedantic", "-Werror", "-O1"]
SANITIZED = ["-g", "-O1", "-fsanitize=fuzzer,address,undefined", "-fno-sanitize-recover=all"]
RUNS = int(os.environ.get("GFMHIL_FUZZ_RUNS", "40000"))
HELLO = {"kind": "hello", "role": "plant", "boot": "x", "version": 2, "table": "abcdef01",
         "T_s": 1e-4, "laws": "0123456789abcdef", "digest": "fedcba9876543210",
         "run": 17}  # fmt: skip
SHARED = text_of("frames_in_c.c")


@pytest.fixture(scope="module")
def header(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """The functions of gfmhil_frames.h."""
    place = tmp_path_factory.mktemp("header")
    (place / "shared.c").write_text(SHARED)
    for compiler in ("clang", "gcc"):
        done = cc(place, *STRICT, "-shared", "-fPIC", f"-I{HEADERS}", "shared.c", "-o", "s.so",
                  compiler=compiler)  # fmt: skip
        assert (done.returncode, done.stderr) == (0, "")
    found = ctypes.CDLL(str(place / "s.so"))
    found.take.restype = found.stuff.restype = found.answer.restype = ctypes.c_size_t
    found.crc.restype = ctypes.c_uint32
    return found


messages = st.binary(min_size=1, max_size=LONGEST) | st.builds(
    lambda a, n, b: (a + bytes([7]) * n + b)[:LONGEST],
    st.binary(max_size=3), st.integers(250, 515), st.binary(max_size=3),
)  # fmt: skip
greetings = st.binary(max_size=100).map(lambda rest: b"GFMHIL " + rest)


@given(many=st.lists(messages | greetings, max_size=4))
def test_a_line_in_c_stuffs_and_unstuffs_as_the_bench(header, many):
    to, found = ctypes.create_string_buffer(LONGEST + 8), []
    for message in many:
        size = header.stuff(message, ctypes.c_size_t(len(message)), to)
        line = to.raw[:size]
        assert line == encoded(message)
        found += taken(header, line)
    assert found == many


def taken(header: Any, line: bytes) -> list[bytes]:
    """The messages that C takes from bytes of a line."""
    to, found = ctypes.create_string_buffer(LONGEST + 8), []
    for byte in line:
        size = header.take(ctypes.c_uint8(byte), to)
        if size:
            found.append(to.raw[:size])
    return found


@given(line=st.binary(max_size=300) | st.lists(st.integers(0, 4), max_size=60).map(bytes))
def test_a_damaged_line_gives_c_what_it_gives_the_bench(header, line):
    bench, found = Unstuffer(), []
    bench.feed(line + b"\0")
    while (message := bench.next()) is not None:
        found.append(message)
    assert taken(header, line + b"\0") == found


@given(
    values=st.lists(st.floats(allow_nan=False, width=64), min_size=5, max_size=5),
    tick=st.integers(0, 2**63 - 1),
    damage=st.integers(0, 64 * 8),
)
def test_frames_in_c_are_those_of_the_bench(header, values, tick, damage):
    y = bytearray(FrameWriter("y").pack(tick, 2, 0, np.array(values)))
    size, zero = ctypes.c_size_t(len(y)), ctypes.c_uint32(0)
    assert header.is_y(bytes(y), size, zero)
    assert not header.is_y(bytes(y), size, ctypes.c_uint32(1))  # it was there before
    assert not header.is_y(bytes(y), ctypes.c_size_t(len(y) - 1), zero)
    if damage < 64 * 8:
        y[damage // 8] ^= 1 << damage % 8
        assert not header.is_y(bytes(y), size, zero)
    u, to = np.array(values[:3]), ctypes.create_string_buffer(48)
    header.seal(ctypes.c_uint64(tick), ctypes.c_uint8(2), u.ctypes.data_as(ctypes.c_void_p), to)
    reader, read = FrameReader("u"), np.zeros(3)
    assert reader.unpack(to.raw, read) == tick and read.tolist() == u.tolist()
    assert reader.state == 2


@given(fields=st.permutations(list(HELLO)), tight=st.booleans())
def test_the_answer_to_a_hello_in_any_order_is_a_hello(header, fields, tight):
    apart = {"separators": (",", ":")} if tight else {}
    hello = b"GFMHIL " + json.dumps({name: HELLO[name] for name in fields}, **apart).encode()
    to = ctypes.create_string_buffer(LONGEST)
    size = header.answer(hello, b"one of ours", to)
    answer = json.loads(to.raw[7:size])
    read = _Hello.model_validate(answer)
    assert read.role == "controller" and to.raw[:7] == b"GFMHIL "
    assert {k: answer[k] for k in ("version", "table", "T_s", "laws", "digest")} == {
        k: HELLO[k] for k in ("version", "table", "T_s", "laws", "digest")
    }
    assert header.is_greeting(hello, b"hello") and not header.is_greeting(hello, b"start")


def test_an_answer_that_has_no_room_is_none(header):
    to = ctypes.create_string_buffer(LONGEST)
    hello = b"GFMHIL " + json.dumps({**HELLO, "laws": "x" * 250}).encode()
    sizes = [header.answer(hello, b"n" * k, to) for k in range(120)]
    first = sizes.index(0)
    assert LONGEST - 2 <= sizes[first - 1] <= LONGEST and not any(sizes[first:])
    assert header.answer(hello.replace(b'"T_s"', b'"Ts"'), b"n", to) == 0


def fuzz(place: Path, seeds: list[bytes], driver: str, *flags: str) -> None:
    """Build a driver with sanitizers, and have libFuzzer make up inputs from the seeds."""
    done = cc(place, *SANITIZED, f"-I{HEADERS}", *flags, driver, "-o", "fuzz", "-lm",
              compiler="clang")  # fmt: skip
    assert done.returncode == 0, done.stderr
    corpus = place / "corpus"
    corpus.mkdir()
    for k, seed in enumerate(seeds):
        (corpus / str(k)).write_bytes(seed)
    command = ["./fuzz", f"-runs={RUNS}", "-seed=1", "-max_len=4096", "-timeout=60", "corpus"]
    done = subprocess.run(command, cwd=place, capture_output=True, check=False)
    said = done.stderr.decode(errors="replace")
    assert done.returncode == 0, said[-3000:]
    assert f"Done {RUNS} runs" in said


def message_seeds() -> list[bytes]:
    """Inputs of messages.h: a whole run, and one of each kind."""
    text = json.dumps(HELLO).replace('"', "\n").encode()
    hello = bytes([1, len(text)]) + text
    frames = [
        bytes([2 | 128, k, k]) + np.array([1.0, 0.5, 1.0, 0.0, 1.0]).tobytes() for k in range(4)
    ]
    end = bytes([2 | 64, 4, 4, 4])
    return [hello + b"".join(frames) + end + hello, hello, *frames, end, b"\0\x08" + bytes(16)]


def test_fuzzing_the_board_finds_nothing(tmp_path):
    exported(tmp_path, "float32", "unrolled", "vsg-2")
    for file in (*DRIVERS.glob("*.[ch]"), EXAMPLES / "board_c" / "main.c"):
        shutil.copy(file, tmp_path)
    shutil.copy(EXAMPLES / "board_c" / "board.h", tmp_path)  # the example's, not the driver's
    fuzz(tmp_path, message_seeds(), "board.c", "-ffp-contract=off", "gfm_vsg_2.c")


def test_fuzzing_the_example_of_a_controller_finds_nothing(tmp_path):
    example = EXAMPLES / "own_controller_c"
    for file in DRIVERS.glob("*.[ch]"):
        shutil.copy(file, tmp_path)
    seeds = [seed.replace(b"abcdef01", b"fb7ec5b6") for seed in message_seeds()]
    fuzz(
        tmp_path, seeds, "controller.c", f"-I{example}", "-D_GNU_SOURCE",
        f'-DCONTROLLER="{example / "controller.c"}"',
    )  # fmt: skip


@pytest.mark.parametrize(("real", "staged"), [("float32", False), ("float64", True)])
def test_fuzzing_the_program_of_a_processor_in_the_loop_finds_nothing(tmp_path, real, staged):
    of = {n: STAGED[n] for n in ("vsg-2 cascaded", "no stage")} if staged else {
        n: LAWS[n] for n in ("vsg-2", "hybrid-angle")
    }  # fmt: skip
    modules = make_modules(of, T_S, real)
    texts = {**sources(modules, T_S, "unrolled"), **selftest(modules, "unrolled")}
    size = 1 + max(len(m.identification(T_S)) for m in modules)
    texts |= {"states.h": _states(modules, size), "pil.c": HARNESS.joinpath("loop.c").read_text()}
    for name, text in texts.items():
        (tmp_path / name).write_text(text)
    for name in ("board.h", "loop.c"):
        shutil.copy(DRIVERS / name, tmp_path)
    word, number = ("I", "f") if real == "float32" else ("Q", "d")
    y = [1.0, 0.5, 1.0, 0.0, 1.0] + [0.1] * (6 if staged else 0)

    def request(what: int, law: int) -> bytes:
        return struct.pack(f"<3{word}{5 + len(y)}{number}", what, law, 0, 1, 0.5, 1, 0, 1, *y)

    ticks = request(0, 0) + request(2, 1) + request(0, 1) + request(1, 0)
    fuzz(tmp_path, [ticks, request(1, 1) + bytes(800) + ticks], "loop.c", "-ffp-contract=off",
         *(f"{m.prefix}.c" for m in modules))  # fmt: skip
