"""What info says of results (diagnostics, posteriors), as lines; it needs few libraries."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lusee_bayes.core import formats
from lusee_bayes.core.formats import opened_tree

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
            counts = [
                f"{judged[kind].sizes.get(f'{kind}_row', 0)} {kind}"
                for kind in ("products", "days", "angles")
            ]
            lines += [str(judged.attrs["verdict"]), f"residuals by {', '.join(counts)}"]
    return lines


def describe_posterior(path: Path) -> list[str]:
    """A posterior at one frequency or at several."""
    with opened_tree(path, formats.POSTERIOR, "a posterior of lusee-bayes map") as tree:
        frequencies, attrs = tree["frequency"].values, tree.attrs
        mean, std, before = (tree[name].values for name in ("mean", "std", "prior_std"))
        held = [name for name in ("truth", "covariance", "independent_mean") if name in tree]
        held += [name for name in HOLDS if name in tree.children]
        joint = "component_mean" in tree
    n, n_modes = mean.shape
    at = f"{frequencies[0]:g} MHz"
    if n > 1:
        kind = "one posterior for all" if joint else "each on its own"
        at = f"{n} frequencies from {frequencies[0]:g} to {frequencies[-1]:g} MHz, {kind}"
    temperature = [
        f"{m:.6g} K +- {s:.3g} K"
        for m, s in zip(mean[:, 0] / MONOPOLE, std[:, 0] / MONOPOLE, strict=True)
    ]
    known = (std < 0.5 * before).sum(axis=1)
    return [
        f"posterior over {n_modes} modes (lmax {attrs['lmax']}) at {at}, {attrs['frame']}",
        f"mean temperature {' to '.join(dict.fromkeys((temperature[0], temperature[-1])))}",
        f"{' to '.join(dict.fromkeys((str(known.min()), str(known.max()))))} modes known to better "
        "than half their prior width",
        *str(attrs.get("unmapped", "")).splitlines(),
        f"also holds: {', '.join(held) or 'nothing else'}",
        f"versions: {attrs['versions']}",
    ]
