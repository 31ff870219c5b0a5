"""The linear Gaussian model d = A m + n, and its update with new data.

It is a distribution over data, with a posterior over m, ::

    Lambda = A^T N^-1 A + S^-1,    C = Lambda^-1,    mean = C A^T N^-1 d

The posterior is computed in a map-space form, of the size of the sky, or a data-space form, of the
size of the data; :mod:`lusee_bayes.linear.solver` has the algebra of both.

A posterior is updated with new data without the old ones. With the posterior m = m1 + R z, z ~ N(0,
1), new data d = A m + offset + n are data of z, ::

    d = (A R) z + (offset + A m1) + n,

a model like any other, whose evidence is p(new data | old data). R = G L^-T comes from the saved L.
With L of the root form (solver.py) the result equals that of all data together to 1e-9 of a
standard deviation.
"""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from lusee_bayes.core.arrays import Array, DataVector, on_processor
from lusee_bayes.core.checks import Described, require_array
from lusee_bayes.core.errors import InputError, nearest
from lusee_bayes.core.linalg import solve_lower
from lusee_bayes.instrument.coupling import Coupling, as_coupling
from lusee_bayes.linear.information import Information, gradient_and_misfit
from lusee_bayes.linear.normal_matrix import has_structure, is_within_times
from lusee_bayes.linear.posterior import Posterior
from lusee_bayes.linear.solver import FORMS, Solver, factorise
from lusee_bayes.noise.covariance import Covariance
from lusee_bayes.sky.prior import IndependentPrior, Prior


