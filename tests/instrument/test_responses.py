"""Four-port responses and waterfalls, against luseepy's own simulation and by hand."""

import json
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from assertions import close, off, refuse, within
from astropy.io import fits
from commands import judged_map, run, sets
from fits_files import effective_lengths, write_images, write_response
from reference import hemisphere, real_harmonics
from scipy.constants import Boltzmann, c, physical_constants

import lusee_bayes as lb
from lusee_bayes.experiment.model import radiometer
from lusee_bayes.instrument.beams.luseepy_files import CONVENTIONS
from lusee_bayes.instrument.beams.sampled import read_beam
from lusee_bayes.instrument.beams.source import CapacitorReceiver, JFETReceiver, read_receiver
from lusee_bayes.instrument.products import labels, to_matrix, to_real
from lusee_bayes.instrument.visibilities import read_visibilities
from lusee_bayes.instrument.waterfalls import read_waterfall, write_four_port
from lusee_bayes.testing import small_scenario

VACUUM = physical_constants["characteristic impedance of vacuum"][0]
LMAX, MOON = 47, 250.0


# --- luseepy's own simulation -------------------------------------------------------------------


@pytest.fixture(scope="module")
def luseepy(test_data):
    """(response, path of the waterfall, its images by name)."""
    folder = test_data / "luseepy"
    path = folder / "four_port_covariance.fits"
    with fits.open(path) as hdus:
        images = {hdu.name.lower(): np.array(hdu.data) for hdu in hdus}
    return read_beam(folder / "synthetic_response_v3.fits"), path, images


def matrix(images, name, channel) -> np.ndarray:
    return images[f"{name}_real"][channel] + 1j * images[f"{name}_imag"][channel]


FREQUENCIES = (5.0, 10.0, 25.0, 50.0)


@pytest.mark.parametrize("channel", range(4))
def test_loads_and_scales_are_luseepys(luseepy, channel):
    response, _, images = luseepy
    f = FREQUENCIES[channel]
    np.testing.assert_allclose(JFETReceiver().load(f), matrix(images, "zl", channel), rtol=1e-13)
    within(response.circuit(f).loading, matrix(images, "m", channel), 1e-14)
    enclosure = matrix(images, "blackbody_normalization", channel).diagonal().real
    np.testing.assert_allclose(response.per_kelvin(f), enclosure, rtol=1e-13)


def simulated(luseepy, test_data, frequency, times, *, fixed_axis=False) -> np.ndarray:
    """V^2/Hz of these samples."""
    response, path, _ = luseepy
    modes = lb.sky_from_file(test_data / "luseepy" / "sky_alm.npz", frequency, LMAX).modes
    observation = replace(read_waterfall(path).observation.select(times), fixed_axis=fixed_axis)
    response = replace(response, luseepy_quadrature=True, moon_k=MOON)
    beams = response.beams(frequency, LMAX)
    seen = np.asarray(lb.CouplingMatrix.observe(beams, observation) @ modes)
    moon = response.background(frequency)
    return volts(response, frequency, seen.reshape(16, -1) + moon[:, None])


def volts(response, frequency, kelvin) -> np.ndarray:
    """Beams, backgrounds or data in V^2/Hz at the receivers' inputs, of those in K."""
    root, matrix = np.sqrt(response.per_kelvin(frequency)), np.asarray(to_matrix(kelvin))
    scale = (root[:, None] * root[None]).reshape(4, 4, *(1,) * (matrix.ndim - 2))
    return np.asarray(to_real(matrix * scale))


@pytest.mark.essential
@pytest.mark.parametrize("channel", range(4))
def test_all_products_in_volts(luseepy, test_data, channel):
    """luseepy transforms the patterns in single precision (6e-8 each)."""
    frequency, expected = FREQUENCIES[channel], luseepy[2]["data"][:, :, channel].T
    every = np.ones(expected.shape[1], dtype=bool)
    # the first sample, where a fixed axis is no approximation, and all about the first one's axis
    assert off(simulated(luseepy, test_data, frequency, ~every | (np.arange(328) == 0)),
               expected[:, :1]) < 5e-8  # fmt: skip
    assert off(simulated(luseepy, test_data, frequency, every, fixed_axis=True), expected) < 1e-7
    # the Moon's axis wanders
    assert 5e-5 < off(simulated(luseepy, test_data, frequency, every), expected) < 5e-4


