"""Errors of the gain table."""

from __future__ import annotations

from dataclasses import replace

import jax
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from lusee_bayes.core.arrays import Array
from lusee_bayes.core.errors import InputError
from lusee_bayes.experiment.scenario import Scenario
from lusee_bayes.experiment.setup import Setup
from lusee_bayes.experiment.terms.term import Around, Term, Truth
from lusee_bayes.instrument.layout import DataLayout
from lusee_bayes.systematics import GAIN_TABLE, GainTable, Systematic, TableErrors

# what the scenario's seed is folded with
DRAW = 10
# standard deviation of a port's power gain: 1 + eps is then positive by ten of them
LARGEST = 0.1


class GainTableTerm(Term):
    """``noise.gain_table``; simulated data hold drawn errors, in prior standard deviations."""

    key = "noise.gain_table"
    remedy = "noise.gain_table.treatment=sampled"

    def moves(self, scenario: Scenario) -> bool:
        section = scenario.noise.gain_table
        return section is not None and section.treatment != "ignored"

    def build(self, setup: Setup, around: Around) -> list[tuple[str, Systematic]]:
        if not self.moves(setup.scenario):
            return []
        errors = table_errors(setup)
        centre = _centre(errors, around)
        seen = around.seen
        if seen is None:
            # those of some sky: what gains make of the data is none, and to first order would be
            # explained by gains that take all of the data away
            seen = setup.layout.gather(setup.signal)
        treatment = setup.scenario.noise.gain_table.treatment
        return [(treatment, GainTable(errors, centre, np.asarray(seen), around.freedom))]

    def truth(self, setup: Setup, key: PRNGKeyArray) -> Truth:
        if setup.scenario.noise.gain_table is None:
            return {}
        shape = (len(table_errors(setup).names),)
        return {GAIN_TABLE: np.asarray(jax.random.normal(jax.random.fold_in(key, DRAW), shape))}

    def distort(
        self,
        visibilities: Float[Array, "products times"],
        setup: Setup,
        truth: Truth,
        key: PRNGKeyArray,
    ) -> Float[Array, "products times"]:
        if setup.scenario.noise.gain_table is None:
            return visibilities
        whole = DataLayout(setup.layout.n_products, setup.layout.n_times)
        errors = replace(table_errors(setup), layout=whole)
        return visibilities * whole.scatter(errors.factors(np.asarray(truth[GAIN_TABLE])))


def table_errors(setup: Setup) -> TableErrors:
    """The errors that the data name, or one for each port.

    Raises
    ------
    InputError
        If the scenario and the data both say how large they are, or none of them, and for errors
        of more than 10 %.
    """
    std, calibration = setup.scenario.noise.gain_table.std, setup.calibration
    named = calibration is not None and calibration.gain_slope is not None
    if named and std is not None:
        raise InputError(
            "the data say the errors of their gain table themselves; leave out noise.gain_table.std"
        )
    if not named:
        if std is None and setup.scenario.flight is not None:
            # what it says of every level of every port: these data have one
            std = setup.scenario.flight.gain_std
            if std is not None and std > LARGEST:
                raise InputError(
                    f"flight.gain_std is {std:g}, and power gains that are off by more than "
                    f"{LARGEST:g} of themselves are not modelled; give a smaller "
                    "noise.gain_table.std for simulated data"
                )
        if std is None:
            raise InputError(
                "the data say nothing of a gain table; give noise.gain_table.std, the relative "
                "error of every port's power gain"
            )
        ports = tuple(range(setup.beam_source.n_ports))
        slope = np.full((len(ports), setup.layout.n_times), std)
        return TableErrors(tuple(f"gain_{port}" for port in ports), ports, slope, setup.layout)
    # of levels that no port has at these times the data say nothing
    used = np.flatnonzero(calibration.gain_slope.any(1))
    port, slope = calibration.gain_port[used], calibration.gain_slope[used]
    for number in np.unique(port):
        total = float(np.sqrt((slope[port == number] ** 2).sum(0)).max())
        if total > LARGEST:
            raise InputError(
                f"the data say that the power gain of port {number} is known to {total:.2g} of "
                f"itself, expected at most {LARGEST:g}; noise.gain_table.treatment=ignored takes "
                "it as it is"
            )
    names = tuple(f"gain_{calibration.gain_names[k].replace(' ', '_')}" for k in used)
    return TableErrors(names, tuple(port.tolist()), slope, setup.layout)


def table_factors(setup: Setup, around: Around) -> Float[np.ndarray, " data"] | None:
    """Gains of the errors that terms of N are built around; None where these are none."""
    if not around.values or not GainTableTerm().moves(setup.scenario):
        return None
    errors = table_errors(setup)
    centre = _centre(errors, around)
    return np.asarray(errors.factors(centre)) if centre.any() else None


def _centre(errors: TableErrors, around: Around) -> Float[np.ndarray, " errors"]:
    values = around.values or {}
    return np.array([values.get(name, 0.0) for name in errors.names]) / errors.stds
