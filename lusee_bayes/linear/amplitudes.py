"""Amplitudes beside the sky: templates in N, patterns, and amplitudes that channels share.

*Templates*, such as point sources' fluxes, are part of the noise. With N = N_0 + T T^T, the
amplitude of each column of T has the prior N(0, 1). With the data's covariance K = A S A^T + N
under the model, and the sky's posterior covariance C, ::

    mean = T^T K^-1 (d - offset) = T^T N^-1 (d - offset - A m),    m: posterior mean of the sky,
    covariance = 1 - T^T K^-1 T = 1 - T^T N^-1 T + P C P^T,        P = T^T N^-1 A,
    Cov(m, amplitudes) = -S A^T K^-1 T = -C P^T.

A is not formed. If data determine an amplitude to 1e-6, 1 - T^T N^-1 T has no digits left. With U
of N = N_0 + U U^T (:mod:`.covariance`), which has the columns of T among its own, and V = L_0^-1 U,
nothing is subtracted::

    N^-1 U = L_0^-T V (1 + V^T V)^-1,    1 - U^T N^-1 U = (1 + V^T V)^-1.

*Patterns* of unknown strength beside a sky, such as point sources, are integrated out and restored,
::

    m = d + sum_j (1 + g_j) t_j,    g_j ~ N(0, 1)

With the patterns as rows of T, and K = 1 + T M T^T = L L^T, the information about d equals that
about m at d + sum_j t_j with ::

    M' = M - M T^T K^-1 T M,    v' = v - M T^T K^-1 T v,

and given d, g ~ N(K^-1 T v(d + sum_j t_j), K^-1).

*Tied amplitudes* of several channels: channel k is solved with the prior N(0, 1) for its amplitudes
z_k, and their posterior is N(E_k, V_k). Up to a factor, its likelihood is then
exp(-z^T (V_k^-1 - 1) z / 2 + z^T V_k^-1 E_k). Now let another prior have independent amplitudes,
where the channels' values of amplitude i are N(0, K_i) with ones on the diagonal (and everywhere,
if all channels share one value). With R R^T the block diagonal matrix of all K_i, and z = R w,
w ~ N(0, 1), ::

    Lambda = 1 + sum_k R_k^T (V_k^-1 - 1) R_k,    mean of w = Lambda^-1 sum_k R_k^T V_k^-1 E_k,

which needs no inverse of K_i: R has a column for each of their eigenvalues above rounding, a single
one if all entries are ones. The result for channel k, N(E'_k, V'_k), is its own posterior times
the other channels' constraint on its amplitudes, exp(-x^T Q x / 2 + q^T x) with x = z - E' and ::

    Q = V'^-1 - V^-1,    q = V^-1 (E' - E).

*Skies that are alike* make errors alike. The score V_k^-1 E_k has the variance J_k = V_k^-1 - 1,
and the slope P_k = -V_k^-1 Cov(z_k, m_k) G_k^-T by the departure u_k of a sky m_k = mu_k + G_k u_k
from its prior. If departures have the correlation rho, the sum of all R_k^T V_k^-1 E_k has the
slope J = sum_k R_k^T J_k R_k by w, and the variance J + X with the sum X over k != l of
rho_kl R_k^T P_k P_l^T R_l. The best estimate from this sum is ::

    Lambda = 1 + J (J + X)^-1 J,    mean of w = Lambda^-1 J (J + X)^-1 sum_k R_k^T V_k^-1 E_k,

without the negative part of X (relative to 1 + J), by which errors would cancel. Otherwise what all
channels learn from their priors of one sky, such as where the Galaxy is, would count many times.

If N has a prior mean e, to make up for the volume of skies (:mod:`.systematic`), z^T e belongs to
the likelihood (the volume at that z), not to the prior: the equations are valid with the E of
N(e, 1). About e, as for :class:`Amplitudes`, E - e and E' - e replace E and E'.

*With a joint posterior of skies*, all data together constrain z = R w of several channels, too. A
channel's posterior given its sky, z - e ~ N(y - P (m - m0), D), and its information (M, v) about
the sky give ln p(d | m, w) = ln p(d | m) + ln p(z | m, d) - ln N(z; 0, 1), i.e. the information ::

    ( M + P^T D^-1 P    P^T D^-1 R       )        ( v                 )
    ( R^T D^-1 P        R^T (D^-1 - 1) R ),       ( R^T R w0          )    about m0, R w0 = y + e.

*The sky above lmax* is nearly the same in all channels, too. Its departure x_k from the prior, in
prior standard deviations, is seen along orthonormal directions D_k, as templates with amplitudes
D_k^T x_k. With x_k = sum_j s_kj x_j + (what differs by channel), x_j ~ N(0, 1), and w_j = Q^T x_j
along directions Q that are the same for all, N(E, V) for the amplitudes becomes ::

    N(R_k^T E, 1 - R_k^T (1 - V) R_k)  for w,    R_k = (s_k1 D_k^T Q, s_k2 D_k^T Q ...).

The factors s_kj are those of the correlation of model skies.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import equinox as eqx
import numpy as np
from jaxtyping import Float
from scipy.linalg import cho_solve

from lusee_bayes.core.arrays import Array, Modes, ModesMatrix, Square, Vector
from lusee_bayes.core.checks import require_shape
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.linalg import checked_cholesky, solve_lower
from lusee_bayes.linear.information import Information
from lusee_bayes.linear.linear_gaussian import Solution
from lusee_bayes.noise.covariance import LowRankFactor

Skies = Float[np.ndarray, "skies modes"]
PatternModes = Float[np.ndarray, "patterns modes"]
Columns = Float[np.ndarray, "_ _"]


# information about an amplitude, over all, that is none
NEGLIGIBLE = 1e-12
# leading data that are compared first, to find a column among many
FEW = 8


@dataclass(frozen=True)
class Amplitudes:
    """Posterior of templates' amplitudes in prior standard deviations, the sky integrated out.

    Attributes
    ----------
    mean : (n,) array
    covariance : (n, n) array
        The unit matrix if the data do not constrain them.
    with_sky : (modes, n) array
        Covariance of the sky with the amplitudes, in K.
    """

    mean: Vector
    covariance: Square
    with_sky: Float[np.ndarray, "modes n"]

    @property
    def std(self) -> Vector:
        """Standard deviations."""
        return np.sqrt(np.diagonal(self.covariance))

    def integrated(self, mean: Modes, covariance: ModesMatrix) -> Amplitudes:
        """Return these amplitudes: the sky is integrated out already."""
        return self


@dataclass(frozen=True)
class AmplitudesOfSky:
    """Posterior of templates' amplitudes given the data and a sky, in prior standard deviations.

    ::

        mean = T^T N^-1 (d - offset - A m0) - P (m - m0),    covariance = 1 - T^T N^-1 T

    for a sky m. They are valid under any posterior of the sky, which other data with other
    amplitudes may constrain, too.

    Attributes
    ----------
    mean : (n,) array
        Given the reference sky.
    pull : (n, modes) array
        P, in 1/K.
    covariance : (n, n) array
    reference : (modes,) array
        The reference sky m0, in K.
    """

    mean: Vector
    pull: Float[np.ndarray, "n modes"]
    covariance: Square
    reference: Modes

    @classmethod
    def of(cls, solution: Solution, templates: Float[Array, "data n"]) -> AmplitudesOfSky:
        """Compute the posterior of templates' amplitudes given the sky.

        Parameters
        ----------
        solution : Solution
            Of a model with ``templates @ templates.T`` in its noise. Its posterior mean becomes the
            reference sky, so that differences from it keep their digits.
        templates : (data, n) array
            T, columns of U, in K.

        Raises
        ------
        InputError
            If N is not positive definite.
        """
        model, t, factor = solution.model, np.asarray(templates), solution.factor
        if isinstance(factor, LowRankFactor):
            rows = np.ascontiguousarray(np.asarray(model.noise.update.root).T)
            at: list[int] = []
            for row in np.ascontiguousarray(t.T):  # two may be alike
                alike = np.flatnonzero((rows[:, :FEW] == row[:FEW]).all(1)).tolist()
                at.append(next(k for k in alike if k not in at and (rows[k] == row).all()))
            left = cho_solve((np.asarray(factor.lower), True), np.eye(len(rows))[:, at])
            half = factor.v @ left
            solved, covariance = factor.base.whiten_transpose(half), left[at]
            residual = solution.data - model.predict(solution.posterior.mean)
            # T^T N^-1 r would lose the digits that the data add to a wide prior
            mean = np.asarray(half).T @ np.asarray(factor.base.whiten(np.asarray(residual)))
        else:
            solved = np.asarray(factor.solve(t))
            covariance = np.eye(t.shape[1]) - t.T @ solved
            mean = t.T @ solution.weighted_residual()
        pull = np.asarray(model.coupling.transpose_mv(np.asarray(solved))).T
        return cls(mean, pull, covariance, solution.posterior.mean)

    def integrated(self, mean: Modes, covariance: ModesMatrix) -> Amplitudes:
        """Integrate out a sky N(mean, covariance), in K and K^2, given any additional data."""
        with_sky = -covariance @ self.pull.T
        least = self.mean - self.pull @ (mean - self.reference)
        return Amplitudes(least, self.covariance - self.pull @ with_sky, with_sky)

    def with_shared(self, shared: Shared, mean: Vector, covariance: Square) -> Amplitudes:
        """Integrate out a sky and w, N(mean, covariance) given any additional data.

        Parameters
        ----------
        shared : Shared
            Of these amplitudes.
        mean, covariance : (modes + w,) and square array
            In K and K^2.
        """
        n = len(self.reference)
        slope = np.linalg.solve(shared.covariance, shared.across.T).T
        reach = np.concatenate([slope @ shared.pull - self.pull, slope @ shared.root], axis=1)
        off = np.concatenate([mean[:n] - self.reference, mean[n:]])
        least = self.mean - slope @ shared.mean + reach @ off
        left = self.covariance - slope @ shared.across.T
        with_all = covariance @ reach.T
        return Amplitudes(least, left + reach @ with_all, with_all[:n])

    def given(self, precision: Square, vector: Vector, expected: Vector) -> AmplitudesOfSky:
        """Add other knowledge of the amplitudes: exp(-x^T Q x / 2 + q^T x), x = z - t.

        Parameters
        ----------
        precision : (n, n) array
            Q.
        vector, expected : (n,) array
            q and t.
        """
        kept = np.linalg.inv(np.eye(len(vector)) + self.covariance @ precision)
        covariance = kept @ self.covariance
        mean = self.mean + covariance @ (vector - precision @ (self.mean - expected))
        return AmplitudesOfSky(mean, kept @ self.pull, covariance, self.reference)

    def information_given(
        self, information: Information, precision: Square, vector: Vector, expected: Vector
    ) -> Information:
        """Information about the sky, with the other knowledge of :meth:`given`.

        ::

            M + P^T W P,    v + P^T (1 + Q D)^-1 (Q x - q),    W = (1 + Q D)^-1 Q,

        with x = ``mean`` - t, D = ``covariance`` and P = ``pull``. If t is near the amplitudes,
        large Q cause no small differences of large numbers.

        Parameters
        ----------
        information : Information
            With amplitudes N(0, 1), about the same reference sky.
        precision, vector, expected : array
            As for :meth:`given`.
        """
        off, pull, inner = self.mean - expected, self.pull, self.covariance
        one, beyond = np.eye(len(off)), vector - expected
        mixed = one + precision @ inner
        gradient = np.linalg.solve(mixed, vector - precision @ off)
        weight, least = np.linalg.solve(mixed, precision), off + inner @ gradient
        misfit = gradient @ inner @ gradient + least @ (precision @ least - 2.0 * vector)
        misfit += beyond @ np.linalg.solve(one + precision, beyond) - expected @ expected
        log_det = np.linalg.slogdet(mixed)[1] - np.linalg.slogdet(one + precision)[1]
        matrix = information.matrix + pull.T @ (0.5 * (weight + weight.T)) @ pull
        vector = information.vector - pull.T @ gradient
        misfit, log_det = information.misfit + misfit, information.log_det + log_det
        return information.altered(matrix=matrix, vector=vector, misfit=misfit, log_det=log_det)


@dataclass(frozen=True)
class Shared:
    """Posterior of a channel's z = R w given its sky, with the mean for the sky m0.

    across : covariance of the channel's amplitudes with z; mean : y + e; pull : P; covariance : D;
    root : R; reference : m0, in K
    """

    across: Float[np.ndarray, "amplitudes shared"]
    mean: Vector
    pull: Float[np.ndarray, "shared modes"]
    covariance: Square
    root: Float[np.ndarray, "shared w"]
    reference: Modes

    def information(self, information: Information) -> Information:
        """Compute the information about the sky and w together, from that about the sky."""
        sky = self.reference
        local, inverse = information.recentred(sky), np.linalg.inv(self.covariance)
        at = np.linalg.lstsq(self.root, self.mean, rcond=None)[0]
        weight, pulled = self.root.T @ inverse, self.pull.T @ inverse
        across, among = weight @ self.pull, (weight - self.root.T) @ self.root
        matrix = np.block([[local.matrix + pulled @ self.pull, across.T], [across, among]])
        vector = np.concatenate([local.vector, self.root.T @ self.mean])
        misfit, reference = local.misfit - self.mean @ self.mean, np.concatenate([sky, at])
        log_det = local.log_det + np.linalg.slogdet(self.covariance)[1]
        scalars = {"misfit": misfit, "log_det": log_det}
        return local.altered(matrix=matrix, vector=vector, reference=reference, **scalars)


def template_amplitudes(solution: Solution, templates: Float[Array, "data n"]) -> Amplitudes:
    """Compute the posterior of templates' amplitudes, the sky integrated out.

    Parameters and errors are those of :meth:`AmplitudesOfSky.of`, and of
    :meth:`Posterior.covariance`.
    """
    of_sky = AmplitudesOfSky.of(solution, templates)
    return of_sky.integrated(solution.posterior.mean, solution.covariance)


def variance_factor(given: Amplitudes, log_std: float) -> float:
    """The most probable factor s of the prior variance of all amplitudes, ln s ~ N(0, log_std^2).

    It is at least e^-3 and at most e^3, to one per cent.

    ::

        ln p(d | s) = ln p(d | 1) + ln E[N(z; 0, s) / N(z; 0, 1)],    z ~ N(mean, covariance).
    """
    widths, axes = np.linalg.eigh(given.covariance)
    squares, log_s = (axes.T @ given.mean) ** 2, np.linspace(-3.0, 3.0, 601)[:, None]
    more = np.expm1(-log_s)
    left = 1.0 + more * widths
    misfit = (log_s + np.log(left) + more * squares / left).sum(1) + (log_s[:, 0] / log_std) ** 2
    return float(np.exp(log_s[np.argmin(misfit), 0]))


class Patterns(eqx.Module):
    """Patterns beside a sky, as constrained by data.

    Attributes
    ----------
    patterns : (patterns, modes) array
        T: each at its expected strength, which is also its uncertainty; in K.
    information : Information
        Of the whole sky m.
    lower : (patterns, patterns) array
        L.
    """

    patterns: PatternModes
    information: Information
    lower: Float[np.ndarray, "patterns patterns"]

    @classmethod
    def of(cls, patterns: PatternModes, information: Information) -> Patterns:
        """Build it from patterns and the information about the whole sky.

        Raises
        ------
        InputError
            If their numbers of modes differ.
        """
        require_shape("the patterns", patterns, (None, information.n_modes))
        lower = np.eye(len(patterns))
        if len(patterns):
            seen = patterns @ information.matrix @ patterns.T
            lower = checked_cholesky("the patterns' precision", seen + lower)
        return cls(patterns, information, lower)

    @property
    def expected(self) -> Modes:
        """sum_j t_j, in K."""
        return self.patterns.sum(0)

    def without(self) -> Information:
        """Integrate out the patterns: the information about d."""
        whole = self.information
        across = solve_lower(self.lower, self.patterns @ whole.matrix, transpose=False)
        pull = solve_lower(self.lower, (self.patterns @ whole.vector)[:, None], transpose=False)
        matrix, vector = whole.matrix - across.T @ across, whole.vector - across.T @ pull[:, 0]
        misfit, reference = whole.misfit - (pull**2).sum(), whole.reference - self.expected
        log_det = whole.log_det + 2.0 * np.log(np.diagonal(self.lower)).sum()
        scalars = {"misfit": misfit, "log_det": log_det}
        return whole.altered(matrix=matrix, vector=vector, reference=reference, **scalars)

    def whole_skies(self, diffuse: Skies, z: Float[np.ndarray, "skies patterns"]) -> Skies:
        """Compute draws of m given draws of d, in K.

        Parameters
        ----------
        diffuse : (skies, modes) array
            d, in K.
        z : (skies, patterns) array
            Draws of independent unit normals; zero for the mean.
        """
        shifted, whole = diffuse + self.expected, self.information
        pull = whole.vector - (shifted - whole.reference) @ whole.matrix
        half = solve_lower(self.lower, self.patterns @ pull.T, transpose=False) + z.T
        return shifted + solve_lower(self.lower, half, transpose=True).T @ self.patterns

    def whole_covariance(self, covariance: ModesMatrix) -> ModesMatrix:
        """Compute the covariance of m from that of d, in K^2.

        Parameters
        ----------
        covariance : (modes, modes) array
            Of d, in K^2.
        """
        if not len(self.patterns):
            return covariance
        white = solve_lower(self.lower, self.patterns, transpose=False)
        # m = d - back (d - mean) + white^T z
        back = white.T @ (white @ self.information.matrix)
        left = covariance - back @ covariance
        return left - left @ back.T + white.T @ white


# repeat the solution on the residual: rounding is then that of E - z, not of z
REFINEMENTS = 2


# common directions of the sky above lmax are those that this share of a channel's or more has
LEAST_SHARE, TINY = 0.01, np.finfo(np.float64).tiny
# at most so many factors, each with at least this variance, of one in every channel
MOST_FACTORS, LEAST_FACTOR = 3, 0.1


@dataclass(frozen=True)
class AlikeAbove:
    """What channels have in common of the sky above lmax.

    Attributes
    ----------
    directions : (others, few) array
        Q.
    strengths : (channels, factors) array
        s_k.
    """

    directions: Float[np.ndarray, "others few"]
    strengths: Float[np.ndarray, "channels factors"]

    @classmethod
    def of(
        cls,
        directions: Sequence[Float[np.ndarray, "others _"]],
        model: Float[np.ndarray, "channels others"],
    ) -> AlikeAbove:
        """Find it from some channels' D_k, and from x_k of model skies."""
        every = np.concatenate(directions, axis=1)
        shares, axes = np.linalg.eigh(every.T @ every)
        kept = shares > LEAST_SHARE
        common = every @ (axes[:, kept] / np.sqrt(shares[kept]))
        seen = model @ common
        seen = seen / np.maximum(np.linalg.norm(seen, axis=1, keepdims=True), TINY)
        left, sizes, _ = np.linalg.svd(seen, full_matrices=False)
        factors = (left * sizes)[:, :MOST_FACTORS]
        return cls(common, factors[:, sizes[:MOST_FACTORS] ** 2 > LEAST_FACTOR])

    def root(self, number: int, directions: Float[np.ndarray, "others n"]) -> Columns:
        """R_k of a channel with these D_k."""
        return np.kron(self.strengths[number], directions.T @ self.directions)

    @property
    def size(self) -> int:
        """Number of common unknowns."""
        return self.directions.shape[1] * self.strengths.shape[1]

    def misfit(self, channels: Iterable[tuple[int, Columns, Vector, Square]]) -> float:
        """What one x adds to the sum of chi^2 of channels with an x each: zero on average.

        Parameters
        ----------
        channels : iterable of (int, (others, n) array, (n,) array, (n, n) array)
            Number, D_k, and mean and covariance of the amplitudes from the channel's own data.
        """
        one = np.eye(self.size)
        precision, vector, square = one, np.zeros(len(one)), 0.0
        for number, directions, mean, covariance in channels:
            root = self.root(number, directions)
            inverse = np.linalg.inv(one - root.T @ root + root.T @ covariance @ root)
            pull = inverse @ (root.T @ mean)
            precision, vector = precision + inverse - one, vector + pull
            square += mean @ root @ pull
        return float(square - vector @ np.linalg.solve(precision, vector))


