"""What the model predicts of every product and of every day from all other data.

The density ln p(d_s | all others) of a group is that of its prediction, whose width counts: a prior
that predicts too much is punished as one that predicts too little is.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int

from lusee_bayes.core.arrays import on_host
from lusee_bayes.core.engine import in_threads
from lusee_bayes.instrument.visibilities import Visibilities
from lusee_bayes.linear.left_out import Missed
from lusee_bayes.linear.model import LinearGaussian
from lusee_bayes.linear.posterior import Posterior
from lusee_bayes.linear.residuals import HOURS_A_DAY, leave_out


@dataclass(frozen=True)
class HeldOut:
    """Groups of data, each against what all others predict of it, added up.

    Attributes
    ----------
    kind : {"product", "day"}
    groups, n : int
        Number of groups, and of their data.
    chi2 : float
        About ``n`` if the model holds.
    log_density : float
        ln p of each group given all others, data in K.
    """

    kind: str
    groups: int
    n: int
    chi2: float
    log_density: float


def held_out(
    model: LinearGaussian, posterior: Posterior, data: Visibilities
) -> tuple[HeldOut, ...]:
    """Predict products, and days of 24 hours from the first sample, from all others.

    Parameters
    ----------
    model : LinearGaussian
        Of these data.
    posterior : Posterior
        Of the model, given these data.
    data : Visibilities
        In K.

    Returns
    -------
    tuple of HeldOut
        One for each kind that has several groups; none where noise couples times and A would be
        too large to be formed (:func:`.leave_out`).

    Raises
    ------
    InputError
        If the model cannot be factorised.
    """
    model, layout = on_host(model), data.layout
    left_out = leave_out(model, posterior, data)
    if left_out is None:
        return ()
    day = np.floor(data.observation.hours / HOURS_A_DAY).astype(int)
    found = (
        _added("product", layout.product, left_out.product),
        _added("day", day[layout.time], lambda k: left_out.stretch(day == k)),
    )
    return tuple(one for one in found if one.groups > 1)


def _added(kind: str, group: Int[np.ndarray, " data"], leave: Callable[[int], Missed]) -> HeldOut:
    counts = np.bincount(group)
    some = np.flatnonzero(counts).tolist()
    if len(some) < 2:
        return HeldOut(kind, len(some), len(group), np.nan, np.nan)
    missed = in_threads(leave, some)
    densities = [one.log_density(int(counts[k])) for k, one in zip(some, missed, strict=True)]
    chi2 = sum(one.chi2 for one in missed)
    return HeldOut(kind, len(some), len(group), float(chi2), float(sum(densities)))
