"""The files in deploy/: units, container files, CAN and the tuning script pass their tools."""

import os
import re
import shutil
import socket
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import pytest

from gfm_hil.cli.common import EXIT_INTERRUPTED, EXIT_OTHERWISE
from gfm_hil.cli.main import parser
from gfm_hil.links.can import CanOptions
from gfm_hil.realtime.priority import PRIORITY
from gfm_hil.scenario import toml_text
from gfm_hil.scenario.schema import PEER_TIMEOUT_S

pytestmark = pytest.mark.processes

DEPLOY = Path(__file__).resolve().parents[1] / "deploy"
ROOT = DEPLOY.parent
COMPOSE, CONTAINERFILE = (DEPLOY / "container" / n for n in ("compose.yaml", "Containerfile"))
TUNE = DEPLOY / "tune-realtime"
ROLES = ("controller", "plant")
OBSERVERS = ("modbus", "scope", "stream")
SERVICES = (*ROLES, "bench", *OBSERVERS)
SYSTEM_UNITS = Path("/usr/lib/systemd/system")

needs_systemd = pytest.mark.skipif(
    shutil.which("systemd-analyze") is None or not SYSTEM_UNITS.is_dir(), reason="needs systemd"
)


def tool(name: str) -> str:
    """A program from a package of the extra `test`."""
    path = shutil.which(name, path=f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")
    if path is None:
        pytest.skip(f"needs {name}")
    return path


def call(*command: str | Path, **more: Any) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, text=True, capture_output=True, check=False, **more)


def unit(role: str) -> Path:
    return DEPLOY / "systemd" / f"gfmhil-{role}@.service"


def settings(path: Path, section: str = "Service") -> dict[str, list[str]]:
    """The settings of a unit's section, each with all its values."""
    found: dict[str, list[str]] = {}
    inside = ""
    for line in path.read_text().splitlines():
        if line.startswith("["):
            inside = line.strip("[]")
        elif inside == section and "=" in line and not line.startswith("#"):
            key, _, value = line.partition("=")
            found.setdefault(key, []).append(value)
    return found


def installed(root: Path) -> Path:
    """Install the units below ``root``, in their places on a machine."""
    units = root / "etc/systemd/system"
    shutil.copytree(SYSTEM_UNITS, root / "usr/lib/systemd/system", symlinks=True)
    shutil.copytree(DEPLOY / "systemd", units)
    shutil.copytree(DEPLOY / "can", units, dirs_exist_ok=True)
    for program in ("opt/gfmhil/bin/gfmhil", "usr/sbin/ip", "usr/bin/ln"):
        (root / program).parent.mkdir(parents=True, exist_ok=True)
        (root / program).write_text("#!/bin/sh\n")
        (root / program).chmod(0o755)
    return units


def verify(root: Path, name: str) -> str:
    """systemd's complaints; its exit code is 0 even for an unknown key."""
    done = call("systemd-analyze", "verify", "--man=no", f"--root={root}", name)
    return done.stdout + done.stderr


@pytest.mark.apt
@needs_systemd
def test_systemd_finds_no_fault_and_would_find_one(tmp_path):
    units = installed(tmp_path)
    services = [f"gfmhil-{name}@rig" for name in SERVICES]
    for name in (*services, "gfmhil-can@can0", "gfmhil-vcan@v"):
        assert verify(tmp_path, f"{name}.service") == ""
    drop_in = units / "gfmhil-plant@.service.d" / "10-processors.conf"
    drop_in.write_text(drop_in.read_text().replace("CPUAffinity", "CpuAffinity"))
    assert "CpuAffinity" in verify(tmp_path, "gfmhil-plant@rig.service")


@pytest.mark.apt
@needs_systemd
@pytest.mark.parametrize("name", SERVICES)
def test_services_expose_little(name):
    done = call(
        "systemd-analyze", "security", "--offline=true", "--threshold=25", "--no-pager", unit(name)
    )
    assert done.returncode == 0, done.stdout


