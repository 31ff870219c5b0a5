"""The files of a map: posterior.nc, and HEALPix FITS whose headers say where they come from."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import xarray as xr
from astropy.io import fits
from jaxtyping import Float

from lusee_bayes.core import formats
from lusee_bayes.core.arrays import Pixels
from lusee_bayes.core.harmonics import mode_numbers
from lusee_bayes.core.lazy import healpy
from lusee_bayes.core.version import __version__, versions
from lusee_bayes.experiment.scenario import Scenario
from lusee_bayes.results.map_result import MapResult
from lusee_bayes.sky.prior import Prior

# FITS keys have eight letters
VERSION_KEYS = {
    "lusee_bayes": "V_LUSEE",
    "commit": "V_COMMIT",
    "jax": "V_JAX",
    "numpyro": "V_NPYRO",
    "arviz-stats": "V_ARVIZ",
    "numpy": "V_NUMPY",
    "scipy": "V_SCIPY",
    "healpy": "V_HEALPY",
    "astropy": "V_ASTRO",
    "lunarsky": "V_LUNAR",
}


def cards(name: str, scenario: Scenario) -> dict[str, object]:
    """Header cards of a result: what it is, of which frequency, beam, site and scenario.

    Values are (value, comment), or for text that would not fit a value alone.
    """
    beam, site = scenario.beam, scenario.observation
    return {
        "CONTENT": (name, "of the posterior over the sky"),
        "FREQ": (scenario.frequency_mhz, "frequency in MHz"),
        "LMAX": (scenario.lmax, "highest ell that is covered"),
        "FRAME": ("galactic", "of directions"),
        "BEAM": (beam.label, "the antennas"),
        "SITELON": (site.lon_deg, "selenographic longitude in degrees"),
        "SITELAT": (site.lat_deg, "selenographic latitude in degrees"),
        "SCENHASH": text_hash(scenario.to_yaml()),
        "CREATOR": f"lusee_bayes {__version__}",
        **{VERSION_KEYS[package]: (v, package) for package, v in versions().items()},
    }


def text_hash(text: str) -> str:
    """SHA-256 of a resolved scenario in YAML."""
    return hashlib.sha256(text.encode()).hexdigest()


def write_maps(folder: Path, maps: Mapping[str, Pixels], scenario: Scenario) -> None:
    """Write NAME.fits of maps: HEALPix RING, Galactic, K, float64, for healpy.read_map."""
    for name, pixels in maps.items():
        extra = [
            (key, *value) if isinstance(value, tuple) else (key, value)
            for key, value in cards(name, scenario).items()
        ]
        healpy.write_map(
            folder / f"{name}.fits",
            pixels,
            coord="G",
            column_names=[name.upper()],
            column_units="K",
            dtype=np.float64,
            extra_header=extra,
        )


def write_cubes(
    folder: Path,
    cubes: Mapping[str, Float[np.ndarray, "frequencies pixels"]],
    frequencies_mhz: Float[np.ndarray, " frequencies"],
    scenario: Scenario,
) -> None:
    """Write NAME.fits of maps at a scenario's frequencies, in the layout of ``sky.cubes``.

    One image (frequency, pixel), HEALPix RING, Galactic, K, float64; the frequencies, which its
    header can only give in even steps, are in a table behind it.
    """
    steps = np.diff(frequencies_mhz)
    for name, pixels in cubes.items():
        image = fits.PrimaryHDU(np.asarray(pixels, dtype=np.float64))
        header = image.header
        for key, value in cards(name, scenario).items():
            if key != "FREQ":
                header[key] = value
        header["BUNIT"], header["COORDSYS"], header["ORDERING"] = "K", "G", "RING"
        header["NSIDE"] = scenario.map_nside
        if not len(steps) or np.allclose(steps, steps[0], rtol=1e-9):
            header["HIERARCH FREQ_START"] = (frequencies_mhz[0], "MHz")
            header["FREQ_END"] = (frequencies_mhz[-1], "MHz")
            header["HIERARCH FREQ_STEP"] = (steps[0] if len(steps) else 1.0, "MHz")
        column = fits.Column("FREQUENCY", "D", unit="MHz", array=frequencies_mhz)
        table = fits.BinTableHDU.from_columns([column], name="FREQUENCIES")
        fits.HDUList([image, table]).writeto(folder / f"{name}.fits")


def posterior_dataset(result: MapResult) -> xr.Dataset:
    """What posterior.nc holds: on dim ``mode`` with coords ``ell``, ``m``; all in K (K^2).

    ``covariance`` and, for :func:`.read_updatable`, L of the precision in units of the prior are
    there where the scenario's ``output`` asks for them.
    """
    scenario, posterior = result.scenario, result.inference.posterior
    ell, m = mode_numbers(scenario.lmax)
    variables = {
        name: (*value, {"units": "K"}) for name, value in result.channel.variables().items()
    }
    frequency = {"frequency_mhz": scenario.frequency_mhz}
    attrs = {"format": formats.POSTERIOR, **frequency, **about(scenario)}
    if scenario.output.covariance:
        matrix = np.asarray(posterior.covariance())
        variables["covariance"] = (("mode", "mode_2"), matrix, {"units": "K2"})
    if scenario.output.updatable:
        lower = np.tril(np.asarray(posterior.lower))
        variables["precision_root"] = (("mode", "mode_2"), lower)
        variables["white_mean"] = ("mode", np.asarray(posterior.white_mean))
        variables |= _prior_variables(posterior.prior)
        attrs["log_evidence"] = float(posterior.log_evidence)
        attrs["data_digests"] = json.dumps(result.digests)
    return xr.Dataset(variables, coords={"ell": ("mode", ell), "m": ("mode", m)}, attrs=attrs)


def _prior_variables(prior: Prior) -> dict[str, tuple]:
    """What ``prior_std`` does not tell of the prior."""
    variables = {}
    if not prior.independent:
        root = np.asarray(prior.colour(np.eye(prior.rank))).T
        variables["prior_root"] = (("mode", "mode_2"), root, {"units": "K"})
    if prior.white_mean is not None:
        mean = np.asarray(prior.colour(prior.white_mean))
        variables["prior_mean"] = ("mode", mean, {"units": "K"})
    return variables


def about(scenario: Scenario) -> dict[str, object]:
    """What a file has to say of its numbers: frame, versions, scenario."""
    return {
        "lmax": scenario.lmax,
        "frame": "galactic",
        "basis": "real orthonormal spherical harmonics, index ell^2 + ell + m",
        "versions": json.dumps(versions()),
        "scenario": scenario.to_yaml(),
    }
