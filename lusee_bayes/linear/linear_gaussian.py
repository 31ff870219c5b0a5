"""The linear Gaussian model d = A m + n.

It is a distribution over data, with a posterior over m, ::

    Lambda = A^T N^-1 A + S^-1,    C = Lambda^-1,    mean = C A^T N^-1 d

The posterior is computed in a map-space form, of the size of the sky, or a data-space form, of the
size of the data; :mod:`lusee_bayes.linear.solver` has the algebra of both. Data with independent
noise are added to earlier ones through their :class:`.Information`.
"""

from __future__ import annotations

import equinox as eqx
import jax
from jaxtyping import Float, PRNGKeyArray

from lusee_bayes.core.arrays import Array, DataVector, on_processor
from lusee_bayes.core.checks import Described, require_array
from lusee_bayes.core.errors import InputError, nearest
from lusee_bayes.instrument.coupling import Coupling, as_coupling
from lusee_bayes.linear.information import Information, gradient_and_misfit
from lusee_bayes.linear.normal_matrix import has_structure, is_within_times
from lusee_bayes.linear.posterior import Posterior
from lusee_bayes.linear.solver import FORMS, Solver, factorise
from lusee_bayes.noise.covariance import Covariance
from lusee_bayes.sky.prior import Prior


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