def test_both_services_differ_only_in_their_role():
    found = [settings(unit(role)) for role in ROLES]
    for role, service in zip(ROLES, found, strict=True):
        start = f"/opt/gfmhil/bin/gfmhil {role} /etc/gfmhil/%i.toml"
        assert service.pop("ExecStart") == [start]
    assert found[0] == found[1]


@pytest.mark.parametrize("name", [*ROLES, "bench"])
def test_services_fit_the_program(name):
    found = {key: " ".join(values) for key, values in settings(unit(name)).items()}
    assert found["LimitRTPRIO"] == str(PRIORITY)
    assert found["RestartPreventExitStatus"] == f"2 {EXIT_OTHERWISE}"
    assert found["SuccessExitStatus"] == str(EXIT_INTERRUPTED)
    assert float(found["WatchdogSec"].removesuffix("s")) >= 2 * PEER_TIMEOUT_S["realtime"]
    # machine code is made at run time, memory is shared, and only the loop's thread has priority
    forbidden = {"MemoryDenyWriteExecute", "PrivateIPC", "DynamicUser", "PrivateNetwork"}
    forbidden |= {"RestrictRealtime", "CPUSchedulingPolicy"}
    assert not forbidden & set(found)


def words(service: dict[str, list[str]]) -> list[str]:
    """Arguments of gfmhil in a unit's ExecStart."""
    (start,) = service["ExecStart"]
    assert start.startswith("/opt/gfmhil/bin/gfmhil ")
    return start.split()[1:]


def test_the_operators_services_look_where_the_bench_records():
    bench = settings(unit("bench"))
    (link,) = bench["ExecStartPre"]
    folder, place = link.split()[-2:]
    assert words(bench)[-1] == folder.removeprefix("%S/gfmhil/")
    assert bench["WorkingDirectory"] == ["%S/gfmhil"]
    for name in OBSERVERS:
        service, relations = settings(unit(name)), settings(unit(name), "Unit")
        assert words(service)[:2] == [name, place]
        bound = relations.get("BindsTo", []) + relations.get("PartOf", [])
        assert bound == relations["After"] == ["gfmhil-bench@%i.service"]
        assert settings(unit(name), "Install")["WantedBy"] == bound
        assert parser(name).parse_args(words(service)).call  # every option exists
        same = ("User", "RuntimeDirectory", "RuntimeDirectoryPreserve", "StateDirectory")
        assert [service[key] for key in same] == [bench[key] for key in same]
        forbidden = {"MemoryDenyWriteExecute", "PrivateIPC", "DynamicUser", "PrivateNetwork"}
        assert not forbidden & set(service)
    assert parser("run").parse_args(words(bench)).call


def test_can_comes_up_at_the_bit_rates_of_the_link():
    start = " ".join(settings(DEPLOY / "can" / "gfmhil-can@.service")["ExecStart"])
    options = CanOptions()
    assert f"bitrate {options.bitrate} dbitrate {options.data_bitrate} fd on" in start
    assert options.fd


def test_udev_starts_a_unit_that_there_is():
    rules = (DEPLOY / "can" / "70-gfmhil-can.rules").read_text()
    wanted = re.findall(r'SYSTEMD_WANTS\}\+="(.+?)%k(.+?)"', rules)
    assert wanted == [("gfmhil-can@", ".service")]
    assert (DEPLOY / "can" / "gfmhil-can@.service").exists()


def interpolated(text: str, **values: str) -> str:
    """Interpolate as compose does: ${NAME:-default}."""
    return re.sub(r"\$\{(\w+):-([^}]*)\}", lambda m: values.get(m[1], m[2]), text)


def test_compose_file_keeps_to_the_specification_and_a_wrong_one_does_not():
    compose_spec = pytest.importorskip("compose_spec")
    reader = compose_spec.PyOptions(apply_merge=True)
    text = interpolated(COMPOSE.read_text())
    assert "${" not in text
    reader.from_yaml(text).validate()
    with pytest.raises(ValueError, match="cap_dorp"):
        reader.from_yaml(text.replace("cap_drop", "cap_dorp")).validate()


