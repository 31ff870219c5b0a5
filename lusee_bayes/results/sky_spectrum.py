"""The spectrum of the sky: temperatures of regions at every frequency, with their covariance.

The temperature of a region is the mean over its pixels, T = L m for a sky m, with the variance
L C L^T in each channel. Two channels have three kinds of errors in common, ::

    Cov(T_f, T_g) = (L W_f) (L W_g)^T + rho_fg [(L E_f) (L E_g)^T + (L F_f) (L F_g)^T],    f != g.

The instrument that they share, z_f = R_f w with the posterior w ~ N(.., 1), moves the sky m_f by
W_f = Cov(m_f, z_f) Cov(z_f)^-1 R_f per unit of w.

Channels are solved with independent priors m = mu + G u, u ~ N(0, 1), but their skies are alike.
Given z, with the covariance C_z, the error of m contains -E u with E = C_z G^-T: the structure that
the data do not measure, which is nearly the same at all frequencies. rho_fg, the correlation of u
at f and g, is measured: it is the product of the posterior means u', each divided by the root of
u' K u', with the fraction K = 1 - G^-1 C G^-T that the data measure. The sky above lmax, with x in
prior standard deviations, is taken for structure of the map: the error also contains -F x, with the
covariance F of m and x given z. All terms together are at most the whole variance, so the matrix is
positive definite.

In a joint posterior the prior correlates the skies. L m_f is linear in the component maps and the
shared unknowns x, with the slope W_f (:func:`.joint.sky_slopes`), and the rest is independent of
other channels: the covariance is W_f Cov(x) W_g^T. That of positive skies is estimated from draws,
times the factor that makes the mean of its inverse right (Hartlap et al. 2007, A&A 464, 399).
Parameters of a learned prior have their most probable values.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from astropy.table import Table
from jaxtyping import Bool, Float
from scipy.linalg import block_diag

from lusee_bayes.core.arrays import Modes, ModesMatrix, Pixels
from lusee_bayes.core.errors import require_known
from lusee_bayes.core.harmonics import averaging_rows, lmax_of, per_mode, pixel_matrix, taper
from lusee_bayes.core.layouts import Layout, Variable
from lusee_bayes.core.lazy import healpy
from lusee_bayes.core.linalg import solve_lower
from lusee_bayes.core.trees import quantity
from lusee_bayes.experiment.unknowns import ALL_TOGETHER, WHOLE_SKY, Fluxes
from lusee_bayes.judge.chi2 import ChiSquare
from lusee_bayes.linear.posterior import Posterior
from lusee_bayes.sky.galaxy import kelvin_steradian

Frequencies = Float[np.ndarray, " frequency"]
Rows = Float[np.ndarray, "area mode"]
WithSky = Float[np.ndarray, "mode_or_source mode"]
Columns = Float[np.ndarray, "mode_or_source shared"]
Above = Float[np.ndarray, "mode_or_source others"]

# resolution of regions
NSIDE = 64
# by Galactic latitude in degrees
REGIONS = "mean sky", "observed sky", "cap b > 60", "cap b < -60", "plane |b| < 10"
OBSERVED = REGIONS[1]
UNOBSERVED, UNMEASURED = "unobserved sky", "unmeasured structure"
ABOVE_LMAX = "sky above lmax"
# draws of a joint posterior, from which covariances of positive skies are computed
N_DRAWS = 400
TINY = np.finfo(np.float64).tiny
# resolution of maps of the spectral index, and number of draws behind them
INDEX_NSIDE, INDEX_DRAWS = 8, 100
# a value is defined where at least this fraction of the draws has it
DEFINED = 0.95


def sky_regions(highest_altitude: Pixels) -> dict[str, Bool[np.ndarray, " fine"]]:
    """The pixels (HEALPix RING, NSIDE 64 or finer) of each region, by name.

    Parameters
    ----------
    highest_altitude : (pixels,) array
        sin of the highest altitude that each pixel reached.
    """
    nside = max(NSIDE, healpy.npix2nside(len(highest_altitude)))
    _, latitude = healpy.pix2ang(nside, np.arange(healpy.nside2npix(nside)), lonlat=True)
    observed = healpy.ud_grade(highest_altitude, nside) >= 0.0
    parts = latitude > 60.0, latitude < -60.0, np.abs(latitude) < 10.0
    return dict(zip(REGIONS, (np.full(len(latitude), True), observed, *parts), strict=True))


@dataclass(frozen=True)
class Departure:
    """A channel's departure from its prior, and the error in common with other frequencies.

    Attributes
    ----------
    mean : (white,) array
        Posterior mean of u, the sky's departure from the prior in prior standard deviations, such
        that products of two channels are the correlation of their skies.
    error : (regions + sources, white) array
        L E: how each region's temperature misses u, and the temperature of each point source.
    above : (regions + sources, others) array
        L F: the same for the sky above lmax; without columns if the model ends there.
    """

    mean: Float[np.ndarray, " white"] = quantity("1", "departure of the sky from its prior")
    error: Float[np.ndarray, "area white"] = quantity("K", "temperature missed per departure")
    above: Float[np.ndarray, "area others"] = quantity("K", "the same for the sky above lmax")

    @classmethod
    def of(
        cls, highest_altitude: Pixels, posterior: Posterior, parts: tuple[WithSky, Columns, Above]
    ) -> Departure:
        """Compute it from a posterior given a channel's own data.

        Parameters
        ----------
        highest_altitude : (pixels,) array
        posterior : Posterior
            With the channel's prior.
        parts : tuple of arrays
            (modes + sources, modes): the covariance of the sky and of :class:`.Fluxes` with the
            sky, in K^2. (modes + sources, shared): w, a root of the part of it that would vanish if
            what channels share were known, in K. (modes + sources, others): F, the covariance with
            the sky above lmax, in prior standard deviations, if what channels share is known.
        """
        prior, mean, (covariance, w, above) = posterior.prior, np.asarray(posterior.mean), parts
        n, inside = len(mean), np.stack([*sky_regions(highest_altitude).values()])
        rows = block_diag(averaging_rows(inside, lmax_of(n)), np.eye(len(w) - n))
        error = np.asarray(prior.whiten(rows @ covariance - (rows @ w) @ w[:n].T))
        u = np.asarray(prior.whiten(mean) - prior.white_mean)
        v = np.asarray(prior.whiten_columns(u[None]))[0]
        return cls(u / np.sqrt(u @ u - v @ covariance[:n] @ v), error, rows @ above)


@dataclass(frozen=True)
class RegionTemperatures:
    """Temperatures of regions in one channel, and of point sources: their means over the sky.

    Attributes
    ----------
    regions, sources : tuple of str
        Names of the regions and point sources, and of the unknowns behind ``shares``.
    mean, std : (regions,) array
    truth : (regions,) array or None
    common : (regions, shared) array
        L W: change per unit of the shared unknowns; before channels are combined, of all unknowns
        of a joint posterior.
    shares : (sources, regions) array
        Fraction of each variance that would vanish if an unknown were known: a systematic, or the
        mean of the sky that never rises; and the fractions from E u and F x. They need not add up.
    draws : (draws, regions) array
        Of a joint posterior; empty otherwise.
    cells : (draws, pixels) array or None
        The first of them, smoothed as maps are drawn, at the centres of HEALPix cells (RING,
        NSIDE 8); None without a joint posterior.
    """

    regions: tuple[str, ...]
    sources: tuple[str, ...]
    mean: Float[np.ndarray, " area"] = quantity("K", "mean temperature")
    std: Float[np.ndarray, " area"] = quantity("K", "standard deviation")
    truth: Float[np.ndarray, " area"] | None = quantity("K", "true temperature")
    common: Float[np.ndarray, "area shared"] = quantity("K", "root of the shared covariance")
    shares: Float[np.ndarray, "source area"] = quantity("1", "fraction of the variance")
    draws: Float[np.ndarray, "joint_draw area"] = quantity("K", "draws of a joint posterior")
    cells: Float[np.ndarray, "cell_draw cell"] | None = quantity("K", "draws in cells of the sky")

    @classmethod
    def of(
        cls,
        highest_altitude: Pixels,
        mean: Modes,
        covariance: ModesMatrix,
        *,
        truth: Modes | None = None,
        roots: Mapping[str, Float[np.ndarray, "mode kept"]],
        common: Callable[[WithSky], np.ndarray] | None = None,
        departure: Departure | None = None,
        draws: Float[np.ndarray, "draw mode"] | None = None,
        fluxes: Fluxes | None = None,
    ) -> RegionTemperatures:
        """Compute them from a posterior of the sky.

        Parameters
        ----------
        highest_altitude : (pixels,) array
            sin of the highest altitude that each pixel reached.
        mean, covariance : (modes,) and (modes, modes) array
            In K and K^2.
        truth : (modes,) array, optional
        roots : mapping of (modes + sources, kept) arrays
            For each systematic, R of the part R R^T of the covariance that would vanish if it were
            known.
        common : callable, optional
            L W from L.
        departure : Departure, optional
        draws : (draws, modes) array, optional
            Of a joint posterior.
        fluxes : Fluxes, optional
            Of point sources.
        """
        regions, n = sky_regions(highest_altitude), len(mean)
        inside, lmax = np.stack([*regions.values()]), lmax_of(n)
        rows, hidden = averaging_rows(inside, lmax), averaging_rows(~inside[1:2], lmax)[0]
        fluxes = fluxes or Fluxes((), *[np.zeros(0)] * 3, np.zeros((0, n)), np.zeros((n, 0)))

        both = block_diag(rows, np.eye(len(fluxes.names)))
        std = np.append(np.sqrt(np.einsum("rm,rm->r", rows @ covariance, rows)), fluxes.std)
        parts = {name: ((both @ root[: both.shape[1]]) ** 2).sum(1) for name, root in roots.items()}
        of_hidden = np.append(rows @ covariance @ hidden, fluxes.with_sky @ hidden)
        parts[UNOBSERVED] = of_hidden**2 / max(hidden @ covariance @ hidden, TINY)
        if departure is not None:
            parts[UNMEASURED] = (departure.error**2).sum(1)
            if departure.above.size:
                parts[ABOVE_LMAX] = (departure.above**2).sum(1)
        return cls(
            (*regions, *fluxes.names),
            tuple(parts),
            np.append(rows @ mean, fluxes.mean),
            std,
            None if truth is None else np.append(rows @ truth, fluxes.truth),
            np.zeros((len(std), 0)) if common is None else common(both),
            np.stack([*parts.values()]) / std**2,
            np.zeros((0, len(std))) if draws is None else draws @ rows.T,
            None if draws is None else draws[:INDEX_DRAWS] @ _cell_rows(lmax).T,
        )


def correlation_of_departures(
    u: Float[np.ndarray, "frequency white"],
) -> Float[np.ndarray, "frequency _"]:
    """Products of departures; noise that exceeds what correlations can be is cut off."""
    alike = np.minimum(u @ u.T, 1.0)
    np.fill_diagonal(alike, 1.0)
    values, vectors = np.linalg.eigh(alike)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    root /= np.linalg.norm(root, axis=1, keepdims=True)
    return root @ root.T


def combined(
    channels: Sequence[RegionTemperatures], posterior: Posterior
) -> list[RegionTemperatures]:
    """Replace slopes by all unknowns by a root of the covariance that these cause."""
    slopes = np.concatenate([channel.common for channel in channels])
    white = solve_lower(posterior.lower, posterior.prior.colour_columns(slopes).T, transpose=False)
    common = np.split(np.linalg.qr(white, mode="r").T, len(channels))
    return [replace(one, common=part) for one, part in zip(channels, common, strict=True)]


@lru_cache(maxsize=1)
def _cell_rows(lmax: int) -> Float[np.ndarray, "cell mode"]:
    """Values of a smoothed sky at the centres of the cells; many times quicker than transforms."""
    return pixel_matrix(INDEX_NSIDE, lmax) * per_mode(taper(lmax))


@dataclass(frozen=True)
class SkySpectrum:
    """The temperature of each region at every frequency.

    Attributes
    ----------
    regions, sources : tuple of str
        As of :class:`RegionTemperatures`; point sources are missing from a joint posterior.
    frequency : (frequencies,) array
    temperature : (regions, frequencies) array
    covariance : (regions, frequencies, frequencies) array
    truth : (regions, frequencies) array or None
    shares : (sources, regions, frequencies) array
    """

    regions: tuple[str, ...]
    sources: tuple[str, ...]
    frequency: Frequencies = quantity("MHz", "frequency")
    temperature: Float[np.ndarray, "area frequency"] = quantity("K", "mean temperature")
    covariance: Float[np.ndarray, "area frequency frequency_2"] = quantity(
        "K2", "posterior covariance of the frequencies"
    )
    truth: Float[np.ndarray, "area frequency"] | None = quantity("K", "true temperature")
    shares: Float[np.ndarray, "source area frequency"] = quantity(
        "1", "fraction of the variance that would vanish if the source were known"
    )

    @classmethod
    def of(cls, each: Sequence[tuple[float, RegionTemperatures, Departure | None]]) -> SkySpectrum:
        """Combine frequencies in MHz, temperatures and departures; None in a joint posterior."""
        frequencies_mhz, channels, departures = zip(*each, strict=True)
        first = channels[0]
        std, common = np.stack([c.std for c in channels]), np.stack([c.common for c in channels])
        n_draws, n = len(first.draws), len(channels)
        if n_draws and not common.size:
            drawn = np.stack([c.draws.T for c in channels], axis=1)
            covariance = np.stack([np.atleast_2d(np.cov(of_region)) for of_region in drawn])
            covariance *= (n_draws - 1.0) / max(n_draws - n - 2.0, 1.0)
        else:
            covariance = np.einsum("frw,grw->rfg", common, common)
            if not n_draws:
                errors = [np.hstack([one.error, one.above]) for one in departures]
                most = max(e.shape[1] for e in errors)  # a channel's model may end at lmax
                errors = np.stack([np.pad(e, [(0, 0), (0, most - e.shape[1])]) for e in errors])
                alike = correlation_of_departures(np.stack([one.mean for one in departures]))
                covariance += alike * np.einsum("frw,grw->rfg", errors, errors)
            covariance[:, *np.diag_indices(n)] = std.T**2
        # an unknown that a channel lacks takes no part in its errors
        sources = tuple(dict.fromkeys(name for one in channels for name in one.sources))
        shares = np.zeros((len(sources), len(first.regions), len(channels)))
        for k, one in enumerate(channels):
            shares[[sources.index(name) for name in one.sources], :, k] = one.shares
        known = all(c.truth is not None for c in channels)
        return cls(
            first.regions,
            sources,
            np.asarray(frequencies_mhz, dtype=np.float64),
            np.stack([c.mean for c in channels], axis=1),
            covariance,
            np.stack([c.truth for c in channels], axis=1) if known else None,
            shares,
        )

    @property
    def std(self) -> Float[np.ndarray, "area frequency"]:
        """Standard deviations, in K."""
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))

    def chi2(self, region: str) -> ChiSquare:
        """Squared distance of a region's spectrum from the truth, with the full covariance."""
        k = self.place(region)
        off = self.temperature[k] - self.truth[k]
        return ChiSquare(float(off @ np.linalg.solve(self.covariance[k], off)), float(len(off)))

    def place(self, region: str) -> int:
        """Index of a region. InputError for an unknown one."""
        require_known("no region", region, self.regions)
        return self.regions.index(region)

    @property
    def jansky(self) -> Frequencies:
        """Flux density of a point source whose temperature is 1 K, in Jy, at each frequency."""
        return WHOLE_SKY / kelvin_steradian(1.0, self.frequency)

    def rows(self, region: str) -> tuple[list[str], list[list[str]]]:
        """Header and rows of a region's spectrum, in K, or a point source's, in Jy."""
        k, kelvin = self.place(region), region.startswith(REGIONS)
        name, unit, scale = ("T", "K", 1.0) if kelvin else ("S", "Jy", self.jansky)
        columns = {name: self.temperature[k], "+-": self.std[k]}
        if self.truth is not None:
            columns["true"] = self.truth[k]
        columns = {f"{column} [{unit}]": scale * value for column, value in columns.items()}
        most = [
            f"{self.sources[j]} {share:.0%}" if (share := self.shares[j, k, i]) >= 0.005 else "-"
            for i, j in enumerate(self.most(k))
        ]
        cells = [[f"{value:,.1f}" for value in one] for one in columns.values()]
        mhz = [f"{value:g}" for value in self.frequency]
        header = ["MHz", *columns, "largest share from"]
        return header, [list(one) for one in zip(mhz, *cells, most, strict=True)]

    def most(self, k: int) -> list[int]:
        """Index of the source of most of the variance of region k, at each frequency."""
        single = [j for j, name in enumerate(self.sources) if name != ALL_TOGETHER]
        return [single[j] for j in np.argmax(self.shares[single, k], axis=0)]

    def table(self) -> Table:
        """spectrum.ecsv: a row for every frequency and region."""
        n_regions, n = self.temperature.shape
        columns = {
            "frequency_mhz": np.tile(self.frequency, n_regions),
            "region": np.repeat(self.regions, n),
            "temperature_k": self.temperature.ravel(),
            "std_k": self.std.ravel(),
        }
        if self.truth is not None:
            columns["true_k"] = self.truth.ravel()
        for name, share in zip(self.sources, self.shares, strict=True):
            columns[f"share of {name}"] = share.ravel()
        units = {"frequency_mhz": "MHz", "temperature_k": "K", "std_k": "K", "true_k": "K"}
        return Table(columns, units={name: u for name, u in units.items() if name in columns})


