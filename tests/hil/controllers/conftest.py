"""Libraries that the tests of controllers have in common, compiled once."""

from pathlib import Path
from typing import Any

import pytest

from gfm_hil.cli import main

SOURCE = Path(__file__).parents[2] / "support" / "foreign_model.c"


@pytest.fixture(scope="package")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Our own laws as models, by kind, law and inner stage."""
    found: dict[Any, str] = {}

    def export(kind: str, law: str, inner: str) -> str:
        if (kind, law, inner) not in found:
            folder = tmp_path_factory.mktemp(kind)
            out = folder / "law.fmu" if kind == "fmu" else folder
            what = ["firmware", kind, law, "--inner", inner, "--real", "float64", "-o", str(out)]
            assert main(what) == 0
            found[kind, law, inner] = f"{kind}:{out if kind == 'fmu' else next(out.glob('*.so'))}"
        return found[kind, law, inner]

    return export


@pytest.fixture(scope="package")
def foreign(exported: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The library of ``foreign_model.c``."""
    headers = Path(exported("dll", "vsg-2", "none").removeprefix("dll:")).parent
    library = tmp_path_factory.mktemp("foreign") / "droop.so"
    assert main(["firmware", "compile", str(SOURCE), "-I", str(headers), "-o", str(library)]) == 0
    return library
