"""Runs of several frequencies from the command line: independent, joint, resumed, shared out."""

import json
from dataclasses import replace

import healpy
import numpy as np
import pytest
from assertions import assert_same_map, refuse
from astropy.io import fits
from commands import posterior_of, refused, run, sets, sky_draws_of, table_of
from experiments import channels_of

import lusee_bayes as lb
from lusee_bayes.core import engine as engine_module
from lusee_bayes.core.engine import ThisProcess
from lusee_bayes.core.harmonics import modes_to_map, n_modes
from lusee_bayes.core.reading import read_model
from lusee_bayes.experiment.model import full_model
from lusee_bayes.judge.measures import signal_to_noise
from lusee_bayes.results.summaries import MapSummary
from lusee_bayes.runs import channels, map_run, sample_run
from lusee_bayes.runs import folder as folder_module
from lusee_bayes.runs.channels import map_channels
from lusee_bayes.sampling.datatree import read_datatree
from lusee_bayes.sky.sky_source import SkyCube
from lusee_bayes.systematics.context import Around

SMALL = ["--set", "lmax=4", "--set", "observation.runs.0.cycles=0.1"]
THREE = ["--frequencies", "20:30:5", *SMALL]
# two components for three channels
JOINT = [*THREE, "--joint", "--set", "spectral.components=[power_law, curvature]"]


def three(*overrides, frequencies="[20, 25, 30]"):
    """The scenario of the command line's THREE."""
    cube = f"frequencies_mhz={frequencies}"
    return lb.load_scenario("fiducial", [*SMALL[1::2], cube, *overrides])


@pytest.fixture(scope="module")
def independent(small_cube):
    """Of a finished run, shared: to be read."""
    return small_cube.folder


@pytest.fixture(scope="module")
def joint(tmp_path_factory):
    """Made by the command line."""
    out = tmp_path_factory.mktemp("joint")
    assert run("map", "fiducial", *JOINT, "--draws", 3, "-o", out, "-q") == 0
    return out


def test_channels_of_different_days(tmp_path):
    """A run states the times of all, and that their observed skies differ."""
    days = {20.0: "2027-01-15", 25.0: "2027-01-16"}
    apart = three(frequencies="[20, 25]")
    starts = [(one, f"observation.start={days[one.frequency_mhz]}") for one in apart.channels()]
    data = [lb.build(lb.load_scenario(one, [start])).data for one, start in starts]
    # so short a step would be too much for any memory, but is not that of the data
    planned = lb.load_scenario(apart, ["observation.step_s=1e-3"])
    made = lb.run_map(planned, tmp_path / "map", data=data).result
    assert "observed sky of each channel" in made.sky_spectrum().regions
    said = json.loads((tmp_path / "map" / "provenance.json").read_text())
    assert said["first"][:10] == days[20.0]
    assert said["last"] == data[1].observation.times[-1].isot[:19]


@pytest.mark.long
def test_independent_channels_are_maps_of_each_frequency(independent):
    channels = posterior_of(independent)
    np.testing.assert_array_equal(channels["frequency"], [20.0, 25.0, 30.0])
    assert sky_draws_of(independent).shape == (3, 3, 25)
    for number, frequency in enumerate((20, 25, 30)):
        settings = [*SMALL[1::2], f"frequency_mhz={frequency}", f"seed={1 + number}"]
        experiment = lb.build(lb.load_scenario("fiducial", settings))
        data = experiment.data
        expected = full_model(experiment.setup, Around(data)).condition(data.data).posterior
        here = channels.dataset.isel(frequency=number)
        assert_same_map(here, expected, 1e-6)
        np.testing.assert_array_equal(here["truth"], np.asarray(data.truth))
    summary = json.loads((independent / "summary.json").read_text())
    assert summary["joint"] is None and len(summary["channels"]) == 3
    assert not (independent / "channels").exists()


