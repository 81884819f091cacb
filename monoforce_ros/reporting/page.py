"""Self-contained HTML pages: the shell and the style that all reports share, and figures embedded as PNG."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PAGE_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #1c2733; background: #f5f7f8; margin: 0; }
main { max-width: 1120px; margin: 0 auto; padding: 32px 24px 64px; }
h1 { font-size: 26px; margin: 0 0 4px; } h2 { font-size: 18px; margin: 36px 0 10px; }
p.lead { color: #51606e; margin: 0 0 20px; max-width: 80ch; }
section.card { background: white; border-radius: 10px; padding: 18px 22px; margin: 18px 0;
  box-shadow: 0 1px 3px #0002; }
img { max-width: 100%; display: block; margin: 0 auto; }
table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; }
th, td { padding: 6px 10px; text-align: right; border-bottom: 1px solid #e3e8ec; white-space: nowrap; }
th:first-child, td:first-child { text-align: left; }
td.best { font-weight: 700; color: #0b6e4f; }
small, .muted { color: #6b7a88; }
details { margin-top: 12px; } summary { cursor: pointer; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: 2px 18px; margin: 0; }
dt { color: #6b7a88; } dd { margin: 0; overflow-wrap: anywhere; }
"""


def page(title: str, body: str, *, heading: str = "", lead: str = "") -> str:
    """A complete, self-contained HTML document.

    Args:
        title: plain text, in the browser's title bar.
        body: HTML below the heading.
        heading: plain text at the top of the page (default: the title).
        lead: plain text of an introduction below the heading.
    """
    introduction = f'<p class="lead">{html.escape(lead, quote=False)}</p>' if lead else ""
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{html.escape(title)}</title><style>{PAGE_STYLE}</style></head>"
        f"<body><main><h1>{html.escape(heading or title)}</h1>{introduction}{body}</main></body></html>"
    )


def card(body: str, *, heading: str = "", caption: str = "") -> str:
    """A section of a page with HTML ``body``; heading and caption are plain text."""
    top = f'<h2 style="margin-top:0">{html.escape(heading)}</h2>' if heading else ""
    below = f'<p class="muted">{html.escape(caption, quote=False)}</p>' if caption else ""
    return f'<section class="card">{top}{below}{body}</section>'


def picture(png: bytes, *, alt: str) -> str:
    """A picture embedded in the page."""
    return f'<img alt="{html.escape(alt)}" src="data:image/png;base64,{base64.b64encode(png).decode()}">'


def picture_card(png: bytes, *, alt: str, heading: str = "", caption: str = "") -> str:
    """A section with a picture."""
    return card(picture(png, alt=alt), heading=heading, caption=caption)


def definition_list(entries: Mapping[str, object]) -> str:
    """Names and values in two columns, as plain text."""
    listed = "".join(f"<dt>{html.escape(k)}</dt><dd>{html.escape(str(v))}</dd>" for k, v in entries.items())
    return f"<dl>{listed}</dl>"


def folded_list(summary: str, lines: Iterable[str]) -> str:
    """Collapsible lines of plain text below a summary; empty without lines."""
    listed = "".join(f"<li>{html.escape(line)}</li>" for line in lines)
    return f"<details><summary>{html.escape(summary)}</summary><ul>{listed}</ul></details>" if listed else ""


def table(head: Sequence[str], rows: Iterable[str]) -> str:
    """A table of HTML header cells and of rows that are HTML ``<tr>`` elements."""
    return f"<table><tr>{''.join(f'<th>{cell}</th>' for cell in head)}</tr>{''.join(rows)}</table>"


def figure_png(figure: Figure) -> bytes:
    """A figure as PNG."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()
