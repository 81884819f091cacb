"""Sections of a document that a benchmark writes anew, between two comments with its name."""

from __future__ import annotations

from pathlib import Path

from monoforce_ros.core import write_text


def replace_section(document: Path, name: str, text: str) -> None:
    """Put ``text`` between ``<!-- NAME -->`` and ``<!-- end of NAME -->``; raises ValueError where they are missing."""
    content = document.read_text(encoding="utf-8")
    start, end = f"<!-- {name} -->", f"<!-- end of {name} -->"
    if content.count(start) != 1 or content.count(end) != 1:
        raise ValueError(f"{document}: expected {start} and {end} once each")
    before, rest = content.split(start)
    write_text(document, f"{before}{start}\n{text.strip()}\n{end}{rest.split(end)[1]}")