def test_all_products_of_the_first_sample(luseepy, test_data):
    first = simulated(luseepy, test_data, 25.0, np.arange(328) == 0)[:, 0]
    assert off(first, luseepy[2]["data"][0, :, 2]) < 3e-8


def test_sky_and_moon_of_one_temperature_are_an_enclosure(luseepy):
    """Short dipoles over a half-space: 1 K of both gives autos of 1 K. The file's Rsky is luseepy's
    quadrature (half a ring at the horizon), 2 degrees between samples."""
    for luseepys, tolerance in ((True, 1e-6), (False, 1e-3)):
        response = replace(luseepy[0], moon_k=1.0, luseepy_quadrature=luseepys)
        sky = np.asarray(response.beams(10.0, 4).modes)[:, 0] * np.sqrt(4 * np.pi)
        total = np.asarray(to_matrix(jnp.asarray(sky + response.background(10.0))[:, None]))
        np.testing.assert_allclose(total[..., 0].diagonal().real, 1.0, rtol=tolerance)


# --- by hand ------------------------------------------------------------------------------------


def varied(images):
    """Effective lengths that are not the same at all frequencies."""
    if "H_theta" in images:
        for k, factor in enumerate((1.0, 0.8 + 0.1j, 0.9 - 0.4j)):
            images["H_theta"][:, k] *= factor
            images["H_phi"][1, k] *= 1.5


def between(values, part):
    return (1.0 - part) * values[1] + part * values[2]


def test_between_frequencies_as_luseepy_does(tmp_path):
    """ZA, resistances and the integrals of open ports over lambda^2 go straight from 20 to 40 MHz;
    M is that of the ZA in between."""
    response = read_beam(write_response(tmp_path / "response.fits", varied, 3))
    f, part = 27.0, 0.35
    theta, phi, solid_angle = hemisphere(20, 40)
    harmonics, open_ = real_harmonics(theta, phi, 3) * solid_angle[:, None], []
    for k, mhz in enumerate((10.0, 20.0, 40.0)):
        lengths = zip(("H_theta", "H_phi"), effective_lengths(theta, phi), strict=True)
        images = {name: np.repeat(h[:, None] + 0j, 3, 1) for name, h in lengths}
        varied(images)
        pairs = sum(np.einsum("ip,jp,pm->ijm", h[:, k], h[:, k].conj(), harmonics)
                    for h in images.values())  # fmt: skip
        open_.append(Boltzmann * VACUUM * (1e6 * mhz / c) ** 2 * pairs)
    za, zl = between(response.impedance_ohm, part), JFETReceiver().load(f)
    m = zl @ np.linalg.inv(za + zl)
    expected = np.einsum("ai,ijm,bj->abm", m, between(open_, part), m.conj())
    largest = np.abs(expected).max()
    got = np.asarray(to_matrix(volts(response, f, response.beams(f, 3).modes)))
    # the file's single precision
    within(got, expected, 1e-6 * largest)
    splined = replace(response, interpolation="spline")
    splined = volts(splined, f, splined.beams(f, 3).modes)
    assert np.abs(np.asarray(to_matrix(splined)) - expected).max() > 1e-2 * largest
    warm = 4 * Boltzmann * 250.0 * m @ between(response.moon_ohm, part) @ m.conj().T
    got = volts(response, f, replace(response, moon_k=250.0).background(f)[:, None])
    close(to_matrix(got)[..., 0], warm, 1e-12)
    enclosure = 4 * Boltzmann * m @ ((za + za.conj().T) / 2) @ m.conj().T
    np.testing.assert_allclose(response.per_kelvin(f), enclosure.diagonal().real, rtol=1e-12)
    # nothing is interpolated where the file has the frequency, to luseepy's 1e-6 MHz
    opened = replace(response, receiver=None)
    exact = opened.beams(20.0, 3).modes
    np.testing.assert_array_equal(opened.beams(20.0 + 9e-7, 3).modes, exact)
    close(replace(opened, interpolation="spline").beams(20.0, 3).modes, exact, 1e-13)


