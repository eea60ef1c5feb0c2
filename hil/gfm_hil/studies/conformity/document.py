"""report.pdf: the report of a law to print, sign and keep, with the hashes of all that it rests
on."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.sax.saxutils import escape

from gfm_hil.core.files import replacing
from gfm_hil.studies.conformity.criteria.base import KNOWN
from gfm_hil.studies.conformity.panels import OTHER_COLOUR, VERDICT_COLOURS

if TYPE_CHECKING:
    from gfm_hil.studies.conformity.result import Conformity

_FONT, _BOLD, _MONO = "DejaVu", "DejaVu-Bold", "DejaVu-Mono"
_FILES = {_FONT: "DejaVuSans", _BOLD: "DejaVuSans-Bold", _MONO: "DejaVuSansMono"}
_SIGNED = ("name", "place", "date", "signature")


def write_document(path: Path, found: Conformity, law: str) -> None:
    """Write the report of a law as A4 pages. Raises ModuleNotFoundError: reportlab is missing."""
    from reportlab.lib.pagesizes import A4
    from reportlab.platypus import SimpleDocTemplate

    title = f"Conformity of {law}"
    with replacing(path) as part:
        document = SimpleDocTemplate(
            str(part), pagesize=A4, leftMargin=42, rightMargin=42, topMargin=42, bottomMargin=48,
            title=title, author=f"gfmhil {dict(found.about(law))['gfmhil']}",
        )  # fmt: skip

        def foot(canvas: Any, _: Any) -> None:
            canvas.setFont(_FONT, 7)
            canvas.drawString(42, 28, f"{title} · digest {found.digests.get(law, '–')}")
            canvas.drawRightString(A4[0] - 42, 28, f"page {canvas.getPageNumber()}")

        content = _Content(document.width - 12)  # the frame's padding
        content.write(found, law, title)
        document.build(content.flow, onFirstPage=foot, onLaterPages=foot)


class _Content:
    """The flow of paragraphs, tables and pictures."""

    def __init__(self, width: float) -> None:
        from matplotlib import get_data_path
        from reportlab.lib.styles import ParagraphStyle
        from reportlab.pdfbase import pdfmetrics
        from reportlab.pdfbase.ttfonts import TTFont

        for name, file in _FILES.items():  # matplotlib's: they have all signs that we print
            pdfmetrics.registerFont(TTFont(name, f"{get_data_path()}/fonts/ttf/{file}.ttf"))

        def style(size: float, font: str = _FONT, **more: Any) -> Any:
            return ParagraphStyle(font, fontName=font, fontSize=size, leading=1.3 * size, **more)

        self.flow: list[Any] = []
        self._width = width
        self._text, self._small = style(8.5, spaceAfter=4), style(7)
        self._bold, self._mono = style(7, _BOLD), style(6, _MONO, wordWrap="CJK")
        self._heads = [style(15, _BOLD, spaceAfter=8)]
        self._heads += [
            style(x, _BOLD, spaceBefore=8, spaceAfter=3, keepWithNext=1) for x in (11, 9)
        ]

    def write(self, found: Conformity, law: str, title: str) -> None:
        """The whole report."""
        from reportlab.platypus import PageBreak

        from gfm_hil.studies.conformity.result import HEADS, explain_counts, row, saturation, tally

        self._head(0, f"{title}: {found.verdict_of(law)}")
        self._table([[name, text] for name, text in found.about(law)], [0.2, 0.8], head=False)
        counts = tally(found, law)
        self._table(counts, [0.3, *[0.7 / (len(counts[0]) - 1)] * (len(counts[0]) - 1)])
        self._paragraph(explain_counts(found, law))
        self._signature()
        rows = [
            [found.matrix[law, c.id], f"{c.id}: {c.test.title}", c.test.source.words()]
            for c in found.cases
        ]
        self._table([["verdict", "test", "source"], *rows], [0.14, 0.43, 0.43])
        recordings = []
        for case in found.cases:
            self.flow.append(PageBreak())
            self._head(1, f"{case.id}: {case.test.title}: {found.matrix[law, case.id]}")
            self._paragraph(case.test.description)
            known = KNOWN[case.test.source.known]
            self._paragraph(f"Source: {case.test.source.words()}, {known}.")
            for part in found.of(law, case.id):
                if part.part:
                    self._head(2, f"{part.part}: {part.verdict}")
                lines = [["", "verdict", *HEADS]]
                for number, v in enumerate(part.verdicts, 1):
                    limits = saturation(v)
                    said = v.verdict + (f" (limiter: {limits})" if limits else "")
                    lines.append([str(number), said, *row(v)])
                if part.verdicts:
                    widths = [0.02, 0.08, 0.13, 0.06, 0.08, 0.09, 0.11, 0.16, 0.17, 0.1]
                    self._table(lines, widths)
                else:
                    self._paragraph(part.reason)
                if part.figure is not None:
                    self._picture(part.figure.path)
                if part.recording:
                    name = "/".join(x for x in (part.test, part.part) if x)
                    recordings.append([f"signals of {name}", part.recording])
        self.flow.append(PageBreak())
        self._head(1, "Hashes")
        self._paragraph(
            "SHA-256 of the files, and of the signals that each run recorded (Run.digest in "
            "Python). The scenarios in the folder runs repeat the runs."
        )
        self._table(
            [["of", "SHA-256"], *map(list, found.hashes.items()), *recordings], [0.38, 0.62],
            mono=True,
        )  # fmt: skip

    def _head(self, level: int, text: str) -> None:
        from reportlab.platypus import Paragraph

        self.flow.append(Paragraph(escape(text), self._heads[level]))

    def _paragraph(self, text: str) -> None:
        from reportlab.platypus import Paragraph

        if text:
            self.flow.append(Paragraph(escape(text), self._text))

    def _table(
        self, rows: list[list[str]], widths: list[float], head: bool = True, mono: bool = False
    ) -> None:
        """Rows of texts, with a column of verdicts in their colours; widths are parts of the
        page's. ``mono``: the last column is of hashes."""
        from reportlab.lib.colors import HexColor
        from reportlab.platypus import Paragraph, Spacer, Table, TableStyle

        def cell(text: str, row: int, column: int) -> Any:
            style = self._bold if (head and row == 0) or (not head and column == 0) else self._small
            if mono and row and column == len(widths) - 1:
                style = self._mono
            verdict = text.partition(" (")[0]
            said = escape(text)
            if head and row and column < 2 and rows[0][column] == "verdict":
                colour = VERDICT_COLOURS.get(verdict, OTHER_COLOUR)
                said = f'<font color="{colour}">{said}</font>'
            return Paragraph(said, style)

        cells = [[cell(x, r, c) for c, x in enumerate(row)] for r, row in enumerate(rows)]
        table = Table(cells, [self._width * w for w in widths], repeatRows=int(head), hAlign="LEFT")
        lines = [
            ("LINEBELOW", (0, 0), (-1, -1), 0.3, HexColor("#cccccc")),
            ("VALIGN", (0, 0), (-1, -1), "TOP"),
            ("LEFTPADDING", (0, 0), (-1, -1), 0),
            ("RIGHTPADDING", (0, 0), (-1, -1), 5),
            ("TOPPADDING", (0, 0), (-1, -1), 1.5),
            ("BOTTOMPADDING", (0, 0), (-1, -1), 1.5),
        ]
        table.setStyle(TableStyle(lines))
        self.flow += [table, Spacer(1, 6)]

    def _signature(self) -> None:
        """Four lines to write on."""
        from reportlab.lib.colors import black
        from reportlab.platypus import Paragraph, Spacer, Table

        gap, each = 12.0, len(_SIGNED)
        width = (self._width - gap * (each - 1)) / each
        cells, widths = list[Any](), list[float]()
        for name in _SIGNED:
            cells += [Paragraph(name, self._small), ""]
            widths += [width, gap]
        above = [("LINEABOVE", (2 * k, 0), (2 * k, 0), 0.6, black) for k in range(each)]
        table = Table([cells[:-1]], widths[:-1], style=above, hAlign="LEFT")
        self.flow += [Spacer(1, 44), table, Spacer(1, 10)]

    def _picture(self, path: Path) -> None:
        from reportlab.lib.utils import ImageReader
        from reportlab.platypus import Image, Spacer

        wide, high = ImageReader(str(path)).getSize()
        scale = min(self._width / wide, 640.0 / high)
        self.flow += [Image(str(path), wide * scale, high * scale), Spacer(1, 6)]
