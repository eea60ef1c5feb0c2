"""Pages of one file each, which need nothing else: one style, one template they extend."""

from __future__ import annotations

import base64
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from gfm_hil.core.files import write_text
from gfm_hil.results.table import Table, shown

if TYPE_CHECKING:
    from jinja2 import Environment

_PAGES = Path(__file__).with_name("pages")


@cache
def _environment() -> Environment:
    import jinja2  # as long as a third of a second, which only a page needs

    found = jinja2.Environment(
        loader=jinja2.FileSystemLoader(_PAGES), autoescape=True, trim_blocks=True,
        lstrip_blocks=True, undefined=jinja2.StrictUndefined,
    )  # fmt: skip
    found.filters["shown"] = shown
    return found


def render(template: str, **values: Any) -> str:
    """A page of a template in ``pages``; its values are escaped, but for ``style``, further CSS."""
    from markupsafe import Markup

    values["style"] = Markup(values.get("style", ""))
    return _environment().get_template(template).render(values)


def fragment(table: Table) -> str:
    """A table as HTML, for a notebook."""
    text = '{% from "macros.html" import table %}{{ table(t) }}'
    return _environment().from_string(text).render(t=table)


class PlotScript(NamedTuple):
    """What a page needs to draw its plots: style and code, each once a page."""

    style: str
    code: str


def plot_script() -> PlotScript:
    """The plotting library uPlot, which the scope serves too, and our script that draws with it."""
    from markupsafe import Markup

    vendor = files("gfm_hil").joinpath("ports/scope/static/vendor")
    style = vendor.joinpath("uPlot.min.css").read_text("utf-8")
    code = vendor.joinpath("uPlot.iife.min.js").read_text("utf-8")
    own = (_PAGES / "plots.js").read_text("utf-8")
    return PlotScript(Markup(style), Markup(f"{code}\n{own}"))


def write_page(path: Path, template: str, **values: Any) -> None:
    """Write a page, see ``render``."""
    write_text(path, render(template, **values))


def inline(picture: Path | bytes, kind: str = "") -> str:
    """A picture, a file or the content of one of a kind (png or svg+xml), as the address of an
    image in a page that needs no other file."""
    if isinstance(picture, Path):
        kind = {".png": "png", ".svg": "svg+xml"}[picture.suffix]
        picture = picture.read_bytes()
    return f"data:image/{kind};base64,{base64.b64encode(picture).decode()}"