def test_receivers(tmp_path):
    """Loads by hand, and the voltages M of any of them."""
    w = 2e6 * np.pi * 20.0
    preamplifiers = {
        "capacitance_pf": (30.0, 40.0, 35.0, 20.0),
        "inductance_nh": (0.0, 10.0, 20.0, 30.0),
        "parallel_ohm": (1e5, 2e5, 3e5, 4e5),
        "series_ohm": (1.0, 2.0, 0.0, 3.0),
        "skin_ohm": (0.0, 1e-12, 0.0, 0.0),
        "skin_power": (1.0, 1.4, 2.0, 2.0),
    }
    z = [
        r + a * w**n + 1j * w * 1e-9 * ind + 1.0 / (1.0 / rp + 1j * w * 1e-12 * cap)
        for cap, ind, rp, r, a, n in zip(*preamplifiers.values(), strict=True)
    ]
    np.testing.assert_allclose(JFETReceiver(**preamplifiers).load(20.0), np.diag(z), rtol=1e-13)
    z = [1.0 / (1j * w * cap * 1e-12) for cap in (30.0, 40.0, 35.0, 20.0)]
    capacitors = CapacitorReceiver(capacitance_pf=(30.0, 40.0, 35.0, 20.0))
    np.testing.assert_allclose(capacitors.load(20.0), np.diag(z), rtol=1e-13)
    # measured, coupled loads: straight lines between the frequencies, none beyond
    rng = np.random.default_rng(2)
    loads = 100.0 * (rng.standard_normal((2, 4, 4)) + 1j * rng.standard_normal((2, 4, 4)))
    images = {"freq": np.array([10.0, 30.0]), "ZL_real": loads.real, "ZL_imag": loads.imag}
    measured = read_receiver(write_images(tmp_path / "zl.fits", images, {}))
    zl = 0.45 * loads[0] + 0.55 * loads[1]
    np.testing.assert_allclose(measured.load(21.0), zl, rtol=1e-13)
    refuse(r"zl\.fits.*10 to 30 MHz.* 31", measured.load, 31.0)
    open_ = replace(read_beam(write_response(tmp_path / "response.fits")), receiver=None)
    np.testing.assert_array_equal(open_.circuit(20.0).loading, np.eye(4))
    response = replace(open_, receiver=measured)
    za = 0.95 * response.impedance_ohm[1] + 0.05 * response.impedance_ohm[2]
    loading = zl @ np.linalg.inv(za + zl)
    np.testing.assert_allclose(response.circuit(21.0).loading, loading, rtol=1e-12)


def test_losses_emit_at_the_antennas_temperature(tmp_path):
    def lossy(images):
        if "Rloss" in images:
            images["Rloss"] = np.tile(0.5 * np.eye(4), (3, 1, 1))
            images["ZA"] = images["ZA"] + images["Rloss"]

    response = read_beam(write_response(tmp_path / "response.fits", lossy))
    m = response.circuit(20.0).loading
    expected = 4 * Boltzmann * 300.0 * 0.5 * m @ m.conj().T
    got = volts(response, 20.0, replace(response, antenna_k=300.0).background(20.0)[:, None])
    close(to_matrix(got)[..., 0], expected, 1e-9)


UNUSABLE = [
    ("freq", lambda f: f[::-1].copy(), "freq does not increase"),
    ("ZA_real", lambda za: za[:, :3], "ZA_real has shape"),
    ("Rmoon", lambda r: 2 * r, "Rsky . Rmoon . Rloss differ"),
    ("theta", lambda theta: 2 * theta, "theta goes 0 to 180, expected 0 to 90"),
]


@pytest.mark.parametrize(("name", "change", "message"), UNUSABLE)
def test_files_that_cannot_be_used(tmp_path, name, change, message):
    def changed(images):
        if name in images:
            images[name] = change(images[name])

    refuse(message, read_beam, write_response(tmp_path / "response.fits", changed))


# --- in scenarios -------------------------------------------------------------------------------


