"""The spectrometer: its channels, its products, and how long a spectrum is integrated.

Facts from the flight software (lusee-night/coreloop: ``high_prec_avg.h``, ``core_loop.h``) and from
luseepy's ``lusee.ingest``. ADCs of 14 bits take 102.4 million samples a second, of which 4096 make
a spectrum of 2048 channels, 25 kHz apart, every 40 microseconds.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from lusee_bayes.core.errors import InputError
from lusee_bayes.instrument.products import labels

N_CHANNELS = 2048
CHANNEL_MHZ = 0.025
FRAME_S = 4096 / 102.4e6
# the ends of what an ADC of 14 bits gives
ADC_LOW, ADC_HIGH = -8192, 8191
# gain states of the flight software (gain_state of core_loop.h) that the gain table knows
LEVELS = {0: "L", 1: "M", 2: "H"}
NO_LEVEL = "-"
PORTS = 4

# autos of the four ports, then real and imaginary part of every pair
FLIGHT_PRODUCTS = (
    *(f"{i}{i}R" for i in range(PORTS)),
    *(f"{i}{j}{part}" for i in range(PORTS) for j in range(i + 1, PORTS) for part in "RI"),
)
# where the products of the package's order are in the spectrometer's
OF_FLIGHT = np.array([FLIGHT_PRODUCTS.index(label) for label in labels()])

BinOrigin = Literal["centre", "edge"]


@dataclass(frozen=True)
class Averaging:
    """Which channels a bin of a spectrum holds, for a value of ``Navgf``.

    Attributes
    ----------
    stride : int
        Bin i begins at channel stride * i.
    members : int
        So many channels from there on are summed.
    divisor : int
        What the sum is divided by.
    """

    stride: int
    members: int
    divisor: int

    @property
    def n_bins(self) -> int:
        """Number of bins."""
        return N_CHANNELS // self.stride

    def channels(self) -> Int[np.ndarray, "bins members"]:
        """Return the channels of every bin."""
        return self.stride * np.arange(self.n_bins)[:, None] + np.arange(self.members)


# of Navgf = 3, which leaves out every fourth channel, the sum of three is divided by four
AVERAGING = {
    1: Averaging(1, 1, 1),
    2: Averaging(2, 2, 2),
    3: Averaging(4, 3, 4),
    4: Averaging(4, 4, 4),
}


def averaging(where: str, navgf: int) -> Averaging:
    """Return which channels the bins hold. InputError, beginning with ``where``, for no Navgf."""
    if navgf not in AVERAGING:
        raise InputError(
            f"{where}: Navgf is {navgf}; the flight software has {', '.join(map(str, AVERAGING))}"
        )
    return AVERAGING[navgf]


def channel_mhz(origin: BinOrigin) -> Float[np.ndarray, " channels"]:
    """Return the middle of every channel in MHz.

    Parameters
    ----------
    origin : {"centre", "edge"}
        Whether channel k has its centre or its lower edge at k times 25 kHz.
    """
    return CHANNEL_MHZ * (np.arange(N_CHANNELS) + (0.5 if origin == "edge" else 0.0))