@pytest.mark.long
def test_runs_take_names_strings_and_data_in_memory(tmp_path, monkeypatch, numbers_alone):
    """A cube of sets in memory is that of the same data simulated; ~ is the user's folder."""
    monkeypatch.setenv("HOME", str(tmp_path))
    scenario = three("noise.radiometer.temperature=model", frequencies="[20, 25]")
    sets, file = channels_of(scenario), tmp_path / "three.yaml"
    file.write_text(scenario.to_yaml())
    here = lb.run_map("~/three.yaml", "~/memory", data=sets, truth=True)
    assert here.folder == tmp_path / "memory"
    again = lb.run_map(file, tmp_path / "b")
    assert_same_map(posterior_of(here.folder), posterior_of(again.folder), 1e-6)
    # the same sets are the same run, others are not
    lb.run_map(scenario, str(here.folder), data=tuple(sets), truth=True)
    refuse("data was", lb.run_map, scenario, here.folder, data=sets[::-1], truth=True)
    provenance = json.loads((here.folder / "provenance.json").read_text())
    assert provenance["file"] == "visibilities in memory"


@pytest.mark.long
def test_files_of_a_cube_agree_with_each_other(joint, capsys):
    channels = posterior_of(joint)
    assert run("info", joint / "posterior.nc") == 0
    said = capsys.readouterr().out
    assert "25 modes (lmax 4) at 3 frequencies from 20 to 30 MHz" in said and "joint" in said
    nside = lb.load_scenario("fiducial", SMALL[1::2]).map_nside
    for name in ("mean", "truth"):
        read = SkyCube.read(joint / f"{name}.fits")
        np.testing.assert_allclose(read.frequencies_mhz, channels["frequency"])
        for k in range(3):
            expected = modes_to_map(channels[name].values[k], nside)
            np.testing.assert_allclose(read.map_at(20.0 + 5 * k), expected, rtol=1e-12)
    assert SkyCube.read(joint / "std.fits").pixels.shape == (3, healpy.nside2npix(nside))
    rows = table_of(joint / "power_spectra.ecsv")
    assert [float(r["frequency_mhz"]) for r in rows] == list(np.repeat([20.0, 25.0, 30.0], 5))
    for name, column in (("mean", "snr"), ("independent_mean", "snr_independent")):
        snr = signal_to_noise(channels[name].values[1], channels["truth"].values[1])
        np.testing.assert_allclose([float(r[column]) for r in rows[5:10]], snr, rtol=1e-9)
    maps = channels["mixing"].values @ channels["component_mean"].values
    # the rest of each channel is a few percent of it
    assert 0 < np.abs(maps - channels["mean"].values).max() < 0.2 * np.abs(maps).max()


@pytest.mark.long
def test_the_independent_means_of_a_joint_run_are_those_of_an_independent_run(joint, independent):
    a, b = posterior_of(joint), posterior_of(independent)
    alone, mean = (np.abs(a[n].values - b["mean"].values) for n in ("independent_mean", "mean"))
    # it is where the first solution was
    assert (alone / b["std"].values).max() < 1e-3 and (mean / b["std"].values).max() > 0.05


@pytest.fixture
def made(monkeypatch):
    """Channels whose posterior was really computed, in order."""
    done, conditioned = [], channels.conditioned

    def counting(experiment, *arguments):
        done.append(experiment.scenario.frequency_mhz)
        return conditioned(experiment, *arguments)

    for module in (engine_module, channels):
        monkeypatch.setattr(module, "ThisProcess", lambda *_: ThisProcess(1))
    monkeypatch.setattr(channels, "conditioned", counting)
    return done


@pytest.mark.long
def test_files_of_another_run_are_not_taken_up(tmp_path, made, monkeypatch, numbers_alone):
    # the channels' files stay
    monkeypatch.setattr(map_run, "MAP", replace(map_run.MAP, unfinished=""))
    two = "[20, 25]"
    lb.run_map(three(frequencies=two), tmp_path)
    lb.run_map(three(frequencies=two), tmp_path)
    assert made == [20, 25]
    lb.run_map(three("noise.radiometer.factor=2", frequencies=two), tmp_path, replace=True)
    assert made == [20, 25] * 2


