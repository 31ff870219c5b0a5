"""Contracts for tests, one for each protocol, and a small scenario. Extensions use them, too."""

from lusee_bayes.experiment.scenario import Scenario, load_scenario
from lusee_bayes.testing.contracts import assert_refused as assert_refused
from lusee_bayes.testing.contracts import check_beam_source as check_beam_source
from lusee_bayes.testing.contracts import check_coupling as check_coupling
from lusee_bayes.testing.contracts import check_covariance as check_covariance
from lusee_bayes.testing.contracts import check_prior as check_prior
from lusee_bayes.testing.contracts import check_sky_source as check_sky_source


def small_scenario(*overrides: str, lmax: int = 6, cycles: float = 0.02) -> Scenario:
    """Return a small version of the paper's scenario: 49 modes and, by default, 96 data.

    Tests that use the same sizes share the compiled programs.

    Parameters
    ----------
    *overrides : str
        ``key.path=value``, as on the command line.
    lmax : int
        Highest ell.
    cycles : float
        Length of the observation, in lunar days.

    Returns
    -------
    Scenario
        ``fiducial`` at these sizes: the embedded Galaxy without point sources.
    """
    sizes = [f"lmax={lmax}", f"observation.runs.0.cycles={cycles}"]
    return load_scenario("fiducial", [*sizes, *overrides])
