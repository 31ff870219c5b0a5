"""Gains against luseepy's recipe written out; spectra that go through what is known, in counts."""

import numpy as np
import pytest
import xarray as xr
from assertions import assert_same, refuse
from naive_flight import naive_gain

from lusee_bayes.flight.gain_model import GainModel, read_gain_table, write_gain_table
from lusee_bayes.flight.session import OF_FLIGHT, channel_mhz
from lusee_bayes.flight.synthesis import ChannelSpectra, bit_slices, rounded
from lusee_bayes.instrument.products import to_matrix, to_real
from lusee_bayes.testing import assert_refused

ANCHORS = np.array([0.1, 1.1, 5.1, 10.1, 20.1, 30.1, 50.1, 70.1])


def telemetry(n=5):
    rng = np.random.default_rng(3)
    middle = {"THERM_FPGA": 20.0, "SPE_ADC0_T": 30.0, "SPE_ADC1_T": 10.0}
    middle |= {"SPE_1VAD8_V": 1.8, "VMON_1V2D": 1.2, "SPE_1VAD8_C": 0.5}
    return {name: value * (1.0 + 0.2 * rng.random(n)) for name, value in middle.items()}


def table():
    rng = np.random.default_rng(1)
    return GainModel(
        "made up",
        np.broadcast_to(ANCHORS, (3, 4, len(ANCHORS))).copy(),
        0.02 + 0.01 * rng.random((3, 4, len(ANCHORS))),
        1e-3 * rng.standard_normal((3, 4, 2, len(ANCHORS))),
        1e-2 * rng.standard_normal((3, 4, 2, 9)),
        np.full((3, 4, 2), 0.1),
    )


def write_folder(folder, made, model="quadratic"):
    """As luseepy has it: all eigenvectors, and a table of coefficients without the zeros."""
    folder.mkdir()
    lines = ["gain_setting,component,model,term,alpha_refit"]
    for i, level in enumerate("LMH"):
        for port in range(4):
            name, vectors = f"{level}{port}", np.zeros((len(ANCHORS), len(ANCHORS)))
            vectors[:, :2] = made.components[i, port].T
            np.save(folder / f"{name}_mean.npy", made.mean[i, port])
            np.save(folder / f"{name}_freqs.npy", made.anchor_mhz[i, port])
            np.save(folder / f"{name}_eigvecs.npy", vectors)
            fpga, adc = "THERM_FPGA", f"SPE_ADC{port // 2}_T"
            terms = ["1", fpga, adc, "SPE_1VAD8_V", "VMON_1V2D", "SPE_1VAD8_C"]
            terms += [f"{fpga}*{fpga}", f"{adc}*{adc}", f"{fpga}*{adc}"]
            for r in range(2):
                for term, value in zip(terms, made.coefficient[i, port, r], strict=True):
                    lines.append(f"{name},PC{r + 1},{model},{term},{float(value)!r}")
    (folder / "alpha_refit.csv").write_text("\n".join(lines) + "\n")
    return folder


def test_gains_are_luseepys_recipe_written_out(tmp_path):
    """The spline of a sum there, where the table sums splines."""
    made, seen, mhz = table(), telemetry(), np.array([0.5, 9.975, 25.0, 49.0])
    folder = write_folder(tmp_path / "gain", made)
    for level in "LH":
        for port in (0, 3):
            basis = made.basis(level, port, mhz)
            found = basis[0] + made.strengths(level, port, seen) @ basis[1:]
            for row in range(5):
                here = {name: values[row] for name, values in seen.items()}
                expected = naive_gain(folder, level, port, here, mhz)
                np.testing.assert_allclose(found[row], expected, rtol=1e-12)


def test_there_is_no_gain_beyond_the_anchors():
    made = table()
    basis = made.basis("M", 1, np.array([0.05, 0.1, 70.1, 70.2]))
    assert np.isnan(basis[:, [0, 3]]).all()
    # at the first and the last anchor they are what the table holds there
    ends = np.concatenate([made.mean[1, 1][None], made.components[1, 1]])[:, [0, -1]]
    np.testing.assert_allclose(basis[:, 1:3], ends, rtol=1e-12)


@pytest.mark.parametrize("model", ["quadratic", "linear"])
def test_luseepys_folder_and_own_file_hold_the_same(tmp_path, model):
    made = table()
    folder = write_folder(tmp_path / "gain", made, model)
    own = write_gain_table(tmp_path / "gains.nc", made)
    for found in (read_gain_table(folder, model), read_gain_table(own)):
        assert_same(found, made, "anchor_mhz", "mean", "components", "coefficient")
    np.testing.assert_array_equal(read_gain_table(own).component_std, made.component_std)


NO_GAINS = [({"mean": 0.0}, "gain"), ({"mean": -1.0}, "gain"), ({"anchor_mhz": 1e6}, "is this Hz")]


