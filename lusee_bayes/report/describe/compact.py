"""What is in a compact posterior."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lusee_bayes.linear.compact import read_compact


def describe_compact(path: Path) -> str:
    """A compact posterior."""
    posterior, about = read_compact(path)
    n, rank = posterior.directions.shape
    return "\n".join(
        [
            f"{path}: compact posterior over {n} modes (lmax {about['lmax']}) at "
            f"{about['frequency_mhz']:g} MHz, {about['frame']}",
            f"  {rank} directions known better than the prior, the best to "
            f"{np.sqrt(posterior.variances.min()):.2g} of its width",
            f"  versions: {about['versions']}",
        ]
    )
