"""A deliberately naive oracle for the linear Gaussian model: textbook formulas, explicit matrices.

Nothing here imports lusee_bayes. With K = A S A^T + N,

    mean = S A^T K^-1 (d - offset),   C = S - S A^T K^-1 A S,   d ~ N(offset, K).

``posterior`` evaluates them in float64, ``exact_posterior`` in decimal arithmetic of 60 digits for
cases in which float64 loses the answer.
"""

from decimal import Decimal, localcontext
from typing import NamedTuple

import numpy as np
from scipy.stats import multivariate_normal, norm


class Answer(NamedTuple):
    mean: np.ndarray
    covariance: np.ndarray
    log_prob: float

    @property
    def std(self):
        return np.sqrt(np.diag(self.covariance))


def matrices(model):
    """A, S and N of a linear Gaussian model, as arrays."""
    parts = model.coupling.dense(), model.prior.covariance(), model.noise.dense()
    return tuple(np.asarray(part) for part in parts)


def posterior(a, s, n, d, offset=0.0) -> Answer:
    a, s, n, d = (np.asarray(x, dtype=np.float64) for x in (a, s, n, d))
    k = a @ s @ a.T + n
    gain = s @ a.T @ np.linalg.inv(k)
    mean = gain @ (d - offset)
    log_prob = multivariate_normal.logpdf(d, mean=np.zeros(len(d)) + offset, cov=k)
    return Answer(mean, s - gain @ a @ s, float(log_prob))


def resolution_rows(posterior, directions) -> np.ndarray:
    """y^T R of linear combinations y of the modes, one a row: R = 1 - C S^-1."""
    prior, y = posterior.prior, np.asarray(directions)
    covariance = np.asarray(posterior.covariance())
    return y - np.linalg.solve(np.asarray(prior.covariance()), covariance @ y.T).T


def log_prob_slope(a, s, n, d, ds, dn) -> float:
    """d ln p(d) / dx for S(x), N(x) with derivatives ds, dn: (y^T dK y - tr K^-1 dK) / 2."""
    k, dk = a @ s @ a.T + n, a @ ds @ a.T + dn
    y = np.linalg.solve(k, d)
    return 0.5 * float(y @ dk @ y - np.trace(np.linalg.solve(k, dk)))


def white_posterior(a, prior_std, noise_std, d) -> Answer:
    """Independent unknowns x ~ N(0, prior_std^2) and noise, d = A x + n, by QR of whitened rows.

    The condition is the root of Lambda's, so that float64 keeps ten digits where that has 1e12.
    """
    rows = np.concatenate([a * prior_std / noise_std[:, None], np.eye(len(prior_std))])
    white = np.concatenate([d / noise_std, np.zeros(len(prior_std))])
    q, r = np.linalg.qr(rows)
    half, chi2 = np.linalg.inv(r), ((white - q @ (q.T @ white)) ** 2).sum()
    log_det = np.log(np.abs(np.diag(r))).sum() + np.log(noise_std).sum()
    log_prob = -0.5 * chi2 - log_det - 0.5 * len(d) * np.log(2 * np.pi)
    covariance = prior_std[:, None] * (half @ half.T) * prior_std
    return Answer(prior_std * (half @ (q.T @ white)), covariance, float(log_prob))


exact = np.vectorize(Decimal, otypes=[object])
_float = np.vectorize(float, otypes=[np.float64])


def solve_exactly(k, b):
    """K^-1 B and ln|K| by Gaussian elimination; no pivoting is needed for a positive K."""
    k, b = k.copy(), b.copy()
    log_det = Decimal(0)
    for i in range(len(k)):
        log_det += k[i, i].ln()
        ratio = k[i + 1 :, i] / k[i, i]
        k[i + 1 :, i:] -= ratio[:, None] * k[i, i:][None]
        b[i + 1 :] -= ratio[:, None] * b[i][None]
    for i in reversed(range(len(k))):
        b[i] = (b[i] - k[i, i + 1 :] @ b[i + 1 :]) / k[i, i]
    return b, log_det


def exact_posterior(a, prior_variance, n, d, digits: int = 60) -> Answer:
    """As ``posterior`` with S = diag(prior_variance), in decimal arithmetic, rounded at the end."""
    with localcontext(prec=digits):
        a, s, n, d = (exact(np.asarray(x)) for x in (a, prior_variance, n, d))
        a_s = a * s[None]
        solved, log_det = solve_exactly(a_s @ a.T + n, np.concatenate([a_s, d[:, None]], axis=1))
        mean, covariance = a_s.T @ solved[:, -1], -(a_s.T @ solved[:, :-1])
        covariance[np.diag_indices(len(s))] += s
        two_pi = Decimal("6.28318530717958647692528676655900576839433879875021")
        log_prob = -(d @ solved[:, -1] + log_det + len(d) * two_pi.ln()) / 2
        return Answer(_float(mean), _float(covariance), float(log_prob))


def random_covariance(rng: np.random.Generator, n: int, scale: float = 1.0) -> np.ndarray:
    """A dense positive definite matrix with correlations of order one, well conditioned."""
    x = rng.normal(size=(n, 2 * n))
    c = scale * x @ x.T / (2 * n)
    return (c + c.T) / 2


def z_of(n_entries: int, false_alarm: float = 1e-4) -> float:
    """Sigmas that n_entries Gaussian errors all stay below, but for a chance ``false_alarm``."""
    return float(norm.isf(false_alarm / 2 / n_entries))


def assert_draws_follow(draws, mean, covariance):
    """Sample mean and covariance of Gaussian draws (draws, entries) against the analytic ones.

    Wick: the mean scatters by sqrt(C_ii / n), the entry ij of the second moment about the true
    mean by sqrt((C_ii C_jj + C_ij^2) / n).
    """
    draws, covariance = np.asarray(draws), np.asarray(covariance)
    n, delta = len(draws), draws - np.asarray(mean)
    variance = np.diag(covariance)
    worst = np.abs(delta.mean(0)) / np.sqrt(variance / n)
    assert worst.max() < z_of(worst.size), f"sample mean off by {worst.max():.2f} sigma"
    scatter = np.sqrt((np.outer(variance, variance) + covariance**2) / n)
    worst = np.abs(delta.T @ delta / n - covariance) / scatter
    assert worst.max() < z_of(worst.size), f"sample covariance off by {worst.max():.2f} sigma"
