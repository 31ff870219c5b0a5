"""How much noise neighbouring channels share, by the response of the filter bank.

A polyphase filter bank of T taps weights T frames of N samples with a window times the impulse
response of a channel, h, before the Fourier transform: y_k(t) = sum_n h(n) x(n + N t) exp(-2 pi i k
n / N). For white noise, ::

    <y_k(t) conj(y_k+d(t + s))> ~ c_d(s) = sum_n h(n) h(n - s N) exp(2 pi i d n / N),

and the powers of two channels, averaged over many frames, have the covariance ::

    sum_s |c_d(s)|^2,

of which c_0(0)^2 would be that of independent frames.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Literal

import numpy as np
from jaxtyping import Float

from lusee_bayes.core.errors import InputError

Taper = Literal["rectangular", "hann", "hamming", "blackman"]
# covariances do not depend on the length of a frame where it is long
FRAME = 512
# beyond that many channels apart nothing is shared
REACH = 6
# coefficients of cos(2 pi j n / N T) of each window
WINDOWS: dict[Taper, tuple[float, ...]] = {
    "rectangular": (1.0,),
    "hann": (0.5, -0.5),
    "hamming": (0.54, -0.46),
    "blackman": (0.42, -0.5, 0.08),
}


@lru_cache(maxsize=16)
def shared_noise(taps: int, taper: Taper) -> tuple[float, ...]:
    """Return the covariance of the powers of channels 0, 1, ... apart.

    Parameters
    ----------
    taps : int
        Number of frames that a spectrum is made of: 1 is a windowed Fourier transform; 0 stands for
        channels that share nothing.
    taper : {"rectangular", "hann", "hamming", "blackman"}

    Returns
    -------
    tuple of float
        In units of the variance of independent frames in independent channels; the first is above
        one where frames overlap.

    Raises
    ------
    InputError
        For fewer taps than none.
    """
    if taps < 0:
        raise InputError(f"a filter bank has no {taps} taps; give 0 for independent channels")
    if taps == 0:
        return (1.0,)
    h = impulse_response(taps, taper)
    found = np.zeros(REACH + 1)
    for shift in range(-taps + 1, taps):
        overlap = np.zeros_like(h)
        if shift >= 0:
            overlap[shift * FRAME :] = h[shift * FRAME :] * h[: len(h) - shift * FRAME]
        else:
            overlap[: shift * FRAME] = h[: shift * FRAME] * h[-shift * FRAME :]
        # frames fold onto one: exp(2 pi i d n / N) has their period
        folded = overlap.reshape(taps, FRAME).sum(axis=0)
        found += np.abs(np.fft.fft(folded)[: REACH + 1]) ** 2
    return tuple((found / (h @ h) ** 2).tolist())


def impulse_response(taps: int, taper: Taper) -> Float[np.ndarray, " samples"]:
    """Return h: a window, times the sinc of one channel where there are several taps."""
    n = taps * FRAME
    t = (np.arange(n) + 0.5) / n
    window = sum(c * np.cos(2.0 * np.pi * j * t) for j, c in enumerate(WINDOWS[taper]))
    return window * np.sinc((t - 0.5) * taps) if taps > 1 else window
