"""How far a map is from a known truth, by latitude and at some multipoles."""

from __future__ import annotations

import numpy as np

from lusee_bayes.core.harmonics import modes_to_map
from lusee_bayes.results.channel import ChannelResult
from lusee_bayes.results.coverage import latitudes

# at which SNR is told
ELLS = (5, 10, 20, 30)


def errors_by_latitude(channel: ChannelResult) -> list[dict[str, float | str]]:
    """By latitude: rms error in K, and the width of error bars over the sky's brightness.

    Parameters
    ----------
    channel : ChannelResult
        With its truth.
    """
    truth, mean = (modes_to_map(m, channel.nside) for m in (channel.truth, channel.mean))
    return [
        {
            "name": name,
            "rms_error_k": float(np.sqrt(((mean - truth)[inside] ** 2).mean())),
            "std_over_sky": float(channel.pixel_std[inside].mean() / truth[inside].mean()),
        }
        for name, inside in latitudes(channel.nside).items()
    ]


def snr_at_some_ell(channel: ChannelResult) -> dict[int, float]:
    """SNR_ell at 5, 10, 20 and 30, as far as the map goes.

    Parameters
    ----------
    channel : ChannelResult
        With its truth.
    """
    snr = channel.snr()
    return {ell: float(snr[ell]) for ell in ELLS if ell < len(snr)}
