"""Documents: generated sections between two comments of a Markdown or HTML file."""

from __future__ import annotations

from pathlib import Path

from monoforce_ros.core import write_text


def write_between(document: Path, name: str, text: str) -> None:
    """Replace the section of a document between its comments ``<!-- NAME -->`` and ``<!-- end of NAME -->``.

    Raises:
        ValueError: the document does not contain each comment exactly once.
    """
    content = document.read_text(encoding="utf-8")
    start, end = f"<!-- {name} -->", f"<!-- end of {name} -->"
    if content.count(start) != 1 or content.count(end) != 1:
        raise ValueError(f"{document}: expected the comments {start} and {end} once each")
    before, _, rest = content.partition(start)
    _, _, after = rest.partition(end)
    write_text(document, f"{before}{start}\n{text.strip()}\n{end}{after}")