@pytest.fixture(scope="module")
def gap(tmp_path_factory):
    """Data of three channels, of which that at 25 MHz has no usable value."""
    path = tmp_path_factory.mktemp("gap") / "w.fits"
    assert run("simulate", "fiducial", *THREE, "-o", path, "-q") == 0
    with fits.open(path, mode="update") as file:
        (channels,) = [hdu for hdu in file if hdu.data is not None and hdu.data.ndim == 3]
        np.moveaxis(channels.data, channels.data.shape.index(3), 0)[1] = np.nan
    return path


# a model that finds nothing besides the sky takes less time
PLAIN = ["beam.exact=true", "noise.above_lmax={treatment: ignored}"]
ONE = [*PLAIN, "joint=true", "spectral.components=[power_law]"]


@pytest.mark.parametrize("joint", [pytest.param([], marks=pytest.mark.long), ONE], ids=len)
def test_a_channel_that_cannot_be_mapped_leaves_the_others_as_they_are(
    gap, joint, tmp_path, numbers_alone, monkeypatch, capsys
):
    # those of a run of the other channels
    scenario = three(*joint, frequencies="[20, 30]")
    whole = lb.run_map(scenario, tmp_path / "without", data=gap, truth=True)
    monkeypatch.setattr(folder_module, "PAGES", {"map": lambda folder, _: head_of(folder)})
    command = ["map", "fiducial", *THREE, *sets(*joint), "--data", gap, "--truth"]
    assert run(*command, "-o", tmp_path / "with") == 0
    told = capsys.readouterr().out
    got, expected = posterior_of(tmp_path / "with"), posterior_of(tmp_path / "without")
    np.testing.assert_array_equal(got["frequency"], [20.0, 30.0])
    for name in ("mean", "std", "prior_std"):
        np.testing.assert_array_equal(got[name], expected[name])
    assert "truth" in got
    frequencies = SkyCube.read(tmp_path / "with" / "mean.fits").frequencies_mhz
    np.testing.assert_array_equal(frequencies, [20.0, 30.0])
    summary = json.loads((tmp_path / "with" / "summary.json").read_text())
    assert summary["log_evidence"] == whole.result.log_evidence
    (reason,) = summary["unmapped"]
    assert reason.startswith("Not mapped, 25 MHz: ")
    assert reason in told
    assert run("info", tmp_path / "with" / "posterior.nc") == 0
    assert reason in capsys.readouterr().out
    assert reason in (tmp_path / "with" / "report.html").read_text()


def head_of(folder):
    """What a report says of channels that could not be mapped."""
    summary = read_model(folder / "summary.json", MapSummary, "the figures of a map run")
    return "\n".join(summary.unmapped)


def test_what_too_few_channels_cannot_be_is_named(gap, tmp_path, numbers_alone):
    joint = three(*PLAIN, "joint=true", "spectral.components=[power_law, curvature]")
    refuse("spectral.components.*; not mapped: 25 MHz: ", lb.run_map, joint, tmp_path, data=gap)
    other = three(frequencies="[40, 45]")
    refuse("no channel.*mapped.*40 MHz", lb.run_map, other, tmp_path, data=gap)
    refuse("no data at", lb.run_map, three(), tmp_path, data=tmp_path / "gone.fits")
    lmax_of_fields = scenario_of().spectral.lmax_of_fields
    refuse("lmax 80.*13122 unknowns.*lmax=69", lmax_of_fields, 80)
    assert lmax_of_fields(60) == 69


@pytest.mark.long
def test_a_run_with_an_unmapped_channel_goes_on(gap, tmp_path, made, monkeypatch, numbers_alone):
    conditioned = channels.conditioned

    def some(*arguments):
        if made:
            raise KeyboardInterrupt
        return conditioned(*arguments)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(channels, "conditioned", some)
        lb.run_map(three(), tmp_path, data=gap)
    assert made == [20]
    result = lb.run_map(three(), tmp_path, data=gap).result
    assert made == [20, 30] and list(result.unmapped) == [25.0]


