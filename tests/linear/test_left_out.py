"""Groups of data left out through the structure of A, against A and N as matrices."""

from __future__ import annotations

import numpy as np
import pytest
from assertions import close
from reference_linear import matrices

import lusee_bayes as lb
from lusee_bayes.experiment.model import full_model
from lusee_bayes.judge import left_out
from lusee_bayes.judge.left_out import FEW_TIMES, DenseLeftOut, StructuredLeftOut, smooth_functions
from lusee_bayes.judge.residuals import held_out

# noise a thousand times larger than the telescope's: what the dense route loses to cancellation is
# then below the tolerance
NOISY = "noise.radiometer.factor=1e6"
# few modes: a product has more data than there are modes; many: it has fewer
FEW = ["lmax=3", "observation.runs=[{cycles: 0.04}, {cycles: 0.03, turntable_deg: 40}]"]
MANY = ["lmax=10", "observation.runs=[{cycles: 0.03}, {cycles: 0.02, turntable_deg: 40}]"]
OFTEN = [*FEW, "observation.step_s=2400"]
KEPT = left_out.KEPT_BYTES
KINDS = {
    "diagonal": [],
    "blocks": ["noise.radiometer.form=exact"],
    "templates": ["noise.beam={shift_mhz: 4}"],
    "blocks and templates": ["noise.radiometer.form=exact", "noise.beam={shift_mhz: 4}"],
}


def agree(found, expected):
    assert found.chi2 == pytest.approx(expected.chi2, rel=1e-8)
    assert found.log_det == pytest.approx(expected.log_det, rel=1e-8)


@pytest.mark.parametrize(
    ("size", "kept", "kind"),
    [
        *((FEW, KEPT, kind) for kind in KINDS),
        *(
            (size, kept, kind)
            for size, kept in ((FEW, 0.0), (MANY, KEPT), (OFTEN, 0.0))
            for kind in ("diagonal", "blocks and templates")
        ),
    ],
)
def test_it_is_what_matrices_say(size, kept, kind, monkeypatch):
    monkeypatch.setattr(left_out, "KEPT_BYTES", kept)
    e = lb.build(lb.load_scenario("fiducial", [*size, NOISY, *KINDS[kind]]))
    model, observation = full_model(e.setup), e.data.observation
    structured = StructuredLeftOut(model, model.condition(e.data.data), e.data.data)
    dense = DenseLeftOut(model, e.data.data, e.data.layout)
    close(structured.u, dense.u, 1e-9)
    day = observation.hours // 24
    for k in np.unique(day):
        agree(structured.stretch(day == k), dense.stretch(day == k))
    np.testing.assert_allclose(structured.inverse_diagonal, dense.inverse_diagonal, rtol=1e-8)
    angle = np.array(observation.turntable_deg)[observation.run] == 40.0
    agree(structured.together(angle), dense.together(angle))
    for product in (0, 2, 15):
        agree(structured.product(product), dense.product(product))


def test_densities_of_groups_are_what_the_covariance_of_the_data_says():
    """ln p(d_s | others) = ln p(d) - ln p(others), each of K = A S A^T + N as a matrix."""
    e = lb.build(lb.load_scenario("fiducial", [*FEW, NOISY]))
    model = full_model(e.setup)
    a, s, n = matrices(model)
    k = a @ s @ a.T + n
    less = e.data.data if model.offset is None else e.data.data - model.offset

    def log_density(chosen):
        block = k[np.ix_(chosen, chosen)]
        value = np.linalg.slogdet(block)[1] + less[chosen] @ np.linalg.solve(block, less[chosen])
        return -0.5 * (value + chosen.sum() * np.log(2.0 * np.pi))

    every = np.ones(len(less), dtype=bool)
    day = e.data.observation.hours[e.data.layout.time] // 24
    groups = {
        "product": [e.data.layout.product == j for j in range(16)],
        "day": [day == j for j in np.unique(day)],
    }
    for found in held_out(model, model.condition(e.data.data), e.data):
        chosen = groups.pop(found.kind)
        expected = sum(log_density(every) - log_density(~inside) for inside in chosen)
        assert (found.groups, found.n) == (len(chosen), len(less))
        # sums of differences of thousands, from blocks with condition numbers of 1e6
        assert found.log_density == pytest.approx(expected, abs=1e-3)
    assert not groups


@pytest.mark.parametrize(
    "kind",
    [*KINDS, pytest.param("coupled", marks=[pytest.mark.long, pytest.mark.essential])],
)
def test_what_is_taken_out_leaves_the_model_of_the_rest(kind):
    """K = A S A^T + N of the others as a matrix: their u, and a time's chi^2 given the rest."""
    drift = ["noise.gain={sigma: 0.01, visibilities: model}"]
    e = lb.build(lb.load_scenario("fiducial", [*FEW, NOISY, *KINDS.get(kind, drift)]))
    model, layout = full_model(e.setup), e.data.layout
    gone = np.zeros((layout.n_products, layout.n_times), dtype=bool)
    gone[:, 4] = gone[6, 9] = gone[2] = True
    left = DenseLeftOut(model, e.data.data, layout).without(gone)
    keep = ~gone[layout.product, layout.time]
    a, s, n = matrices(model)
    k = (a @ s @ a.T + n)[np.ix_(keep, keep)]
    rest = e.data.data if model.offset is None else e.data.data - model.offset
    inverse = np.linalg.inv(k)
    u = inverse @ np.asarray(rest)[keep]
    close(left.u[~gone], u, 1e-7)
    assert not left.u[gone].any()
    here = layout.time[keep] == 9
    block = inverse[np.ix_(here, here)]
    noise = (inverse @ n[np.ix_(keep, keep)] @ inverse)[np.ix_(here, here)]
    found = left.stretch(np.arange(layout.n_times) == 9)
    assert found.chi2 == pytest.approx(u[here] @ np.linalg.solve(block, u[here]), rel=1e-6)
    expected = here.sum() - np.trace(np.linalg.solve(block, noise))
    assert found.directions == pytest.approx(expected, abs=1e-5)


def test_smooth_functions_are_few_and_make_up_every_phase():
    azimuth = np.linspace(2.9, 3.6, 300) % np.pi  # a turn in between does not matter
    azimuth = np.where(azimuth < 1.0, azimuth + np.pi, azimuth)
    angle = azimuth[:, None] * np.arange(11.0)
    phases = np.concatenate([np.cos(angle), np.sin(angle)], axis=1)
    functions = smooth_functions(phases, azimuth)
    n = functions.shape[1]
    assert n < 40
    np.testing.assert_allclose(functions.T @ functions, np.eye(n), rtol=0, atol=1e-12)
    np.testing.assert_allclose(functions @ (functions.T @ phases), phases, rtol=0, atol=1e-11)
    # few times, or functions that are not smooth, are taken as they are
    few = phases[:FEW_TIMES]
    np.testing.assert_array_equal(smooth_functions(few, azimuth[:FEW_TIMES]), np.eye(FEW_TIMES))
    rough = np.random.default_rng(0).standard_normal((60, 3))
    np.testing.assert_array_equal(smooth_functions(rough, azimuth[:60]), np.eye(60))
