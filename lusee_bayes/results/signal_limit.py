"""Limits on a global signal: a template beside the spectrum of the sky.

The spectrum y of a region, with the posterior covariance V of all frequencies
(:mod:`.sky_spectrum`), is fitted by ::

    y(f) = exp(sum_k c_k T_k(x)) + a t(f),    x = ln f scaled to -1 ... 1,

a smooth sky, a polynomial of ln f, plus a template t of the amplitude a. T_k are Chebyshev
polynomials; c and a have flat priors. Sky, gains, receivers and ground are in V. The fit is linear
about the smooth sky that fits best, which a signal that is detected changes: the square of a over
its error is then by how much the signal lowers chi^2, even if a smooth sky looks nearly the same. A
sky that needs one more term can look like the template, too, which chi^2 does not show: given
enough frequencies, the change of a with that term is part of its error.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy.polynomial.chebyshev import chebvander
from scipy.linalg import solve_triangular
from scipy.optimize import curve_fit
from scipy.stats import foldnorm

from lusee_bayes.core import arrays, layouts, linalg, reading
from lusee_bayes.core.errors import InputError, refusing
from lusee_bayes.experiment.unknowns import ALL_TOGETHER
from lusee_bayes.judge.chi2 import ChiSquare
from lusee_bayes.results.sky_spectrum import OBSERVED, Frequencies, SkySpectrum

# degree of the polynomial, how often it is fitted beside a signal, and the smallest template, in K
ORDER, STEPS, FAINT = 6, 5, 1e-6
# standard deviations of a detection, and the probability below the limit
DETECTED, LEVEL = 5.0, 0.95
Columns = Float[np.ndarray, "_ _"]
TERM = "the next term of the polynomial"
TEMPLATE_COLUMNS = {
    "frequency_mhz": layouts.Variable(("frequency",), grows=True),
    "temperature_k": layouts.Variable(("frequency",)),
}
TABLE = layouts.Layout("a template of a signal", TEMPLATE_COLUMNS)


@dataclass(frozen=True)
class SignalLimit:
    """The amplitude of a template beside the sky.

    Attributes
    ----------
    name, region : str
    amplitude, std : float
        In units of the template; the error includes the change with one more term.
    limit : float
        The magnitude of the amplitude is below it with a probability of 95 %.
    fit : ChiSquare
        Of the smooth sky and the signal.
    without : dict of float
        Standard deviation if errors from one source (:class:`.SkySpectrum`, or :data:`TERM`) were
        absent.
    """

    name: str
    region: str
    amplitude: float
    std: float
    limit: float
    fit: ChiSquare
    without: dict[str, float]

    @property
    def detected(self) -> bool:
        """Whether the smooth sky fits, and the amplitude is beyond five standard deviations."""
        return self.fit.fits and abs(self.amplitude) > DETECTED * self.std

    def sentence(self) -> str:
        """The limit in words, with the source that sets it."""
        amplitude = f"{self.amplitude:.3g} +- {self.std:.2g} K"
        if not (self.fit.fits or self.fit.too_small):
            return (
                f"{self.name}: no limit, a smooth spectrum of the {self.region} does not fit "
                f"({self.fit.words()}); raise --order"
            )
        if self.detected:
            return f"{self.name}: detected, {amplitude}"
        least = min(self.without, key=self.without.__getitem__)
        return (
            f"{self.name}: below {self.limit:.3g} K (95 %), {amplitude}; without errors from "
            f"{least} the error would be {self.without[least]:.2g} K"
        )


def signal_limit(
    spectrum: SkySpectrum,
    name: str,
    template: Callable[[Frequencies], Frequencies],
    *,
    region: str = OBSERVED,
    order: int = ORDER,
) -> SignalLimit:
    """Fit a template beside the smooth spectrum of a region.

    Parameters
    ----------
    spectrum : SkySpectrum
    name : str
        Of the template.
    template : callable
        t(f), in K, for frequencies in MHz.
    region : str, optional
        One of the spectrum's regions.
    order : int, optional
        Degree of the polynomial of ln f.

    Raises
    ------
    InputError
        If the region is unknown, there are too few frequencies, the template vanishes there, or
        the fit does not converge.
    """
    k, f = spectrum.place(region), spectrum.frequency
    if order < 0:
        raise InputError(f"--order is {order}, expected 0 or more")
    if len(f) < order + 3:
        raise InputError(
            f"{len(f)} frequencies do not determine a polynomial of degree {order} and a signal: "
            f"at least {order + 3} are needed; lower --order"
        )
    x = np.log(f / np.sqrt(f.min() * f.max())) / np.log(np.sqrt(f.max() / f.min()))
    t, y = template(f), spectrum.temperature[k]
    if not np.isfinite(t).all() or np.abs(t).max() < FAINT:
        wrong = f"{name}: the template vanishes or is not finite at {f.min():g} to {f.max():g} MHz"
        raise InputError(wrong)
    if not (np.isfinite(y) & (y > 0.0)).all():
        raise InputError(f"the {region} has temperatures that are not positive")
    linalg.checked_cholesky("the covariance of the spectrum", spectrum.covariance[k])

    def triangle(columns: Columns, covariance: arrays.Square) -> Columns:
        """The triangular factor of white columns: the last entry of each is beside all others."""
        lower = np.linalg.cholesky(covariance)
        return np.linalg.qr(solve_triangular(lower, columns, lower=True), mode="r")

    def fitted(order: int) -> tuple[float, float, Columns]:
        """Amplitude, chi^2, and derivatives by all parameters, for a degree."""
        smooth, amplitude = chebvander(x, order), 0.0

        def sky(_: Frequencies, *values: float) -> Frequencies:
            return np.exp(smooth @ values)

        values = np.linalg.lstsq(smooth, np.log(y), rcond=None)[0]
        for _ in range(STEPS):
            left = y - amplitude * t
            with refusing(f"no smooth spectrum fits the {region}; lower --order", RuntimeError):
                values, *_ = curve_fit(sky, f, left, values, spectrum.covariance[k], method="trf")
            columns = np.column_stack([sky(f, *values)[:, None] * smooth, t])
            both = np.column_stack([columns, left - sky(f, *values)])
            *_, (over, change), (_, rest) = triangle(both, spectrum.covariance[k])[:, -2:]
            amplitude += float(change / over)
            if abs(amplitude * over) < DETECTED:
                break
        return amplitude, float(rest**2), columns

    amplitude, chi2, columns = fitted(order)
    change = fitted(order + 1)[0] - amplitude if len(f) > order + 3 else 0.0

    def error_under(covariance: arrays.Square, change: float = change) -> float:
        return float(np.hypot(1.0 / triangle(columns, covariance)[-1, -1], change))

    std = error_under(spectrum.covariance[k])
    without = {TERM: error_under(spectrum.covariance[k], 0.0)}
    for source, shares in zip(spectrum.sources, spectrum.shares[:, k], strict=True):
        if source == ALL_TOGETHER:
            continue
        # never to nothing: shares of several sources overlap
        kept = np.sqrt(np.clip(1.0 - shares, 1e-6, 1.0))
        without[source] = error_under(spectrum.covariance[k] * np.outer(kept, kept))
    limit = float(foldnorm.ppf(LEVEL, abs(amplitude) / std, scale=std))
    fit = ChiSquare(chi2, float(len(f) - order - 2))
    return SignalLimit(name, region, amplitude, std, limit, fit, without)


def named_template(text: str) -> tuple[str, Callable[[Frequencies], arrays.Vector]]:
    """A template from its text on the command line, with a name.

    Parameters
    ----------
    text : str
        ``trough:MHZ:WIDTH``, a Gaussian absorption of 1 K; ``excess``, a background of 1 K at
        20 MHz with the index -2.6; ``constant``, 1 K as of the CMB; or a CSV file with
        ``frequency_mhz`` and ``temperature_k``, interpolated.

    Raises
    ------
    InputError
        For anything else.
    """
    kind, *numbers = text.split(":")
    if kind == "excess" and not numbers:
        return "excess background (1 K at 20 MHz)", lambda f: (f / 20.0) ** -2.6
    if kind == "constant" and not numbers:
        return "constant", np.ones_like
    if kind == "trough":
        with refusing(f"got '{text}', expected trough:MHZ:WIDTH, as trough:17.5:3", ValueError):
            centre, width = map(float, numbers)
            if not width > 0.0:
                raise ValueError
        name = f"trough at {centre:g} MHz, {width:g} MHz wide"
        return name, lambda f: -np.exp(-0.5 * ((f - centre) / width) ** 2)
    if not Path(text).is_file():
        wrong = f"no template '{text}'; give trough:MHZ:WIDTH, excess, constant or a CSV file"
        raise InputError(wrong)
    table = reading.read_table(Path(text), TABLE)
    mhz, kelvin = table["frequency_mhz"], table["temperature_k"]
    shape = kelvin / (np.abs(kelvin).max() or 1.0)
    return f"{Path(text).stem}, at its peak", lambda f: np.interp(f, mhz, shape, np.nan, np.nan)