def test_a_scenario_with_a_response_and_a_warm_moon(tmp_path):
    path = write_response(tmp_path / "response.fits")
    given = ["frequency_mhz=20", f"beam.file={path}", "beam.moon_temperature_k=5e4"]
    cold_scenario = small_scenario(*given[:-1], cycles=0.05)
    warm, cold = lb.build(small_scenario(*given, cycles=0.05)), lb.build(cold_scenario)
    setup, data = warm.setup, warm.data
    np.testing.assert_array_equal(setup.beams.modes, read_beam(path).beams(20.0, 6).modes)
    moon = np.asarray(replace(read_beam(path), moon_k=5e4).background(20.0))
    np.testing.assert_array_equal(setup.background, moon[:, None] * np.ones(data.layout.n_times))
    np.testing.assert_array_equal(cold.setup.background, 0.0)
    added = np.asarray(setup.signal) - np.asarray(cold.setup.signal)
    np.testing.assert_allclose(added, np.tile(moon[:, None], added.shape[1]), rtol=1e-9, atol=1e-6)
    assert cold.setup.offset is None
    # the Moon's radiation is taken off the data again, and is part of the noise level
    assert data.data.mean() > cold.data.data.mean()
    levels = [float(radiometer(e.setup).diagonal().sum()) for e in (warm, cold)]
    assert levels[0] > levels[1]
    sky, posterior = np.asarray(setup.sky.modes), lb.infer(warm).posterior
    off_by = (np.asarray(posterior.mean) - sky) / np.asarray(posterior.std())
    assert np.sqrt((off_by**2).mean()) < 1.5
    wrong = lb.infer(lb.build(cold_scenario, data)).posterior
    off_by = (np.asarray(wrong.mean) - sky) / np.asarray(wrong.std())
    assert off_by[0] > 5.0  # a warm Moon looks like a warmer sky


OPEN = ["beam.file={response}", "beam.moon_temperature_k=250", "beam.receiver=open"]
OTHERS = [
    ([], "give the response as beam.file"),
    (OPEN[:1], "use --set beam.moon_temperature_k=250"),
    (OPEN, "remove beam.receiver to use the loads ZL in the data"),
    (["frequency_mhz=11"], "no channel at 11 MHz"),
]


@pytest.mark.parametrize(("overrides", "message"), OTHERS)
def test_data_of_another_instrument(luseepy, overrides, message):
    response, path, _ = luseepy
    given = ["frequency_mhz=10", *(o.format(response=response.path) for o in overrides)]
    refuse(message, lb.read_data, path, lb.load_scenario("fiducial", given))


def test_luseepys_data_in_kelvin(luseepy):
    response, path, images = luseepy
    given = ["frequency_mhz=10", f"beam.file={response.path}", "beam.moon_temperature_k=250"]
    data = lb.read_data(path, lb.load_scenario("fiducial", given))
    assert (data.n_missing, data.frequency_mhz) == (0, 10.0)
    enclosure = matrix(images, "blackbody_normalization", 1).diagonal().real
    for place, label in enumerate(labels()):
        i, j = int(label[0]), int(label[1])
        expected = images["data"][:, place, 1] / np.sqrt(enclosure[i] * enclosure[j])
        np.testing.assert_allclose(data.grid()[place], expected, rtol=1e-14)


@pytest.mark.long
def test_the_map_from_luseepys_four_ports(luseepy, tmp_path, test_data):
    """10 MHz, V^2/Hz, the Moon at 250 K, a fixed axis: what short dipoles can see comes back."""
    response, path, _ = luseepy
    given = ["frequency_mhz=10", f"beam.file={response.path}", "beam.quadrature=luseepy"]
    given += ["beam.moon_temperature_k=250", "observation.fixed_axis=true"]
    given.append(f"sky.file={test_data / 'luseepy' / 'sky_alm.npz'}")
    rho, summary = judged_map(path, given, tmp_path / "map")
    assert rho[[1, 2, 3, 5, 7]].min() > 0.9 and rho[1::2].min() > 0.7
    assert np.abs(rho[4::2]).mean() < 0.2
    # noiseless but for luseepy's single precision
    assert summary["chi2"] < 0.01 * summary["chi2_expected"]


# --- what headers state -------------------------------------------------------------------------


CONTRADICTIONS = [
    *({key: "another"} for key in CONVENTIONS), {"INPUT_KIND": "loaded"}, {"FIELD_KIND": "rE"},
    {"FIELD_UNIT": "V/m"}, {"FIELD_UNIT": "m", "NORM_KIND": "current"}, {"NORM_KIND": "guessed"},
    {"BUNIT": "V"},
]  # fmt: skip


