"""Other users of the machine: we neither use nor remove their files, locks and sockets.

The other user is a second uid, for which the tests must run as root.
"""

import fcntl
import os
import shutil
import stat
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from gfm_hil.core import temporary as scratch
from gfm_hil.core.errors import UserError
from gfm_hil.links.shm import segment
from gfm_hil.links.shm.link import ShmLink
from gfm_hil.links.zeromq.link import ZmqLink
from gfm_hil.recording import parts as recording

from ...support.shm import header

pytestmark = pytest.mark.processes

OTHER = 65534  # nobody
SECRET = b"readable by its owner alone"
PATIENCE_S = 60

as_root = pytest.mark.skipif(os.geteuid() != 0, reason="root is needed to act as a second user")
Act = Callable[..., "subprocess.Popen[bytes]"]


@pytest.fixture
def shared() -> Iterator[Path]:
    """A folder that all users may write to, as /dev/shm and /tmp are."""
    place = Path(tempfile.mkdtemp(prefix="shared-"))
    place.chmod(0o1777)
    yield place
    shutil.rmtree(place)


@pytest.fixture
def other(shared) -> Iterator[Act]:
    """Run a program as the other user in the shared folder until it is ready."""
    started = []

    def call(program: str, content: bytes = b"") -> subprocess.Popen[bytes]:
        # only root may be able to read the interpreter, so the program itself changes its user
        begin = f"""
import fcntl, os, socket, sys, time
os.setgroups([]), os.setgid({OTHER}), os.setuid({OTHER}), os.umask(0)
"""
        end = "\nprint('ready', flush=True); time.sleep(600)"
        process = subprocess.Popen(
            [sys.executable, "-I", "-c", begin + program + end],
            cwd=shared, stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        )  # fmt: skip
        started.append(process)
        assert process.stdin is not None
        assert process.stdout is not None
        process.stdin.write(content)
        process.stdin.close()
        assert process.stdout.readline() == b"ready\n"
        return process

    yield call
    for process in started:
        process.kill()
        process.wait()


def copies_of_the_secret(place: Path) -> list[Path]:
    return [p for p in place.rglob("*") if p.is_file() and p.read_bytes() == SECRET]


@as_root
@pytest.mark.attack(
    "2.1",
    "another user plants gfmhil-parts-x in /dev/shm, with links to a file of mode 0600",
    "a run of root copied the file into the other user's folder",
)
def test_planted_parts_are_not_rescued(shared, other, tmp_path, monkeypatch, attack_now):
    secret = tmp_path / "secret"
    secret.write_bytes(SECRET)
    secret.chmod(0o600)
    other(
        f"""
here = os.getcwd()
os.makedirs("gfmhil-parts-x"), os.makedirs("run")
os.symlink({str(secret)!r}, "gfmhil-parts-x/plant_signals.npy")
os.symlink(here + "/run/parts", "gfmhil-parts-x/home")
os.symlink(here + "/gfmhil-parts-x", "run/parts")
"""
    )
    monkeypatch.setattr(recording, "_MEMORY", shared)
    folder = tmp_path / "mine"
    folder.mkdir()
    recording.keep_in_memory(folder, 10)
    recording.remove_parts(folder)
    assert not [p for p in copies_of_the_secret(shared) if not p.is_symlink()]
    assert (shared / "run" / "parts").is_symlink()
    assert (shared / "gfmhil-parts-x" / "home").is_symlink()  # we must not remove it
    copied = [p for p in (shared / "run").rglob("*") if not p.is_symlink()]
    assert copied == []
    attack_now(f"ignored: {len(copied)} files copied, the folder stays as it was")


