"""A as a function of the antennas' parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import equinox as eqx
from jaxtyping import Float

from lusee_bayes.core.arrays import Array
from lusee_bayes.core.errors import InputError
from lusee_bayes.instrument.beams.fields import ProductBeams
from lusee_bayes.instrument.beams.monopoles import Monopoles, monopole_beams, parameter, with_values
from lusee_bayes.instrument.coupling import BeamOperator, CouplingMatrix
from lusee_bayes.instrument.pointing import Pointing
from lusee_bayes.instrument.products import DataLayout


class Instrument(eqx.Module):
    """Antennas whose parameters may change, with everything else that A is made of.

    Attributes
    ----------
    monopoles : Monopoles
        The antennas and the ground, with the present values of all parameters.
    pointing : Pointing
        The orientations at every sample.
    layout : DataLayout
        The product and the time of every row of A.
    frequency_mhz : float
        In MHz.
    lmax : int
        Highest ell of the beams and the sky.
    nodes : (int, int) or None
        Of the grid on which beams are computed; see ``monopole_beams``.
    operator : BeamOperator or None
        The rotations of all samples, computed by :meth:`prepared`.
    """

    monopoles: Monopoles
    pointing: Pointing
    layout: DataLayout
    frequency_mhz: float = eqx.field(static=True)
    lmax: int = eqx.field(static=True)
    nodes: tuple[int, int] | None = eqx.field(static=True, default=None)
    operator: BeamOperator | None = None

    def prepared(self) -> Instrument:
        """Compute the rotations of all samples, as :meth:`dense` needs them.

        Returns
        -------
        Instrument
            The same with its operator.
        """
        return replace(self, operator=BeamOperator.of(self.pointing, self.layout))

    def value(self, name: str) -> Float[Array, ""]:
        """Look up the present value of a parameter.

        Parameters
        ----------
        name : str
            One of ``beams.PARAMETERS``.

        Returns
        -------
        () array
            In the unit that the name ends with.

        Raises
        ------
        InputError
            If there is no such parameter; the message names the nearest.
        """
        return parameter(name).where(self.monopoles)

    def beams(self, values: Mapping[str, Float[Array, ""]] | None = None) -> ProductBeams:
        """Compute the beams of all products.

        Parameters
        ----------
        values : mapping of str to () array, optional
            Values of some parameters (``beams.PARAMETERS``); the others keep theirs.

        Returns
        -------
        ProductBeams
            Up to ``lmax``; differentiable in the values.

        Raises
        ------
        InputError
            If there is no parameter of that name.
        """
        antennas = with_values(self.monopoles, values or {})
        return monopole_beams(self.frequency_mhz, self.lmax, antennas, nodes=self.nodes)

    def dense(self, values: Mapping[str, Float[Array, ""]]) -> Float[Array, "data modes"]:
        """Compute A as a matrix, of a :meth:`prepared` instrument.

        Parameters
        ----------
        values : mapping of str to () array
            Values of some parameters (``beams.PARAMETERS``); the others keep theirs.

        Returns
        -------
        (data, modes) array
            Differentiable in the values.

        Raises
        ------
        InputError
            If the instrument was not prepared, or there is no parameter of that name.
        """
        if self.operator is None:
            raise InputError("prepare the instrument first: instrument = instrument.prepared()")
        return self.operator.coupling(self.beams(values))

    def coupling_of(self, beams: ProductBeams) -> CouplingMatrix:
        """Compute A of given beams, or dA of a difference of beams.

        Parameters
        ----------
        beams : ProductBeams
            Up to the instrument's lmax.

        Returns
        -------
        CouplingMatrix
            For the instrument's orientations and layout.

        Raises
        ------
        InputError
            If the beams have another lmax or other products.
        """
        return CouplingMatrix.build(beams, self.pointing, self.layout)
