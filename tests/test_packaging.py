"""The packages: their imports, a wheel's content, and content that no file may have."""

import ast
import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from collections.abc import Iterator
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from importlib.metadata import files as files_of
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from gfm_hil.cli import main

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = {
    "gfm_runtime": ROOT / "runtime" / "gfm_runtime",
    "gfm_plant": ROOT / "plant_emulator" / "gfm_plant",
    "gfm_design": ROOT / "design" / "gfm_design",
    "gfm_hil": ROOT / "hil" / "gfm_hil",
    "gfm_pytest": ROOT / "hil" / "gfm_pytest",
    "gfmhil": ROOT / "hil" / "gfmhil",
}
RUNTIME_NEEDS = {"numpy", "numba", "llvmlite", "lazy_loader"}
# The reader of law files, which the loop does not use (pydantic_core is a part of pydantic).
_FILES = ("lawfile", "mistakes", "inner_file", "expressions", "law", "shipped", "toml_file")
_STAGES = [p.stem for p in (FOLDERS["gfm_runtime"] / "inner").glob("*.py")]  # their options
_COUNTS = ("measure", "modulate", "pair")  # likewise
BESIDE_THE_LOOP = {
    **{f"{name}.py": {"pydantic", "pydantic_core"} for name in (*_FILES, *_STAGES, *_COUNTS)},
    "elf.py": {"elftools"},  # the extra "calibration"
}
OF_THE_SAME_PROJECT = {"pydantic_core", "llvmlite"}  # as pydantic and numba, which pin them
SOURCES = [
    *FOLDERS.values(),
    *(ROOT / name for name in ("tests", "benchmarks", "docs", "examples")),
]
TEXT = {".py", ".md", ".toml", ".yml", ".yaml", ".json", ".service", ".sh", ".dbc", ".html"}
HOME = re.compile(r"/(home|Users|root|work)/")


