"""The parsers of files: scenarios, laws, campaigns, run folders and shared memory."""

import contextlib
import io
import os
import shutil
import time
import tomllib
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import strategies as st

from gfm_design.norms.performance import read_weights
from gfm_hil.api.mpc import MpcCase
from gfm_hil.api.raw import RawCase
from gfm_hil.cli import main
from gfm_hil.core import temporary as scratch
from gfm_hil.core.errors import UserError
from gfm_hil.engine.setup import make_bench, make_benches
from gfm_hil.links.shm import segment
from gfm_hil.links.shm.link import ShmLink
from gfm_hil.ports.scope.recording import open_recording
from gfm_hil.ports.streams.port import Follower
from gfm_hil.recording.parts import RolePart
from gfm_hil.run.runner import run_scenario
from gfm_hil.scenario import (
    SCENARIO_FOLDERS,
    Scenario,
    check_scenario,
    load_scenario,
    scenario_toml,
)
from gfm_hil.scenario.events.grid_profile import read_profile
from gfm_hil.studies.campaign import loading
from gfm_hil.studies.conformity.diff import Results, compare_results, read_results
from gfm_hil.studies.conformity.sets import load_cases, load_under_test
from gfm_plant import NoEquilibrium, load_converter
from gfm_runtime import LawError, discretise, get_law, law_file, load_law, pack_law
from gfm_runtime.firmware import STYLES, elf_a2l, golden, make_modules
from gfm_runtime.firmware.module import tunable
from gfm_runtime.firmware.report import read_report, reports

from ..support.files import text_of
from ..support.laws import EVERYTHING
from .conftest import CORPUS, Parser, Take
from .mutations import blobs, tables, texts

CATALOGUE = Path(load_law.__code__.co_filename).parent / "laws"
CONVERTERS = Path(load_converter.__code__.co_filename).parent / "converters"
RESULTS = text_of("results.json")
CAMPAIGN = text_of("campaign_of_every_draw.toml")
PROFILE = text_of("profile.csv")
EVENTS = text_of("every_event.toml")


LINK = """
title = "x"
duration = 0.05
[link]
type = "%s"
endpoint = "%s"
peer_timeout_s = 1.0
options = { %s }
impairment = { pause_at = 3, kill_at = 3, seed = 3 }
"""
LINKS = (
    LINK % ("zmq", "tcp://127.0.0.1:5555", 'curve = "keys"'),
    LINK % ("zmq", "tcp://192.0.2.1:5555", "plain = true"),
    LINK % ("can", "can+udp://127.0.0.1:4000", "fd = true, every = 1, bitrate = 1000000"),
    LINK % ("shm", "shm://x", ""),
)
WEIGHTS = """
W_11 = { num = [1.0, 4.0], den = [1.0, 4e-4] }
W_22 = { num = [1.0], den = [1.0, 0.1] }
"""


def _shipped(*folders: Path) -> list[str]:
    return [path.read_text("utf-8") for f in folders for path in sorted(f.glob("*.toml"))]


def toml(*seeds: str) -> st.SearchStrategy[bytes]:
    """Changed word by word as text, or value by value as tables."""
    return texts(seeds) | tables([tomllib.loads(seed) for seed in seeds])


def _scenarios() -> st.SearchStrategy[bytes]:
    """Shipped ones, every event, and every key that there is."""
    return toml(*_shipped(*SCENARIO_FOLDERS), EVENTS, scenario_toml(load_scenario("switchover")))


def reading(
    name: str,
    load: Callable[[Path], Any],
    refusal: type[Exception] | tuple[type[Exception], ...],
    check: Callable[[Any], None] = lambda found: None,
) -> Callable[[Path], AbstractContextManager[Take]]:
    """Opens the parser of one file: an input is its content, which ``load`` reads or refuses;
    ``check`` gets what was read."""

    @contextlib.contextmanager
    def open_parser(place: Path) -> Iterator[Take]:
        def take(content: bytes) -> None:
            (place / name).write_bytes(content)
            try:
                found = load(place / name)
            except refusal as problem:
                short(str(problem))
            else:
                check(found)

        yield take

    return open_parser


def _scenario(file: Path) -> tuple[Path, Scenario]:
    return file.with_name("again.toml"), load_scenario(str(file))


def _written_again(found: tuple[Path, Scenario]) -> None:
    """Read what is written of it, and do what a run in process does before it writes anything."""
    again, scenario = found
    again.write_text(scenario_toml(scenario), "utf-8")
    read = load_scenario(str(again))
    assert read == scenario and read.digest() == scenario.digest()
    try:
        make_benches(load_scenario(str(again), mode="lockstep", link__type="inproc"))
    except (UserError, NoEquilibrium) as problem:
        short(str(problem))


def _converter(file: Path) -> None:
    scenario = file.with_name("scenario.toml")
    plant = f'[plant]\nconverter = "{file}"\n'
    scenario.write_text(f'title = "x"\nduration = 0.05\nlink.type = "inproc"\n{plant}')
    make_bench(load_scenario(str(scenario)))


