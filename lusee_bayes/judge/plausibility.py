"""Check whether data are plausible as correlations of a scenario's instrument under its sky."""

from itertools import combinations

import numpy as np
from jaxtyping import Float

from lusee_bayes.core.arrays import DataVector, Grid, GridFlags
from lusee_bayes.core.errors import InputError
from lusee_bayes.instrument.products import auto_indices, to_matrix
from lusee_bayes.instrument.visibilities import Visibilities

# standard deviations that noise alone exceeds in less than one of 1e8 samples
SIGNIFICANT = 6.0
# no sky and no gain differs this much from the model: the unit is wrong, or the file is damaged
IMPOSSIBLE = 1e3
# skies of this band are known to some ten per cent, but beams can be wrong by a factor
DOUBTFUL = 3.0
# a map with less information is no measurement
LEAST_BITS = 1.0


def require_plausible(data: Visibilities, signal: Grid, std: DataVector) -> tuple[str, ...]:
    """Check measured data against constraints that every correlator and every sky obey.

    Auto-correlations are powers, thus positive, and ``|V_ij|^2 <= V_ii V_jj`` (Cauchy and Schwarz),
    both within the noise.

    Parameters
    ----------
    data : Visibilities
    signal : (products, times) array
        Visibilities of the modelled sky, in K.
    std : (data,) array
        Standard deviations of the radiometer noise, in K.

    Returns
    -------
    tuple of str
        Doubts for the report, a sentence each.

    Raises
    ------
    InputError
        For values that no sky causes, and for significantly negative auto-correlations.
    """
    values, layout = np.asarray(data.grid()), data.layout
    sigma = np.asarray(layout.scatter(np.asarray(std)))
    modelled, autos = np.asarray(signal), auto_indices(round(np.sqrt(layout.n_products)))
    typical = float(np.median(modelled[autos]))
    _refuse(
        data,
        np.abs(values) > IMPOSSIBLE * max(typical, float(np.abs(modelled).max())),
        f"more than {IMPOSSIBLE:g} times the modelled sky ({typical:.3g} K); check the unit of the "
        "data, or flag the sample (NaN)",
    )
    _refuse(
        data,
        np.isin(np.arange(len(values)), autos)[:, None] & (values < -SIGNIFICANT * sigma),
        "a significantly negative auto; check signs and order of the products, or flag it (NaN)",
    )
    return (*_about_range(values[autos], modelled[autos]), *_about_crosses(data, values, sigma))


def about_information(bits: float) -> tuple[str, ...]:
    """Warn if data contain no information; no warning if it is NaN, i.e. unknown."""
    text = f"The data contain only {bits:.2g} bits of information on the sky: the map is the prior."
    return (text,) if bits < LEAST_BITS else ()


def _refuse(data: Visibilities, bad: GridFlags, why: str) -> None:
    """Raise an InputError for the first bad sample, if there is one."""
    if not bad.any():
        return
    product, time = (int(index[0]) for index in np.nonzero(bad))
    value = float(np.asarray(data.grid())[product, time])
    raise InputError(
        f"product {data.labels[product]} at {data.observation.times[time].isot[:19]} is "
        f"{value:.4g} K ({int(bad.sum())} samples in all): {why}"
    )


def _about_range(
    autos: Float[np.ndarray, "antennas times"], modelled: Float[np.ndarray, "antennas times"]
) -> tuple[str, ...]:
    present = ~np.isnan(autos)
    if not present.any():
        return ()
    ratio = float(np.median(autos[present] / modelled[present]))
    finding = f"auto-correlations are {ratio:.2g} times those of the modelled sky"
    advice = "check the unit of the data, their frequency and the beams"
    if not 1.0 / IMPOSSIBLE < ratio < IMPOSSIBLE:
        raise InputError(f"the {finding}; {advice}")
    return () if 1.0 / DOUBTFUL < ratio < DOUBTFUL else (f"The {finding}: {advice}.",)


def _about_crosses(data: Visibilities, values: Grid, sigma: Grid) -> tuple[str, ...]:
    """Pairs of antennas whose crosses are larger than their autos allow."""
    correlations, spreads = to_matrix(values), np.abs(to_matrix(sigma))
    doubts = []
    for i, j in combinations(range(len(correlations)), 2):
        vi, vj = correlations[i, i].real, correlations[j, j].real
        cross = np.abs(correlations[i, j])
        # autos that are not positive give no bound
        usable = (vi > 0) & (vj > 0) & ~np.isnan(cross)
        vi, vj = np.where(usable, vi, 1.0), np.where(usable, vj, 1.0)
        bound = np.sqrt(vi * vj)
        of_bound = 0.5 * bound * np.hypot(spreads[i, i] / vi, spreads[j, j] / vj)
        excess = usable & (cross - bound > SIGNIFICANT * np.hypot(spreads[i, j], of_bound))
        if excess.any():
            first = data.observation.times[int(np.nonzero(excess)[0][0])].isot[:19]
            larger = f"|V_{i}{j}| is larger than sqrt(V_{i}{i} V_{j}{j}), which is impossible"
            where = f"{int(excess.sum())} of {int(usable.sum())} samples (first {first})"
            doubts.append(f"{larger}, in {where}: one of {i}{i}, {j}{j} and {i}{j} is wrong.")
    return tuple(doubts)
