"""The linear Gaussian model d = A m + n: a distribution over data, and its posterior over m.

    Lambda = A^T N^-1 A + S^-1,    C = Lambda^-1,    mean = C A^T N^-1 d

A map-space form (of the size of the sky) and a data-space form (of the size of the data) are
offered; :mod:`lusee_bayes.solver` has the algebra of both.
"""

from __future__ import annotations

import equinox as eqx
import jax
from jaxtyping import Array, Float, PRNGKeyArray

from lusee_bayes.checks import (
    AnyArray,
    InputError,
    nearest,
    require_finite,
    require_float64,
    require_shape,
)
from lusee_bayes.coupling import CouplingMatrix
from lusee_bayes.covariance import Covariance
from lusee_bayes.information import Information
from lusee_bayes.normal_matrix import has_structure
from lusee_bayes.posterior import Posterior
from lusee_bayes.prior import Prior
from lusee_bayes.solver import FORMS, Solver, factorise

# a larger A is not formed where it can be done without: some 60,000 data at lmax 47
DENSE_BYTES = 1.2e9


class LinearGaussian(eqx.Module):
    """d = A m + offset + n, m ~ N(0, S), n ~ N(0, N): a distribution over data vectors.

    coupling : A, structured or a (data, modes) array; prior : S; noise : N;
    offset : (data,) what the data hold on average without any sky, in K; None for nothing.
    """

    coupling: CouplingMatrix | Float[Array, "data unknowns"]
    prior: Prior
    noise: Covariance
    offset: Float[Array, " data"] | None = None

    def __check_init__(self):
        if not isinstance(self.coupling, CouplingMatrix):
            require_float64("the coupling matrix", self.coupling)
            require_finite("the coupling matrix", self.coupling)
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
            require_float64("the offset", self.offset)
            require_shape("the offset", self.offset, (n_data,))
            require_finite("the offset", self.offset)

    @property
    def n_data(self) -> int:
        """Number of data."""
        return self.coupling.shape[0]

    def predict(self, sky: Float[Array, " unknowns"]) -> Float[Array, " data"]:
        """What data of this sky are on average: A m + offset, in K."""
        seen = self.coupling @ sky
        return seen if self.offset is None else seen + self.offset

    def sample(self, key: PRNGKeyArray) -> tuple[Float[Array, " unknowns"], Float[Array, " data"]]:
        """A sky from the prior and a data vector of it: (m, d)."""
        sky_key, noise_key = jax.random.split(key)
        sky = self.prior.sample(sky_key)
        return sky, self.predict(sky) + self.noise.sample(noise_key)

    def factorise(self, form: str | None = None) -> Solver:
        """Everything that does not depend on the data; use it to condition on many data vectors.

        ``form``: "map", "data" or "root" (solver.py); None takes the cheaper of the first two from
        the sizes. InputError if N is not positive definite.
        """
        if form is None:
            form = "data" if self.n_data < self.prior.rank else "map"
        if form not in FORMS:
            raise InputError(f"unknown form '{form}'; {nearest(form, FORMS)}")
        return factorise(self.coupling, self.prior, self.noise, self.offset, form)

    def condition(self, data: Float[AnyArray, " data"], form: str | None = None) -> Posterior:
        """The posterior over the sky given ``data`` (data,), in K.

        ``form``: as for :meth:`factorise`, or "structured", through A^T N^-1 A without A; None
        takes that one where A would be larger than ``DENSE_BYTES`` and N has structure in time.
        """
        if form == "structured" or (form is None and self.too_large):
            return self.inform(data)[1]
        return self.factorise(form).condition(data)

    @property
    def too_large(self) -> bool:
        """Whether A would be larger than ``DENSE_BYTES``, and is not needed."""
        size = 8 * self.n_data * self.prior.size
        return size > DENSE_BYTES and has_structure(self.coupling, self.noise)

    def inform(
        self,
        data: Float[AnyArray, " data"],
        key: PRNGKeyArray | None = None,
        n_perturbations: int = 0,
    ) -> tuple[Information, Posterior]:
        """What ``data`` say of the sky, and the posterior: see :meth:`Information.of`."""
        return Information.of(
            self.coupling, self.prior, self.noise, self.offset, data, key, n_perturbations
        )

    def log_prob(self, data: Float[AnyArray, " data"]) -> Float[Array, ""]:
        """ln p(d), the evidence: the sky is integrated out. Differentiable."""
        return self.factorise().log_prob(data)