def imported(path: Path) -> Iterator[str]:
    """Dotted names that a file imports; those of `from a import b` are `a.b`."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"), str(path))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def files(folder: Path, suffixes: set[str]) -> list[Path]:
    return [
        path
        for path in sorted(folder.rglob("*"))
        if path.suffix in suffixes and not {"_build", "_static"} & set(path.parts)
    ]


def test_imports_run_one_way():
    """The contracts of pyproject.toml hold, between the packages and between the rooms."""
    where = os.pathsep.join(str(folder.parent) for folder in FOLDERS.values())
    done = subprocess.run(
        [sys.executable, "-c", "from importlinter.cli import lint_imports_command as c; c()"],
        cwd=ROOT, env={**os.environ, "PYTHONPATH": where}, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    assert "0 broken" in done.stdout


def test_runtime_needs_numpy_and_numba_only():
    known = RUNTIME_NEEDS | {"gfm_runtime"} | set(sys.stdlib_module_names)
    wrong = [
        f"{path.relative_to(ROOT)}: {name}"
        for path in files(FOLDERS["gfm_runtime"], {".py"})
        for name in imported(path)
        if name.split(".")[0] not in known | BESIDE_THE_LOOP.get(path.name, set())
    ]
    assert not wrong


def test_a_plain_install_has_all_that_the_plant_imports():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    installed = {canonicalize_name(Requirement(each).name) for each in project["dependencies"]}
    names = {n.split(".")[0] for p in files(FOLDERS["gfm_plant"], {".py"}) for n in imported(p)}
    foreign = (
        names - set(sys.stdlib_module_names) - {"gfm_plant", "gfm_runtime", *OF_THE_SAME_PROJECT}
    )
    assert {canonicalize_name(name) for name in foreign} <= installed


def test_the_citation_names_this_version():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    said = yaml.safe_load((ROOT / "CITATION.cff").read_text("utf-8"))
    assert (said["version"], said["license"]) == (project["version"], project["license"])


@pytest.mark.parametrize("package", FOLDERS)
def test_package_is_typed(package):
    assert (FOLDERS[package] / "py.typed").is_file()


def test_no_machine_paths():
    folders = [*SOURCES, *(ROOT / name for name in ("scenarios", "deploy"))]
    paths = [path for folder in folders for path in files(folder, TEXT)]
    paths += [path for path in ROOT.iterdir() if path.suffix in TEXT]
    paths += [path for path in (ROOT / ".ci").iterdir() if path.is_file()]
    wrong = [
        str(path.relative_to(ROOT))
        for path in paths
        if HOME.search(path.read_text(encoding="utf-8"))
    ]
    assert not wrong


def committed(folder: str) -> set[str]:
    """The files of a folder that git tracks."""
    done = subprocess.run(
        ["git", "ls-files", folder], cwd=ROOT, capture_output=True, text=True, check=True
    )
    return set(done.stdout.split())


@pytest.mark.attack(
    "10.7", "deploying from a wheel", "deploy/ was not in it: units and scripts only by a checkout"
)
def test_deploy_writes_what_is_committed_and_keeps_what_is_there(tmp_path, capsys, attack_now):
    out = tmp_path / "deploy"
    assert main(["deploy", "--out", str(out)]) == 0
    written = {p.relative_to(tmp_path).as_posix() for p in out.rglob("*") if p.is_file()}
    assert written == committed("deploy")
    for name in written:
        assert (tmp_path / name).read_bytes() == (ROOT / name).read_bytes()
    assert os.access(out / "tune-realtime", os.X_OK)
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "compose.yaml").write_text("mine")
    for place in (mine, mine / "compose.yaml"):
        assert main(["deploy", "--out", str(place)]) == 2
    assert [p.name for p in mine.iterdir()] == ["compose.yaml"]
    told = capsys.readouterr().err
    assert f"{mine}: is not empty" in told and f"{mine / 'compose.yaml'}: is no folder" in told
    attack_now(f"`gfmhil deploy --out DIR` writes {len(written)} files and replaces none")


def pins(name: str) -> dict[str, str]:
    """Package to the lines that follow it in a lock file; each package once per Python version."""
    text = (ROOT / "requirements" / name).read_text(encoding="utf-8")
    return {k + rest.split("\n")[0]: rest for k, rest in re.findall(LOCKED, text)}


LOCKED = re.compile(r"^([a-z0-9][a-z0-9._-]*)(==[^ ]+(?:.|\n(?=    --))*)", re.MULTILINE)


@pytest.mark.parametrize(
    ("name", "extras"), [("ci.txt", ("test", "docs")), ("container.txt", ("scope", "metrics"))]
)
@pytest.mark.attack(
    "10.8",
    "a package of the same version but other content, in CI and in the image",
    "it was installed: no version was fixed and no hash checked",
)
def test_the_locks_fit_the_project_and_every_line_has_hashes(name, extras, attack_now):
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    wanted = [*project["dependencies"], "hatchling>=1.27"]
    wanted += [line for extra in extras for line in project["optional-dependencies"][extra]]
    locked: dict[str, set[str]] = {}
    lines = pins(name)
    for line, rest in lines.items():
        assert "--hash=sha256:" in rest, line
        requirement = Requirement(line.rstrip(" \\"))
        versions = locked.setdefault(canonicalize_name(requirement.name), set())
        versions.add(str(requirement.specifier).removeprefix("=="))
    for line in wanted:
        requirement = Requirement(line)
        found = locked[canonicalize_name(requirement.name)]
        assert all(requirement.specifier.contains(version) for version in found), line
    assert "--only-binary :all:" in (ROOT / "requirements" / name).read_text(encoding="utf-8")
    attack_now(f"refused by pip: {len(lines)} packages of {name} carry their hashes")


@pytest.mark.full
def test_the_bill_of_materials_names_versions_and_licences(tmp_path):
    pytest.importorskip("cyclonedx_py")
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    python = tmp_path / "venv" / "bin" / "python"  # with the metadata of what the image has
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", tmp_path / "venv"], check=True)
    (packages,) = (tmp_path / "venv").glob("lib/*/site-packages")
    for name in {line.partition("==")[0] for line in pins("container.txt")}:
        with suppress(PackageNotFoundError):  # of another Python or system
            place = next(p for p in files_of(name) or () if p.name == "METADATA").locate().parent
            shutil.copytree(place, packages / place.name)
    command = [ROOT / ".ci" / "sbom", tmp_path / "sbom.json", python]
    done = subprocess.run(command, env={**os.environ, "PATH": path}, check=False,
                          capture_output=True, text=True)  # fmt: skip
    assert done.returncode == 0, done.stderr
    bill = json.loads((tmp_path / "sbom.json").read_text(encoding="utf-8"))
    assert (bill["bomFormat"], bill["metadata"]["component"]["name"]) == ("CycloneDX", "gfmhil")
    parts = {part["name"]: part for part in bill["components"]}
    for name in ("numpy", "numba", "pyzmq"):
        assert parts[name]["version"] == version(name)
        assert parts[name]["licenses"]


def test_wheel_holds_packages_and_scenarios(tmp_path):
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    (wheel,) = tmp_path.glob("*.whl")
    held = set(zipfile.ZipFile(wheel).namelist())
    wanted = {
        f"{package}/{path.relative_to(folder).as_posix()}"
        for package, folder in FOLDERS.items()
        for path in folder.rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    wanted |= {
        f"gfm_hil/{path.relative_to(ROOT).as_posix()}"
        for suffix in ("toml", "py")
        for path in (ROOT / "scenarios").rglob(f"*.{suffix}")
    }
    wanted |= {f"gfm_hil/{name}" for name in committed("deploy")}
    assert {name for name in held if name.startswith("gfm_hil/deploy/")} <= wanted  # and no key
    assert wanted - held == set()
    tops = {name.split("/")[0] for name in held}
    assert {top for top in tops if not top.endswith(".dist-info")} <= set(FOLDERS)
