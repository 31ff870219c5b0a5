"""Contracts for tests: one for each protocol, which every implementation must pass.

Extensions can use them, too.
"""

from lusee_bayes.testing.contracts import assert_refused as assert_refused
from lusee_bayes.testing.contracts import check_beam_source as check_beam_source
from lusee_bayes.testing.contracts import check_coupling as check_coupling
from lusee_bayes.testing.contracts import check_covariance as check_covariance
from lusee_bayes.testing.contracts import check_prior as check_prior
from lusee_bayes.testing.contracts import check_sky_source as check_sky_source
from lusee_bayes.testing.scenarios import small_scenario as small_scenario
