"""Names of files and folders as users give them."""

from __future__ import annotations

import os
from pathlib import Path


def user_path(path: str | os.PathLike[str]) -> Path:
    """A path, with the user's folder in place of a leading ``~``."""
    return Path(os.path.expanduser(path))
