"""The page about testing: the frames' layout and the calls of the fixture, from the code."""

from __future__ import annotations

import inspect
import re

from gfm_hil.links.frame import DATA_IDS, MAGIC, frame_dtype
from gfm_hil.scope.view import HEAD
from gfm_hil.testing import Experiment
from gfm_hil.testing.steps import Steps
from gfm_runtime.signals import TABLE_VERSION

_KINDS = {"u1": "uint8", "<u2": "uint16", "<u4": "uint32", "<u8": "uint64", "<f8": "float64"}
_MEANING = {
    "magic": f"`0x{MAGIC:04X}`",
    "version": f"of the signal table, {TABLE_VERSION}",
    "data_id": f"{DATA_IDS['y']}: $y$, {DATA_IDS['u']}: $u$",
    "state": "of the sender; the plant: 0, 3 (SAFE: it tripped), 4 (STOPPED: the run is over)",
    "reason": "of the sender; 0",
    "spare": "0",
    "sequence": "from 0, one more each frame, modulo $2^{32}$",
    "tick": "$k$; of $u$: that of the $y$ it answers",
    "crc": "CRC-32 of zlib and Ethernet over all bytes before it",
}


def scope_head() -> str:
    """The numbers that a picture of the scope begins with, a row each."""
    rows = [f"| {k} | {name} | {text} |" for k, (name, text) in enumerate(HEAD.items())]
    return "\n".join(["| | | |", "|---|---|---|", *rows])


def frame_layout() -> str:
    """Both frames side by side, a row a field."""
    layouts = {group: frame_dtype(group) for group in ("y", "u")}
    rows = ["| field | type | at byte of $y$ | at byte of $u$ | |", "|---|---|---|---|---|"]
    names = dict.fromkeys(name for d in layouts.values() for name in (d.names or ())[:-1])
    for name in (*names, "crc"):
        places = {g: d.fields[name] for g, d in layouts.items() if d.fields and name in d.fields}
        kind = next(iter(places.values()))[0].str.lstrip("|")
        cells = [str(places[g][1]) if g in places else "–" for g in layouts]
        meaning = _MEANING.get(name, "p.u.")
        rows.append(f"| `{name}` | {_KINDS[kind]} | {' | '.join(cells)} | {meaning} |")
    sizes = " | ".join(str(d.itemsize) for d in layouts.values())
    return "\n".join([*rows, f"| size | | {sizes} | bytes |"])


def calls(what: str) -> str:
    """The ``steps`` or the ``assertions`` of the fixture: signature and what it says of itself."""
    owner = Steps if what == "steps" else Experiment
    rows = ["| call | |", "|---|---|"]
    for name, member in vars(owner).items():
        if not inspect.isfunction(member) or name.startswith("_"):
            continue
        named = [
            re.sub(r": .*?(?= = |$)", "", str(p)).replace(" = ", "=").replace("=None", "=…")
            for p in list(inspect.signature(member).parameters.values())[1:]
        ]
        text = " ".join((inspect.getdoc(member) or "").split("\n\n")[0].split())
        rows.append(f"| `bench.{name}({', '.join(named)})` | {text.replace('``', '`')} |")
    return "\n".join(rows)
