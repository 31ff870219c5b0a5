"""Spectra of all channels go through what is known, and counts are exact."""

from __future__ import annotations

import numpy as np
import pytest

from lusee_bayes.core.errors import InputError
from lusee_bayes.flight.gain_model import synthetic_gains
from lusee_bayes.flight.session import OF_FLIGHT, TELEMETRY, channel_mhz
from lusee_bayes.flight.synthesis import ChannelSpectra, Counting, bit_slices, rounded
from lusee_bayes.instrument.products import to_matrix, to_real


def covariances(nodes, rows, rng):
    a = rng.normal(size=(2, 4, 6, 1, rows)) + 0.1 * rng.normal(size=(2, 4, 6, nodes, rows))
    a = a[0] + 1j * a[1]
    return np.moveaxis(to_real(np.einsum("ianr,janr->ijnr", a, a.conj())), 0, 1)


@pytest.mark.parametrize("nodes", [[10.0], [10.0, 25.0], [8.0, 10.0, 12.0, 14.0, 30.0]])
def test_channels_go_through_the_known_frequencies_and_are_covariances(nodes):
    known = covariances(len(nodes), 3, np.random.default_rng(1))
    mhz = channel_mhz("centre")
    spectra = ChannelSpectra.of(np.array(nodes), mhz)(known)
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
    with pytest.raises(InputError, match="positive definite"):
        ChannelSpectra.of(np.array([20.0]), channel_mhz("edge"))(known)


def test_counts_are_gains_times_power_in_the_order_of_the_spectrometer():
    table, n = synthetic_gains(), 2
    telemetry = {name: np.array([20.0, 31.0]) for name in TELEMETRY}
    spectra = covariances(1, n, np.random.default_rng(3))[0][..., None] * np.ones(2048) * 1e-17
    one = Counting(table, "LMHM", 1, "centre")(spectra, telemetry)
    at = 800  # 20 MHz
    gain = [
        (np.array([1.0, *table.strengths(level, port, telemetry)[1]])
         @ table.basis(level, port, np.array([20.0]))[:, 0])
        for port, level in enumerate("LMHM")
    ]  # fmt: skip
    assert gain[2] / gain[0] > 500.0
    expected = spectra[:, 1, at] / 1e-18
    np.testing.assert_allclose(one[1, 0, at], expected[0] * gain[0], rtol=1e-12)
    # the first cross of both orders
    np.testing.assert_allclose(one[1, 4, at], expected[1] * np.sqrt(gain[0] * gain[1]), rtol=1e-12)
    minus = Counting(table, "LMHM", 1, "centre", -1)(spectra, telemetry)
    np.testing.assert_array_equal(minus[:, 5], -one[:, 5])
    np.testing.assert_array_equal(minus[:, 4], one[:, 4])
    # three of four channels, divided by four
    three = Counting(table, "LMHM", 3, "centre")(spectra, telemetry)
    np.testing.assert_allclose(three[..., 200], one[..., 800:803].sum(axis=2) / 4.0, rtol=1e-12)
    assert three.shape == (n, 16, 512)


def test_counts_are_whole_numbers_of_few_enough_bits():
    spectra = np.abs(np.random.default_rng(4).normal(size=(3, 16, 100))) * 0.7
    slices = bit_slices(spectra)
    autos = OF_FLIGHT[[0, 7, 12, 15]]
    found = rounded(spectra, np.broadcast_to(slices, (3, 16)))
    step = 2.0 ** (slices - 31)
    np.testing.assert_allclose(found, spectra, rtol=1e-6, atol=step.max())
    whole = spectra[0, autos] / step[autos, None]
    assert 2**25 < np.rint(whole).max() < 2**28
