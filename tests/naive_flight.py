"""What becomes of one spectrum of a session, written out from luseepy's files, by numpy alone."""

import csv

import h5py
import numpy as np
from scipy.interpolate import CubicSpline

from lusee_bayes.instrument.products import labels

# autos of the four ports, then real and imaginary part of every pair
FLIGHT_ORDER = ["00R", "11R", "22R", "33R"]
FLIGHT_ORDER += [f"{i}{j}{part}" for i in range(4) for j in range(i + 1, 4) for part in "RI"]


def naive_gain(folder, level, port, seen, mhz):
    """luseepy's recipe, of its files, for one spectrum."""
    adc = seen["SPE_ADC0_T" if port < 2 else "SPE_ADC1_T"]
    values = {"1": 1.0, **seen, "THERM_FPGA*THERM_FPGA": seen["THERM_FPGA"] ** 2}
    for own in ("SPE_ADC0_T", "SPE_ADC1_T"):
        values |= {f"{own}*{own}": adc**2, f"THERM_FPGA*{own}": seen["THERM_FPGA"] * adc}
    name, q = f"{level}{port}", {"PC1": 0.0, "PC2": 0.0}
    with (folder / "alpha_refit.csv").open() as file:
        for row in csv.DictReader(file):
            if row["gain_setting"] == name and row["model"] == "quadratic":
                q[row["component"]] += float(row["alpha_refit"]) * values[row["term"]]
    files = (folder / f"{name}_{part}.npy" for part in ("mean", "eigvecs", "freqs"))
    mean, vectors, anchors = map(np.load, files)
    return CubicSpline(anchors, mean + q["PC1"] * vectors[:, 0] + q["PC2"] * vectors[:, 1])(mhz)


def naive_band(flight, name, row, f, comb=False):
    """A parabola through the channels of a band of 1 MHz, product by product, in V^2/Hz.

    Without the channels of the comb where it is on. And the number of independent samples behind
    each value, for a flat spectrum.
    """
    with h5py.File(flight / f"session_{name}.h5") as file:
        counts = file["spectra/data"][row].astype(float)
        codes = file["spectra/metadata/actual_gain"][row]
        stride = int(file["spectra/metadata/Navgf"][row])
        group = file["spectra_interpolated_telemetry"]
        seen = {key: float(group[key][row]) for key in group if not key.endswith("time")}
    channels = stride * np.arange(2048 // stride)[:, None] + np.arange(stride)
    x = 0.025 * channels - f
    within = (np.abs(x) <= 0.5 + 1e-9).all(axis=1)
    if comb:
        within &= (channels % 4 != 2).all(axis=1)
    mhz, levels = 0.025 * channels[within], ["LMH"[code] for code in codes]
    gains = [naive_gain(flight / "gain", levels[p], p, seen, mhz).mean(axis=1) for p in range(4)]
    # mean powers of each bin's channels
    powers = np.stack([(x[within] ** k).mean(axis=1) for k in range(3)], axis=1)
    weights, found = np.linalg.pinv(powers)[0], {}
    for label, spectrum in zip(FLIGHT_ORDER, counts[:, np.flatnonzero(within)], strict=True):
        gain = np.sqrt(gains[int(label[0])] * gains[int(label[1])])
        found[label] = weights @ (spectrum * 1e-18 / gain)
    return np.array([found[label] for label in labels()]), 2.0**25 * stride / (weights @ weights)
