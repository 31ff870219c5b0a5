"""The sky and data with bad times: m ~ N(0, S), d_t ~ N((A m)_t, N_t / w_t), w_t integrated out.

The data of every time are a multivariate Student-t: a burst gets a small weight w_t, and needs no
flag. ``weight`` (times), kept with the draws, is what each time counts for: about 1 where the data
fit, 1e-3 where they are 30 sigma off.
"""

import numpyro

import lusee_bayes as lb

# nu is fixed: a few strong bursts would pull it down to about 2, and with it the weights of the
# good times towards chance
FREEDOM = 4.0


def model(gaussian, systematics, layout, data=None):
    """``gaussian``: N without ``systematics``, which must not couple different times."""
    for systematic in systematics:
        gaussian = systematic.sampled(gaussian)
    sky = numpyro.sample("sky", lb.SkyPrior(gaussian.prior))
    seen = lb.TimesStudentT(gaussian.predict(sky), gaussian.noise, layout, FREEDOM)
    data = numpyro.sample("data", seen, obs=data)
    numpyro.deterministic("weight", seen.weights(data))
