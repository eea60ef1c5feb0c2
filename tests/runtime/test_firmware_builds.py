"""The build files of a firmware folder: by CMake itself, and from projects of others."""

import shutil
import subprocess
from importlib.metadata import version
from pathlib import Path
from xml.etree import ElementTree

import pytest
import yaml

from ..support.firmware import cc, exported

pytestmark = [pytest.mark.compilers, pytest.mark.timeout(300)]

PROJECT = """
cmake_minimum_required(VERSION 3.13)
project(app C)
{library}
add_executable(app selftest.c)
target_link_libraries(app gfm::gfm)
"""
INSTALLED = f"find_package(gfm {version('gfmhil')} REQUIRED)"
ADDED = "add_subdirectory(firmware)"
M4F = (
    "-DCMAKE_SYSTEM_NAME=Generic",
    "-DCMAKE_C_COMPILER=arm-none-eabi-gcc",
    "-DCMAKE_C_FLAGS=-mcpu=cortex-m4 -mthumb -mfloat-abi=hard -mfpu=fpv4-sp-d16 "
    "--specs=nosys.specs",
)
#: doubles of what ESP-IDF and Zephyr define, by their documentation
ESP_IDF = """
macro(idf_component_register)
  cmake_parse_arguments(A "" "" "SRCS;INCLUDE_DIRS" ${ARGN})
  set(COMPONENT_LIB __idf_gfm)
  add_library(__idf_gfm STATIC ${A_SRCS})
  target_include_directories(__idf_gfm PUBLIC ${A_INCLUDE_DIRS})
endmacro()
set(ESP_PLATFORM 1)
add_subdirectory(firmware)
target_link_libraries(__idf_gfm PUBLIC m)
add_library(gfm::gfm ALIAS __idf_gfm)
"""
ZEPHYR = """
macro(zephyr_library_named name)
  add_library(${name} STATIC)
endmacro()
macro(zephyr_include_directories directory)
  set(INCLUDED ${CMAKE_CURRENT_SOURCE_DIR}/${directory} PARENT_SCOPE)
  include_directories(${CMAKE_CURRENT_SOURCE_DIR}/${directory})
endmacro()
macro(zephyr_library_compile_options)
  target_compile_options(gfm PRIVATE ${ARGN})
endmacro()
macro(zephyr_library_sources)
  target_sources(gfm PRIVATE ${ARGN})
endmacro()
set(CONFIG_GFM y)
add_subdirectory(firmware/zephyr gfm)
include_directories(${INCLUDED})
target_link_libraries(gfm PUBLIC m)
add_library(gfm::gfm ALIAS gfm)
"""


def cmake(folder: Path, *arguments: str) -> None:
    done = cc(folder, *arguments, compiler="cmake")
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.fixture
def firmware(tmp_path: Path) -> Path:
    (tmp_path / "firmware").mkdir()
    return exported(tmp_path / "firmware", "float32", "records", "vsg-1", "vsg-2")


def project(folder: Path, firmware: Path, library: str, *settings: str) -> None:
    """Builds a project whose application is the self-test, with the library from elsewhere."""
    for name in ("selftest.c", "selftest.h", "golden.h"):
        shutil.copy(firmware / name, folder / name)
    (folder / "CMakeLists.txt").write_text(PROJECT.format(library=library))
    cmake(folder, "-S", ".", "-B", "app", *settings)
    cmake(folder, "--build", "app")


@pytest.mark.parametrize("settings", [(), M4F], ids=["host", "m4f"])
def test_an_installed_library_is_what_another_project_links(tmp_path, firmware, settings):
    cmake(tmp_path, "-S", "firmware", "-B", "build", *settings)
    cmake(tmp_path, "--build", "build")
    cmake(tmp_path, "--install", "build", "--prefix", str(tmp_path / "there"))
    shutil.rmtree(tmp_path / "build")
    away = tmp_path / "away"
    away.mkdir()
    project(away, firmware, INSTALLED, f"-DCMAKE_PREFIX_PATH={tmp_path / 'there'}", *settings)
    if not settings:
        ran = subprocess.run([away / "app" / "app"], check=False, capture_output=True)
        assert ran.returncode == 0


@pytest.mark.parametrize("library", [ADDED, ESP_IDF, ZEPHYR], ids=["cmake", "esp-idf", "zephyr"])
def test_a_folder_is_a_part_of_another_build(tmp_path, firmware, library):
    project(tmp_path, firmware, library, "-DCMAKE_EXPORT_COMPILE_COMMANDS=1")
    ran = subprocess.run([tmp_path / "app" / "app"], check=False, capture_output=True)
    assert ran.returncode == 0
    assert "-ffp-contract=off" in (tmp_path / "app" / "compile_commands.json").read_text()


def test_a_zephyr_module_and_a_cmsis_pack_name_files_that_are_there(firmware):
    module = yaml.safe_load((firmware / "zephyr" / "module.yml").read_text())
    assert module == {"name": "gfm", "build": {"cmake": "zephyr", "kconfig": "zephyr/Kconfig"}}
    assert (firmware / module["build"]["cmake"] / "CMakeLists.txt").is_file()
    assert (firmware / module["build"]["kconfig"]).is_file()
    pack = ElementTree.parse(firmware / "gfmhil.gfm.pdsc").getroot()
    assert f"{pack.findtext('vendor')}.{pack.findtext('name')}.pdsc" == "gfmhil.gfm.pdsc"
    names = {file.attrib["name"] for file in pack.iter("file")}
    built = {p.name for p in firmware.glob("gfm*.[ch]")}
    assert names == built
