"""Errors of a gain table: factors of the visibilities.

With eps_i(t) = sum_e z_e s_e(t) over the errors e of port i, z ~ N(0, 1), the relative error of
port i's power gain, the data are ::

    d = F(z) v + n,    F_ij = sqrt((1 + eps_i)(1 + eps_j)),    v = A m + all other signals,

For errors of 1 %, terms beyond first order (1e-4) are ten times the radiometer noise, unless the
expansion is about values and a sky that the data determine: then it is the Gaussian about the joint
mode of all unknowns.
"""

from typing import Annotated

import equinox as eqx
import numpy as np
from jaxtyping import Float
from pydantic import Field

from lusee_bayes.core.arrays import Array, DataVector, Vector, namespace
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.section import NOT_TINY, Section, Treatment
from lusee_bayes.instrument.products import DataLayout, ports
from lusee_bayes.systematics.context import Around, Setup
from lusee_bayes.systematics.systematic import Systematic, Unknown, multiplied

# the site of the errors, in prior standard deviations
GAIN_TABLE = "gain_table"
# largest standard deviation of a port's power gain: 1 + eps = 0 is then ten of them away
LARGEST = 0.1
# the common part of all errors, in words
COMMON_GAIN = "common gain"


class GainTableSection(Section):
    """Errors of the gain table, shared by all spectra at one level of one port.

    Attributes
    ----------
    std : float
        Relative prior standard deviation of every port's power gain, used if neither the data nor
        ``flight.gain_std`` specifies the errors of the gain table.
    treatment : {"marginalised", "sampled", "ignored"}
        Add their covariance to N to first order about their iterative estimate, sample them with
        the map, or leave them out of the model.
    """

    std: Annotated[float, Field(gt=0, le=LARGEST), NOT_TINY] | None = None
    treatment: Treatment = "marginalised"


class GainTable(Systematic):
    """Errors of the gain table with independent Gaussian priors, in prior standard deviations.

    Attributes
    ----------
    errors : tuple of str
        Their names.
    port : tuple of int
        The port of each.
    slope : (errors, times) array
        Relative change of the port's power gain per prior standard deviation.
    layout : DataLayout
        The data.
    """

    key, section, words, draw = "noise.gain_table", GainTableSection, "the gain table", 10
    changes_coupling, moves, scales_sky = False, True, True

    errors: tuple[str, ...] = eqx.field(static=True)
    port: tuple[int, ...] = eqx.field(static=True)
    slope: Float[Array, "errors times"]
    layout: DataLayout

    @classmethod
    def build(cls, section: GainTableSection, setup: Setup, around: Around) -> "GainTable":
        """Use the errors that the data name, or one for each port.

        Raises
        ------
        InputError
            If both the scenario and the data specify the errors, or neither does, and for errors
            above 10 %.
        """
        std, calibration = section.std, setup.calibration
        named = calibration is not None and calibration.gain_slope is not None
        if named and std is not None:
            wrong = "the data contain the errors of their gain table; remove noise.gain_table.std"
            raise InputError(wrong)
        if not named:
            if std is None and setup.scenario.flight is not None:
                # it applies to every level of every port: these data have one level
                std = setup.scenario.flight.gain_std
                if std is not None and std > LARGEST:
                    raise InputError(
                        f"flight.gain_std is {std:g}, but relative errors of power gains above "
                        f"{LARGEST:g} are not modelled; give a smaller noise.gain_table.std"
                    )
            if std is None:
                why = "the data contain no gain table; give noise.gain_table.std, a relative error"
                raise InputError(why)
            n_ports = setup.beam_source.n_ports
            slope = np.full((n_ports, setup.layout.n_times), std)
            names = tuple(f"gain_{port}" for port in range(n_ports))
            return cls(names, tuple(range(n_ports)), slope, setup.layout)
        # the data do not constrain levels that no port has at these times
        used = np.flatnonzero(calibration.gain_slope.any(1))
        port, slope = calibration.gain_port[used], calibration.gain_slope[used]
        for number in np.unique(port):
            if (total := float(np.sqrt((slope[port == number] ** 2).sum(0)).max())) > LARGEST:
                raise InputError(
                    f"the data give the power gain of port {number} an error of {total:.0%}, not "
                    f"at most {LARGEST:.0%}; noise.gain_table.treatment=ignored treats it as exact"
                )
        names = tuple(f"gain_{calibration.gain_names[k].replace(' ', '_')}" for k in used)
        return cls(names, tuple(port.tolist()), slope, setup.layout)

    @property
    def unknowns(self) -> tuple[Unknown, ...]:
        return (Unknown(GAIN_TABLE, size=len(self.errors)),)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the errors."""
        return self.errors

    @property
    def stds(self) -> Vector:
        """Prior standard deviations of the power gains, relative: rms over the times of each."""
        slope = np.asarray(self.slope)
        return np.sqrt((slope**2).sum(1) / (slope != 0).sum(1))

    def like_the_sky(self) -> tuple[tuple[str, ...], Float[np.ndarray, "parts n"]]:
        """Their common part, along the mean power gain of all ports and times.

        Errors of single ports and levels do not look like a sky.
        """
        along = np.asarray(self.slope).mean(1)
        common = along / max(float(np.linalg.norm(along)), np.finfo(np.float64).tiny)
        return (COMMON_GAIN,), common[None]

    def factors(self, z: Float[Array, " errors"]) -> DataVector:
        """Compute F of every datum from values in prior standard deviations."""
        n_ports = round(np.sqrt(self.layout.n_products))
        at_port = (np.arange(n_ports)[:, None] == np.array(self.port)[None]).astype(np.float64)
        first, second, _ = ports(n_ports)
        gains = 1.0 + at_port @ (z[:, None] * self.slope)
        return self.layout.gather(namespace(gains).sqrt(gains[first] * gains[second]))

    def effect(self, model, values):
        """Multiply by F."""
        return multiplied(model, self.factors(values[GAIN_TABLE]))