def test_the_bench_of_the_compose_file_is_one_that_there_is():
    yaml = pytest.importorskip("yaml")
    bench = yaml.safe_load(interpolated(COMPOSE.read_text()))["services"]["bench"]
    options = parser("run").parse_args(bench["command"])
    assert None not in (options.scope, options.stream, options.modbus)
    assert f"{options.scenario}:ro" in " ".join(bench["volumes"])


def test_containerfile_passes_its_linter():
    done = call(tool("hadolint"), CONTAINERFILE)
    assert (done.returncode, done.stdout) == (0, "")


def test_image_gets_every_file_that_the_build_needs(tmp_path):
    source = tmp_path / "src"
    source.mkdir()
    for line in re.findall(r"^COPY (?!--)(.+)$", CONTAINERFILE.read_text(), re.M):
        *names, target = line.split()
        for name in names:
            place = tmp_path / target.strip("/") / (name if target.endswith("/") else "")
            copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copy
            copy(ROOT / name, place)
    done = call(sys.executable, "-m", "hatchling", "build", "-t", "wheel", cwd=source)
    assert done.returncode == 0, done.stderr
    (wheel,) = (source / "dist").glob("*.whl")
    names = zipfile.ZipFile(wheel).namelist()
    assert {"gfm_runtime/__init__.py", "gfm_hil/scenarios/pref_step.toml"} <= set(names)
    assert not [name for name in names if "__pycache__" in name]


def test_roles_meet_with_the_arguments_keys_and_names_of_the_compose_file(tmp_path):
    yaml = pytest.importorskip("yaml")
    keys = tmp_path / "keys"
    assert call(sys.executable, "-m", "gfm_hil", "keys", "--out", keys).returncode == 0
    scenario = tmp_path / "scenario.toml"
    scenario.write_text(
        toml_text({"title": "met", "duration": 0.05, "mode": "lockstep",
                   "link": {"peer_timeout_s": 30.0}})
    )  # fmt: skip
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = str(probe.getsockname()[1])
    services = yaml.safe_load(interpolated(COMPOSE.read_text(), GFMHIL_PORT=port))["services"]
    running = []
    for role in ROLES:
        mounted = tmp_path / role  # only the keys that the file mounts for this side
        mounted.mkdir()
        for secret in services[role]["secrets"]:
            shutil.copy(keys / secret["source"], mounted / Path(secret["target"]).name)
        words = [
            word.replace("/run/keys", str(mounted)).replace("/etc/gfmhil", str(tmp_path))
            for word in services[role]["command"]
        ]
        words += ["--out", str(tmp_path / f"{role}-run"), "--quiet"]
        running.append(
            subprocess.Popen([sys.executable, "-m", "gfm_hil", *words], stderr=subprocess.PIPE)
        )
    try:
        for process in running:
            _, err = process.communicate(timeout=90)
            assert (process.returncode, err) == (0, b"")
    finally:
        for process in running:
            process.kill()
            process.wait()


def test_script_passes_its_linter():
    done = call(tool("shellcheck"), TUNE)
    assert (done.returncode, done.stdout) == (0, "")


