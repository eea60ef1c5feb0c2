"""The packages: who imports whom, what a wheel holds, what no file may hold."""

import ast
import re
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = {
    "gfm_runtime": ROOT / "runtime" / "gfm_runtime",
    "gfm_plant": ROOT / "plant_emulator" / "gfm_plant",
    "gfm_design": ROOT / "design" / "gfm_design",
    "gfm_hil": ROOT / "hil" / "gfm_hil",
    "gfm_pytest": ROOT / "hil" / "gfm_pytest",
}
MAY_IMPORT = {
    "gfm_runtime": (),
    "gfm_plant": ("gfm_runtime.signals",),
    "gfm_design": ("gfm_runtime", "gfm_plant"),
    "gfm_hil": ("gfm_runtime", "gfm_plant", "gfm_design"),
    "gfm_pytest": ("gfm_hil",),
}
RUNTIME_NEEDS = {"numpy", "numba"}
# The reader of law files, which the loop does not use (pydantic_core is a part of pydantic).
BESIDE_THE_LOOP = {"lawfile.py": {"pydantic", "pydantic_core"}}
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


def within(name: str, module: str) -> bool:
    return name == module or name.startswith(module + ".")


def files(folder: Path, suffixes: set[str]) -> list[Path]:
    return [
        path
        for path in sorted(folder.rglob("*"))
        if path.suffix in suffixes and not {"_build", "_static"} & set(path.parts)
    ]


@pytest.mark.parametrize("package", FOLDERS)
def test_imports_run_one_way(package: str) -> None:
    allowed = (package, *MAY_IMPORT[package])
    wrong = [
        f"{path.relative_to(ROOT)}: {name}"
        for path in files(FOLDERS[package], {".py"})
        for name in imported(path)
        if name.split(".")[0] in FOLDERS and not any(within(name, module) for module in allowed)
    ]
    assert not wrong


def test_runtime_needs_numpy_and_numba_only() -> None:
    known = RUNTIME_NEEDS | {"gfm_runtime"} | set(sys.stdlib_module_names)
    wrong = [
        f"{path.relative_to(ROOT)}: {name}"
        for path in files(FOLDERS["gfm_runtime"], {".py"})
        for name in imported(path)
        if name.split(".")[0] not in known | BESIDE_THE_LOOP.get(path.name, set())
    ]
    assert not wrong


@pytest.mark.parametrize("package", FOLDERS)
def test_package_is_typed(package: str) -> None:
    assert (FOLDERS[package] / "py.typed").is_file()


def test_no_source_is_longer_than_400_lines() -> None:
    lengths = {
        str(path.relative_to(ROOT)): len(path.read_text(encoding="utf-8").splitlines())
        for folder in SOURCES
        for path in files(folder, {".py"})
    }
    assert lengths
    assert {name: n for name, n in lengths.items() if n > 400} == {}


def test_no_machine_paths() -> None:
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


def test_wheel_holds_packages_and_scenarios(tmp_path: Path) -> None:
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
        for path in (ROOT / "scenarios").rglob("*.toml")
    }
    assert wanted - held == set()
    tops = {name.split("/")[0] for name in held}
    assert {top for top in tops if not top.endswith(".dist-info")} <= set(FOLDERS)
