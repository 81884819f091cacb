"""Self-contained HTML pages: their style, figures as PNG, and texts put into documents."""

from __future__ import annotations

import io
from pathlib import Path

from matplotlib.figure import Figure

from monoforce_ros.core import write_text

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


def write_between(document: Path, name: str, text: str) -> None:
    """Put a text into a document, between its comments ``<!-- NAME -->`` and ``<!-- end of NAME -->``.

    Raises:
        ValueError: the document has no such comments.
    """
    content = document.read_text(encoding="utf-8")
    begin, end = f"<!-- {name} -->", f"<!-- end of {name} -->"
    if begin not in content or end not in content:
        raise ValueError(f"{document}: no {begin} and {end} to write between")
    before, _, rest = content.partition(begin)
    write_text(document, f"{before}{begin}\n{text.strip()}\n{end}{rest.partition(end)[2]}")


def figure_png(figure: Figure) -> bytes:
    """A figure as PNG."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()
