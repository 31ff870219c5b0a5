"""Data of the spectrometer: from a sky to counts and back; maps of files and of data in kelvin."""

from dataclasses import replace

import numpy as np
import pytest
from assertions import refuse
from experiments import unknowns_report
from naive_flight import naive_band
from tables import tables

import lusee_bayes as lb
from lusee_bayes.experiment.data_files import per_kelvin_of, reduce_files
from lusee_bayes.experiment.flight_simulation import simulate_flight
from lusee_bayes.experiment.model import set_up
from lusee_bayes.flight import gain_model, recipe, session, synthesis
from lusee_bayes.flight.reduced import BURST, COMB, NO_DATA, SATURATED, USED, write_reduced
from lusee_bayes.flight.session_files import read_session
from lusee_bayes.instrument.products import all_products, auto_indices, labels
from lusee_bayes.instrument.visibilities import Calibration
from lusee_bayes.noise.radiometer import exact_blocks

TABLES = tables(__file__)

FREQUENCIES = [10.0, 25.0]
SMALL = ["lmax=4", f"frequencies_mhz={FREQUENCIES}", "flight={per_kelvin_v2_hz: 1e-21}"]
AUTOS = [0, 7, 12, 15]


def simulated(folder, *more, rows=8, step_s=1800.0, average_s=None):
    """Sessions, reduced, and the table of what is in them."""
    cycles = (rows + 0.5) * step_s / (27.321661 * 86400.0)
    size = [f"observation.runs=[{{cycles: {cycles}}}]", f"observation.step_s={step_s}"]
    files = lb.run_simulate_flight(lb.load_scenario("fiducial", [*SMALL, *size, *more]), folder)
    assert files.n_spectra == rows
    average = f"observation.average_s={'null' if average_s is None else average_s}"
    reduced = reduce_files(list(files.sessions), lb.load_scenario(str(files.scenario), [average]))
    with np.load(folder / "truth.npz") as truth:
        return reduced, dict(truth)


def relative_error(reduced, truth):
    """Of each product, in the mean of the autos."""
    true = truth["visibility_v2_hz"]
    return np.abs((reduced.values - true) / true[:, AUTOS].mean(axis=1, keepdims=True))


QUIET = "flight.simulated.radiometer=false"
# what the spectrum does within a band of 1 MHz beyond a parabola is 6e-6 at 10 MHz
EXACT = "flight.degree=4"


@pytest.mark.parametrize(("state", "more"), TABLES["states"])
def test_visibilities_come_back(tmp_path, state, more):
    state = f"flight.simulated={{radiometer: false, {state}}}"
    reduced, truth = simulated(tmp_path, EXACT, state, more)
    assert relative_error(reduced, truth).max() < 1e-6
    assert (reduced.reason == USED).all()
    levels = {"".join(one) for one in reduced.level}
    assert levels == {"".join(one) for one in truth["level"]}
    assert len(levels) == (2 if "switch" in state else 1)


def test_another_sign_or_origin_is_seen(tmp_path):
    made, _ = simulated(tmp_path, QUIET, rows=4)
    scenario = lb.load_scenario(str(tmp_path / "scenario.yaml"), ["observation.average_s=null"])
    given = scenario.flight
    for change in ({"convention": "conj(s_i) s_j"}, {"bin_origin": "edge"}):
        scenario = scenario.model_copy(update={"flight": given.model_copy(update=change)})
        other = reduce_files([tmp_path / "session_000.h5"], scenario)
        assert relative_error(other, {"visibility_v2_hz": made.values}).max() > 1e-3


def test_times_and_windows_are_those_of_the_observation(tmp_path):
    reduced, truth = simulated(tmp_path, "flight.simulated.clock=unknown", QUIET, step_s=42.0)
    assert np.abs((reduced.observation.times.mjd - truth["mjd_utc"]) * 86400.0).max() < 1e-4
    np.testing.assert_allclose(reduced.observation.windows.live_s, 2**20 * 40e-6, rtol=1e-12)
    assert truth["frames"] == 2**20


