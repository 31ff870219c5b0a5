"""Beams of one's own: known in directions of a grid or of HEALPix pixels, at some frequencies.

Either E_theta and E_phi of every antenna, or the beam of every product. Frame: topocentric at
turntable angle zero, theta from the zenith, phi from East towards North; time goes as exp(+i w t).
Nothing is received from below the horizon.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Complex, Float

from lusee_bayes.core.checks import Described, listed
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.layouts import require_mhz
from lusee_bayes.instrument.beams.fields import AntennaFields
from lusee_bayes.instrument.beams.grid import HemisphereGrid
from lusee_bayes.instrument.beams.gridded import at_frequency
from lusee_bayes.instrument.beams.product_beams import ProductBeams, stokes_beam
from lusee_bayes.instrument.beams.sampling import Directions
from lusee_bayes.instrument.products import auto_indices, to_matrix, to_real


@dataclass(frozen=True, repr=False)
class SampledBeams(Described):
    """Fields of antennas, or beams of products, in directions of a grid or of HEALPix pixels.

    :func:`sampled_beams` makes them of arrays.

    Attributes
    ----------
    frequencies_mhz : (frequencies,) array
        Growing.
    directions : Directions
        What the last axes of the arrays are.
    e_theta, e_phi : (frequencies, antennas, ...) complex array or None
        Response to the theta and phi components of the incident field.
    products : (frequencies, products, ...) array or None
        The beam of every real product, in place of the fields.
    absolute : bool
        Whether B_k = V_k for a source of 1 K sr: the scale is that of the data in K. Otherwise the
        autos are scaled to integrate to one on average.
    path : str
        Where they come from, for messages.
    """

    frequencies_mhz: Float[np.ndarray, " frequencies"]
    directions: Directions
    e_theta: Complex[np.ndarray, "frequencies antennas *directions"] | None = None
    e_phi: Complex[np.ndarray, "frequencies antennas *directions"] | None = None
    products: Float[np.ndarray, "frequencies products *directions"] | None = None
    absolute: bool = False
    path: str = "the beams"

    def description(self) -> tuple[str, ...]:
        kind = "E fields of" if self.products is None else "product beams of"
        scale = "K per K" if self.absolute else "to be scaled so that autos integrate to one"
        return (
            f"{kind} {self.n_ports} antennas, {self.directions.text}",
            f"at {listed(tuple(f'{f:g}' for f in self.frequencies_mhz))} MHz; {scale}",
        )

    @property
    def n_ports(self) -> int:
        """Number of antennas."""
        if self.products is None:
            return self.e_theta.shape[1]
        return round(np.sqrt(self.products.shape[1]))

    def fields(
        self, frequency_mhz: float, grid: HemisphereGrid, turn_deg: float = 0.0
    ) -> AntennaFields:
        """Return the fields on a grid.

        Parameters
        ----------
        frequency_mhz : float
        grid : HemisphereGrid
        turn_deg : float
            How far the antennas are turned, from East towards North.

        Returns
        -------
        AntennaFields

        Raises
        ------
        InputError
            Outside the frequencies, or for beams of products.
        """
        if self.products is not None:
            raise InputError(
                f"{self.path} has beams of products, not the E fields of antennas, which this needs"
            )
        e_theta, e_phi = at_frequency(
            self.path,
            self.frequencies_mhz,
            frequency_mhz,
            self.e_theta,
            self.e_phi,
            interpolation="spline",
        )
        fields = self.directions.vectors_on(e_theta, e_phi, grid, turn_deg)
        return AntennaFields(*fields, grid)

    def patterns(
        self, frequency_mhz: float, grid: HemisphereGrid, turn_deg: float = 0.0
    ) -> Complex[np.ndarray, "antennas antennas theta phi"]:
        """Return the response of every pair to Stokes I on a grid; arguments as of :meth:`fields`.

        Raises
        ------
        InputError
            Outside the frequencies.
        """
        if self.products is None:
            return np.asarray(stokes_beam(self.fields(frequency_mhz, grid, turn_deg)))
        (beams,) = at_frequency(
            self.path, self.frequencies_mhz, frequency_mhz, self.products, interpolation="spline"
        )
        return to_matrix(self.directions.scalars_on(beams, grid, turn_deg))

    def beams(
        self,
        frequency_mhz: float,
        lmax: int,
        *,
        turn_deg: float = 0.0,
        normalise: bool | None = None,
    ) -> ProductBeams:
        """Return the beams of all products.

        Parameters
        ----------
        frequency_mhz : float
        lmax : int
        turn_deg : float
            How far the antennas are turned, from East towards North.
        normalise : bool, optional
            Scale them so that autos integrate to one on average; by default unless they are
            absolute.

        Returns
        -------
        ProductBeams
            In K per K.

        Raises
        ------
        InputError
            Outside the frequencies, or if autos that are to be scaled do not integrate to anything
            positive.
        """
        grid = self.directions.quadrature(lmax)
        patterns = to_real(self.patterns(frequency_mhz, grid, turn_deg))
        if not self.absolute if normalise is None else normalise:
            scale = float(grid.integrate(patterns[auto_indices(self.n_ports)]).mean())
            if not scale > 0.0:
                raise InputError(
                    f"{self.path}: the autos integrate to {scale:g} sr on average above the "
                    "horizon, expected a positive number"
                )
            patterns = patterns / scale
        return ProductBeams(grid.modes(patterns, lmax), float(frequency_mhz))


def sampled_beams(
    frequencies_mhz: Any,
    *,
    e_theta: Any = None,
    e_phi: Any = None,
    products: Any = None,
    theta_deg: Any = None,
    phi_deg: Any = None,
    absolute: bool = False,
    path: str = "the beams",
) -> SampledBeams:
    """Make beams of arrays.

    Give either ``e_theta`` and ``e_phi``, or ``products``; either ``theta_deg`` and ``phi_deg``, or
    none of them for HEALPix pixels (RING; theta from the zenith, phi from East towards North).

    Parameters
    ----------
    frequencies_mhz : float or (frequencies,) array
        Growing. With a single number the arrays have no axis of frequencies.
    e_theta, e_phi : (frequencies, antennas, theta, phi) or (frequencies, antennas, pixels) array
        Complex response of each antenna to the theta and phi components of the incident field,
        with one phase centre for all antennas, exp(+i w t).
    products : (frequencies, products, theta, phi) or (frequencies, products, pixels) array
        Real beams of the products 00R, 01R, 01I, 02R, ..., as of :func:`.products.labels`.
    theta_deg : (theta,) array
        Growing from the zenith to the horizon, or further; what is on or below it is not used.
    phi_deg : (phi,) array
        360 k / n, k = 0 .. n - 1, from East towards North; 360 may be there, too.
    absolute : bool
        See :class:`SampledBeams`.
    path : str
        Where they come from, for messages.

    Returns
    -------
    SampledBeams

    Raises
    ------
    InputError
        If the arrays do not fit, are not finite above the horizon, or do not cover it.
    """
    known = np.atleast_1d(np.asarray(frequencies_mhz, dtype=np.float64))
    if known.ndim != 1 or not (known > 0.0).all() or not (np.diff(known) > 0.0).all():
        raise InputError(f"{path}: frequencies_mhz must be positive and grow, got {known}")
    require_mhz(f"{path}: frequencies_mhz", known)
    fields = [one for one in (e_theta, e_phi) if one is not None]
    if len(fields) not in (0, 2) or bool(fields) == (products is not None):
        raise InputError(f"{path}: give e_theta and e_phi, or products")
    given = {"products": products} if products is not None else {"e_theta": e_theta, "e_phi": e_phi}
    arrays = {}
    for name, values in given.items():
        kind = np.float64 if name == "products" else np.complex128
        if name == "products" and np.iscomplexobj(values):
            raise InputError(
                f"{path}: products are complex; give real and imaginary parts as 01R, 01I, ..."
            )
        arrays[name] = np.asarray(values, dtype=kind)
        arrays[name] = arrays[name][None] if np.ndim(frequencies_mhz) == 0 else arrays[name]
    shape = next(iter(arrays.values())).shape
    directions = Directions.of(theta_deg, phi_deg, shape[2:], path)
    for name, values in arrays.items():
        if values.shape != shape or len(values) != len(known):
            raise InputError(
                f"{path}: {name} has shape {values.shape}, expected frequencies ({len(known)}) x "
                f"{'products' if name == 'products' else 'antennas'} x {directions.text}, and the "
                "same for all arrays"
            )
        arrays[name] = directions.above(values, f"{path}: {name}")
    n = round(np.sqrt(shape[1]))
    if products is not None and n * n != shape[1]:
        raise InputError(
            f"{path}: {shape[1]} products do not come from any number of antennas; expected "
            "1, 4, 9, 16, ..."
        )
    return SampledBeams(known, directions, **arrays, absolute=absolute, path=path)
