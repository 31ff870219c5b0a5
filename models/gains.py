"""Sky and gain drifts together: d = (1 + g_i(t)) (1 + g_j(t)) (A m)_ij + n, exactly.

The drifts are Gaussian processes g_i = sigma_g h_i built from white noise (site ``gain_noise``);
``gains`` (antennas, times) is stored with the draws.
"""

import numpyro

import lusee_bayes as lb


def model(gaussian, gain_drifts, data=None):
    """``gaussian``: A, S and N without the drifts; needs noise.gain.treatment=sampled."""
    drift = gain_drifts.scales()  # samples gain_sigma, gain_correlation_h where uncertain
    response = gain_drifts.response(gain_drifts.histories(drift))
    sky = numpyro.sample("sky", lb.SkyPrior(gaussian.prior))
    seen = response * gaussian.predict(sky)
    numpyro.sample("data", lb.CorrelatedNormal(seen, gaussian.noise), obs=data)
