"""Laws of the fields of positive skies, learned from the large scales of all channels.

Learning takes twenty rounds of :mod:`.positive_joint`. A and tilt are those of a power law, of
which modes up to a low ell tell nearly all: those above are integrated out, with the power of the
template.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from lusee_bayes.core.arrays import on_host
from lusee_bayes.core.harmonics import n_modes, per_mode, power_spectrum
from lusee_bayes.linear.information import Information
from lusee_bayes.linear.marginal_information import marginalised
from lusee_bayes.linear.positive_joint import Channels, ChannelsInMemory, find_joint_mode
from lusee_bayes.sky.field_laws import FieldLaws
from lusee_bayes.sky.positive_skies import PositiveSkies

# highest ell of the maps that laws are learned from
COARSE_LMAX = 16


def learn_laws(
    skies: PositiveSkies,
    channels: Channels,
    *,
    lmax_fields: int,
    report: Callable[[int, str], None] | None = None,
) -> FieldLaws:
    """Learn C_ell of all fields and residuals, by the maximum of the evidence.

    Parameters
    ----------
    skies : PositiveSkies
    channels : Channels
        Their data.
    lmax_fields : int
        Highest ell of the exponents while laws are learned, at least that of the maps then.
    report : callable, optional
        Told the number of every round, and how far it moved.

    Raises
    ------
    InputError
        As :func:`.find_joint_mode`.
    """
    lmax = min(skies.lmax, COARSE_LMAX)
    coarse = skies.coarser(lmax, lmax_fields)
    parts = _large_scales(skies, channels, n_modes(lmax))
    mode = find_joint_mode(coarse, FieldLaws.of(coarse), parts, learn=True, report=report)
    return mode.laws


def _large_scales(skies: PositiveSkies, channels: Channels, n: int) -> ChannelsInMemory:
    """What all channels say of the first modes."""
    names = ("matrix", "vector", "reference", "misfit", "log_det", "n_data")

    def large(channel: int, information: Information) -> dict[str, np.ndarray]:
        found = on_host(information)
        if found.n_modes > n:
            found = marginalised(found, n, _small_scales(skies, channel)[n:])
        return {name: np.asarray(getattr(found, name)) for name in names}

    shapes = dict(zip(names, ((n, n), (n,), (n,), (), (), ()), strict=True))
    found = channels.each(large, shapes)
    return ChannelsInMemory(
        tuple(
            Information(*(np.asarray(found[name][k]) for name in names))
            for k in range(len(skies.levels))
        )
    )


def _small_scales(skies: PositiveSkies, channel: int) -> Float[np.ndarray, " modes"]:
    """The template's power in every mode, with its sources'."""
    template = skies.modes(channel, np.zeros(skies.n_fields))
    return per_mode(power_spectrum(template) + power_spectrum(skies.sources[channel]).sum(0))
