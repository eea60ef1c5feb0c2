"""Hashes of what a report rests on."""

import hashlib
from collections.abc import Iterable, Iterator, Mapping
from importlib.resources import files
from pathlib import Path

from gfm_hil.controllers import PIL, controller_file
from gfm_hil.studies.conformity.execute import ControllerUnderTest
from gfm_hil.studies.conformity.sets import Case
from gfm_runtime.lawfile import shipped_law


def file_hashes(
    laws: Mapping[str, str],
    inner: str | None,
    under_test: Path,
    converter: str,
    cases: Iterable[Case],
    external: ControllerUnderTest | None,
    recorded: Iterable[Path] = (),
    network: Path | None = None,
) -> dict[str, str]:
    """SHA-256 by what each file is.

    Args:
        laws: name or path by what results call each.
        inner: stage of every law, a shipped name or a path; None if each has its own.
        under_test, converter: file of the converter under test, and the converter that it names.
        cases: the tests.
        external: a model beside the laws, or None.
        recorded: files of a recording that is judged.
        network: scenario of the network over which the tests are laid, or None.
    """

    def each() -> Iterator[tuple[str, bytes]]:
        for title, name in laws.items():
            text = None if name.endswith(".toml") else shipped_law(name)
            yield f"law {title}", Path(name).read_bytes() if text is None else text.encode()
        if inner is not None and inner != "none":
            yield f"inner stage {inner}", _file_content(inner, "gfm_runtime", "inner_stages")
        if external is not None and not external.model.startswith(PIL):
            yield external.name, controller_file(external.model)[1].read_bytes()
        if external is not None and external.ports is not None:
            yield f"map {external.ports.name}", external.ports.read_bytes()
        for path in recorded:
            yield f"recording {path.name}", path.read_bytes()
        if network is not None:
            yield f"network {network.name}", network.read_bytes()
        yield f"converter under test {under_test.name}", under_test.read_bytes()
        yield f"converter {converter}", _file_content(converter, "gfm_plant", "converters")
        for case in cases:
            yield f"test {case.id}", case.path.read_bytes()

    return {name: hashlib.sha256(content).hexdigest() for name, content in each()}


def _file_content(name: str, package: str, folder: str) -> bytes:
    """The content of a file by its path, or by the name of one that ships."""
    if name.endswith(".toml"):
        return Path(name).read_bytes()
    return files(package).joinpath(folder, f"{name}.toml").read_bytes()