def _law(file: Path) -> None:
    for law in load_law(str(file)).laws:
        assert all(element.is_proper for element in law.phi.values())
        found = discretise(law, 1e-4)
        assert all(np.isfinite(matrix).all() for matrix in (found.A, found.C))
        assert pack_law(found)["n"][0] <= 12


def _firmware(file: Path) -> None:
    golden(read_report(file.parent).modules, 3)


def _reports() -> list[str]:
    laws = (get_law("psc-1"), load_law("psc-1", "cascaded").laws[0])
    out = []
    for law in laws:
        modules = make_modules({"psc-1": law}, 1e-4, "float32")
        for style in STYLES:
            of = [tunable(m, law_file("psc-1"), 1e-4) for m in modules]
            chosen = of if style == "tunable" else modules
            out.append(reports(chosen, 1e-4, style)["report.json"])
    return out


@contextlib.contextmanager
def _campaign(place: Path) -> Iterator[Take]:
    file, tried = place / "campaign.toml", loading._TRIED

    def take(text: bytes) -> None:
        file.write_bytes(text)
        try:
            loading.load_campaign(str(file))
        except UserError as problem:
            short(str(problem))

    loading._TRIED = 20  # instead of a million runs, to save time
    try:
        yield take
    finally:
        loading._TRIED = tried


@contextlib.contextmanager
def _conformity(place: Path) -> Iterator[Take]:
    """An input is the file of a test, or of a converter under test."""
    file = place / "test.toml"

    def take(text: bytes) -> None:
        file.write_bytes(text)
        for load in (lambda: load_cases([str(file)]), lambda: load_under_test(file)):
            try:
                load()
            except UserError as problem:
                short(str(problem))

    yield take


def _conformity_files() -> st.SearchStrategy[bytes]:
    folders = [folder / "conformity" for folder in SCENARIO_FOLDERS]
    return texts(_shipped(*folders, *(folder / "miso" for folder in folders)))


def _compared(found: Results) -> None:
    """Compare it with a good one, either way."""
    good = Results.model_validate_json(RESULTS)
    for pair in ((found, good), (good, found)):
        compare_results(*pair).page("old", "new")


def short(text: str) -> None:
    """Check that an error message is readable."""
    assert len(text) < 20_000, f"{len(text)} characters"
    for line in text.removesuffix("\n").split("\n"):
        assert line.isprintable(), f"{line!r:.3000}"


@contextlib.contextmanager
def _run_folder(place: Path) -> Iterator[Take]:
    """An input is the name of a file in the run folder, a line end, and the file's new content."""
    finished, going = _runs(place)

    def take(message: bytes) -> None:
        name, _, content = message.partition(b"\n")
        for folder in (finished, going):
            path = folder / name.decode("ascii", "replace")
            if path.name not in {p.name for p in folder.rglob("*")}:
                continue
            before = path.read_bytes()
            try:
                path.write_bytes(content.replace(b"@held@", os.fsencode(place / "held")))
                (_look_back if folder is finished else _look_on)(folder)
            finally:
                path.write_bytes(before)

    hold = scratch.hold(place / "held")
    try:
        yield take
    finally:
        scratch.release(hold)


def _runs(place: Path) -> tuple[Path, Path]:
    """The folders of a finished run and of one that seems to be in progress."""
    scenario = check_scenario(
        {
            "title": "over", "duration": 0.002, "law": "vsg-2", "link": {"type": "inproc"},
            "events": [{"t": 0.001, "type": "reference", "P_ref": 0.6}],
        },
        "",
    )  # fmt: skip
    finished, going, held = place / "finished", place / "going", place / "held"
    run_scenario(scenario, finished)
    held.mkdir(0o700)
    going.mkdir()
    (going / "scenario.toml").write_text(scenario_toml(scenario), "utf-8")
    for role in ("plant", "controller"):
        part = RolePart.create(going, role, scenario.ticks)
        part.signals[:], part.progress[:] = 1.0, (10, 0, 0)
        (going / f"commands_{role}.json").write_text(
            f'{{"endpoint": "ipc://{held}/{role}", "T_s": 0.0001, "names": ["vsg-2"], "laws":'
            ' [{"label": "vsg-2", "name": "vsg-2", "gains": {"D_p": 0.01}},'
            ' {"label": "b", "name": "b", "gains": {}}]}'
        )
        (going / f"events_{role}.jsonl").write_text('{"tick": 1, "t": 0.1, "event": "a"}\n')
    return finished, going


def _look_back(folder: Path) -> None:
    """Run everything that reads a finished run."""
    command("export", str(folder), "--format", "csv", "-o", str(folder.parent / "out.csv"))
    with contextlib.suppress(UserError):
        record = open_recording(folder)
        assert record.done() >= 0 and record.f_b > 0
        record.events()
        record.ended()