@pytest.mark.long
def test_sampling_several_channels(tmp_path, capsys):
    few = ["--chains", 2, "--draws", 100, "--warmup", 100, "-q", "--set", "lmax=2"]
    command = ["sample", "fiducial", "--frequencies", "20,30", *SMALL, *few, "-o", tmp_path]
    assert run(*command) == 0
    assert SkyCube.read(tmp_path / "mean.fits").pixels.shape[0] == 2
    for name in ("20MHz", "30MHz"):
        assert (tmp_path / name / "report.html").is_file()
    samples = tmp_path / "20MHz" / "samples.nc"
    before = read_datatree(samples)["posterior"]["sky"].values
    assert run(*command, "--resume") == 0
    np.testing.assert_array_equal(read_datatree(samples)["posterior"]["sky"].values, before)
    joint = (tmp_path / "joint", "--set", "joint=true", "--set", "spectral.components=[power_law]")
    assert "sky.py' does not integrate skies out" in refused(capsys, *command[:-1], *joint)
    refuse("not possible for positive", lb.run_sample, three(*POSITIVE), tmp_path / "positive")


@pytest.mark.long
def test_sampled_unknowns_beside_joint_skies_are_those_of_the_map(tmp_path):
    """Receivers are linear: draws have mean and width of the joint Gaussian. Noise is so strong
    that each channel learns from the others."""
    common = "noise.receiver={power_k: 2000, relative_std: 0.2, smooth_octaves: 1.0}"
    noisy = common, "noise.radiometer.factor=1e4", "joint=true", "lmax=3"
    lb.run_map(three(*noisy, "spectral.components=[power_law]"), tmp_path / "map")
    sampled = three(*noisy, "spectral.components=[power_law]", "noise.receiver.treatment=sampled")
    sampler = lb.Sampler(chains=4, draws=500, warmup=200, seed=1)
    drawn = lb.run_sample(sampled, tmp_path / "draws", sampler=sampler).result
    found, table = posterior_of(tmp_path / "map"), table_of(tmp_path / "map" / "unknowns.csv")
    assert (drawn[0].tree["constant_data"]["analytic_std"].values / found["std"][0]).mean() > 1.3
    for number, result in enumerate(drawn):
        assert result.summary["r_hat"].max() < 1.02
        mhz, sites = result.experiment.scenario.frequency_mhz, result.tree["posterior"]
        here = [row for row in table if float(row["frequency_mhz"]) == mhz]
        mean = [*found["mean"][number], *(float(row["value"]) for row in here)]
        std = np.array([*found["std"][number], *(float(row["std"]) for row in here)])
        unknowns = [sites[row["unknown"]].values.ravel() for row in here]
        values = [*result.skies.reshape(2000, -1).T, *unknowns]
        # some 1,000 independent draws: four and a half standard deviations
        assert np.abs((np.mean(values, 1) - mean) / std).max() < 0.15
        assert np.abs(np.std(values, 1) / std - 1.0).max() < 0.1


POSITIVE = [
    *("lmax=4", "observation.runs.0.cycles=0.1", "spectral.model=positive"),
    *("spectral.fields=[level, index]", "joint=true"),
]


def scenario_of(*overrides, frequencies="[10, 20, 40]"):
    return lb.load_scenario("fiducial", [*POSITIVE, f"frequencies_mhz={frequencies}", *overrides])


