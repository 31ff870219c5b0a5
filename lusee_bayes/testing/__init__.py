"""What tests share: one contract for each protocol, which every kind of it has to pass.

Extensions can use them, too.
"""

from lusee_bayes.testing.beam_source import check_beam_source
from lusee_bayes.testing.coupling import check_coupling
from lusee_bayes.testing.covariance import check_covariance, check_slopes
from lusee_bayes.testing.prior import check_prior
from lusee_bayes.testing.refusals import assert_refused
from lusee_bayes.testing.scenarios import small_scenario
from lusee_bayes.testing.sky_source import check_sky_source

__all__ = [
    "assert_refused",
    "check_beam_source",
    "check_coupling",
    "check_covariance",
    "check_prior",
    "check_sky_source",
    "check_slopes",
    "small_scenario",
]
