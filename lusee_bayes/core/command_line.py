"""The command line that runs, if there is one: results say what made them."""

from __future__ import annotations

from contextvars import ContextVar

COMMAND: ContextVar[str] = ContextVar("COMMAND", default="")


def printable(text: str) -> str:
    """Text in which the bytes of file names that are not UTF-8 are shown by their escapes."""
    return text.encode(errors="backslashreplace").decode()
