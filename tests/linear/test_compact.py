"""Compact posteriors: against the full covariance, and drawn from with NumPy alone."""

from __future__ import annotations

import re
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
from scipy import stats

import lusee_bayes as lb
from lusee_bayes.cli.main import main
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.harmonics import from_healpy
from lusee_bayes.linear.compact import CompactPosterior, read_compact
from lusee_bayes.noise.covariance import DiagonalCovariance
from lusee_bayes.report.describe import describe

LMAX = 5


def posterior(n_data: int, form: str):
    rng = np.random.default_rng(2)
    n = (LMAX + 1) ** 2
    coupling = jnp.asarray(rng.standard_normal((n_data, n)) * 10.0 ** rng.uniform(-3, 3, n))
    prior = lb.HarmonicPrior(jnp.asarray(10.0 / (1.0 + np.arange(LMAX + 1)) ** 2))
    noise = DiagonalCovariance(jnp.full(n_data, 0.3))
    data = jnp.asarray(rng.standard_normal(n_data))
    return lb.LinearGaussian(coupling, prior, noise).condition(data, form=form)


@pytest.mark.parametrize(("n_data", "form"), [(60, "map"), (20, "map"), (20, "data")])
def test_without_tolerance_it_is_the_posterior(n_data, form):
    full = posterior(n_data, form)
    compact = CompactPosterior.of(full, tolerance=1e-12)
    np.testing.assert_array_equal(compact.mean, full.mean)
    expected = np.asarray(full.covariance())
    std = np.asarray(full.std())
    np.testing.assert_allclose(compact.std(), std, rtol=1e-6)
    np.testing.assert_allclose(
        compact.covariance() / np.outer(std, std), expected / np.outer(std, std), atol=1e-6
    )
    assert len(compact.variances) <= n_data


def test_what_is_left_out_makes_no_error_bar_too_small():
    full = posterior(30, "map")
    std, prior = np.asarray(full.std()), np.sqrt(np.asarray(full.prior.variance()))
    ranks = []
    for tolerance in (1e-12, 1e-2, 0.3):
        compact = CompactPosterior.of(full, tolerance)
        excess = compact.std() ** 2 - std**2
        assert (excess > -1e-9 * prior**2).all()
        assert (excess < tolerance * prior**2 + 1e-9 * prior**2).all()
        ranks.append(len(compact.variances))
    assert ranks[0] > ranks[2]


def test_draws_have_its_mean_and_covariance():
    full = posterior(30, "map")
    compact = CompactPosterior.of(full, tolerance=1e-9)
    draws = compact.sample(np.random.default_rng(4), 4000)
    white = np.asarray(full.whiten(jnp.asarray(draws)))
    # standard normals, if mean and covariance are right: sums of squares of each mode and of each
    assert stats.kstest((white**2).sum(1), stats.chi2(white.shape[1]).cdf).pvalue > 1e-3
    per_mode = (white**2).sum(0)
    assert stats.kstest(per_mode, stats.chi2(len(draws)).cdf).pvalue > 1e-3
    assert np.abs(white.mean(0)).max() < 4.5 / np.sqrt(len(draws))


def test_files_bit_by_bit(tmp_path):
    compact = CompactPosterior.of(posterior(30, "map"))
    path = tmp_path / "posterior_compact.npz"
    about = {"frequency_mhz": 25.0, "lmax": LMAX, "frame": "galactic", "versions": "{}"}
    compact.write(path, about)
    back, said = read_compact(path)
    for name in ("mean", "prior_std", "directions", "variances"):
        np.testing.assert_array_equal(getattr(back, name), getattr(compact, name))
    assert said["frequency_mhz"] == 25.0
    assert "compact posterior over 36 modes (lmax 5) at 25 MHz" in describe(path)


def test_other_files_are_refused(tmp_path):
    np.savez(tmp_path / "a.npz", mean=np.zeros(3))
    (tmp_path / "b.npz").write_text("nothing")
    for name in ("a.npz", "b.npz", "none.npz"):
        with pytest.raises(InputError, match="compact posterior"):
            read_compact(tmp_path / name)


@pytest.mark.long
def test_readmes_lines_make_draws(tmp_path, monkeypatch):
    """The block of README.md, run as it stands on what ``map --compact`` writes."""
    readme = Path(__file__).resolve().parents[2] / "README.md"
    blocks = re.findall(r"^```python\n(.*?)^```", readme.read_text(), re.DOTALL | re.MULTILINE)
    (block,) = [b for b in blocks if "posterior_compact.npz" in b]
    assert len(block.splitlines()) <= 20
    monkeypatch.chdir(tmp_path)
    small = ["--set", "lmax=5", "--set", "observation.runs.0.cycles=0.1"]
    assert main(["map", "fiducial", *small, "--compact", "--covariance", "--quiet"]) == 0
    made: dict[str, np.ndarray] = {}
    exec(block, made)
    with xr.open_dataset("output/fiducial/posterior.nc", engine="h5netcdf") as file:
        mean, covariance = file["mean"].values, file["covariance"].values
    skies, alm = made["skies"], made["alm"]
    white = np.linalg.solve(np.linalg.cholesky(covariance), (skies - mean).T)
    # directions left at the prior's variance add at most a hundredth of it to a mode
    compact, _ = read_compact("output/fiducial/posterior_compact.npz")
    inner = np.linalg.solve(np.linalg.cholesky(compact.covariance()), (skies - mean).T)
    assert stats.kstest((inner**2).sum(0), stats.chi2(len(mean)).cdf).pvalue > 1e-3
    assert (white**2).mean() == pytest.approx(1.0, abs=0.1)
    np.testing.assert_allclose(from_healpy(alm), skies, rtol=1e-14)
