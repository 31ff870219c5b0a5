"""Waterfalls in luseepy's layout of four ports: written, read back, and between frequencies."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from astropy.io import fits
from closeness import within

import lusee_bayes as lb
from lusee_bayes.cli.main import main
from lusee_bayes.instrument.beams import CapacitorReceiver, read_beam


@pytest.fixture(scope="module")
def luseepy(test_data):
    """(response, path of the waterfall)."""
    folder = test_data / "luseepy"
    return read_beam(folder / "synthetic_response_v3.fits"), folder / "four_port_covariance.fits"


MATRICES = ("ZA", "ZL", "M", "Rsky", "Rmoon", "Rloss", "blackbody_normalization")
LAYOUT = [
    *("data", "freq", "time", "products"),
    *(f"{name}_{part}" for name in MATRICES for part in ("real", "imag")),
    "loading_condition_number",
    *(f"covariance_antihermitian_{kind}" for kind in ("absolute", "relative")),
    *("covariance_eigenvalues", "covariance_minimum_eigenvalue_ratio", "receiver_params"),
]


def test_luseepys_four_ports_are_written_back(luseepy, tmp_path):
    """Its data through K and back; every image and word that it has, in its place."""
    response, original = luseepy
    waterfall = lb.read_waterfall(original)
    channels = [waterfall.at(f) for f in waterfall.frequencies_mhz]
    circuits = [response.circuit(f) for f in waterfall.frequencies_mhz]
    path = lb.write_four_port(
        tmp_path / "w.fits", channels, circuits, moon_k=250.0, response=response.path
    )
    with fits.open(path) as ours, fits.open(original) as theirs:
        assert [hdu.header["EXTNAME"] for hdu in ours] == LAYOUT
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
        assert json.loads(ours["receiver_params"].data.tobytes()) == json.loads(
            theirs["receiver_params"].data.tobytes()
        )
    back = lb.read_waterfall(path)
    # a multiplication and a division by the same number
    np.testing.assert_allclose(back.grid, waterfall.grid, rtol=3e-16, atol=0)
    assert (back.moon_k, back.antenna_k, back.interpolation) == (250.0, 0.0, "linear-native-alm")
    seconds = (back.observation.times - waterfall.observation.times).to_value("s")
    assert not seconds.any()


def test_gaps_are_written(luseepy, tmp_path):
    response, original = luseepy
    waterfall = lb.read_waterfall(original)
    keep = np.arange(328) % 7 < 3
    grid = waterfall.grid[:, keep, :1].copy()
    grid[3, 2] = np.nan
    part = replace(
        waterfall,
        grid=grid,
        frequencies_mhz=waterfall.frequencies_mhz[:1],
        observation=waterfall.observation.select(keep),
        per_kelvin=waterfall.per_kelvin[:1],
    )
    path = lb.write_four_port(tmp_path / "w.fits", [part.at(5.0)], [response.circuit(5.0)])
    back = lb.read_waterfall(path)
    np.testing.assert_allclose(back.grid, grid, rtol=3e-16, atol=0)
    assert not (back.observation.times - part.observation.times).to_value("s").any()
    with fits.open(path) as hdus:
        gaps = np.isnan(hdus["covariance_eigenvalues"].data)
    assert gaps.sum() == 4 and gaps[2].all()


def test_open_ports_have_no_loads_to_write(luseepy, tmp_path):
    response, original = luseepy
    channel = lb.read_waterfall(original).at(5.0)
    with pytest.raises(lb.InputError, match="the ports are open; give another beam.receiver"):
        circuit = replace(response, receiver=None).circuit(5.0)
        lb.write_four_port(tmp_path / "w.fits", [channel], [circuit])
    assert not list(tmp_path.iterdir())


def test_there_is_no_room_for_windows(luseepy, tmp_path):
    response, original = luseepy
    channel = lb.read_waterfall(original).at(5.0)
    with pytest.raises(lb.InputError, match="luseepy's waterfalls have no room for windows"):
        lb.write_four_port(tmp_path / "w.fits", [channel.stamped("start")], [response.circuit(5.0)])
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("image", "word", "value"),
    [(0, "BUNIT", "K"), (0, "TIMEUNIT", "s"), (0, "TIMESYS", "local"), ("ZL_real", "BUNIT", "S")],
)
def test_words_that_contradict_the_layout_are_refused(luseepy, tmp_path, image, word, value):
    with fits.open(luseepy[1]) as hdus:
        hdus[image].header[word] = value
        hdus.writeto(tmp_path / "w.fits")
    with pytest.raises(lb.InputError, match=f"{word}|unit"):
        lb.read_waterfall(tmp_path / "w.fits")


@pytest.mark.essential
def test_simulated_and_mapped_between_the_responses_frequencies(luseepy, tmp_path):
    """14.5 MHz / 3, a Moon of many digits, other receivers, which nothing but the data say."""
    response, _ = luseepy
    path, moon, capacitor = tmp_path / "w.fits", 251.23456789012345, "{model: capacitor}"
    beam = [f"beam.file={response.path}", "lmax=4", "observation.runs.0.cycles=0.03"]
    warm = f"beam.moon_temperature_k={moon!r}"
    f = 14.5 / 3 + 2.0

    def simulate(*further):
        arguments = [a for o in (*beam, warm, *further) for a in ("--set", o)]
        command = ["simulate", "fiducial", "-o", str(path), "--frequencies", f"{f!r},10", "-q"]
        return main([*command, "--force", *arguments])

    assert simulate(f"beam.receiver={capacitor}") == 0
    scenario = lb.load_scenario("fiducial", [*beam, f"frequency_mhz={f!r}", warm])
    data = lb.read_data(path, scenario)
    setup = lb.build(scenario, data).setup
    expected = replace(response, receiver=CapacitorReceiver()).beams(f, 4)
    # the loads go through the file bit by bit
    np.testing.assert_allclose(setup.beams.modes, expected.modes, rtol=0, atol=1e-14)
    sure = lb.load_scenario("fiducial", [*beam, f"frequency_mhz={f!r}", warm,
                                         f"beam.receiver={capacitor}"])  # fmt: skip
    np.testing.assert_allclose(data.grid(), lb.build(sure).data.grid(), rtol=1e-14)
    # and through the package's own files
    own = lb.read_visibilities(data.write(tmp_path / "own.nc"))
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
        (
            "beam.receiver=jfet",
            "leave out beam.receiver, so that the loads ZL in the data are used",
        ),
        ("beam.interpolation=spline", "use --set beam.interpolation=linear"),
    ):
        with pytest.raises(lb.InputError, match=message):
            lb.read_data(path, lb.load_scenario("fiducial", [*given, override]))
    assert simulate("beam.interpolation=spline") == 0
    with pytest.raises(lb.InputError, match="use --set beam.interpolation=spline"):
        lb.read_data(path, lb.load_scenario("fiducial", given))
    lb.read_data(path, lb.load_scenario("fiducial", [*given, "beam.interpolation=spline"]))
    # where the response has the frequency nothing is interpolated
    lb.read_data(path, lb.load_scenario("fiducial", [*given, "frequency_mhz=10"]))
