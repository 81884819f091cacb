"""TODO."""

from monoforce_ros.reporting.page import PAGE_STYLE, figure_png, write_between

__all__ = [
    "PAGE_STYLE",
    "figure_png",
    "write_between",
]
