"""All channels see one sky above lmax: the joint posterior and the spectrum, against matrices."""

import numpy as np
import pytest
from assertions import within
from reference_linear import white_posterior
from scipy.linalg import block_diag

import lusee_bayes as lb
from lusee_bayes.core.harmonics import averaging_rows, n_modes, per_mode
from lusee_bayes.experiment import model
from lusee_bayes.experiment.model import radiometer
from lusee_bayes.results import sky_spectrum
from lusee_bayes.sky.sky_source import write_alms

LMAX, TOP, N, MHZ = 3, 7, n_modes(3), [25.0, 27.0, 30.0]


@pytest.fixture(scope="module")
def scenario(tmp_path_factory):
    """A sky with one spectral index, which ends at ell 9; the model ends at 7."""
    std = per_mode(3e3 * (1.0 + np.arange(10)) ** -1.2)
    modes = std * np.random.default_rng(1).standard_normal(len(std))
    modes[0] = 1e5
    path = write_alms(tmp_path_factory.mktemp("sky") / "sky.fits", modes, {"FREQ": 25.0})
    options = [f"lmax={LMAX}", f"frequencies_mhz={MHZ}", "observation.step_s=60000"]
    options += [f"sky={{model: file, file: {path}, spectral_index: -2.5}}"]
    options += ["prior={model: isotropic, spectrum: sky}", "output.covariance=true"]
    options += [f"noise.above_lmax={{least_lmax: {TOP}, margin: 4}}"]
    options += ["noise.radiometer.temperature=model", "beam.exact=true"]
    options += ["spectral={components: [power_law], residual: 0.03}"]
    return lb.load_scenario("fiducial", overrides=options)


@pytest.fixture(scope="module")
def channels(scenario):
    """White A of the map and of what is above it, in prior standard deviations, data, S^1/2."""
    made = []
    for one in scenario.channels():
        setup = (experiment := lb.build(one)).setup
        std = np.sqrt(per_mode(np.asarray(one.sky.at(one.frequency_mhz, TOP).spectrum())))
        lower = np.linalg.cholesky(np.asarray(radiometer(setup).dense()))
        a = np.linalg.solve(lower, np.asarray(setup.above.coupling.dense()))
        d = np.linalg.solve(lower, experiment.data.data)
        made.append((a[:, :N], a[:, N:] * std[N:], d, std[:N]))
    return made


def mapped(scenario, ending, tmp_path, monkeypatch):
    """The result where the model of some channels ends at lmax, as their beams do."""
    whole = model.sky_above

    def seen_above(setup, *more):
        if MHZ.index(setup.frequency_mhz) in ending:
            raise lb.InputError("the beams end at lmax")
        return whole(setup, *more)

    lb.run_simulate(scenario, data := tmp_path / "data.fits")
    monkeypatch.setattr(model, "sky_above", seen_above)
    result = lb.run_map(scenario, tmp_path / "map", data=data).result
    assert [k for k, one in enumerate(result.channels) if any(one.doubts)] == [*ending]
    return result


@pytest.mark.parametrize("ending", [(), (1,), pytest.param((0, 2), marks=pytest.mark.essential)])
def test_a_joint_posterior_has_one(
    ending, scenario, channels, tmp_path, monkeypatch, numbers_alone
):
    """Maps, their errors, and what it adds to chi^2 that no sky of the map explains."""
    joint = lb.load_scenario(scenario, overrides=["joint=true"])
    prior = (result := mapped(joint, ending, tmp_path, monkeypatch)).joint.prior
    maps, above, data, _ = zip(*channels, strict=True)
    above = [b * (k not in ending) for k, b in enumerate(above)]
    common = np.vstack([w * a for w, a in zip(prior.mixing[:, 0], maps, strict=True)])
    rows = np.hstack([common, block_diag(*maps), np.vstack(above)])
    residual = np.concatenate([prior.residual_root(k) for k in range(3)])
    std = np.concatenate([prior.roots[0], residual, np.ones(above[0].shape[1])])
    answer = white_posterior(rows, std, np.ones(len(rows)), np.concatenate(data))
    for k, channel in enumerate(result.channels):
        to_sky = np.zeros((N, len(std)))
        to_sky[:, :N], to_sky[:, N * (k + 1) :][:, :N] = prior.mixing[k, 0] * np.eye(N), np.eye(N)
        covariance = to_sky @ answer.covariance @ to_sky.T
        within((channel.mean - to_sky @ answer.mean) / channel.std, 0.0, 1e-2)
        np.testing.assert_allclose(channel.std**2, np.diagonal(covariance), rtol=2e-3)
    free = [np.linalg.qr(a, mode="complete")[0][:, N:].T for a in maps]
    left = np.concatenate([q @ d for q, d in zip(free, data, strict=True)])
    seen = [q @ b for q, b in zip(free, above, strict=True)]
    noise = (np.eye(len(left)) + b @ b.T for b in (np.vstack(seen), block_diag(*seen)))
    one, apart = (left @ np.linalg.solve(n, left) for n in noise)
    assert (abs(one - apart) > 1.0) == (len(ending) < 2)
    assert result.joint.misfit_above == pytest.approx(one - apart, rel=0.1, abs=1e-3)


@pytest.mark.parametrize("ending", [pytest.param((), marks=pytest.mark.essential), (1,)])
def test_independent_channels_miss_the_same(
    ending, scenario, channels, monkeypatch, tmp_path, numbers_alone
):
    """Errors of two channels are as alike as the sky that causes them, if all of it is one sky."""
    monkeypatch.setattr(sky_spectrum, "correlation_of_departures", lambda u: np.ones((3, 3)))
    result = mapped(scenario, ending, tmp_path, monkeypatch)
    spectrum, errors = result.sky_spectrum(), []
    regions = sky_spectrum.sky_regions(result.channels[0].highest_altitude)
    to_region = averaging_rows(np.stack([*regions.values()]), LMAX)
    for k, (a, b, _, std) in enumerate(channels):
        b = b * (k not in ending)
        before, rows = np.append(std, np.ones(b.shape[1])), np.hstack([a, b])
        alone = white_posterior(rows, before, np.ones(len(rows)), np.zeros(len(rows)))
        errors.append(to_region @ (alone.covariance[:N] / before))
    expected = np.einsum("frk,grk->rfg", *[np.stack(errors)] * 2)
    expected[:, *np.diag_indices(3)] = spectrum.std**2
    scale = spectrum.std[:, :, None] * spectrum.std[:, None]
    within((spectrum.covariance - expected) / scale, 0.0, 1e-3)