@pytest.mark.long
def test_files_of_a_run_agree_with_each_other(tmp_path, capsys):
    command = ["map", "fiducial", *sets(*POSITIVE[:-1]), "--frequencies", "10,20,40", "--joint"]
    shared = sets("noise.pointing={turntable_deg: 0.2}")
    assert run(*command, *shared, "--draws", 3, "-v", "-o", tmp_path / "out") == 0
    said = capsys.readouterr().out
    assert "spectral.model=positive" in said and "prior.model=isotropic is not used" in said
    channels = posterior_of(tmp_path / "out")
    assert [channels[name].attrs["units"] for name in ("component_mean", "mean")] == ["1", "K"]
    assert channels["component_mean"].shape == (2, n_modes(6))  # 1.5 times the maps' lmax
    scenario = scenario_of("spectral.sources=false")
    skies = scenario.spectral.positive_skies(scenario.frequencies_mhz, scenario.lmax)
    exponents = channels["mixing"].values @ channels["component_mean"].values
    for k, draws in enumerate(sky_draws_of(tmp_path / "out")):
        assert (skies.values(k, exponents[k]) > 0).all()
        # what residuals and point sources, which this sky has not, add is small
        common, mean = skies.modes(k, exponents[k]), channels["mean"].values[k]
        assert np.abs(common - mean).max() < 0.1 * np.abs(mean).max()
        # three draws of each mode are within five standard deviations of the mean
        assert (np.abs(draws - mean) < 5.0 * channels["std"].values[k]).all()
    # all channels have one turntable
    offsets = table_of(tmp_path / "out" / "pointing.csv")
    value, true, std = ([float(row[name]) for row in offsets] for name in ("value", "true", "std"))
    assert len(value) == 3 and np.ptp(value) < 1e-9
    assert abs(value[0] - true[0]) < 4.0 * std[0] < 0.4
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["joint"]["components"] == ["level", "index"]
    assert "spectral.model=positive" in summary["joint"]["prior"]
    page = " ".join((tmp_path / "out" / "report.html").read_text().split())
    assert "component maps: level, index" in page and "is not used" in page


@pytest.mark.long
def test_joint_maps_of_low_frequencies_are_no_worse_than_independent_ones(tmp_path):
    """5 and 6 MHz, where absorption reddens the plane, and the errors towards the centre."""
    frequencies = [5.0, 6.0, 8.0, 12.0, 20.0, 40.0]
    given = ["lmax=10", "joint=true", "spectral.model=positive", f"frequencies_mhz={frequencies}"]
    scenario = lb.load_scenario("fiducial", given)
    channels = map_channels(scenario, tmp_path)
    mean, truth, independent = (channels.stacked(n) for n in ("mean", "truth", "independent"))
    # but for the monopole, which all know well
    worse = np.linalg.norm((independent - truth)[:, 1:], axis=1)
    assert (worse / np.linalg.norm((mean - truth)[:, 1:], axis=1) > 1.0).all()
    nside = scenario.map_nside
    lon, lat = healpy.pix2ang(nside, np.arange(healpy.nside2npix(nside)), lonlat=True)
    centre = (np.abs((lon + 180.0) % 360.0 - 180.0) < 10.0) & (np.abs(lat) < 10.0)
    for channel in channels.channels:
        z = (modes_to_map(channel.mean - channel.truth, nside) / channel.pixel_std)[centre]
        # lmax 10 resolves one or two places there: 3 sigma at most
        assert np.sqrt((z**2).mean()) < 3.0


def test_a_run_knows_its_input_files_by_their_content(tmp_path, monkeypatch):
    """Maps and samples are continued if a file is only touched, and not if it has other numbers."""
    path, seen = tmp_path / "cl.txt", []
    prior = f"prior={{spectrum_file: {path}}}"

    def finished(folder, identity, sampler):
        seen.append(identity)
        raise lb.InputError("enough")

    monkeypatch.setattr(sample_run, "_finished", finished)
    for spectrum in ("0 1e9\n1 1e8\n", "0 1e9\n1 1e8\n", "0 1e9\n1 2e8\n"):
        path.write_text(spectrum)
        scenario = lb.load_scenario("fiducial", [*SMALL[1::2], "lmax=1", prior])
        seen.append(folder_module.identity_of(scenario))
        refuse("enough", lb.run_sample, scenario, tmp_path / "out", resume=True)
    maps, samples = seen[::2], seen[1::2]
    assert maps[0] == maps[1] != maps[2] and samples[0] == samples[1]
    other = {name for name in samples[0] if samples[0][name] != samples[2][name]}
    assert "input file" in other and str(path) in samples[0]["input file"]
