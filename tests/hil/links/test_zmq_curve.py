"""ZeroMQ beyond one machine: encrypted, with the one known plant, or refused."""

import socket
import stat
import threading
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from gfm_hil.cli import main
from gfm_hil.core.errors import PeerLost, UserError
from gfm_hil.core.roles import ROLES, Role
from gfm_hil.engine.handshake import shake_hands
from gfm_hil.links import open_link
from gfm_hil.links.zeromq.curve import key_files, write_keys
from gfm_hil.links.zeromq.link import ZmqLink
from gfm_hil.links.zeromq.options import ZmqOptions, beyond_loopback

from ...support.links import PATIENT, assert_same, deliver, in_threads, run_pair
from ...support.processes import free_port

pytestmark = pytest.mark.processes


@pytest.fixture
def tcp() -> str:
    """A loopback endpoint that was free a moment ago."""
    return f"tcp://127.0.0.1:{free_port()}"


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("keys")
    write_keys(folder)
    return folder


@pytest.fixture(scope="module")
def others(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Keys of a stranger who knows our controller's public key, which is public."""
    folder = tmp_path_factory.mktemp("others")
    write_keys(folder)
    return folder


def mixed(folder: Path, mine: Path, theirs: Path) -> Path:
    """The plant's keys of one folder, the controller's public key of another."""
    for name, source in (
        ("plant.key_secret", mine),
        ("plant.key", mine),
        ("controller.key", theirs),
    ):
        (folder / name).write_bytes((source / name).read_bytes())
    return folder


def curve(folder: Path) -> ZmqOptions:
    return ZmqOptions(curve=str(folder))


@pytest.fixture
def controller(tcp: str, keys: Path) -> Iterator[ZmqLink]:
    link = ZmqLink("controller", tcp, curve(keys))
    yield link
    link.close()


def arrives(plant: ZmqLink, controller: ZmqLink, seconds: float = 30.0) -> bool:
    plant.send(b"frame")
    return controller.wait(seconds) and controller.receive() == b"frame"


def test_an_encrypted_run_is_bit_for_bit_in_process(make, run, tmp_path, tcp, keys):
    content = {"law": "vsg-2", "duration": 0.03, "link": PATIENT}
    apart = run_pair(make(**content), tmp_path, "zmq", {"curve": str(keys)}, endpoint=tcp).signals
    assert_same(apart, run(**content).signals)


def test_frames_are_not_readable_on_the_wire(tcp, keys):
    """Through a relay that eavesdrops."""
    heard = bytearray()
    with socket.create_server(("127.0.0.1", 0)) as server:
        host, port = server.getsockname()

        def relay() -> None:
            near, _ = server.accept()
            far = socket.create_connection(("127.0.0.1", int(tcp.rpartition(":")[2])))

            def carry(source: socket.socket, sink: socket.socket) -> None:
                with suppress(OSError), sink:  # an end that is closed may reset the connection
                    while content := source.recv(4096):
                        heard.extend(content)
                        sink.sendall(content)

            back = threading.Thread(target=carry, args=(far, near), daemon=True)
            back.start()
            carry(near, far)

        threading.Thread(target=relay, daemon=True).start()
        ends = [
            ZmqLink("controller", tcp, curve(keys)),
            ZmqLink("plant", f"tcp://{host}:{port}", curve(keys)),
        ]
        secret = b"nobody else is to know"
        try:
            deliver(ends[1], secret)
            assert ends[0].wait(30)
            assert ends[0].receive() == secret
        finally:
            for end in ends[::-1]:
                end.close()
    assert b"CURVE" in heard
    assert secret not in heard


def test_only_the_plant_whose_key_is_known_gets_in(controller, tcp, keys, others, tmp_path, opened):
    intruder = opened(ZmqLink("plant", tcp, curve(mixed(tmp_path, others, keys))))
    plain = opened(ZmqLink("plant", tcp))
    intruder.send(b"forged")
    plain.send(b"forged")
    assert not controller.wait(1.0)
    plant = opened(ZmqLink("plant", tcp, curve(keys)))  # and the strangers do not take its place
    assert arrives(plant, controller)


def test_nobody_gets_in_while_there_is_nobody_to_ask(
    controller, tcp, keys, others, tmp_path, opened
):
    """By default libzmq accepts every peer that knows the controller's public key."""
    controller._curve.close()
    intruder = opened(ZmqLink("plant", tcp, curve(mixed(tmp_path, others, keys))))
    assert not arrives(intruder, controller, seconds=1.0)


def test_an_abstract_socket_is_refused():
    for role in ROLES:
        with pytest.raises(UserError, match=r"'ipc://@rig': an abstract socket is no file"):
            open_link("zmq", role, "ipc://@rig")


def test_a_plant_talks_to_no_other_controller(tcp, keys, others, tmp_path, opened):
    false = opened(ZmqLink("controller", tcp, curve(others)))
    plant = opened(ZmqLink("plant", tcp, curve(mixed(tmp_path, keys, keys))))
    assert not arrives(plant, false, seconds=1.0)


@pytest.mark.parametrize("knows", ["no key", "a wrong key"])
def test_both_wait_in_vain_and_say_so(knows, make, tcp, keys, others, tmp_path):
    options: dict[Role, ZmqOptions] = {"controller": curve(keys), "plant": ZmqOptions()}
    if knows == "a wrong key":
        options["plant"] = curve(mixed(tmp_path, others, keys))
    scenario = make(link={**PATIENT, "start_timeout_s": 1.5, "endpoint": tcp})

    def call(role: Role) -> None:
        link = ZmqLink(role, tcp, options[role])
        try:
            shake_hands(role, link, scenario, lambda: False, lambda text: None)
        finally:
            link.close()

    found = in_threads(call)
    for role, other in zip(ROLES, ROLES[::-1], strict=True):
        assert isinstance(found[role], PeerLost)
        assert f"the {other} did not come within 1.5 s" in str(found[role])


@pytest.mark.parametrize(
    ("endpoint", "beyond"),
    [
        ("ipc:///tmp/link", False),
        ("tcp://127.0.0.1:5555", False),
        ("tcp://127.8.8.8:5555", False),
        ("tcp://[::1]:5555", False),
        ("tcp://localhost:5555", False),
        ("tcp://lo:5555", False),
        ("tcp://0.0.0.0:5555", True),
        ("tcp://*:5555", True),
        ("tcp://[::]:5555", True),
        ("tcp://192.0.2.7:5555", True),
        ("tcp://no-such-host.invalid:5555", True),
        ("tcp://127.0.0.1:0;192.0.2.7:5555", True),
        ("tcp://127.0.0.1.nip.invalid:5555", True),
    ],
)
def test_what_counts_as_beyond_this_machine(endpoint, beyond):
    assert beyond_loopback(endpoint) is beyond


@pytest.mark.parametrize("role", ROLES)
def test_unencrypted_beyond_this_machine_is_refused_unless_meant(role):
    with pytest.raises(UserError) as found:
        open_link("zmq", role, "tcp://0.0.0.0:5555")
    text = str(found.value)
    assert text.startswith("link: endpoint = 'tcp://0.0.0.0:5555': goes beyond this machine")
    assert "link.options.curve" in text
    assert "link.options.plain = true" in text
    with socket.socket() as probe:
        probe.bind(("0.0.0.0", 0))
        port = probe.getsockname()[1]
    open_link("zmq", role, f"tcp://0.0.0.0:{port}", {"plain": True}).close()


def test_the_command_refuses_it_and_takes_options(capsys, tmp_path):
    def refusal(*options: str) -> str:
        begin = ["controller", "pref_step", "--mode", "lockstep"]
        place = [
            "--endpoint",
            "tcp://0.0.0.0:5555",
            "--out",
            str(tmp_path / str(len(list(tmp_path.iterdir())))),
        ]
        assert main([*begin, *place, *options]) == 2
        return str(capsys.readouterr().err)

    assert "tcp://0.0.0.0:5555': goes beyond this machine" in refusal()
    assert not list(tmp_path.iterdir())  # before anything starts
    assert "controller.key_secret: " in refusal("--option", f"curve={tmp_path}")
    both = refusal("--option", "curve=x", "--option", "plain=true")
    assert "plain = true and curve = 'x': only one of both" in both
    assert "options.colour = 'red': unknown key" in refusal("--option", "colour=red")
    with pytest.raises(SystemExit) as ended:
        refusal("--option", "curve")
    assert ended.value.code == 2
    assert "'curve': must be KEY=VALUE" in capsys.readouterr().err


def test_a_missing_or_damaged_key_is_named(tcp, tmp_path):
    write_keys(tmp_path)
    for name, content in (
        ("controller.key_secret", (tmp_path / "plant.key").read_text()),  # has no secret
        ("plant.key", 'curve\n    public-key = "too short"\n'),
        ("plant.key", ""),
        ("plant.key", 'curve\n    public-key = "' + "~" * 40 + '"\n'),
        ("plant.key", 'curve\n    public-key = "' + "#" * 40 + '"\n'),
        ("plant.key", None),
    ):
        kept = (tmp_path / name).read_text()
        (tmp_path / name).unlink()
        if content is not None:
            (tmp_path / name).write_text(content)
        with pytest.raises(UserError) as found:
            ZmqLink("controller", tcp, curve(tmp_path))
        assert str(found.value).startswith(f"link.options.curve = {str(tmp_path)!r}: {name}: ")
        assert "gfmhil keys" in str(found.value)
        (tmp_path / name).write_text(kept)
    ZmqLink("controller", tcp, curve(tmp_path)).close()


def test_keys_are_for_their_owner_alone_and_never_lost_by_accident(tmp_path, capsys):
    folder = tmp_path / "lab" / "keys"
    assert main(["keys", "--out", str(folder)]) == 0
    out = capsys.readouterr().out
    files = key_files(folder)
    assert sorted(folder.iterdir()) == sorted(files)
    assert all(str(file) in out for file in files)
    assert {stat.S_IMODE(file.stat().st_mode) for file in files} == {0o600}
    before = {file: file.read_bytes() for file in files}

    files[0].unlink()
    assert main(["keys", "--out", str(folder)]) == 2
    assert "is there already; --force" in capsys.readouterr().err
    assert not files[0].exists()
    assert all(file.read_bytes() == before[file] for file in files[1:])

    files[1].chmod(0o644)
    assert main(["keys", "--out", str(folder), "--force"]) == 0
    assert {stat.S_IMODE(file.stat().st_mode) for file in files} == {0o600}
    assert not {file.read_bytes() for file in files} & set(before.values())


def test_keys_that_cannot_be_written(tmp_path, capsys):
    (tmp_path / "file").write_text("")
    assert main(["keys", "--out", str(tmp_path / "file")]) == 2
    assert capsys.readouterr().err.count("\n") == 1
