"""Sky and data with bad times: m ~ N(0, S), d_t ~ N((A m)_t, N_t / w_t), w_t integrated out.

The data of every time follow a multivariate Student-t: a burst gets a small weight w_t and needs no
flag. ``weight`` (times), stored with the draws, is the weight of each time: about 1 where the data
fit, 1e-3 where they deviate by 30 sigma.
"""

import numpyro

import lusee_bayes as lb
from lusee_bayes.sampling.distributions import TimesStudentT

# nu is fixed: a few strong bursts would pull it down to about 2, and make the weights of good times
# nearly random
FREEDOM = 4.0


def model(gaussian, systematics, layout, data=None):
    """``gaussian``: N without ``systematics``, which must not couple different times."""
    for systematic in systematics:
        gaussian = systematic.sampled(gaussian)
    sky = numpyro.sample("sky", lb.SkyPrior(gaussian.prior))
    seen = TimesStudentT(gaussian.predict(sky), gaussian.noise, layout, FREEDOM)
    data = numpyro.sample("data", seen, obs=data)
    numpyro.deterministic("weight", seen.weights(data))