MACHINE = {
    "sys/devices/system/cpu/online": "0-3",
    "sys/devices/system/cpu/isolated": "",
    "sys/devices/system/cpu/cpu0/cpufreq/scaling_governor": "powersave",
    "sys/devices/system/cpu/cpu2/cpufreq/scaling_governor": "powersave",
    "sys/devices/system/cpu/cpu3/cpufreq/scaling_governor": "performance",
    "sys/devices/system/cpu/cpu3/cpuidle/state0/latency": "2",
    "sys/devices/system/cpu/cpu3/cpuidle/state0/disable": "0",
    "sys/devices/system/cpu/cpu3/cpuidle/state2/latency": "170",
    "sys/devices/system/cpu/cpu3/cpuidle/state2/disable": "0",
    "proc/sys/kernel/timer_migration": "1",
    "proc/sys/kernel/nmi_watchdog": "0",
    "sys/kernel/mm/transparent_hugepage/enabled": "[always] madvise never",
    "proc/irq/9/smp_affinity_list": "0-3",
    "proc/irq/10/smp_affinity_list": "0-1",
}
APPLIED = {
    "sys/devices/system/cpu/cpu2/cpufreq/scaling_governor": "performance",
    "sys/devices/system/cpu/cpu3/cpuidle/state2/disable": "1",
    "proc/sys/kernel/timer_migration": "0",
    "sys/kernel/mm/transparent_hugepage/enabled": "madvise",
    "proc/irq/9/smp_affinity_list": "0,1",
}


@pytest.fixture
def machine(tmp_path) -> Path:
    """The files of a machine with four processors, the last two for the loops."""
    for name, text in MACHINE.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text + "\n")
    return tmp_path


def contents(root: Path) -> dict[str, str]:
    files = (path for path in root.rglob("*") if path.is_file())
    return {str(path.relative_to(root)): path.read_text().strip() for path in files}


def test_script_reports_and_changes_nothing(machine):
    done = call(TUNE, "--root", machine)
    assert (done.returncode, done.stderr) == (1, "")
    assert contents(machine) == MACHINE
    for name, value in APPLIED.items():
        assert re.search(rf"^change  /{name} = .* -> {value} ", done.stdout, re.M)
    assert len(re.findall("^change", done.stdout, re.M)) == len(APPLIED)
    assert "isolcpus=managed_irq,domain,2,3 nohz_full=2,3 rcu_nocbs=2,3 irqaffinity=0,1" in (
        done.stdout
    )


def test_script_applies_what_it_has_reported_and_nothing_else(machine):
    assert call(TUNE, "--root", machine, "--apply").returncode == 0
    assert contents(machine) == {**MACHINE, **APPLIED}
    assert not re.search("^change", call(TUNE, "--root", machine).stdout, re.M)


@pytest.mark.parametrize("cpus", [(), ("--cpus", "2,3")])
def test_script_has_nothing_to_say_to_a_machine_that_is_ready(machine, cpus):
    call(TUNE, "--root", machine, "--apply")
    (machine / "sys/devices/system/cpu/isolated").write_text("2-3\n")
    (machine / "sys/kernel/realtime").write_text("1\n")
    done = call(TUNE, "--root", machine, *cpus)
    assert done.returncode == 0
    assert {line.split()[0] for line in done.stdout.splitlines()} == {"ok"}


def test_script_leaves_this_machine_as_it_is():
    def seen() -> list[str]:
        places = [*Path("/proc/irq").glob("*/smp_affinity_list")]
        places += [Path("/proc/sys/kernel/timer_migration"), Path("/proc/sys/vm/stat_interval")]
        places += Path("/sys/devices/system/cpu").glob("cpu*/cpuidle/state*/disable")
        return [f"{path} {path.read_text()}" for path in places]

    before = seen()
    assert call(TUNE).returncode in (0, 1)
    assert seen() == before


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--cpus", "9"), "processor 9 is not there (0 1 2 3)"),
        (("--cpus", "two"), "--cpus two: must be like 2-3 or 1,3"),
        (("--cpus", "3-2"), "--cpus 3-2: must be like 2-3 or 1,3"),
        (("--cpus",), "--cpus: needs a value"),
        (("--now",), "--now: not known"),
    ],
)
def test_script_refuses_what_it_cannot_do_before_it_does_anything(machine, words, said):
    done = call(TUNE, "--root", machine, "--apply", *words)
    assert done.returncode == 2
    assert said in done.stderr and done.stderr.count("\n") == 1
    assert contents(machine) == MACHINE
