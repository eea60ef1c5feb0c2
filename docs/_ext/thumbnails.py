"""Sphinx extension: the gallery, a section of a page, shows the first figure of each program."""

from __future__ import annotations

from typing import Any

from docutils import nodes

_PAGE, _SECTION = "notebook", "gallery"


def _show(app: Any, doctree: nodes.document, docname: str) -> None:
    if docname != _PAGE:
        return
    grid = nodes.container(classes=["thumbnails"])
    for page in app.env.toctree_includes[_PAGE]:
        title = app.env.titles[page].astext()
        card = nodes.reference("", "", refuri=app.builder.get_relative_uri(docname, page))
        images = (image["uri"] for image in app.env.get_doctree(page).findall(nodes.image))
        # of a figure in several formats the one for a page
        if picture := next((uri for uri in images if uri.endswith(".png")), None):
            card += nodes.image(uri=picture, candidates={"*": picture}, alt=title)
        card += nodes.inline("", title)
        grid += nodes.paragraph("", "", card)
    next(s for s in doctree.findall(nodes.section) if _SECTION in s["ids"]).append(grid)


def setup(app: Any) -> dict[str, Any]:
    """Hook into Sphinx."""
    app.connect("doctree-resolved", _show)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
