"""Priors by name, for a comparison under which of them data are most probable."""

from __future__ import annotations

from collections.abc import Sequence

from lusee_bayes.core.errors import InputError, nearest
from lusee_bayes.experiment.scenario import Scenario
from lusee_bayes.experiment.schema import (
    IsotropicPriorSection,
    LocalScalesPriorSection,
    PriorSection,
)

# takes C_ell of the scenario's sky, which only simulations know
OF_TRUE_SKY = "isotropic-sky"
NAMED: dict[str, PriorSection] = {
    "isotropic": IsotropicPriorSection(),
    OF_TRUE_SKY: IsotropicPriorSection(spectrum="sky"),
    "local_scales": LocalScalesPriorSection(),
}


def named_priors(
    names: Sequence[str] | None, scenario: Scenario, *, known_sky: bool
) -> dict[str, PriorSection]:
    """Find the sections of priors.

    The scenario's own section is taken where it is of the kind that is named, so that a template
    or an amplitude of its own counts.

    Parameters
    ----------
    names : sequence of str or None
        Two or more of ``isotropic`` (C_ell learned), ``isotropic-sky`` (that of the scenario's
        sky) and ``local_scales``; None for all that can be.
    scenario : Scenario
    known_sky : bool
        Whether the data are of the scenario's sky.

    Raises
    ------
    InputError
        For an unknown name, one that is given twice, fewer than two, and ``isotropic-sky`` where
        the sky is not known.
    """
    if names is None:
        names = [name for name in NAMED if known_sky or name != OF_TRUE_SKY]
    for name in names:
        if name not in NAMED:
            raise InputError(f"--priors: no prior '{name}'; {nearest(name, NAMED)}")
    if len(set(names)) < len(names):
        raise InputError(f"--priors {','.join(names)}: give each prior once")
    if len(names) < 2:
        raise InputError(
            f"--priors: {len(names)} given, and a comparison needs two or more of "
            f"{', '.join(NAMED)}"
        )
    if OF_TRUE_SKY in names and not known_sky:
        raise InputError(
            f"--priors: {OF_TRUE_SKY} takes C_ell of the scenario's sky, which nobody knows of "
            "measured data; leave it out, or give --truth if the data are of that sky"
        )
    return {name: _section(NAMED[name], scenario.prior) for name in names}


def _section(named: PriorSection, own: PriorSection) -> PriorSection:
    """The scenario's own section if it is of the kind of a named one."""
    if own.model != named.model:
        return named
    # isotropic priors differ in where C_ell comes from
    return own if own.model != "isotropic" or own.origin == named.origin else named
