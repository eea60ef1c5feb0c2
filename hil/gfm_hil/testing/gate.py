"""The conformity tests as a gate: a test of a user passes only if every clause does."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from gfm_hil.api.studies import conform
from gfm_hil.studies.conformity.result import Conformity


def gate(near: Path, new_folder: Callable[[], Path]) -> Callable[..., Conformity]:
    """``conform`` for tests: the folder ``near`` is searched first for files of laws, sets, stages
    and converters, and each call writes its report into a new folder."""

    def beside(value: Any) -> Any:
        if isinstance(value, list | tuple):
            return [beside(one) for one in value]
        there = isinstance(value, str | Path) and (near / value).exists()
        return str(near / value) if there else value

    def call(law: Any, against: Any = "all", **more: Any) -> Conformity:
        """As ``gfmhil.conform``. Raises AssertionError: a clause fails or cannot be judged; one
        line a part, and the report."""
        __tracebackhide__ = True
        folder = new_folder()
        given = {name: beside(value) for name, value in more.items()}
        found = conform(beside(law), beside(against), folder, **given)
        if not found.passed:
            report = f"report: {folder / 'report.html'}"
            raise AssertionError("\n".join([*found.failures, report]))
        return found

    return call