class LinearGaussian(Described, eqx.Module):
    """d = A m + offset + n, m ~ N(mu, S), n ~ N(0, N): a distribution over data vectors.

    Parameters
    ----------
    coupling : Coupling or (data, unknowns) array
        A. An array is wrapped in a ``DenseCoupling``.
    prior : Prior
        S, in K^2, and mu where it is not zero.
    noise : Covariance
        N, in K^2.
    offset : (data,) array or None
        Mean of the data without a sky, in K; None for zero.

    Raises
    ------
    InputError
        If the sizes do not fit together, or an array is not float64 or not finite.
    """

    coupling: Coupling = eqx.field(converter=as_coupling)
    prior: Prior
    noise: Covariance
    offset: DataVector | None = None

    def __check_init__(self):
        n_data, n_unknowns = self.coupling.shape
        if self.noise.size != n_data:
            raise InputError(
                f"the coupling matrix has {n_data} rows, the noise covariance {self.noise.size}; "
                "build both for the same observation and flags"
            )
        if self.prior.size != n_unknowns:
            raise InputError(
                f"the coupling matrix has {n_unknowns} columns, the prior {self.prior.size} "
                "unknowns; give both the same lmax"
            )
        if self.offset is not None:
            require_array("the offset", self.offset, (n_data,))

    def description(self) -> tuple[str, ...]:
        offset = "" if self.offset is None else " + offset"
        return (
            f"d = A m{offset} + n, {self.n_data} data, {self.prior.size} unknowns of the sky, in K",
            f"A {type(self.coupling).__name__}, S {type(self.prior).__name__}, "
            f"N {type(self.noise).__name__}",
            "condition(data) gives the posterior",
        )

    @property
    def n_data(self) -> int:
        """Number of data."""
        return self.coupling.shape[0]

    def predict(self, sky: Float[Array, " unknowns"]) -> DataVector:
        """Predict the mean data of a sky, without noise.

        Parameters
        ----------
        sky : (unknowns,) array
            m, in K.

        Returns
        -------
        (data,) array
            A m + offset, in K.

        Raises
        ------
        InputError
            If ``sky`` is not float64 or has another length.
        """
        seen = self.coupling @ sky
        return seen if self.offset is None else seen + self.offset

    def chi2(self, sky: Float[Array, " unknowns"], data: DataVector) -> Float[Array, ""]:
        """Compute ``|L^-1 (d - A m - offset)|^2``, with N = L L^T.

        Parameters
        ----------
        sky : (unknowns,) array
            m, in K.
        data : (data,) array
            d, in K.

        Returns
        -------
        () array
            chi^2 of the residuals.

        Raises
        ------
        InputError
            If N is not positive definite.
        """
        model = self
        if is_within_times(self.noise):
            model, sky, data = on_processor((self, sky, data))
        centred = data if model.offset is None else data - model.offset
        return gradient_and_misfit(model.coupling, model.noise.factor(), centred, sky)[1]

    def sample(self, key: PRNGKeyArray) -> tuple[Float[Array, " unknowns"], DataVector]:
        """Draw a sky from the prior, and data of that sky.

        Parameters
        ----------
        key : PRNGKeyArray
            Random key.

        Returns
        -------
        (unknowns,) array
            m, in K.
        (data,) array
            d, in K.

        Raises
        ------
        InputError
            If N is not positive definite.
        """
        sky_key, noise_key = jax.random.split(key)
        sky = self.prior.sample(sky_key)
        return sky, self.predict(sky) + self.noise.sample(noise_key)

    def factorise(self, form: str | None = None) -> Solver:
        """Do all work that does not depend on the data, to condition on many data vectors.

        Parameters
        ----------
        form : {"map", "data", "root"}, optional
            See :mod:`lusee_bayes.linear.solver`. By default the cheaper of "map" and "data".

        Returns
        -------
        Solver
            The factorised model.

        Raises
        ------
        InputError
            If the form is unknown, N is not positive definite, or Lambda cannot be factorised.
        """
        if form is None:
            form = "data" if self.n_data < self.prior.rank else "map"
        if form not in FORMS:
            raise InputError(f"unknown form '{form}'; {nearest(form, FORMS)}")
        return factorise(self.coupling, self.prior, self.noise, self.offset, form)

    def condition(self, data: DataVector, form: str | None = None) -> Posterior:
        """Compute the posterior over the sky given data.

        Parameters
        ----------
        data : (data,) array
            d, in K.
        form : {"map", "data", "root", "structured"}, optional
            As for :meth:`factorise`, or "structured": through A^T N^-1 A without A. That is the
            default where A and N have structure in time, the prior is over modes, and the data
            are as many as these.

        Returns
        -------
        Posterior
            With the evidence of the data.

        Raises
        ------
        InputError
            If the data are not float64, not finite or of another length, the model cannot be
            factorised, or the mean does not converge.
        """
        if form == "structured" or (form is None and self.is_structured):
            return self.inform(data)[1]
        return self.factorise(form).condition(data)

    @property
    def is_structured(self) -> bool:
        """Whether the posterior is found without A by default; see :meth:`condition`."""
        enough = self.n_data >= self.prior.size
        return self.prior.invertible and enough and has_structure(self.coupling, self.noise)

    def inform(
        self, data: DataVector, known: Information | None = None
    ) -> tuple[Information, Posterior]:
        """Compute the information of data, and the posterior; see :meth:`Information.of`.

        Parameters
        ----------
        data : (data,) array
            d, in K.
        known : Information, optional
            Of the same data, found with another prior.

        Returns
        -------
        Information
            ln p(d | m) as a function of the sky.
        Posterior
            Under the model's prior.

        Raises
        ------
        InputError
            As :meth:`Information.of`.
        """
        return Information.of(self.coupling, self.prior, self.noise, self.offset, data, known)

    def log_prob(self, data: DataVector) -> Float[Array, ""]:
        """Compute the evidence ln p(d), with the sky integrated out. Differentiable.

        Parameters
        ----------
        data : (data,) array
            d, in K.

        Returns
        -------
        () array
            ln p(d), for data in K.

        Raises
        ------
        InputError
            As :meth:`condition`.
        """
        return self.factorise().log_prob(data)


# priors are the same if they differ by less, as a part of variances and standard deviations
SAME = 1e-9


