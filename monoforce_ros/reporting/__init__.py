"""Reports for people: self-contained HTML pages, tables written into documents, and progress bars."""

from monoforce_ros.reporting.documents import write_between
from monoforce_ros.reporting.page import (
    PAGE_STYLE,
    card,
    definition_list,
    figure_png,
    folded_list,
    page,
    picture,
    picture_card,
    table,
)
from monoforce_ros.reporting.progress import progress, progress_bar

__all__ = [
    "PAGE_STYLE",
    "card",
    "definition_list",
    "figure_png",
    "folded_list",
    "page",
    "picture",
    "picture_card",
    "progress",
    "progress_bar",
    "table",
    "write_between",
]