@dataclass(frozen=True)
class IndexMaps:
    """The spectrum of every cell of the sky, ln T = a + b x + c x^2 with x = ln(f / f_0).

    Fitted to joint draws of the skies, each point with its own weight; NaN where less than 95 % of
    the draws are positive at all frequencies. The turnover is where T no longer grows with f: NaN
    unless 95 % of the draws turn over within the band.

    Attributes
    ----------
    reference_mhz : float
        f_0, the geometric mean of the frequencies.
    maps : dict of (pixels,) arrays
        ``index`` (b), ``index_std``, ``curvature`` (c), ``curvature_std``, ``turnover`` and
        ``turnover_std`` in MHz; HEALPix RING, Galactic.
    """

    reference_mhz: float
    maps: dict[str, Pixels]

    @classmethod
    def of(
        cls, frequencies_mhz: Frequencies, draws: Float[np.ndarray, "frequency draw cell"]
    ) -> IndexMaps:
        """Fit them to draws in K, at three or more frequencies."""
        reference = float(np.exp(np.log(frequencies_mhz).mean()))
        x, positive = np.log(frequencies_mhz / reference), (draws > 0.0).all(0)
        log = np.log(np.where(positive, draws, 1.0))
        cells = zip(np.moveaxis(log, 2, 0), 1.0 / (draws.std(1) / draws.mean(1)).T, strict=True)
        fits = [np.polyfit(x, of_cell, 2, w=weight) for of_cell, weight in cells]
        c, b, _ = np.stack(fits, axis=1)  # (cells, draws) each
        with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
            turnover = reference * np.exp(-b / (2.0 * c))
        inside = (turnover >= frequencies_mhz.min()) & (turnover <= frequencies_mhz.max())
        maps = {}
        for name, values, known in (
            ("index", b, positive.T),
            ("curvature", c, positive.T),
            ("turnover", turnover, positive.T & inside & (c < 0.0)),
        ):
            few = known.mean(1, keepdims=True) < DEFINED
            shown = np.ma.array(np.where(known, values, 0.0), mask=~known | few)
            maps[name] = shown.mean(1).filled(np.nan)
            maps[f"{name}_std"] = shown.std(1).filled(np.nan)
        return cls(reference, maps)