def _look_on(folder: Path) -> None:
    """Run everything that reads a run in progress."""
    command("command", str(folder))
    with contextlib.suppress(UserError):
        record = open_recording(folder)
        assert record.done() >= 0 and record.f_b > 0
        record.events()
        record.look_up_laws()
    with contextlib.suppress(UserError):
        follower = Follower(folder)
        for rows in follower.news():
            assert len(rows.signals) == len(rows.times)


def command(*arguments: str) -> None:
    """Check that a command ends with an exit code and, if that is 2, with a message."""
    out, said = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(said):
        code = main(arguments)
    assert code in (0, 2)
    assert bool(said.getvalue()) == (code == 2)
    short(said.getvalue())
    assert "\x1b" not in out.getvalue() + said.getvalue()


def _run_files() -> st.SearchStrategy[bytes]:
    place = Path(os.environ.get("TMPDIR", "/tmp")) / f"gfmhil-fuzz-seeds-{os.getpid()}"
    place.mkdir()
    try:
        kinds = []
        for folder in _runs(place):
            for path in sorted(p for p in folder.rglob("*") if p.is_file()):
                name = str(path.relative_to(folder)).encode() + b"\n"
                content = path.read_bytes().replace(os.fsencode(place / "held"), b"@held@")
                written = path.suffix in (".npz", ".npy")
                made = blobs([content]) if written else texts([content.decode()])
                kinds.append(made.map(lambda new, name=name: name + new))
    finally:
        shutil.rmtree(place)
    return st.one_of(kinds)


@contextlib.contextmanager
def _segment(place: Path) -> Iterator[Take]:
    """An input is the content of a link's memory; ``@owner@`` stands for a living owner."""
    name = f"fuzz-{os.getpid()}"
    path = scratch.private_folder() / f"{segment.PREFIX}{name}"

    def take(content: bytes) -> None:
        for role in ("plant", "controller"):
            path.write_bytes(content.replace(_OWNER, segment._PLANT.pack(*segment.myself())))
            path.chmod(0o600)
            with contextlib.suppress(UserError):
                link = ShmLink(role, f"shm://{name}")
                try:
                    link.wait(0.0)
                    for _ in range(3):
                        found = link.receive()
                        assert found is None or len(found) < 1000
                    link.send(b"x" * 48)
                finally:
                    link.close()

    try:
        yield take
    finally:
        path.unlink(missing_ok=True)


_OWNER = b"@owner@ @owner@ @owner@!"  # as long as an identity


def _segments() -> st.SearchStrategy[bytes]:
    name = f"fuzz-seed-{time.monotonic_ns()}"
    controller = ShmLink("controller", f"shm://{name}")
    try:
        controller.send(b"GFMHIL {}")
        whole = (scratch.private_folder() / f"{segment.PREFIX}{name}").read_bytes()
    finally:
        controller.close()
    whole = whole.replace(segment._PLANT.pack(*segment.myself()), _OWNER)
    head = st.builds(lambda new: new + whole[512:], blobs([whole[:512]]))
    return head | blobs([whole[:512], whole])


def _profile(file: Path) -> None:
    ticks = [k for k, _ in read_profile(str(file), 50.0).points(1e-4)]
    assert ticks == sorted(ticks)


def _elf(file: Path) -> None:
    text, measured, calibrated = elf_a2l(file)
    assert text.count("/begin MEASUREMENT") == measured
    assert text.count("/begin CHARACTERISTIC") == calibrated


_ELF = (CORPUS / "elf" / "vsg_2_records").read_bytes()
FILES = (
    Parser("profile", reading("a.csv", _profile, UserError), lambda: texts([PROFILE])),
    Parser("scenario", reading("scenario.toml", _scenario, UserError, _written_again), _scenarios),
    Parser("link", reading("scenario.toml", _scenario, UserError), lambda: toml(*LINKS)),
    Parser(
        "converter",
        reading("converter.toml", _converter, (UserError, NoEquilibrium)),
        lambda: toml(*_shipped(CONVERTERS)),
    ),
    Parser(
        "law", reading("law.toml", _law, LawError), lambda: toml(*_shipped(CATALOGUE), EVERYTHING)
    ),
    Parser("weights", reading("weights.toml", read_weights, ValueError), lambda: toml(WEIGHTS)),
    Parser("firmware", reading("report.json", _firmware, LawError), lambda: texts(_reports())),
    Parser("elf", reading("program.elf", _elf, LawError), lambda: blobs([_ELF])),
    Parser("campaign", _campaign, lambda: toml(CAMPAIGN)),
    Parser("conformity", _conformity, _conformity_files),
    Parser(
        "conformity_results",
        reading("results.json", read_results, UserError, _compared),
        lambda: texts([RESULTS]),
    ),
    Parser("run_folder", _run_folder, _run_files),
    Parser("mpc", reading("case.m", MpcCase, UserError), lambda: texts([text_of("case9.m")])),
    Parser("raw", reading("case.raw", RawCase, UserError), lambda: texts([text_of("kundur.raw")])),
    Parser("segment", _segment, _segments),
)
