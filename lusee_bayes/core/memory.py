"""How much memory this process may take."""

from __future__ import annotations

import os
import resource
from functools import lru_cache
from pathlib import Path

# limits of the process's control group, of either version
CGROUP_LIMITS = (
    Path("/sys/fs/cgroup/memory.max"),
    Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"),
)
# addresses that libraries and threads reserve without using the memory, below which XLA aborts
RESERVED = 1_500_000_000


@lru_cache(maxsize=1)
def memory_limit() -> int:
    """Bytes of this machine's memory, or of the share of it that the process is limited to."""
    limits = [os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")]
    addresses, _ = resource.getrlimit(resource.RLIMIT_AS)
    if addresses != resource.RLIM_INFINITY:
        limits.append(max(0, addresses - RESERVED))
    for path in CGROUP_LIMITS:
        text = path.read_text(encoding="utf-8").strip() if path.is_file() else ""
        if text.isdigit():
            limits.append(int(text))
    return min(limits)


def gigabytes(n: float | int) -> str:
    """Format a number of bytes: 1.2 GB."""
    return f"{n / 1e9:.2g} GB" if n < 1e11 else f"{n / 1e9:,.0f} GB"