def test_the_turntable_turns_within_a_session(tmp_path):
    runs = "observation.runs=[{cycles: 0.0045}, {cycles: 0.0045, turntable_deg: 30}]"
    reduced, truth = simulated(tmp_path, QUIET, EXACT, runs, rows=10)
    assert relative_error(reduced, truth).max() < 1e-6
    scenario = lb.load_scenario(str(tmp_path / "scenario.yaml"), ["observation.average_s=null"])
    data = lb.read_data(tmp_path / "session_000.h5", scenario)
    assert data.observation.turntable_deg == (0.0, 30.0)
    assert data.observation.run.tolist() == 5 * [0] + 5 * [1]
    # and the model sees the sky that the sessions hold
    signal = set_up(scenario, data).signal
    np.testing.assert_allclose(data.grid(), signal, atol=1e-6 * np.abs(signal).max())


def test_reduced_spectra_are_mapped_as_they_were_reduced(tmp_path):
    """What another scenario says of the reduction is not ignored."""
    reduced, _ = simulated(tmp_path, QUIET, rows=4)
    given = str(tmp_path / "scenario.yaml"), ["observation.average_s=null", "frequency_mhz=10.0"]
    scenario = lb.load_scenario(*given)
    path = write_reduced(tmp_path / "reduced.nc", reduced, scenario.to_yaml())
    lb.read_data(path, scenario)
    lb.read_data(path, lb.load_scenario("fiducial", [*SMALL, "frequency_mhz=10.0"]))
    for key, value in (
        ("flight.turntable_deg", "45"),
        ("flight.bin_origin", "edge"),
        ("flight.convention", "conj(s_i) s_j"),
        ("observation.timestamp", "end"),
        ("observation.average_s", "7200"),
    ):
        other = lb.load_scenario(given[0], [*given[1], f"{key}={value}"])
        refuse(f"was reduced with {key}=", lb.read_data, path, other)


@pytest.mark.long
def test_receiver_noise_is_that_of_the_frames_and_channels(tmp_path):
    reduced, truth = simulated(tmp_path, rows=150, step_s=42.0)
    for band, f in enumerate(FREQUENCIES):
        true = truth["visibility_v2_hz"][band]
        blocks = np.array(exact_blocks(true)) / reduced.n_averaged[band][:, None, None]
        off = (reduced.values[band] - true).T
        chi2 = np.einsum("rp,rp->r", off, np.linalg.solve(blocks, off[..., None])[..., 0])
        kept = reduced.reason[band] == USED
        assert kept.mean() > 0.99
        z = (chi2[kept].sum() / 16.0 / kept.sum() - 1.0) * np.sqrt(8.0 * kept.sum())
        assert abs(z) < 4.0, f
        # the spread of all products in whitened coordinates, not their sum alone
        white = np.linalg.solve(np.linalg.cholesky(blocks[kept]), off[kept][..., None])[..., 0]
        spread = white.T @ white / kept.sum()
        assert np.abs(spread - np.eye(16)).max() < 5.0 * np.sqrt(2.0 / kept.sum())
    # a band of 40 channels and a parabola: less than 40 independent samples a frame
    assert 0.3 * 40 < reduced.n_averaged.max() / truth["frames"] < 40.0


DISTURBED = (
    "flight.simulated={tones_mhz: [9.8, 24.7, 25.1], tone_share: 0.1, saturated_share: 0.03, "
    "comb_share: 0.05, burst_every_h: 1.0, burst_s: 900, absent_share: 0.02}"
)


