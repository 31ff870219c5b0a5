"""Visibilities of several frequencies, as files hold them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.layouts import Attribute
from lusee_bayes.instrument.beams.gridded import SAME_FREQUENCY_MHZ
from lusee_bayes.instrument.beams.receiver import MeasuredReceiver
from lusee_bayes.instrument.layout import DataLayout
from lusee_bayes.instrument.observation import Observation
from lusee_bayes.instrument.products import N_ANTENNAS, all_products
from lusee_bayes.instrument.visibilities import Visibilities

# words of the header that both kinds of files have
SITE_AND_STEP = {
    "LUN_LONG_DEG": Attribute(low=-360.0, high=360.0),
    "LUN_LAT_DEG": Attribute(low=-90.0, high=90.0),
    "DELTAT_SEC": Attribute(low=1e-6, high=1e9),
}


@dataclass(frozen=True)
class Waterfall:
    """Visibilities of several frequencies.

    Attributes
    ----------
    path : str
        The file, for error messages.
    grid : (products, times, frequencies) array
        In K, in the package's order of products; NaN where a sample is missing.
    frequencies_mhz : (frequencies,) array
    observation : Observation
        Of instants: luseepy's simulators evaluate the sky at the times, and neither layout has
        windows.
    per_kelvin : (frequencies, ports) array or None
        V^2/Hz that 1 K makes at each port; None unless the file is in V^2/Hz.
    moon_k, antenna_k : float
        Temperatures in K of the Moon and of the antennas, whose emission the visibilities contain.
    receiver : MeasuredReceiver or None
        The receivers' loads at the channels; None unless the file holds them.
    interpolation : str or None
        How luseepy calls its interpolation of the response between channels; None if not said.
    """

    path: str
    grid: Float[np.ndarray, "products times frequencies"]
    frequencies_mhz: Float[np.ndarray, " frequencies"]
    observation: Observation
    per_kelvin: Float[np.ndarray, "frequencies ports"] | None = None
    moon_k: float = 0.0
    antenna_k: float = 0.0
    receiver: MeasuredReceiver | None = None
    interpolation: str | None = None

    def channel(self, frequency_mhz: float) -> int:
        """Return the number of the channel at a frequency.

        Raises
        ------
        InputError
            If the file has none there.
        """
        known = self.frequencies_mhz
        nearest = int(np.argmin(np.abs(known - frequency_mhz)))
        if abs(known[nearest] - frequency_mhz) > SAME_FREQUENCY_MHZ:
            raise InputError(
                f"{self.path} has no channel at {frequency_mhz:.15g} MHz (it has "
                f"{', '.join(f'{f:.9g}' for f in known)}); use --set frequency_mhz="
                f"{known[nearest]:.15g}"
            )
        return nearest

    def at(self, frequency_mhz: float, n_ports: int = N_ANTENNAS) -> Visibilities:
        """Return one channel, without the samples that are missing or not finite.

        Parameters
        ----------
        frequency_mhz : float
        n_ports : int
            Number of ports of the instrument.

        Returns
        -------
        Visibilities

        Raises
        ------
        InputError
            If the file has no such channel, has products of other ports, or nothing is left.
        """
        channel = self.channel(frequency_mhz)
        values = self.grid[:, :, channel]
        present = np.isfinite(values)
        within = np.array([p.j < n_ports for p in all_products()])
        if present[~within].any():
            first = int(np.argmax(present.any(1) & ~within))
            raise InputError(
                f"{self.path} has the product {all_products()[first].label}, but the beams are "
                f"those of {n_ports} ports; give beam.rotations_deg an angle for every port"
            )
        try:
            layout = DataLayout.from_flags(~present[within])
        except InputError as error:
            raise InputError(f"{self.path} at {frequency_mhz:g} MHz: {error}") from error
        data = layout.gather(np.where(present, values, 0.0)[within])
        return Visibilities(
            data,
            layout,
            self.observation,
            float(self.frequencies_mhz[channel]),
            receiver=self.receiver,
        )