def deviation_model(posterior: Posterior, model: LinearGaussian) -> LinearGaussian:
    """Write the model of new data in terms of z, the deviation from an earlier posterior.

    Parameters
    ----------
    posterior : Posterior
        Of the earlier data, in the map-space or root form.
    model : LinearGaussian
        Of the new data alone, with the same prior.

    Returns
    -------
    LinearGaussian
        With the unknowns z ~ N(0, 1).

    Raises
    ------
    InputError
        If the priors differ or are not over harmonic coefficients, or the posterior is of the
        data-space form.
    """
    _require_same_prior(posterior, model)
    if posterior.basis is not None:
        raise InputError(
            "this posterior is of the data-space form; condition with form='root' what is to be "
            "updated later"
        )
    dense = model.coupling.dense()
    offset = dense @ posterior.mean
    return replace(
        model,
        coupling=_in_deviations(posterior, dense),
        prior=IndependentPrior(jnp.ones(posterior.prior.rank)),
        offset=offset if model.offset is None else offset + model.offset,
    )


def updated(posterior: Posterior, model: LinearGaussian, data: DataVector) -> Posterior:
    """Compute the posterior given earlier data and new ones with independent noise.

    Gain drifts that go on from the earlier data into the new ones are not independent: they couple
    the two.

    Parameters
    ----------
    posterior : Posterior
        Of the earlier data, in the map-space or root form.
    model : LinearGaussian
        Of the new data alone, with the same prior.
    data : (data,) array
        The new data, in K.

    Returns
    -------
    Posterior
        Given all data, with the evidence of all data.

    Raises
    ------
    InputError
        As :func:`deviation_model` and :meth:`LinearGaussian.condition`.
    """
    return composed(posterior, deviation_model(posterior, model).condition(data, form="root"))


def composed(posterior: Posterior, deviation: Posterior) -> Posterior:
    """Compute the posterior of m = m1 + R z from that of z.

    Parameters
    ----------
    posterior : Posterior
        Of the earlier data: m1 and R.
    deviation : Posterior
        Of z, the unknowns of :func:`deviation_model`, in the map-space or root form.

    Returns
    -------
    Posterior
        Of the sky given all data.

    Raises
    ------
    InputError
        If ``deviation`` is of the data-space form.
    """
    if deviation.basis is not None:
        raise InputError("condition the deviations with form='root'")
    step = solve_lower(posterior.lower, deviation.white_mean[:, None], transpose=True)[:, 0]
    return Posterior(
        posterior.prior,
        posterior.white_mean + step,
        jnp.tril(posterior.lower) @ jnp.tril(deviation.lower),
        None,
        posterior.log_evidence + deviation.log_evidence,
        deviation.refinement,
    )


@eqx.filter_jit
def _in_deviations(
    posterior: Posterior, dense: Float[Array, "data modes"]
) -> Float[Array, "data white"]:
    """A G L^-T."""
    columns = posterior.prior.colour_columns(dense)
    return solve_lower(posterior.lower, columns.T, transpose=False).T


def _require_same_prior(posterior: Posterior, model: LinearGaussian) -> None:
    old, new = posterior.prior, model.prior
    if not (old.invertible and new.invertible) or old.size != new.size:
        raise InputError(
            f"the earlier posterior has {old.size} modes, the new data's model {new.size}; give "
            "both the same lmax and a prior over harmonic coefficients"
        )
    before, now = np.asarray(old.variance()), np.asarray(new.variance())
    if not np.allclose(before, now, rtol=SAME, atol=0.0):
        k = int(np.argmax(np.abs(before - now) / np.maximum(before, now).clip(min=1e-300)))
        raise InputError(
            f"the earlier posterior has another prior: a variance of {before[k]:.4g} K^2 at "
            f"ell = {int(np.sqrt(k))}, now {now[k]:.4g}; give both the same sky and prior"
        )
    widths = np.sqrt(now)
    if not (old.independent and new.independent):
        apart = np.abs(np.asarray(old.covariance()) - np.asarray(new.covariance()))
        if (apart > SAME * widths[:, None] * widths).any():
            raise InputError(
                "the earlier posterior has another prior, with other correlations of the modes; "
                "give both the same sky and prior"
            )
    means = [
        np.zeros(p.size) if p.white_mean is None else np.asarray(p.colour(p.white_mean))
        for p in (old, new)
    ]
    if (np.abs(means[0] - means[1]) > SAME * widths).any():
        raise InputError(
            "the earlier posterior has a prior with another mean; give both the same "
            "prior.mean_file"
        )
