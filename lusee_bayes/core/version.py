"""Origin of a result: versions of the package and its libraries, and the command line, if any."""

import subprocess
from contextvars import ContextVar
from functools import lru_cache
from importlib import metadata
from pathlib import Path

__version__ = "0.2.0"


@lru_cache(maxsize=1)
def commit() -> str | None:
    """The commit of the clone that contains the package, with -dirty if files have changed since.

    None if the package is not in a clone, or Git is not installed.
    """
    clone = Path(__file__).resolve().parents[2]
    if not (clone / ".git").exists():
        return None
    command = ["git", "-C", str(clone), "describe", "--always", "--dirty", "--exclude=*"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=10)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()


def release() -> str:
    """The version, and the commit if known."""
    return f"{__version__} (commit {commit()})" if commit() else __version__


def versions(*, with_commit: bool = True) -> dict[str, str]:
    """Return the versions of the package and of the libraries that affect its numbers.

    Parameters
    ----------
    with_commit : bool
        Include the package's commit if known.
    """
    libraries = ("jax", "numpyro", "arviz-stats", "numpy", "scipy", "healpy", "astropy", "lunarsky")
    package = {"commit": commit()} if with_commit and commit() else {}
    return {"lusee_bayes": __version__, **package, **{name: installed(name) for name in libraries}}


# cached, since every written file needs it
installed = lru_cache(metadata.version)
COMMAND: ContextVar[str] = ContextVar("COMMAND", default="")


def printable(text: str) -> str:
    """Return the text with non-UTF-8 bytes of file names as escapes."""
    return text.encode(errors="backslashreplace").decode()