@pytest.mark.essential
def test_disturbances_are_found_and_little_else(tmp_path):
    reduced, truth = simulated(tmp_path, DISTURBED, "seed=4", rows=500, step_s=42.0, average_s=7200)
    saturated, tone, comb = truth["saturated"], truth["tone"], truth["comb"]
    burst = truth["burst"] & ~saturated
    assert min(saturated.sum(), tone.sum(), comb.sum(), burst.sum()) > 8
    mhz = np.arange(2048) * session.CHANNEL_MHZ
    for band, f in enumerate(FREQUENCIES):
        reason = reduced.reason[band]
        np.testing.assert_array_equal(reason == SATURATED, saturated)
        assert (reason[burst] == BURST).mean() >= 0.95
        assert (reason[~burst & ~saturated] == BURST).mean() <= 1e-3
        assert not np.isin(reason, [NO_DATA, COMB]).any()
        within = np.abs(mhz - f) <= 0.5 + 1e-9
        of_comb = comb[:, None] & (np.arange(2048)[within] % 4 == 2)
        injected = (tone[:, None] & truth["tone_channel"][within]) | of_comb
        flagged = np.rint(reduced.lines[band] * within.sum())
        rows, expected = ~saturated, injected.sum(axis=1)
        found = np.minimum(flagged, expected)[rows].sum() / expected[rows].sum()
        others = np.maximum(flagged - expected, 0)[rows].sum() / (~injected[rows]).sum()
        assert found >= 0.95
        assert others <= 1e-3
    # what is left agrees with the sky
    bins, n = reduced.bin_of, reduced.values.shape[2]
    for band in range(2):
        kept = (reduced.reason[band] == USED).astype(float)
        true = truth["visibility_v2_hz"][band][AUTOS]
        mean = np.array([np.bincount(bins, kept * t, n) / np.bincount(bins, kept, n) for t in true])
        z = (reduced.values[band][AUTOS] / mean - 1.0) * np.sqrt(reduced.n_averaged[band])
        assert np.abs(z).max() < 4.5


@pytest.mark.long
def test_bursts_of_an_hour_are_found_and_little_else(tmp_path):
    """One is at the end of a span, where nothing holds the curve down."""
    bursts = "flight.simulated={burst_every_h: 2.0, burst_s: 3600, absent_share: 0.01}"
    given, size = (bursts, "seed=5", "frequencies_mhz=[10]"), {"rows": 674, "step_s": 42.0}
    reduced, truth = simulated(tmp_path, *given, **size, average_s=7200)
    burst = truth["burst"]
    assert (reduced.reason[0][burst] == BURST).mean() >= 0.95
    assert (reduced.reason[0][~burst] == BURST).mean() <= 1e-3


def test_products_that_are_absent_are_absent(tmp_path):
    reduced, truth = simulated(tmp_path, "flight.simulated.absent_share=0.5", QUIET, EXACT, rows=12)
    assert truth["absent"].any()
    gone = np.isnan(reduced.values).sum(axis=1)
    np.testing.assert_array_equal(gone[0], truth["absent"].sum(axis=1))
    assert relative_error(reduced, truth)[np.isfinite(reduced.values)].max() < 1e-6


@pytest.mark.long
def test_the_same_seed_makes_the_same_disturbances_and_noise(tmp_path):
    one, first = simulated(tmp_path / "a", DISTURBED, rows=20)
    two, second = simulated(tmp_path / "b", DISTURBED, rows=20)
    np.testing.assert_array_equal(one.values, two.values)
    for name, values in first.items():
        np.testing.assert_array_equal(values, second[name])


@pytest.mark.parametrize("changes, text", TABLES["no sessions"])
def test_what_makes_no_sessions_is_refused(changes, text):
    refuse(text, simulate_flight, lb.load_scenario("fiducial", [*SMALL, *changes]))


def test_a_tone_that_no_bin_holds_is_refused():
    """Navgf 3 leaves out every fourth channel, the last of each bin."""

    def drawn(channel):
        section = recipe.FlightSimulatedSection(navgf=3, tones_mhz=(0.025 * channel,))
        return synthesis.Disturbances.drawn(section, np.arange(20.0), 3600.0, "centre", 1)

    for channel in (1000, 1001, 1002):
        assert np.flatnonzero(drawn(channel).tone_channel).tolist() == [channel]
    refuse(r"channel 1003.*Navgf 3.*25\.(05|1) MHz", drawn, 1003)