@pytest.mark.attack(
    "2.2",
    "a link and an unknown file among the parts of a killed run",
    "the link was followed and both were copied into the run's folder",
)
def test_only_recorded_files_are_rescued(tmp_path, monkeypatch, attack_now):
    secret, memory, folder = tmp_path / "secret", tmp_path / "memory", tmp_path / "run"
    secret.write_bytes(SECRET)
    memory.mkdir()
    folder.mkdir()
    monkeypatch.setattr(recording, "_MEMORY", memory)

    def left(name: str, *, link: bool) -> None:
        """Make the files of a killed run."""
        place, handle = scratch.make("gfmhil-parts-", memory)
        (place / "home").symlink_to(folder / "parts")
        (folder / "parts").symlink_to(place)
        (place / "plant_times.npy").write_bytes(b"times")
        (place / "plant_times.npy").chmod(0o644)
        if link:
            (place / name).symlink_to(secret)
        else:
            (place / name).write_bytes(SECRET)
        scratch.release(handle)

    another = tmp_path / "another"
    another.mkdir()
    left("plant_signals.npy", link=True)
    recording.keep_in_memory(another, 10)
    recording.remove_parts(another)
    assert (folder / "parts").is_symlink()  # it stays in memory, for inspection
    assert {path.name for path in folder.iterdir()} == {"parts"}
    shutil.rmtree((folder / "parts").readlink())
    (folder / "parts").unlink()
    left("unknown", link=False)
    recording.keep_in_memory(another, 10)
    recording.remove_parts(another)
    (copied,) = (folder / "parts").iterdir()
    modes = [stat.S_IMODE(p.stat().st_mode) for p in (folder / "parts", copied)]
    assert (copied.name, copied.read_bytes()) == ("plant_times.npy", b"times")
    assert modes == [0o700, 0o600]
    attack_now("only the recording's own files, modes 0700 and 0600")


LOCK = """
handle = os.open(".", os.O_RDONLY)
fcntl.flock(handle, fcntl.LOCK_EX)
"""
START = """
import sys
from pathlib import Path
from gfm_hil.core import temporary as scratch
from gfm_hil.recording import parts as recording
from gfm_hil.links.shm.link import ShmLink
recording._MEMORY = scratch.MEMORY = shared = Path(sys.argv[1])
with scratch.temporary("gfmhil-run-") as place:
    recording.keep_in_memory(place, 10)
    assert (place / "parts").is_symlink()
    recording.remove_parts(place)
    ends = [ShmLink(side, "shm://x") for side in ("controller", "plant")]
    assert ends[1].send(b"hello") and ends[0].receive() == b"hello"
    for end in ends:
        end.close()
"""


@as_root
@pytest.mark.attack(
    "2.3", "another user holds a lock on TMPDIR and /dev/shm", "every start hung, without a word"
)
def test_a_lock_on_a_shared_folder_hinders_nothing(shared, other, attack_now):
    other(LOCK)
    subprocess.run(
        [sys.executable, "-c", START, str(shared)],
        env={**os.environ, "TMPDIR": str(shared)}, check=True, timeout=PATIENCE_S,
    )  # fmt: skip
    assert [path.name for path in shared.iterdir()] == ["gfmhil-0"]
    attack_now("starts: only files of the own user are locked")


@pytest.mark.attack(
    "2.4", "a process of the own user keeps a segment locked", "every start hung, without a word"
)
def test_a_lock_that_is_kept_is_told(tmp_path, attack_now):
    place = tmp_path / "segment"
    place.touch(0o600)
    with place.open() as kept, place.open() as wanted:
        fcntl.flock(kept, fcntl.LOCK_EX)
        with pytest.raises(TimeoutError) as found:
            scratch.lock(wanted.fileno(), fcntl.LOCK_SH, patience_s=0.05)
    assert str(found.value) == "another process has kept it locked for 0.05 s"
    attack_now(f"refused in words after {scratch.PATIENCE_S:g} s")


