"""Ground, antennas and map from one run: the sky is integrated out for every beam.

Adapt the names and priors to your question. ``instrument.coupling`` accepts every parameter of the
embedded antennas, or of a grid of beam files (docs/files.md).
"""

import numpyro
from numpyro import distributions as dist

import lusee_bayes as lb


def model(instrument, gaussian, data=None):
    """``gaussian``: S and N; the sampled antennas' A replaces its A."""
    values = {
        "surface_permittivity": dist.Uniform(2.5, 5.0),
        "deep_permittivity": dist.Uniform(5.0, 8.0),
        "loss_tangent": dist.LogUniform(1e-3, 1e-1),
        "zenith_angle_deg": dist.Normal(instrument.value("zenith_angle_deg"), 2.0),
    }
    values = {name: numpyro.sample(name, prior) for name, prior in values.items()}
    level = numpyro.sample("noise_level", dist.LogNormal(0.0, 0.5))
    gaussian = lb.LinearGaussian(
        instrument.coupling(values), gaussian.prior, gaussian.noise.scaled(level), gaussian.offset
    )
    numpyro.sample("data", lb.Marginal(gaussian), obs=data)
    return gaussian
