"""Compiled programs, kept by JAX from one run to the next in the user's cache folder.

``LUSEE_BAYES_CACHE`` names another folder, or says ``off``; a cache that JAX itself has been told
to use is left alone.
"""

from __future__ import annotations

import hashlib
import os
import platform
from pathlib import Path

import jax
from platformdirs import user_cache_path

SWITCH, OFF = "LUSEE_BAYES_CACHE", "off"
# the level of XLA's messages, and what JAX sets where it is imported before this package: XLA then
# warns of every program that it finds in the cache, in red
MESSAGES, CHATTY = "TF_CPP_MIN_LOG_LEVEL", "1"
SETTINGS = {
    # a map needs some 10 MB; the size makes JAX lock the folder, which several processes may use
    "jax_compilation_cache_max_size": 500_000_000,
    "jax_persistent_cache_min_compile_time_secs": 0.0,
    "jax_persistent_cache_min_entry_size_bytes": -1,
    # the names of XLA's own caches, which lie in the folder, would enter the names of programs
    "jax_persistent_cache_enable_xla_caches": "none",
}


def use_compilation_cache() -> None:
    """Let JAX keep what it compiles from now on.

    Does nothing where JAX was imported before this package: XLA would warn of every program that it
    finds, and reads the level of its messages no more.
    """
    wanted = os.environ.get(SWITCH, "")
    known = jax.config.jax_compilation_cache_dir is not None
    if known or wanted == OFF or os.environ.get(MESSAGES) == CHATTY:
        return
    folder = (Path(wanted) if wanted else user_cache_path("lusee_bayes")) / "programs" / _machine()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        # a home that cannot be written to: programs are compiled anew
        return
    for name, value in {**SETTINGS, "jax_compilation_cache_dir": str(folder)}.items():
        jax.config.update(name, value)


def _machine() -> str:
    """A name for what programs are compiled for: those of one processor may fail on another."""
    features, info = platform.processor(), Path("/proc/cpuinfo")
    if info.is_file():
        lines = info.read_text(encoding="utf-8").splitlines()
        features = next((x for x in lines if x.startswith(("flags", "Features"))), features)
    return hashlib.sha256(f"{platform.machine()} {features}".encode()).hexdigest()[:16]