@as_root
@pytest.mark.parametrize("role", ["controller", "plant"])
@pytest.mark.attack(
    "2.5",
    "another user makes the folder with the shared memory that root's plant waits for",
    "it was joined",
)
def test_memory_of_another_user_is_refused(role, shared, other, monkeypatch, attack_now):
    monkeypatch.setattr(scratch, "MEMORY", shared)
    other(
        "os.mkdir('gfmhil-0', 0o777)\nopen('gfmhil-0/link-x', 'wb').write(sys.stdin.buffer.read())",
        header(segment.VERSION, segment.myself()),
    )
    before = (shared / "gfmhil-0/link-x").stat()
    with pytest.raises(UserError, match=rf"gfmhil-0 is not a folder .* uid {OTHER}, mode 0777\)"):
        ShmLink(role, "shm://x")
    assert (shared / "gfmhil-0/link-x").stat() == before
    attack_now("either side refuses the folder, with owner and mode")


@as_root
@pytest.mark.attack(
    "2.6", "another user leaves files, links and pipes named gfmhil-link-x", "root removed them"
)
def test_what_is_not_ours_is_not_swept(shared, other, monkeypatch, tmp_path, attack_now):
    monkeypatch.setattr(scratch, "MEMORY", shared)
    precious = tmp_path / "precious"
    precious.touch()
    other(
        f"""
open("gfmhil-link-empty", "wb").close()
os.mkfifo("gfmhil-link-pipe")
os.symlink({str(precious)!r}, "gfmhil-link-link")
"""
    )
    ShmLink("controller", "shm://mine").close()
    assert {p.name.rpartition("-")[2] for p in shared.iterdir()} == {"empty", "pipe", "link", "0"}
    assert precious.exists()
    attack_now("all three stay; the own run starts")


@as_root
@pytest.mark.attack(
    "2.12", "another user puts a link in place of the folder with the shared memory", "not tried"
)
def test_a_link_in_place_of_the_folder_is_refused(shared, other, monkeypatch, tmp_path, attack_now):
    monkeypatch.setattr(scratch, "MEMORY", shared)
    precious = tmp_path / "link-old"
    precious.touch()
    other(f"os.symlink({str(tmp_path)!r}, 'gfmhil-0')")
    with pytest.raises(UserError, match="is not a folder of our user alone"):
        ShmLink("controller", "shm://mine")
    assert precious.exists()
    attack_now("refused; nothing behind the link is swept")


@pytest.mark.attack(
    "2.7", "the folder with the shared memory is open to others (mode 0755)", "it was used"
)
def test_memory_that_is_open_to_others_is_refused(tmp_path, monkeypatch, attack_now):
    monkeypatch.setattr(scratch, "MEMORY", tmp_path)
    controller = ShmLink("controller", "shm://x")
    folder = scratch.private_folder()
    modes = [stat.S_IMODE(path.stat().st_mode) for path in (folder, *folder.iterdir())]
    assert modes == [0o700, 0o600]
    folder.chmod(0o755)
    with pytest.raises(UserError, match=r"is not a folder of our user alone .* mode 0755"):
        ShmLink("plant", "shm://x")
    folder.chmod(0o700)
    controller.close()
    attack_now("refused, with the mode")


LISTEN = """
listener = socket.socket(socket.AF_UNIX)
listener.bind("link")
listener.listen()
"""
WAIT = """
listener.settimeout(1)  # libzmq tries again every 0.1 s
try:
    listener.accept(), sys.exit("it connected")
except TimeoutError:
    pass
"""


@as_root
@pytest.mark.parametrize("role", ["controller", "plant"])
@pytest.mark.attack(
    "2.8",
    "another user listens at the ipc endpoint",
    "root's plant connected; root's controller removed the socket where no process listened",
)
def test_a_socket_of_another_user_is_refused(role, shared, other, attack_now):
    other(LISTEN)
    with pytest.raises(UserError, match=rf"link belongs to another user \(uid {OTHER}\)") as found:
        ZmqLink(role, f"ipc://{shared}/link").close()
    attack_now(str(found.value).rpartition("/")[2])


