"""What info says of results (diagnostics, posteriors), as lines; it needs few libraries."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from lusee_bayes.core import formats
from lusee_bayes.core.checks import counted
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.formats import opened_tree
from lusee_bayes.core.trees import from_tree

# a uniform sky of 1 K
MONOPOLE = np.sqrt(4.0 * np.pi)
HOLDS = ("posterior", "log_likelihood", "observed_data", "constant_data", "information")


def describe_diagnostics(path: Path) -> list[str]:
    """The diagnostics of a map."""
    lines = []
    with opened_tree(path, formats.DIAGNOSTICS, "diagnostics of lusee-bayes map") as tree:
        for frequency, channel in sorted(tree.children.items(), key=lambda one: float(one[0])):
            lines.append(f"diagnostics of a map at {frequency} MHz")
            judged = channel.children.get("judged")
            if judged is None:
                lines.append("the data fit as a whole and were not judged group by group")
                continue
            kinds, n = np.unique(judged["groups/kind"].values, return_counts=True)
            counts = ", ".join(map(counted, n.tolist(), kinds.tolist()))
            lines += [str(judged.attrs["verdict"]), f"residuals by {counts}"]
    return lines


@dataclass(frozen=True)
class _Skies:
    """What is said of a posterior: skies in K, where they are, and where they come from."""

    frequency: Float[np.ndarray, " frequency"]
    mean: Float[np.ndarray, "frequency mode"]
    std: Float[np.ndarray, "frequency mode"]
    prior_std: Float[np.ndarray, "frequency mode"]
    lmax: int
    frame: str
    versions: dict[str, str]
    unmapped: str = ""


def describe_posterior(path: Path) -> list[str]:
    """A posterior at one frequency or at several."""
    with opened_tree(path, formats.POSTERIOR, "a posterior of lusee-bayes map") as tree:
        found = from_tree(_Skies, tree, str(path))
        held = [name for name in ("truth", "covariance", "independent_mean") if name in tree]
        held += [name for name in HOLDS if name in tree.children]
        joint = "component_mean" in tree
    if not found.mean.size:
        raise InputError(f"{path} holds no sky; make that map again")
    frequencies, (n, n_modes) = found.frequency, found.mean.shape
    at = f"{frequencies[0]:g} MHz"
    if n > 1:
        kind = "one posterior for all" if joint else "each on its own"
        at = f"{n} frequencies from {frequencies[0]:g} to {frequencies[-1]:g} MHz, {kind}"
    temperature = [
        f"{m:.6g} K +- {s:.3g} K"
        for m, s in zip(found.mean[:, 0] / MONOPOLE, found.std[:, 0] / MONOPOLE, strict=True)
    ]
    known = (found.std < 0.5 * found.prior_std).sum(axis=1)
    return [
        f"posterior over {n_modes} modes (lmax {found.lmax}) at {at}, {found.frame}",
        f"mean temperature {' to '.join(dict.fromkeys((temperature[0], temperature[-1])))}",
        f"{' to '.join(dict.fromkeys((str(known.min()), str(known.max()))))} modes known to better "
        "than half their prior width",
        *found.unmapped.splitlines(),
        f"also holds: {', '.join(held) or 'nothing else'}",
        f"versions: {json.dumps(found.versions)}",
    ]