@pytest.mark.parametrize("words", CONTRADICTIONS, ids=str)
def test_headers_that_contradict_the_reader_are_refused(tmp_path, words):
    path = write_response(tmp_path / "response.fits")
    for key, value in words.items():
        fits.setval(path, f"HIERARCH {key}", value=value)
    with pytest.raises(lb.InputError, match="|".join([*words, "unit"])) as refused:
        read_beam(path)
    assert "expected" in str(refused.value) or "known" in str(refused.value)


def test_headers_that_state_what_the_reader_assumes_are_read(luseepy, tmp_path):
    """luseepy's own words, those of a converted simulation, and those that it was not given."""
    assert luseepy[0].n_phi == 180
    path = write_response(tmp_path / "response.fits")
    converted = {"NORM_KIND": "vsource", "INPUT_KIND": "embedded", "FIELD_UNIT": "V"}
    for words in (converted, dict.fromkeys(converted, "UNKNOWN")):
        for key, value in words.items():
            fits.setval(path, f"HIERARCH {key}", value=value)
        read_beam(path)


# --- waterfalls in luseepy's layout of four ports -------------------------------------------------


MATRICES = ("ZA", "ZL", "M", "Rsky", "Rmoon", "Rloss", "blackbody_normalization")


def test_luseepys_four_ports_are_written_back(luseepy, tmp_path):
    """Its data through K and back; every image and word that it has, in its place."""
    response, original, _ = luseepy
    waterfall = read_waterfall(original)
    channels = [waterfall.at(f) for f in waterfall.frequencies_mhz]
    circuits = [response.circuit(f) for f in waterfall.frequencies_mhz]
    words = {"moon_k": 250.0, "response": response.path}
    path = write_four_port(tmp_path / "w.fits", channels, circuits, **words)
    with fits.open(path) as ours, fits.open(original) as theirs:
        assert [hdu.header["EXTNAME"] for hdu in ours] == [h.header["EXTNAME"] for h in theirs]
        for one, other in zip(ours, theirs, strict=True):
            assert one.header.get("BUNIT") == other.header.get("BUNIT")
            assert one.shape == other.shape if one.is_image else one.data.dtype == other.data.dtype
        for word in ("TIMESYS", "TIMEFMT", "TIMEUNIT"):
            assert ours["time"].header[word] == theirs["time"].header[word]
        for word in ("VERSION", "LUN_LAT_DEG", "LUN_LONG_DEG", "LUN_HEIGHT_M", "DELTAT_SEC",
                     "RESPONSE", "FREQINT", "RECMODEL", "TMOON_K", "TANT_K", "BUNIT"):  # fmt: skip
            assert ours[0].header[word] == theirs[0].header[word], word
        np.testing.assert_array_equal(ours["time"].data, theirs["time"].data)
        np.testing.assert_array_equal(ours["products"].data, theirs["products"].data)
        for name in ("data", *MATRICES):
            parts = [name] if name == "data" else [f"{name}_real", f"{name}_imag"]
            largest = max(np.abs(theirs[part].data).max() for part in parts)
            # luseepy's Rsky is what its own integrals give, the file's has 24 bits
            tolerance = 1e-7 if name in ("Rsky", "Rmoon") else 1e-14
            for part in parts:
                off = np.abs(ours[part].data - theirs[part].data).max()
                assert off <= tolerance * largest, part
        condition = "loading_condition_number"
        np.testing.assert_allclose(ours[condition].data, theirs[condition].data, rtol=1e-12)
        eigenvalues = "covariance_eigenvalues"
        largest = theirs[eigenvalues].data.max()
        within(ours[eigenvalues].data, theirs[eigenvalues].data, 1e-12 * largest)
        told = [json.loads(file["receiver_params"].data.tobytes()) for file in (ours, theirs)]
        assert told[0] == told[1]
    back = read_waterfall(path)
    # a multiplication and a division by the same number
    np.testing.assert_allclose(back.grid, waterfall.grid, rtol=3e-16, atol=0)
    assert (back.moon_k, back.antenna_k, back.interpolation) == (250.0, 0.0, "linear-native-alm")
    assert not (back.observation.times - waterfall.observation.times).to_value("s").any()


