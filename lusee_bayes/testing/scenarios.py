"""Small scenarios that tests share."""

from __future__ import annotations

from lusee_bayes.experiment.scenario import Scenario, load_scenario


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
