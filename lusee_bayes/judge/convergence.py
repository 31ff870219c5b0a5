"""Check whether the draws of chains can be trusted yet."""

from collections.abc import Mapping

import numpy as np

# sufficient R-hat and effective size per chain (Vehtari et al. 2021); bounds beyond which R-hat and
# the fraction of diverged draws are bad
AGREE, PER_CHAIN, FAR, FEW = 1.01, 100, 1.05, 0.01
CRITERIA = (
    f"Required: R-hat of at most {AGREE:g}, effective sizes of {PER_CHAIN} for each chain, no "
    f"divergences. Bad: R-hat above {FAR:g}, or more than {FEW:.0%} of the draws diverged."
)


def warnings_of(table: Mapping[str, np.ndarray], *, chains: int, divergences: int) -> list[str]:
    """List reasons not to trust draws yet, with remedies; empty if there are none.

    Parameters
    ----------
    table : mapping
        Columns of summary.csv: quantity, r_hat, ess_bulk, ess_tail.
    chains, divergences : int
        Of the run.
    """
    warnings = []
    names, r_hat = table["quantity"], np.nan_to_num(table["r_hat"], nan=-np.inf, posinf=np.inf)
    if above := int((r_hat > AGREE).sum()):
        furthest = int(np.argmax(r_hat))
        warnings.append(
            f"Not converged: R-hat is above {AGREE:g} for {above} of {len(names)} quantities, "
            f"largest for {names[furthest]} ({r_hat[furthest]:.4g}). Raise --draws and --warmup."
        )
    least = PER_CHAIN * chains
    for column, what in (("ess_bulk", "bulk"), ("ess_tail", "tail")):
        size = np.nan_to_num(table.get(column, np.inf), nan=np.inf)
        if few := int((size < least).sum()):
            worst = int(np.argmin(size))
            warnings.append(
                f"The {what} effective size is below {least} for {few} of {len(names)} quantities, "
                f"smallest for {names[worst]} ({size[worst]:.0f}): raise --draws."
            )
    if divergences:
        warnings.append(
            f"{divergences} trajectories diverged: the steps are too long where the posterior is "
            "narrow. Raise --warmup, or reparametrise the program so that it is nowhere narrow."
        )
    return warnings