def test_gaps_are_written(luseepy, tmp_path):
    response, original, _ = luseepy
    waterfall, keep = read_waterfall(original), np.arange(328) % 7 < 3
    grid = waterfall.grid[:, keep, :1].copy()
    grid[3, 2] = np.nan
    first = {name: getattr(waterfall, name)[:1] for name in ("frequencies_mhz", "per_kelvin")}
    part = replace(waterfall, grid=grid, observation=waterfall.observation.select(keep), **first)
    path = write_four_port(tmp_path / "w.fits", [part.at(5.0)], [response.circuit(5.0)])
    back = read_waterfall(path)
    np.testing.assert_allclose(back.grid, grid, rtol=3e-16, atol=0)
    assert not (back.observation.times - part.observation.times).to_value("s").any()
    with fits.open(path) as hdus:
        gaps = np.isnan(hdus["covariance_eigenvalues"].data)
    assert gaps.sum() == 4 and gaps[2].all()


def test_open_ports_have_no_loads_to_write(luseepy, tmp_path):
    response, original, _ = luseepy
    channel = read_waterfall(original).at(5.0)
    circuit, path = replace(response, receiver=None).circuit(5.0), tmp_path / "w.fits"
    refuse(r"ports.*open.*beam\.rec", write_four_port, path, [channel], [circuit])
    assert not list(tmp_path.iterdir())


@pytest.mark.essential
def test_simulated_and_mapped_between_the_responses_frequencies(luseepy, tmp_path):
    """14.5 MHz / 3, a Moon of many digits, other receivers, which nothing but the data say."""
    response, *_ = luseepy
    path, moon, capacitor = tmp_path / "w.fits", 251.23456789012345, "{model: capacitor}"
    beam = [f"beam.file={response.path}", "lmax=4", "observation.runs.0.cycles=0.03"]
    warm, f = f"beam.moon_temperature_k={moon!r}", 14.5 / 3 + 2.0

    def simulate(*further):
        command = ["simulate", "fiducial", "-o", path, "--frequencies", f"{f!r},10", "-q"]
        return run(*command, "--force", *sets(*beam, warm, *further))

    assert simulate(f"beam.receiver={capacitor}") == 0
    scenario = lb.load_scenario("fiducial", [*beam, f"frequency_mhz={f!r}", warm])
    data = lb.read_data(path, scenario)
    setup = lb.build(scenario, data).setup
    expected = replace(response, receiver=CapacitorReceiver()).beams(f, 4)
    # the loads go through the file bit by bit
    within(setup.beams.modes, expected.modes, 1e-14)
    sure = lb.load_scenario("fiducial", [*beam, f"frequency_mhz={f!r}", warm,
                                         f"beam.receiver={capacitor}"])  # fmt: skip
    np.testing.assert_allclose(data.grid(), lb.build(sure).data.grid(), rtol=1e-14)
    # and through the package's own files
    own = read_visibilities(data.write(tmp_path / "own.nc"))
    np.testing.assert_array_equal(own.receiver.load(f), data.receiver.load(f))
    np.testing.assert_array_equal(lb.build(scenario, own).setup.beams.modes, setup.beams.modes)

    # what hints say is accepted
    given = [*beam, "frequency_mhz=6.83333", "beam.moon_temperature_k=251.235"]
    for key in ("frequency_mhz", "beam.moon_temperature_k"):
        with pytest.raises(lb.InputError, match=f"use --set {key}=") as caught:
            lb.read_data(path, lb.load_scenario("fiducial", given))
        given.append(str(caught.value).split("--set ")[1])
    lb.read_data(path, lb.load_scenario("fiducial", given))

    # other receivers, another rule
    for override, message in (
        ("beam.receiver=jfet", "remove beam.receiver"),
        ("beam.interpolation=spline", "use --set beam.interpolation=linear"),
    ):
        refuse(message, lb.read_data, path, lb.load_scenario("fiducial", [*given, override]))
    assert simulate("beam.interpolation=spline") == 0
    words = "use --set beam.interpolation=spline"
    refuse(words, lb.read_data, path, lb.load_scenario("fiducial", given))
    lb.read_data(path, lb.load_scenario("fiducial", [*given, "beam.interpolation=spline"]))
    # where the response has the frequency nothing is interpolated
    lb.read_data(path, lb.load_scenario("fiducial", [*given, "frequency_mhz=10"]))
