"""What tests share: one contract for each protocol, which every kind of it has to pass.

Extensions can use them, too.
"""

from lusee_bayes.testing.cases import small_scenario as small_scenario
from lusee_bayes.testing.checks import assert_refused as assert_refused
from lusee_bayes.testing.checks import check_beam_source as check_beam_source
from lusee_bayes.testing.checks import check_coupling as check_coupling
from lusee_bayes.testing.checks import check_covariance as check_covariance
from lusee_bayes.testing.checks import check_prior as check_prior
from lusee_bayes.testing.checks import check_sky_source as check_sky_source
from lusee_bayes.testing.checks import check_slopes as check_slopes
