"""Compiled programs, kept from one run to the next in the user's cache folder.

JAX reads and writes a folder of compiled programs in place, where another process may meet half a
file. So every process works on a folder of its own, with links to all programs that are there;
what it has compiled itself joins them by renaming. ``LUSEE_BAYES_CACHE`` names another folder, or
says ``off``; a cache that JAX itself has been told to use is left alone.
"""

from __future__ import annotations

import atexit
import hashlib
import os
import platform
import shutil
from contextlib import suppress
from functools import lru_cache
from pathlib import Path

import jax
from platformdirs import user_cache_path

from lusee_bayes.core.files import remove_left_scratch, scratch_folder

SWITCH, OFF = "LUSEE_BAYES_CACHE", "off"
# the level of XLA's messages, and what JAX sets where it is imported before this package: XLA then
# warns of every program that it finds in the cache, in red
MESSAGES, CHATTY = "TF_CPP_MIN_LOG_LEVEL", "1"
# the programs of one machine together; a map needs some 10 MB
LARGEST_BYTES = 500_000_000
PROGRAM = "-cache"


def use_compilation_cache() -> None:
    """Let JAX keep what it compiles from now on; does nothing when called again.

    Nothing either where JAX was imported before this package: XLA would warn of every program that
    it finds, and reads the level of its messages no more.
    """
    if jax.config.jax_compilation_cache_dir is None and os.environ.get(MESSAGES) != CHATTY:
        _open()


def publish() -> None:
    """Give what this process has compiled to all others."""
    if _open.cache_info().currsize:
        shared, own = _open() or (None, None)
        if shared is not None:
            _publish(shared, own)


@lru_cache(maxsize=1)
def _open() -> tuple[Path, Path] | None:
    """The folder of this machine's programs, and this process's own; None without a cache."""
    wanted = os.environ.get(SWITCH, "")
    if wanted == OFF:
        return None
    shared = (Path(wanted) if wanted else user_cache_path("lusee_bayes")) / "programs" / _machine()
    try:
        shared.mkdir(parents=True, exist_ok=True)
        remove_left_scratch(shared)
        own = scratch_folder(shared)
    except OSError:
        # a home that cannot be written to: programs are compiled anew
        return None
    for path in _kept(shared):
        with suppress(FileNotFoundError):
            try:
                os.link(path, own / path.name)
            except OSError:
                shutil.copy2(path, own / path.name)
    jax.config.update("jax_compilation_cache_dir", str(own))
    # the names of XLA's own caches, which lie in the folder, would enter the names of programs
    jax.config.update("jax_persistent_cache_enable_xla_caches", "none")
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    atexit.register(_close, shared, own)
    return shared, own


def _kept(shared: Path) -> list[Path]:
    """The programs of a folder, the newest first; those beyond ``LARGEST_BYTES`` are removed."""
    found = []
    for path in shared.glob(f"*{PROGRAM}"):
        with suppress(FileNotFoundError):
            found.append((path.stat().st_mtime, path.stat().st_size, path))
    kept, total = [], 0
    for _, size, path in sorted(found, reverse=True):
        total += size
        if total <= LARGEST_BYTES:
            kept.append(path)
        else:
            path.unlink(missing_ok=True)
    return kept


def _publish(shared: Path, own: Path) -> None:
    for path in own.glob(f"*{PROGRAM}"):
        target = shared / path.name
        if target.exists():
            continue
        scratch = own / f"{path.name}.published"
        with suppress(OSError):
            shutil.copyfile(path, scratch)
            os.replace(scratch, target)


def _close(shared: Path, own: Path) -> None:
    _publish(shared, own)
    shutil.rmtree(own, ignore_errors=True)


def _machine() -> str:
    """A name for what programs are compiled for: those of one processor may fail on another."""
    features, info = platform.processor(), Path("/proc/cpuinfo")
    if info.is_file():
        lines = info.read_text(encoding="utf-8").splitlines()
        features = next((x for x in lines if x.startswith(("flags", "Features"))), features)
    described = f"{platform.machine()} {features} {jax.__version__} {jax.lib.__version__}"
    return hashlib.sha256(described.encode()).hexdigest()[:16]