@as_root
def test_a_plant_that_came_first_refuses_it_too(shared, other):
    plant = ZmqLink("plant", f"ipc://{shared}/link")
    try:
        assert not plant.wait(0.001)
        other(LISTEN)
        with pytest.raises(UserError, match="belongs to another user"):
            plant.wait(PATIENCE_S)
    finally:
        plant.close()


@as_root
def test_a_plant_does_not_connect_again_to_another_users_socket(shared, other):
    """libzmq would, as soon as the controller has gone."""
    endpoint = f"ipc://{shared}/link"
    controller = ZmqLink("controller", endpoint)
    plant = ZmqLink("plant", endpoint)
    plant.send(b"hello")
    assert controller.wait(30)
    controller.close()
    (shared / "link").unlink()
    other(LISTEN + WAIT)
    with pytest.raises(UserError, match="belongs to another user"):
        plant.again()
    plant.close()


@as_root
@pytest.mark.attack(
    "2.9",
    "the folder of the ipc endpoint belongs to another user, or all may replace its files",
    "it was used",
)
def test_a_folder_in_which_others_can_replace_the_socket_is_refused(shared, other, attack_now):
    other("os.mkdir('theirs', 0o755); os.mkdir('open', 0o777)")
    os.chown(shared / "open", 0, 0)
    for name in ("theirs", "open"):
        with pytest.raises(UserError, match=f"other users can replace what is in .*/{name} "):
            ZmqLink("controller", f"ipc://{shared}/{name}/link")
    attack_now("both refused, with owner and mode")


CONNECT = """
peer = socket.socket(socket.AF_UNIX)
try:
    peer.connect("link")
    peer.settimeout(30)
    said = peer.recv(64)
except OSError as problem:
    said = b""
sys.exit("it got in") if said else None
"""


@as_root
@pytest.mark.parametrize("mode", [0o600, 0o777])
@pytest.mark.attack(
    "2.10",
    "another user connects to the controller's ipc socket, even one whose mode was opened to all",
    "it took the plant's place where the umask or the mode let it",
)
def test_another_user_does_not_get_in(mode, shared, other, attack_now):
    """ZeroMQ sends a greeting to a peer that it has accepted."""
    controller = ZmqLink("controller", f"ipc://{shared}/link")
    try:
        path = shared / "link"
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
        path.chmod(mode)
        other(CONNECT)
        if mode == 0o600:
            plant = ZmqLink("plant", f"ipc://{shared}/link")
            assert plant.send(b"mine")
            assert controller.wait(30)
            assert controller.receive() == b"mine"
            plant.close()
        else:
            with pytest.raises(UserError, match=r"other users may connect to .* \(mode 0777\)"):
                ZmqLink("plant", f"ipc://{shared}/link")
    finally:
        controller.close()
    attack_now("turned away by its uid (SO_PEERCRED) before a word; the socket has mode 0600")


@pytest.mark.attack(
    "2.11",
    "the run's folder holds a link named parts to a private folder of the own user",
    "the recording went there, and the folder was removed in the end",
)
def test_a_planted_link_to_parts_is_refused(tmp_path, monkeypatch, attack_now):
    memory, precious, folder = (tmp_path / name for name in ("memory", "precious", "run"))
    for path in (memory, precious, folder):
        path.mkdir(0o700)
    monkeypatch.setattr(recording, "_MEMORY", memory)
    (folder / "parts").symlink_to(precious)
    with pytest.raises(UserError, match="not to a recording in memory of our user"):
        recording.keep_in_memory(folder, 10)
    assert precious.is_dir()
    (folder / "parts").unlink()
    (folder / "parts").symlink_to(memory / "gfmhil-parts-gone")
    with pytest.raises(UserError, match="No such file"):
        recording.keep_in_memory(folder, 10)
    attack_now("refused, with the place it leads to")
