"""Gains against luseepy's recipe written out, and what their files hold."""

import numpy as np
import pytest
import xarray as xr
from scipy.interpolate import CubicSpline

from lusee_bayes.core.errors import InputError
from lusee_bayes.flight.gain_model import GainModel, read_gain_table, write_gain_table
from lusee_bayes.testing.contracts import assert_refused

ANCHORS = np.array([0.1, 1.1, 5.1, 10.1, 20.1, 30.1, 50.1, 70.1])
TERMS = {
    0: ("1", "THERM_FPGA", "SPE_ADC0_T", "SPE_1VAD8_V", "VMON_1V2D", "SPE_1VAD8_C"),
    1: ("1", "THERM_FPGA", "SPE_ADC1_T", "SPE_1VAD8_V", "VMON_1V2D", "SPE_1VAD8_C"),
}


def telemetry(n=5):
    rng = np.random.default_rng(3)
    return {
        "THERM_FPGA": 20.0 + 5.0 * rng.random(n),
        "SPE_ADC0_T": 30.0 + 5.0 * rng.random(n),
        "SPE_ADC1_T": 10.0 + 5.0 * rng.random(n),
        "SPE_1VAD8_V": 1.8 + 0.01 * rng.random(n),
        "VMON_1V2D": 1.2 + 0.01 * rng.random(n),
        "SPE_1VAD8_C": 0.5 + 0.01 * rng.random(n),
    }


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
            name = f"{level}{port}"
            vectors = np.zeros((len(ANCHORS), len(ANCHORS)))
            vectors[:, :2] = made.component[i, port].T
            np.save(folder / f"{name}_mean.npy", made.mean[i, port])
            np.save(folder / f"{name}_freqs.npy", made.anchor_mhz[i, port])
            np.save(folder / f"{name}_eigvecs.npy", vectors)
            fpga, adc = "THERM_FPGA", TERMS[port // 2][2]
            terms = (*TERMS[port // 2], f"{fpga}*{fpga}", f"{adc}*{adc}", f"{fpga}*{adc}")
            for r in range(2):
                for term, value in zip(terms, made.coefficient[i, port, r], strict=True):
                    lines.append(f"{name},PC{r + 1},{model},{term},{float(value)!r}")
    (folder / "alpha_refit.csv").write_text("\n".join(lines) + "\n")
    return folder


def test_gains_are_luseepys_recipe_written_out():
    made, seen, mhz = table(), telemetry(), np.array([0.5, 9.975, 25.0, 49.0])
    for level, i in (("L", 0), ("H", 2)):
        for port in (0, 3):
            basis = made.basis(level, port, mhz)
            found = basis[0] + made.strengths(level, port, seen) @ basis[1:]
            adc = seen["SPE_ADC0_T" if port < 2 else "SPE_ADC1_T"]
            for row in range(5):
                f, a = seen["THERM_FPGA"][row], adc[row]
                phi = [1.0, f, a, seen["SPE_1VAD8_V"][row], seen["VMON_1V2D"][row]]
                phi += [seen["SPE_1VAD8_C"][row], f * f, a * a, f * a]
                q = made.coefficient[i, port] @ np.array(phi)
                at_anchors = made.mean[i, port] + q @ made.component[i, port]
                # the spline of the sum, where the table sums splines
                expected = CubicSpline(ANCHORS, at_anchors)(mhz)
                np.testing.assert_allclose(found[row], expected, rtol=1e-12)


def test_there_is_no_gain_beyond_the_anchors():
    made = table()
    basis = made.basis("M", 1, np.array([0.05, 0.1, 70.1, 70.2]))
    assert np.isnan(basis[:, [0, 3]]).all()
    # at the first and the last anchor they are what the table holds there
    ends = np.concatenate([made.mean[1, 1][None], made.component[1, 1]])[:, [0, -1]]
    np.testing.assert_allclose(basis[:, 1:3], ends, rtol=1e-12)


@pytest.mark.parametrize("model", ["quadratic", "linear"])
def test_luseepys_folder_and_own_file_hold_the_same(tmp_path, model):
    made = table()
    folder = write_folder(tmp_path / "gain", made, model)
    own = write_gain_table(tmp_path / "gains.nc", made)
    for found in (read_gain_table(folder, model), read_gain_table(own)):
        for name in ("anchor_mhz", "mean", "component", "coefficient"):
            np.testing.assert_array_equal(getattr(found, name), getattr(made, name))
    np.testing.assert_array_equal(read_gain_table(own).component_std, made.component_std)


@pytest.mark.parametrize(
    ("changes", "words"),
    [({"mean": 0.0}, "gain"), ({"mean": -1.0}, "gain"), ({"anchor_mhz": 1e6}, "is this Hz")],
)
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
        with pytest.raises(InputError, match=words):
            read_gain_table(one)


def test_telemetry_has_to_be_there():
    seen = telemetry()
    del seen["VMON_1V2D"]
    with pytest.raises(InputError, match="the telemetry lacks VMON_1V2D"):
        table().strengths("M", 0, seen)


def test_folders_that_lack_something_are_refused(tmp_path):
    assert_refused(lambda: read_gain_table(tmp_path / "absent"))
    folder = write_folder(tmp_path / "gain", table())
    assert_refused(lambda: read_gain_table(folder, "cubic"))
    # no coefficients of that family
    assert_refused(lambda: read_gain_table(folder, "linear"))
    text = (folder / "alpha_refit.csv").read_text()
    for old, new in (
        ("L0,PC1,quadratic,1,", "X0,PC1,quadratic,1,"),
        ("L0,PC1,quadratic,1,", "L0,PC3,quadratic,1,"),
        ("L0,PC1,quadratic,1,", "L0,PC1,quadratic,SPE_ADC1_T,"),
        ("L0,PC1,quadratic,1,", "L0,PC1,quadratic,THERM_FPGA,"),
    ):
        (folder / "alpha_refit.csv").write_text(text.replace(old, new, 1))
        assert_refused(lambda: read_gain_table(folder))
    (folder / "alpha_refit.csv").write_text(text)
    np.save(folder / "M2_mean.npy", np.full(len(ANCHORS), np.nan))
    assert_refused(lambda: read_gain_table(folder))
    (folder / "M2_mean.npy").write_bytes(b"\x93NUMPY")
    assert_refused(lambda: read_gain_table(folder))