@pytest.mark.long
def test_gains_are_off_as_they_are_said_to_be(tmp_path):
    """By the table the values are those of gains that are off by what the truth says."""
    off = "flight.gain_std=0.02", "flight.component_std=[0.01, 0.02]", "noise.gain_table={}"
    reduced, truth = simulated(tmp_path, QUIET, EXACT, *off, rows=3, step_s=7200.0)
    z = dict(zip(truth["gain_error_name"].tolist(), truth["gain_error"].tolist(), strict=True))
    assert len(z) == 3 * 4 * 3
    known, _ = simulated(tmp_path / "known", QUIET, EXACT, rows=3, step_s=7200.0)
    seen, table = read_session(tmp_path / "session_000.h5").telemetry, gain_model.synthetic_gains()
    eps = np.empty((4, len(FREQUENCIES), 3))
    for port in range(4):
        basis = table.basis("M", port, np.array(FREQUENCIES))[..., None]
        gain = basis[0] + np.einsum("nr,rfk->fn", table.strengths("M", port, seen), basis[1:])
        parts = [s * z[f"M{port} PC{r + 1}"] * basis[1 + r] for r, s in enumerate((0.01, 0.02))]
        eps[port] = 0.02 * z[f"M{port}"] + sum(parts) / gain
    assert np.abs(eps).min() > 1e-4 and np.abs(eps).max() > 0.01
    for band in range(len(FREQUENCIES)):
        for k, product in enumerate(all_products()):
            ratio = np.sqrt((1.0 + eps[product.i, band]) * (1.0 + eps[product.j, band]))
            level = np.abs(known.values[band, AUTOS]).mean()
            off = reduced.values[band, k] - ratio * known.values[band, k]
            # what eps does within the band beyond a polynomial of degree 4
            assert np.abs(off).max() < 2e-6 * level
    # and these are the slopes by which the map has them
    gains = reduced.at(10.0, np.full(4, 1e-21)).calibration
    slope = dict(zip(gains.gain_names, gains.gain_slope, strict=True))
    for port in range(4):
        names = [name for name in z if name.startswith(f"M{port}")]
        found = sum(z[name] * slope[name] for name in names)
        # the mean of log(f / 20 MHz) / 5 over the band is 1e-4 below that in its middle
        np.testing.assert_allclose(found, eps[port, 0], rtol=0.0, atol=1e-5)


NAMES = "abcd"


@pytest.fixture(scope="module")
def truth(flight):
    return dict(np.load(flight / "truth.npz"))


def scenario_of(flight, *changes):
    luseepy = flight.parent / "luseepy"
    given = [
        "frequency_mhz=10.0",
        "lmax=32",
        "observation={timestamp: instant}",
        f"beam={{model: response, file: {luseepy / 'synthetic_response_v3.fits'}, receiver: jfet, "
        "moon_temperature_k: 250.0, exact: true}",
        f"sky={{model: file, file: {luseepy / 'sky_alm.npz'}}}",
        "prior={model: isotropic, spectrum: sky}",
        "noise={radiometer: {form: exact, temperature: measured}, "
        "receiver: {power_v2_hz: 4.0e-20, relative_std: 0.1}, above_lmax: {treatment: ignored}}",
        f"flight={{gain_table: {flight / 'gain'}, bin_origin: centre}}",
    ]
    return lb.load_scenario("fiducial", [*given, *changes])


def files(flight):
    return [flight / f"session_{name}.h5" for name in NAMES]


@pytest.fixture(scope="module")
def mapped(flight):
    """One map of the four sessions, with everything that is done to them."""
    scenario = scenario_of(flight)
    experiment = lb.build(scenario, lb.read_data(files(flight), scenario))
    return experiment, lb.infer(experiment)


@pytest.mark.essential
def test_what_the_comb_spoils_and_nothing_else_is_left_out(mapped, truth):
    """Of bins that hold four channels each, the comb is no line: only the others tell."""
    experiment, _ = mapped
    comb = [(s, int(r)) for s, r in truth["comb"] if s == "c"]
    saturated = {(s, int(r)) for s, r in truth["saturated"]}
    names = [(s, int(r)) for s, r in zip(truth["session"], truth["row"], strict=True)]
    times = [name for name in names if name not in saturated]
    assert [times[k] for k in np.flatnonzero(experiment.fitting.flagged.all(axis=0))] == comb
    assert "3 of 124 times" in experiment.fitting.remark


