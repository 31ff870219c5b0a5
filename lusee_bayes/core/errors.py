"""Errors that a user can understand: one sentence, no traceback."""

import difflib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager

# characters of a message, since it quotes the user's input
LONGEST = 1000


class InputError(ValueError):
    """Invalid input; the message states the problem, its place and the remedy.

    The message is one line: unprintable characters are escaped, and the middle of a long message is
    omitted.
    """

    def __init__(self, message: object):
        words = " ".join(str(message).split())
        text = "".join(c if c.isprintable() else repr(c)[1:-1] for c in words)
        if len(text) > LONGEST:
            text = f"{text[: LONGEST // 2]} ... {text[-LONGEST // 2 :]}"
        super().__init__(text)


class WorkersLost(RuntimeError):
    """Raised when workers fail repeatedly or are gone; the message is one sentence."""


@contextmanager
def refusing(message: str, *kinds: type[Exception]) -> Iterator[None]:
    """Raise InputError with this message for errors of these kinds."""
    try:
        yield
    except kinds as error:
        raise InputError(message) from error


def require_known(what: str, word: str, known: Iterable[str]) -> None:
    """Raise InputError with the nearest known word if this word is unknown."""
    if word not in known:
        raise InputError(f"{what} '{word}'; {nearest(word, known)}")


def nearest(word: str, known: Iterable[str]) -> str:
    """Return a hint that names the closest of ``known``, or all of them if none is close."""
    known = list(known)
    close = difflib.get_close_matches(word, known, n=1, cutoff=0.5)
    return f"did you mean '{close[0]}'?" if close else f"known: {', '.join(sorted(known))}"