def cane_1979(frequencies_mhz: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Temperature of the Galactic poles, in K (Cane 1979, MNRAS 189, 465).

    I_g f^-0.52 (1 - exp(-tau)) / tau + I_eg f^-0.80 exp(-tau) with tau = 5.0 f^-2.1, f in MHz,
    I_g = 2.48 MJy/sr and I_eg = 1.06 MJy/sr.
    """
    f = np.asarray(frequencies_mhz)
    tau = 5.0 * f**-2.1
    galactic = 2.48e6 * f**-0.52 * -np.expm1(-tau) / tau
    return kelvin_steradian(galactic + 1.06e6 * f**-0.80 * np.exp(-tau), f)


def novaco_brown_1978(frequencies_mhz: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Mean temperature of the sky from RAE 2, in K (Novaco and Brown 1978, ApJ 221, 114).

    I = 13.8 f^-0.76 exp(-3.28 f^-0.64) MJy/sr, f in MHz, as written by Zaslavsky et al. 2011 (Radio
    Science 46, RS2008); measured up to 9 MHz.
    """
    f = np.asarray(frequencies_mhz)
    return kelvin_steradian(13.8e6 * f**-0.76 * np.exp(-3.28 * f**-0.64), f)


# published spectra by name, each with the frequencies of its measurements in MHz
PUBLISHED: dict[str, tuple[Callable, tuple[float, float]]] = {
    "poles: Cane 1979": (cane_1979, (0.25, 100.0)),
    "RAE 2: Novaco and Brown 1978": (novaco_brown_1978, (0.25, 9.2)),
}
# the table of a spectrum that others measured
MEASURED_COLUMNS = {
    "frequency_mhz": Variable(("frequency",), low=0.0),
    "temperature_k": Variable(("frequency",)),
    "std_k": Variable(("frequency",), low=0.0, optional=True),
}
MEASURED = Layout("a spectrum", MEASURED_COLUMNS)