@pytest.mark.parametrize(("changes", "words"), NO_GAINS)
def test_gains_are_positive_and_their_frequencies_in_mhz(tmp_path, changes, words):
    """In luseepy's folder as in a file of the package."""
    made = table()
    folder, own = write_folder(tmp_path / "gain", made), write_gain_table(tmp_path / "g.nc", made)
    ((name, factor),) = changes.items()
    path = folder / f"M2_{'mean' if name == 'mean' else 'freqs'}.npy"
    np.save(path, factor * np.load(path))
    with xr.open_dataset(own, engine="h5netcdf") as file:
        found = file.load()
    found[name][1, 2] *= factor
    found.to_netcdf(own, engine="h5netcdf")
    for one in (folder, own):
        refuse(words, read_gain_table, one)


def test_what_lacks_something_is_refused(tmp_path):
    seen = telemetry()
    del seen["VMON_1V2D"]
    refuse("the telemetry lacks VMON_1V2D", table().strengths, "M", 0, seen)
    assert_refused(lambda: read_gain_table(tmp_path / "absent"))
    folder = write_folder(tmp_path / "gain", table())
    assert_refused(lambda: read_gain_table(folder, "cubic"))
    # no coefficients of that family
    assert_refused(lambda: read_gain_table(folder, "linear"))
    text = (folder / "alpha_refit.csv").read_text()
    terms = ("L0,PC1,quadratic,SPE_ADC1_T", "L0,PC1,quadratic,THERM_FPGA")
    for row in ("X0,PC1,quadratic,1", "L0,PC3,quadratic,1", *terms):
        (folder / "alpha_refit.csv").write_text(text.replace("L0,PC1,quadratic,1", row, 1))
        assert_refused(lambda: read_gain_table(folder))
    (folder / "alpha_refit.csv").write_text(text)
    np.save(folder / "M2_mean.npy", np.full(len(ANCHORS), np.nan))
    assert_refused(lambda: read_gain_table(folder))
    (folder / "M2_mean.npy").write_bytes(b"\x93NUMPY")
    assert_refused(lambda: read_gain_table(folder))


def covariances(nodes, rows, rng):
    a = rng.normal(size=(2, 4, 6, 1, rows)) + 0.1 * rng.normal(size=(2, 4, 6, nodes, rows))
    a = a[0] + 1j * a[1]
    return np.moveaxis(to_real(np.einsum("ianr,janr->ijnr", a, a.conj())), 0, 1)


@pytest.mark.parametrize("nodes", [[10.0], [10.0, 25.0], [8.0, 10.0, 12.0, 14.0, 30.0]])
def test_channels_go_through_the_known_frequencies_and_are_covariances(nodes):
    known = covariances(len(nodes), 3, np.random.default_rng(1))
    spectra = ChannelSpectra.of(np.array(nodes), channel_mhz("centre"))(known)
    for number, f in enumerate(nodes):
        at = int(np.rint(f / 0.025))
        np.testing.assert_allclose(spectra[:, :, at], known[number], rtol=1e-11, atol=1e-12)
    t = np.moveaxis(to_matrix(spectra), (0, 1), (-2, -1))
    t /= np.trace(t, axis1=-2, axis2=-1)[..., None, None]
    assert np.linalg.eigvalsh(t).min() > 0.0
    # smooth across the known frequencies, within a band and at its ends
    third = np.diff(np.log(spectra[0, 0]), 3)
    for f in nodes:
        at = int(np.rint(f / 0.025))
        assert np.abs(third[at - 20 : at + 20]).max() < 1e-4


def test_one_frequency_makes_a_power_law():
    known = covariances(1, 2, np.random.default_rng(2))
    spectra = ChannelSpectra.of(np.array([20.0]), channel_mhz("edge"))(known)
    f = channel_mhz("edge")[400]
    np.testing.assert_allclose(spectra[:, :, 400], known[0] * (f / 20.0) ** -2.5, rtol=1e-12)


def test_visibilities_that_voltages_cannot_have_are_refused():
    known = covariances(1, 2, np.random.default_rng(2))
    known[0, 1] *= 10.0
    refuse("positive definite", ChannelSpectra.of(np.array([20.0]), channel_mhz("edge")), known)


def test_counts_are_whole_numbers_of_few_enough_bits():
    spectra = np.abs(np.random.default_rng(4).normal(size=(3, 16, 100))) * 0.7
    slices, autos = bit_slices(spectra), OF_FLIGHT[[0, 7, 12, 15]]
    found, step = rounded(spectra, np.broadcast_to(slices, (3, 16))), 2.0 ** (slices - 31)
    np.testing.assert_allclose(found, spectra, rtol=1e-6, atol=step.max())
    assert 2**25 < np.rint(spectra[0, autos] / step[autos, None]).max() < 2**28