@dataclass(frozen=True)
class Tied:
    """Posterior of amplitudes given the data of all channels.

    Attributes
    ----------
    mean : (channels, n) array
    root : (channels, n, white) array
        R of the covariance R R^T of the amplitudes of all channels.
    white : (white,) array
        Mean of w.
    prior_root : (channels, n, white) array
        R of the prior, z = R w.
    draws : (draws, channels, n) array
        Of all channels together.
    log_evidence : float
        ln p of all data, minus the sum of the channels' ln p with amplitudes N(0, 1); of skies that
        are independent.
    names : tuple of str
        Of the amplitudes, if they have names.
    above : AlikeAbove or None
        The sky above lmax, as another common unknown of a joint posterior.
    """

    mean: Float[np.ndarray, "channels n"]
    root: Float[np.ndarray, "channels n white"]
    white: Float[np.ndarray, " white"]
    prior_root: Float[np.ndarray, "channels n white"]
    draws: Float[np.ndarray, "draws channels n"]
    log_evidence: float
    names: tuple[str, ...] = ()
    above: AlikeAbove | None = None

    @classmethod
    def of_nothing(cls, n_channels: int) -> Tied:
        """Of channels without common amplitudes."""
        mean, root = np.zeros((n_channels, 0)), np.zeros((n_channels, 0, 0))
        return cls(mean, root, mean[0], root, mean[None], 0.0)

    @property
    def start(self) -> Vector:
        """Values of all common unknowns before channels have common skies."""
        n = 0 if self.above is None else self.above.size
        return np.concatenate([self.white, np.zeros(n)])

    @property
    def covariance(self) -> Float[np.ndarray, "channels n n"]:
        """Covariance of each channel's amplitudes."""
        return self.root @ np.swapaxes(self.root, 1, 2)


