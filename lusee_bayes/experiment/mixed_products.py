"""Changes of data that mix the products of each time, and their residual chi^2, all at once.

d' = sum_jk W_jk x_jk, where x_jk has product k in the place of product j. With K the covariance of
the data under a prior that allows any sky, and b the model without a sky, ::

    chi^2(W) = (X w - b)^T K^-1 (X w - b) = (w, -1)^T Q (w, -1),    Q = (X, b)^T K^-1 (X, b).

With Q at hand exchanges, signs and reversals cost nothing; factors and constants are solved for.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from lusee_bayes.core.linalg import solve_lower
from lusee_bayes.experiment.any_sky import UnderAnySky, filled
from lusee_bayes.experiment.mistakes import DataMistake, data_mistakes
from lusee_bayes.instrument.products import all_products
from lusee_bayes.linear.posterior import Posterior

# times that are tried one by one, the worst first
TIMES = 32


@dataclass(frozen=True)
class MixedProducts:
    """Q of the module's equations, of some data.

    here : UnderAnySky; posterior : under the wide prior; grid : (products, times) array, in K; q :
    (columns, columns) array, of every x_jk, ones in every product, the times reversed, and b
    """

    here: UnderAnySky
    posterior: Posterior
    grid: Float[np.ndarray, "products times"]
    q: Float[np.ndarray, "columns columns"]

    @classmethod
    def of(cls, here: UnderAnySky, posterior: Posterior) -> MixedProducts:
        """Of data and their posterior under the wide prior."""
        grid, layout, offset = filled(here.data), here.data.layout, here.model.offset
        n, product, time = len(grid), layout.product, layout.time
        mixed = np.zeros((layout.size, n, n))
        mixed[np.arange(layout.size), product] = grid[:, time].T
        steady = np.zeros(layout.size) if offset is None else np.asarray(offset)
        columns = [mixed.reshape(layout.size, -1), np.eye(n)[product]]
        columns += [np.stack([grid[:, ::-1][product, time], steady], axis=1)]
        return cls(here, posterior, grid, _gram(here, posterior, np.concatenate(columns, axis=1)))

    def chi2(self, vector: Float[np.ndarray, " columns"]) -> float:
        """chi^2 of (w, -1)."""
        return float(vector @ self.q @ vector)

    def vector(self, mixing: Float[np.ndarray, "products products"], b: float = -1.0) -> np.ndarray:
        """(w, -1) of a mixing, or w of one that is added."""
        return np.concatenate([mixing.ravel(), np.zeros(len(mixing) + 1), [b]])

    def tried(self) -> Iterator[tuple[float, DataMistake]]:
        """Every mistake with its chi^2."""
        n_ports = self.here.setup.beam_source.n_ports
        for mistake in data_mistakes(n_ports):
            w = self.vector(mistake.mixing)
            if mistake.reverses:
                w = np.zeros(len(w))
                w[-2:] = 1.0, -1.0
            yield self.chi2(w), mistake
        products = all_products(n_ports)
        autos = np.array([p.i == p.j for p in products], dtype=np.float64)
        for product, which in zip(products, np.eye(len(products)), strict=True):
            yield self._factor(f"product {product.label}", which)
        yield self._factor("every auto", autos)
        for port in range(n_ports):
            powers = np.array([float(p.i == port) + float(p.j == port) for p in products])
            yield self._gain(port, powers)
        yield self._constant(np.flatnonzero(autos))
        yield from self._times()

    def _factor(
        self, name: str, which: Float[np.ndarray, " products"]
    ) -> tuple[float, DataMistake]:
        """A factor of some products: chi^2 is a parabola in what is missing."""
        whole = self.vector(np.eye(len(which)))
        step = self.vector(np.diag(which), 0.0)
        curvature = float(step @ self.q @ step)
        missing = -float(step @ self.q @ whole) / curvature
        return self.chi2(whole + missing * step), DataMistake(
            f"{name} is {_number(1.0 / (1.0 + missing), curvature**-0.5)} times what the others "
            "predict",
            f"look at the calibration of {name}",
            np.diag(1.0 + missing * which),
        )

    def _gain(self, port: int, powers: Float[np.ndarray, " products"]) -> tuple[float, DataMistake]:
        """A gain of a port's voltage, squared in its auto: chi^2 is of fourth order in it."""
        parts = [self.vector(np.diag((powers == k) * 1.0), -1.0 * (k == 0)) for k in range(3)]
        gram = np.array([[u @ self.q @ v for v in parts] for u in parts])
        chi2 = np.polynomial.Polynomial(
            [np.trace(gram[:, ::-1], offset=2 - order) for order in range(5)]
        )
        roots = chi2.deriv().roots()
        real = roots.real[np.abs(roots.imag) <= 1e-6 * np.abs(roots.real)]
        gain = real[np.argmin(chi2(real))]
        return float(chi2(gain)), DataMistake(
            f"the voltage of port {port} is {1.0 / gain:.5g} times what the others predict",
            f"look at the calibration of port {port}",
            np.diag(gain**powers),
        )

    def _constant(self, autos: np.ndarray) -> tuple[float, DataMistake]:
        """A constant in every auto."""
        n = len(self.grid)
        whole = self.vector(np.eye(n))
        places = n * n + autos
        level = np.linalg.solve(self.q[np.ix_(places, places)], self.q[places] @ whole)
        whole[places] -= level
        constant = np.zeros(n)
        constant[autos] = level
        named = ", ".join(f"{x:.4g}" for x in level)
        return self.chi2(whole), DataMistake(
            f"the autos have a constant of {named} K besides the sky",
            "give noise.receiver, or subtract it",
            np.eye(n),
            constant,
        )

    def _times(self) -> Iterator[tuple[float, DataMistake]]:
        """A factor of all products of one time."""
        here, layout, values = self.here, self.here.data.layout, np.asarray(self.here.data.data)
        factor = here.model.noise.factor()
        # K^-1 (d - b)
        left = np.asarray(
            factor.solve(values - np.asarray(here.model.predict(self.posterior.mean)))
        )
        pull = np.bincount(layout.time, values * left, layout.n_times)
        most = np.bincount(layout.time, values * np.asarray(factor.solve(values)), layout.n_times)
        worst = np.argsort(-(pull**2) / np.where(most > 0.0, most, np.inf))[:TIMES]
        worst = worst[most[worst] > 0.0]
        columns = np.where(layout.time[:, None] == worst, values[:, None], 0.0)
        curvature = np.diagonal(_gram(here, self.posterior, columns))
        whole = self.chi2(self.vector(np.eye(len(self.grid))))
        for time, bend in zip(worst.tolist(), curvature.tolist(), strict=True):
            if not bend > 0.0:  # the others predict nothing
                continue
            missing = -pull[time] / bend
            when = here.data.observation.times[time].isot[:19]
            yield (
                whole - pull[time] ** 2 / bend,
                DataMistake(
                    f"all products at {when} are {_number(1.0 / (1.0 + missing), bend**-0.5)} "
                    "times what the other times predict",
                    "leave this time out",
                    (1.0 + missing) * np.eye(len(self.grid)),
                    time=time,
                ),
            )


def _number(factor: float, std: float) -> str:
    """A factor with the error of its inverse."""
    return f"{factor:.5g} +- {std * factor**2:.1g}"


def _gram(
    here: UnderAnySky, posterior: Posterior, columns: Float[np.ndarray, "data n"]
) -> Float[np.ndarray, "n n"]:
    """X^T K^-1 X, K^-1 = N^-1 - N^-1 A C A^T N^-1."""
    solved = np.asarray(here.model.noise.factor().solve(columns))
    seen = np.stack([np.asarray(here.model.coupling.transpose_mv(x)) for x in solved.T])
    white = np.asarray(posterior.prior.colour_columns(seen)).T
    half = solve_lower(posterior.lower, white, transpose=False)
    return columns.T @ solved - half.T @ half
