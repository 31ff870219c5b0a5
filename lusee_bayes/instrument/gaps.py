"""Visibilities on the full grid, where some samples are absent and noise levels are needed."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from lusee_bayes.core.arrays import Array, namespace
from lusee_bayes.core.checks import is_traced
from lusee_bayes.core.errors import InputError
from lusee_bayes.instrument.layout import DataLayout
from lusee_bayes.instrument.products import all_products


def without_gaps(
    visibilities: Float[Array, "products times"], layout: DataLayout
) -> Float[Array, "products times"]:
    """Return visibilities with a value at every sample, for the noise around them.

    The noise of a sample depends on the antenna temperatures of its ports, and in the exact form
    on all products of its time. Where one of these is absent, it is interpolated linearly between
    the samples of the same product before and after it (at the ends the nearest one is taken). A
    cross that was never measured is zero: its ports are taken to be uncorrelated. The auto of a
    port that was never used is the mean of the others, and no sample depends on it.

    Parameters
    ----------
    visibilities : (products, times) array
        In K. A sample is absent where it is not in the layout, and its value is 0 (as
        :meth:`DataLayout.scatter` leaves it) or NaN; a model's values at absent samples are kept.
    layout : DataLayout

    Returns
    -------
    (products, times) array

    Raises
    ------
    InputError
        If an auto is absent at all times, but a product of its port is not.
    """
    if layout.index is None or is_traced(visibilities, layout.index):
        return visibilities
    values, present = np.array(visibilities), np.asarray(layout.present)
    absent = ~present & (np.isnan(values) | (values == 0.0))
    if not absent.any():
        return visibilities
    products = all_products(round(np.sqrt(layout.n_products)))
    times = np.arange(layout.n_times)
    unused = []
    for number, product in enumerate(products):
        gaps = absent[number]
        if not gaps.any():
            continue
        if not gaps.all():
            values[number, gaps] = np.interp(times[gaps], times[~gaps], values[number, ~gaps])
        elif product.i != product.j:
            values[number] = 0.0
        else:
            _require_unused(product.i, present)
            unused.append(number)
    if unused:
        autos = [k for k, p in enumerate(products) if p.i == p.j and k not in unused]
        values[unused] = values[autos].mean(0)
    return namespace(visibilities).asarray(values)


def _require_unused(port: int, present: np.ndarray) -> None:
    products = all_products(round(np.sqrt(len(present))))
    for product, there in zip(products, present.any(1), strict=True):
        if there and port in (product.i, product.j):
            raise InputError(
                f"the auto {port}{port}R is absent at all times, and the noise of "
                f"{product.label} depends on it; give modelled visibilities of all samples, such "
                "as the signal of a CouplingMatrix without flags"
            )