def kernel(
    frequencies_mhz: Float[np.ndarray, " channels"], octaves: float
) -> Float[np.ndarray, "channels channels"]:
    """K(f, f') = exp(-(log2 f - log2 f')^2 / (2 octaves^2)), an unknown's prior covariance."""
    x = np.log2(frequencies_mhz) / octaves
    return np.exp(-0.5 * (x[:, None] - x[None]) ** 2)


def root_of_kernels(
    kernels: Float[np.ndarray, "n channels channels"],
) -> Float[np.ndarray, "channels n white"]:
    """R of K = R R^T, for the amplitudes of all channels.

    Parameters
    ----------
    kernels : (n, channels, channels) array
        K_i; they may be singular.
    """
    n, n_channels, _ = kernels.shape
    strengths, vectors = np.linalg.eigh(kernels)
    number, kept = np.nonzero(strengths > strengths.max() * n_channels * np.finfo(float).eps)
    blocks = np.zeros((n_channels, n, len(kept)))
    values = vectors[number, :, kept] * np.sqrt(strengths[number, kept])[:, None]
    blocks[:, number, np.arange(len(kept))] = values.T
    return blocks


@dataclass(frozen=True)
class AlikeErrors:
    """Errors of the scores V_k^-1 E_k that channels have in common, since their skies are alike.

    Attributes
    ----------
    slopes : (channels, n, modes) array
        P_k: of the scores, by the sky's departure from the prior, in prior standard deviations.
    correlation : (channels, channels) array
        rho, of these departures.
    """

    slopes: Float[np.ndarray, "channels n modes"]
    correlation: Float[np.ndarray, "channels channels"]

    def weighed(
        self,
        blocks: Float[np.ndarray, "channels n white"],
        white: Float[np.ndarray, " white"],
        lower: Float[np.ndarray, "white white"],
    ) -> tuple[np.ndarray, np.ndarray]:
        """Mean and root of the precision of w, from those for independent errors."""
        seen = np.einsum("kiw,kim->kwm", blocks, self.slopes)
        seen = solve_lower(lower, np.concatenate(seen, axis=1), transpose=False)
        seen = seen.reshape(len(lower), len(blocks), -1)
        apart = self.correlation - np.diag(np.diagonal(self.correlation))
        values, axes = np.linalg.eigh(np.einsum("wkm,kj,vjm->wv", seen, apart, seen, optimize=True))
        more, one = (axes * np.maximum(values, 0.0)) @ axes.T, np.eye(len(lower))
        half = solve_lower(lower, one, transpose=False)
        told = one - half @ half.T
        mixed = np.linalg.solve(told + more + NEGLIGIBLE * one, told)
        kept = one - told + told @ mixed
        least = np.linalg.solve(kept, mixed.T @ (lower.T @ white))
        return np.linalg.solve(lower.T, least), lower @ np.linalg.cholesky(kept)


