"""Amplitudes of templates that are part of the noise, as point sources' fluxes are.

With N = N_0 + T T^T, an amplitude of each column of T is N(0, 1) before there are data. With
K = A S A^T + N the covariance of data under the model, and C that of the sky, ::

    mean = T^T K^-1 (d - offset) = T^T N^-1 (d - offset - A m),    m the posterior mean of the sky,
    covariance = 1 - T^T K^-1 T = 1 - T^T N^-1 T + P C P^T,        P = T^T N^-1 A,
    Cov(m, amplitudes) = -S A^T K^-1 T = -C P^T.

A is not formed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from lusee_bayes.core.arrays import Array, on_host
from lusee_bayes.linear.model import LinearGaussian
from lusee_bayes.linear.posterior import Posterior


@dataclass(frozen=True)
class Amplitudes:
    """Posterior of templates' amplitudes in prior standard deviations, the sky integrated out.

    Attributes
    ----------
    mean : (n,) array
    covariance : (n, n) array
        The unit matrix where the data say nothing.
    with_sky : (modes, n) array
        Covariance of the sky with the amplitudes, in K.
    """

    mean: Float[np.ndarray, " n"]
    covariance: Float[np.ndarray, "n n"]
    with_sky: Float[np.ndarray, "modes n"]

    @property
    def std(self) -> Float[np.ndarray, " n"]:
        """Standard deviations."""
        return np.sqrt(np.diagonal(self.covariance))


@dataclass(frozen=True)
class AmplitudesOfSky:
    """Posterior of templates' amplitudes given the data and a sky, in prior standard deviations.

    ::

        mean = T^T N^-1 (d - offset - A m0) - P (m - m0),    covariance = 1 - T^T N^-1 T

    of a sky m. Other data may tell of the sky, too, where they have amplitudes of their own: these
    hold under any posterior of the sky.

    Attributes
    ----------
    mean : (n,) array
        Of the reference sky.
    pull : (n, modes) array
        P, in 1/K.
    covariance : (n, n) array
    reference : (modes,) array
        The reference sky m0, in K.
    """

    mean: Float[np.ndarray, " n"]
    pull: Float[np.ndarray, "n modes"]
    covariance: Float[np.ndarray, "n n"]
    reference: Float[np.ndarray, " modes"]

    def integrated(
        self, mean: Float[np.ndarray, " modes"], covariance: Float[np.ndarray, "modes modes"]
    ) -> Amplitudes:
        """Integrate a sky N(mean, covariance) out, in K and K^2: given any data besides."""
        with_sky = -covariance @ self.pull.T
        return Amplitudes(
            self.mean - self.pull @ (mean - self.reference),
            self.covariance - self.pull @ with_sky,
            with_sky,
        )

    def given(
        self, precision: Float[np.ndarray, "n n"], vector: Float[np.ndarray, " n"]
    ) -> AmplitudesOfSky:
        """Take in what is known of the amplitudes besides: exp(-z^T Q z / 2 + q^T z).

        Parameters
        ----------
        precision : (n, n) array
            Q.
        vector : (n,) array
            q.
        """
        kept = np.linalg.inv(np.eye(len(vector)) + self.covariance @ precision)
        covariance = kept @ self.covariance
        return AmplitudesOfSky(
            self.mean + covariance @ (vector - precision @ self.mean),
            kept @ self.pull,
            covariance,
            self.reference,
        )


def amplitudes_of_sky(
    model: LinearGaussian,
    reference: Float[Array, " modes"],
    data: Float[Array, " data"],
    templates: Float[Array, "data n"],
) -> AmplitudesOfSky:
    """Compute the posterior of templates' amplitudes given the sky.

    Parameters
    ----------
    model : LinearGaussian
        With ``templates @ templates.T`` in its noise.
    reference : (modes,) array
        A sky near the one that is meant, in K: differences from it keep their digits.
    data : (data,) array
        d, in K.
    templates : (data, n) array
        T, in K.

    Raises
    ------
    InputError
        If N is not positive definite.
    """
    model, reference, data, t = on_host((model, reference, data, templates))
    solved = np.asarray(model.noise.factor().solve(t))
    pull = np.stack([np.asarray(model.coupling.transpose_mv(column)) for column in solved.T])
    return AmplitudesOfSky(
        solved.T @ (data - np.asarray(model.predict(reference))),
        pull,
        np.eye(t.shape[1]) - t.T @ solved,
        np.asarray(reference),
    )


def template_amplitudes(
    model: LinearGaussian,
    posterior: Posterior,
    data: Float[Array, " data"],
    templates: Float[Array, "data n"],
) -> Amplitudes:
    """Compute the posterior of templates' amplitudes.

    Parameters
    ----------
    model : LinearGaussian
        With ``templates @ templates.T`` in its noise.
    posterior : Posterior
        Of this model, given these data alone.
    data : (data,) array
        d, in K.
    templates : (data, n) array
        T, in K.

    Raises
    ------
    InputError
        As :meth:`Posterior.covariance`, and if N is not positive definite.
    """
    posterior = on_host(posterior)
    found = amplitudes_of_sky(model, posterior.mean, data, templates)
    return found.integrated(np.asarray(posterior.mean), np.asarray(posterior.covariance()))


def weighted_residual(
    model: LinearGaussian, posterior: Posterior, data: Float[Array, " data"]
) -> Float[np.ndarray, " data"]:
    """Compute N^-1 (d - offset - A m), m the posterior mean of the sky.

    T^T of it is the mean of amplitudes, and a term N_0 of N times it that of its part in the data.

    Parameters
    ----------
    model : LinearGaussian
    posterior : Posterior
        Of this model, given these data alone.
    data : (data,) array
        d, in K.

    Raises
    ------
    InputError
        If N is not positive definite.
    """
    model, posterior, data = on_host((model, posterior, data))
    residual = data - np.asarray(model.predict(posterior.mean))
    return np.asarray(model.noise.factor().solve(residual))
