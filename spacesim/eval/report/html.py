"""Pieces of a self-contained HTML page: escaping, tables, embedded pictures and the style sheet.

Functions take plain text and escape it, except parameters that are said to be HTML.
"""

import base64
import html
import io
from collections.abc import Iterable, Sequence
from pathlib import Path
from string import Template

from PIL import Image

from spacesim.data.errors import InputError
from spacesim.data.images import read_png
from spacesim.eval.report.style import STYLE

SERIES = 6
"""Number of colours that distinguish runs; more runs take them in turn."""


def escape(value: object) -> str:
    """HTML of any value's text."""
    return html.escape(str(value))


def swatch(index: int) -> str:
    """HTML of the coloured dot of run number `index`."""
    return f'<i class="dot s{index % SERIES}" aria-hidden="true"></i>'


def section(title: str, body: str, lead: str = "") -> str:
    """HTML of a section with a heading; body: HTML."""
    lead = f'<p class="lead">{escape(lead)}</p>' if lead else ""
    return f"<section><h2>{escape(title)}</h2>{lead}{body}</section>"


def table(caption: str, head: Sequence[str], groups: Iterable[tuple[str, Sequence[Sequence[str]]]]) -> str:
    """HTML of a table. head, rows: cells of HTML, the first of each row its header; groups: (title, rows)."""
    columns = "".join(f'<th scope="col">{cell}</th>' for cell in head)
    header = f"<thead><tr>{columns}</tr></thead>" if any(head) else ""
    bodies = []
    for title, rows in groups:
        lines = [
            f'<tr><th scope="row">{row[0]}</th>' + "".join(f"<td>{cell}</td>" for cell in row[1:]) + "</tr>"
            for row in rows
        ]
        heading = f'<tr class="group"><th scope="colgroup" colspan="{len(head)}">{escape(title)}</th></tr>'
        bodies.append(f"<tbody>{heading if title else ''}{''.join(lines)}</tbody>")
    return (
        f'<div class="scroll" tabindex="0" role="region" aria-label="{escape(caption)}"><table>'
        f"<caption>{escape(caption)}</caption>{header}{''.join(bodies)}</table></div>"
    )


def picture(path: Path, alt: str, caption: str, limit: int) -> str:
    """HTML of a figure with the PNG at `path` inside the page, made smaller to `limit` pixels a side.

    caption: HTML. Raises InputError where there is no such picture.
    """
    try:
        shown = Image.fromarray(read_png(path)).convert("RGB")
    except InputError:
        raise InputError(f"{path}: expected a picture that spacesim eval wrote, found none") from None
    shown.thumbnail((limit, limit), Image.Resampling.BOX)
    buffer = io.BytesIO()
    shown.save(buffer, "png")  # optimize takes three times as long and saves a twentieth of the bytes
    data = base64.b64encode(buffer.getvalue()).decode()
    width, height = shown.size
    return (
        f'<figure><img src="data:image/png;base64,{data}" width="{width}" height="{height}" '
        f'alt="{escape(alt)}"><figcaption>{caption}</figcaption></figure>'
    )


def page(title: str, body: str) -> str:
    """The whole document; body: HTML."""
    return _PAGE.substitute(title=escape(title), body=body, style=STYLE)


_PAGE = Template("""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<meta http-equiv="Content-Security-Policy"
      content="default-src 'none'; style-src 'unsafe-inline'; img-src data:">
<title>$title</title>
<style>$style</style>
</head>
<body>
<main>
$body
</main>
</body>
</html>
""")