def tie(
    mean: Float[np.ndarray, "channels n"],
    covariance: Float[np.ndarray, "channels n n"],
    kernels: Float[np.ndarray, "n channels channels"],
    normals: Float[np.ndarray, "draws most"],
    alike: AlikeErrors | None = None,
) -> Tied:
    """Replace the independent priors of channels' amplitudes by one that ties them.

    Parameters
    ----------
    mean, covariance : (channels, n) and (channels, n, n) array
        E and V: from each channel's own data, with amplitudes N(0, 1).
    kernels : (n, channels, channels) array
        K_i, with ones on their diagonals; they may be singular.
    normals : (draws, channels * n) array
        Standard normals for the draws; of each, one per column of R is used.
    alike : AlikeErrors, optional
        What the channels' skies add to all scores; without, errors are independent.

    Raises
    ------
    InputError
        If a covariance is not positive definite.
    """
    n_channels, n = mean.shape
    if not (np.linalg.eigvalsh(covariance) > 0).all():
        raise InputError(
            "a channel's data determine shared unknowns to below rounding; map channels one by one"
        )
    blocks = root_of_kernels(kernels)
    root, inverse = blocks.reshape(n_channels * n, -1), np.linalg.inv(covariance)
    pulled = np.einsum("kij,kjw->kiw", inverse - np.eye(n), blocks)
    lower = np.linalg.cholesky(np.eye(root.shape[1]) + root.T @ pulled.reshape(root.shape))
    white, z = np.zeros(root.shape[1]), np.zeros(mean.shape)
    for _ in range(1 + REFINEMENTS):
        left = (root.T @ (np.einsum("kij,kj->ki", inverse, mean - z) + z).ravel() - white)[:, None]
        step = solve_lower(lower, solve_lower(lower, left, transpose=False), transpose=True)
        white = white + step[:, 0]
        z = (root @ white).reshape(mean.shape)
    off = mean - z
    quadratic = np.einsum("ki,kij,kj->", off, inverse, off) - (z**2).sum() + white @ white
    log_dets = np.linalg.slogdet(covariance)[1].sum() + 2.0 * np.log(np.diagonal(lower)).sum()
    evidence = float(-0.5 * (quadratic + log_dets))
    if alike is not None:
        white, lower = alike.weighed(blocks, white, lower)
    half = solve_lower(lower, root.T, transpose=False).T.reshape(n_channels, n, -1)
    z = (root @ white).reshape(mean.shape)
    draws = solve_lower(lower, normals[:, : root.shape[1]].T, transpose=True).T @ root.T
    return Tied(z, half, white, blocks, z + draws.reshape(-1, n_channels, n), evidence)
