"""Lines of progress."""

from collections.abc import Callable

Log = Callable[[str], None]
"""Receiver of lines of progress, such as `print` or `logging.getLogger("nnap_em").info`."""


def silent(text: str) -> None:
    """Discard a line."""