@pytest.mark.long
def test_the_map_is_that_of_the_same_data_in_kelvin(flight, truth, mapped):
    """Data that are made by hand, a sum for each product, and know nothing of sessions."""
    _, found = mapped
    per_kelvin = truth["per_kelvin_v2_hz"][0]
    scale = np.sqrt([per_kelvin[int(x[0])] * per_kelvin[int(x[1])] for x in labels()])
    bad = {(s, int(r)) for s, r in [*truth["comb"], *truth["saturated"]] if s == "c"}
    names = [(s, int(r)) for s, r in zip(truth["session"], truth["row"], strict=True)]
    keep, combs = [k for k, name in enumerate(names) if name not in bad], [("d", 4), ("d", 5)]
    made = [naive_band(flight, *names[k], 10.0, comb=names[k] in combs) for k in keep]
    said = {"timestamp": "instant", "step_s": float(truth["integration_s"])}
    said |= {"site": (float(truth["lon_deg"]), float(truth["lat_deg"])), "products": list(labels())}
    values = np.array([values for values, _ in made]) / scale
    data = lb.Visibilities.from_arrays(values, truth["times_utc"][keep], 10.0, **said)
    # how many samples there are is not said by times
    data = replace(data, calibration=Calibration(np.array([n for _, n in made])))
    other = lb.infer(lb.build(scenario_of(flight, "flight.leave_out=false"), data)).posterior
    std = np.asarray(other.std())
    assert np.abs((np.asarray(found.posterior.mean) - np.asarray(other.mean)) / std).max() < 0.01
    np.testing.assert_allclose(np.asarray(found.posterior.std()), std, rtol=1e-3)


@pytest.mark.essential
def test_the_known_sky_is_within_the_error_bars(mapped):
    experiment, found = mapped
    off = found.posterior.whiten(np.asarray(experiment.setup.sky.modes)[None])[0]
    # an isotropic prior of the sky's own C_ell: chi^2 of the modes scatters by sqrt(2 n)
    n = len(off)
    assert np.sum(off**2) == pytest.approx(n, abs=5.0 * np.sqrt(2.0 * n))
    told = unknowns_report(experiment, found).table.set_index("unknown")
    truth_k = 4e-20 / per_kelvin_of(experiment.scenario)
    for port in range(4):
        row = told.loc[f"receiver_{port}_k"]
        assert abs(row["value"] - truth_k[port]) < 5.0 * row["std"]
        assert row["std"] < 0.1 * row["prior_std"]


@pytest.mark.parametrize(("changes", "told"), TABLES["asked"])
def test_what_files_leave_open_is_asked_for_by_name(flight, changes, told):
    refuse(told, lb.read_data, files(flight)[:1], scenario_of(flight, *changes))


def test_volts_that_beams_do_not_know_can_be_given(flight):
    no_volts = "beam={model: monopole}", "noise.receiver=null"
    scenario = scenario_of(flight, *no_volts, "flight.per_kelvin_v2_hz=5.0e-23")
    data = lb.read_data(files(flight)[:1], scenario)
    autos = data.grid()[auto_indices()]
    assert 1e5 < autos.min() < autos.max() < 2e5


def test_sessions_are_given_once_not_mixed_with_other_files_and_of_the_site(flight):
    scenario, one = scenario_of(flight), files(flight)[0]
    refuse("twice", reduce_files, [one, one], scenario)
    refuse("truth.npz", lb.read_data, [one, flight / "truth.npz"], scenario)
    elsewhere = scenario_of(flight, "observation.lat_deg=-20.0")
    refuse("use --set observation", set_up, elsewhere, lb.read_data(files(flight)[:1], elsewhere))
    ours = scenario_of(flight, "observation.lat_deg=-20.0", "flight.site=scenario")
    assert lb.read_data(files(flight)[:1], ours).observation.lat_deg == -20.0
