"""The pages about testing and the scope: the calls of the fixture, the head of a picture."""

from __future__ import annotations

import inspect
import re

from gfm_hil.core.terminal import markdown
from gfm_hil.ports.scope.picture import HEAD
from gfm_hil.testing import Experiment
from gfm_hil.testing.steps import Steps


def scope_head() -> str:
    """The numbers that a picture of the scope begins with, a row each."""
    return markdown(("", "", ""), [(str(k), *row) for k, row in enumerate(HEAD.items())])


def calls(what: str) -> str:
    """The ``steps`` or the ``assertions`` of the fixture: signature and what it says of itself."""
    owner = Steps if what == "steps" else Experiment
    rows = []
    for name, member in vars(owner).items():
        if not inspect.isfunction(member) or name.startswith("_"):
            continue
        named = [
            re.sub(r": .*?(?= = |$)", "", str(p)).replace(" = ", "=").replace("=None", "=…")
            for p in list(inspect.signature(member).parameters.values())[1:]
        ]
        text = " ".join((inspect.getdoc(member) or "").split("\n\n")[0].split())
        rows.append((f"`bench.{name}({', '.join(named)})`", text.replace("``", "`")))
    return markdown(("call", ""), rows)
