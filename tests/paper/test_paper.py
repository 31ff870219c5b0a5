"""The paper's reproduction: resumable, complete, and judged by conditions that can fail."""

from dataclasses import replace
from functools import cache

import healpy
import numpy as np
import pytest
import xarray as xr
from assertions import refuse, require_conventions
from astropy import units as u
from astropy.coordinates import SkyCoord
from commands import assert_drawn, table_of

from lusee_bayes.core import formats, harmonics
from lusee_bayes.instrument.beams.fields import HemisphereGrid
from lusee_bayes.instrument.products import labels
from lusee_bayes.paper import cases as paper
from lusee_bayes.paper import claims, figures
from lusee_bayes.runs import paper_run as runs

TINY = ["lmax=6", "observation.step_s=43200"]


def made_up(name, scenario):
    """A case as it is kept, of numbers that agree with the paper."""
    return synthetic(name, agrees=True).assign_attrs(
        **formats.header(formats.PAPER_CASE), scenario=scenario.to_yaml(),
        frequency_mhz=scenario.frequency_mhz, log_evidence=1.0, chi2=2.0, chi2_expected=3.0,
    )  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """All that a run writes, its cases made up: the real ones take minutes (see the long test)."""
    out, names = tmp_path_factory.mktemp("paper"), iter(paper.CASES)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(runs, "compute_case", lambda s: made_up(next(names), s))
        runs.run_paper(out)
    return out


@pytest.fixture
def four(monkeypatch):
    """A run has four cases, no figures and no claims, which are about all of them."""
    whole_paper()  # kept for all tests: of all cases
    monkeypatch.setattr(paper, "CASES", dict(list(paper.CASES.items())[:4]))
    one = dict.fromkeys(("section", "paper", "obtained", "agrees", "reason"), "yes")
    monkeypatch.setattr(runs, "claim_table", lambda _: [one])
    monkeypatch.setattr(runs, "PAPER", replace(runs.PAPER, figures={}))


def run_cases(folder, *overrides):
    return runs.run_paper(folder, [*TINY, *overrides]).result


@pytest.fixture
def computed(monkeypatch):
    """The scenarios that were really computed, in order."""
    done, compute = [], runs.compute_case

    def counting(scenario):
        done.append(scenario)
        return compute(scenario)

    monkeypatch.setattr(runs, "compute_case", counting)
    return done


@pytest.mark.long
def test_everything_is_written(folder):
    names = "cases figures cases.csv claims.csv claims.md manifest.json"
    assert {p.name for p in folder.iterdir()} == set(names.split())
    assert {p.stem for p in (folder / "figures").iterdir()} == set(figures.FIGURES)
    assert_drawn(*(folder / "figures").iterdir())
    assert {p.name for p in (folder / "cases").iterdir()} == {f"{n}.nc" for n in paper.CASES}
    rows = table_of(folder / "cases.csv")
    assert [row["case"] for row in rows] == list(paper.CASES)
    assert (rows[0]["rho_10"], rows[0]["ell_cross"]) == ("0.95", "33")


@pytest.mark.long
def test_claims_have_every_column_filled(folder):
    rows = table_of(folder / "claims.csv")
    assert len(rows) == len(claims.CLAIMS) > 20
    for row in rows:
        assert set(row) == {"section", "paper", "obtained", "agrees", "reason"}
        assert all(row.values()), row
        assert row["agrees"] in ("yes", "partly", "no")
        assert (row["reason"] == "agrees") == (row["agrees"] == "yes")
    assert len((folder / "claims.md").read_text().splitlines()) == len(claims.CLAIMS) + 4


@pytest.mark.long
def test_a_real_run_at_tiny_size(tmp_path):
    assert all(path.is_file() for path in runs.run_paper(tmp_path, TINY).files)
    require_conventions(tmp_path / "cases" / "fiducial.nc")
    rows = table_of(tmp_path / "cases.csv")
    assert float(rows[0]["rho_1"]) > 0.9  # one cycle knows the dipole
    assert rows[0]["rho_10"] == "beyond"
    for row in rows:
        assert float(row["chi2_expected"]) > 0


@pytest.mark.long
def test_an_interrupted_run_goes_on_where_it_stopped(four, tmp_path, computed, monkeypatch):
    compute, uninterrupted = runs.compute_case, run_cases(tmp_path / "whole")
    scenarios = computed.copy()
    computed.clear()

    def interrupted(scenario):
        if len(computed) == 2:
            raise KeyboardInterrupt
        return compute(scenario)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(runs, "compute_case", interrupted)
        run_cases(tmp_path / "stopped")
    done = computed.copy()
    computed.clear()
    cases = run_cases(tmp_path / "stopped")
    # side by side, in any order
    assert len(done) == 2 and all(one in [*done, *computed] for one in scenarios)
    assert len(computed) == len(scenarios) - 2
    assert not (tmp_path / "stopped" / "unfinished-cases").exists()
    for name, case in cases.items():
        xr.testing.assert_identical(case, uninterrupted[name])


@pytest.mark.long
def test_only_what_changed_is_computed_again(four, tmp_path, computed, monkeypatch):
    monkeypatch.setattr(paper, "CASES", dict(list(paper.CASES.items())[:2]))
    first = run_cases(tmp_path)
    run_cases(tmp_path)
    assert len(computed) == 2
    scenarios = paper.paper_scenarios(TINY)
    changed = scenarios["noise_x10"].model_copy(update={"seed": 7})
    with monkeypatch.context() as patch:
        patch.setattr(runs, "paper_scenarios", lambda *_: scenarios | {"noise_x10": changed})
        again = run_cases(tmp_path)
    assert computed[2:] == [changed]
    assert not np.array_equal(first["noise_x10"]["mean"], again["noise_x10"]["mean"])
    # numbers of another version of the package are not taken over
    monkeypatch.setattr(formats, "__version__", "0.0.0")
    monkeypatch.setattr(paper, "CASES", dict(list(paper.CASES.items())[:1]))
    run_cases(tmp_path)
    assert len(computed) == 4


@pytest.mark.parametrize("place", ["cases", "unfinished-cases"])
def test_a_broken_case_file_is_computed_again(four, place, tmp_path, monkeypatch):
    computed = []
    spy = lambda s: computed.append(s) or made_up("fiducial", s)  # noqa: E731
    monkeypatch.setattr(runs, "compute_case", spy)
    monkeypatch.setattr(paper, "CASES", dict(list(paper.CASES.items())[:1]))
    (tmp_path / place).mkdir()
    (tmp_path / place / "fiducial.nc").write_text("truncated")
    run_cases(tmp_path)
    assert len(computed) == 1


def test_the_nearest_sky_in_log_frequency_is_scaled(tmp_path):
    names = ["exp1.0MHz_sky.hdf5", "exp3MHz_sky.hdf5", "exp10.0MHz_sky_map_with_absorption.hdf5"]
    paths = [tmp_path / name for name in names]
    for path in paths:
        path.touch()
    assert [paper.sky_frequency_mhz(path) for path in paths] == [1.0, 3.0, 10.0]
    scenarios = paper.paper_scenarios(skies=paths)
    assert scenarios["at_5MHz"].sky.file == str(paths[1])  # 5/3 < 10/5
    assert scenarios["at_5MHz"].sky.file_frequency_mhz == 3.0
    assert scenarios["noise_x10"].sky.file == str(paths[2])
    assert paper.paper_scenarios()["fiducial"].sky.model == "galaxy"


@pytest.mark.parametrize("name", ["sky.hdf5", "exp_10MHz.hdf5", "exp0MHz.hdf5"])
def test_a_name_without_frequency_is_refused(tmp_path, name):
    (tmp_path / name).touch()
    refuse("states no frequency; name it as exp", paper.sky_frequency_mhz, tmp_path / name)
    refuse("no sky map at", paper.sky_frequency_mhz, tmp_path / "exp5MHz.hdf5")


@cache
def whole_paper():
    """The scenarios of all cases: to be read."""
    return paper.paper_scenarios()


def synthetic(name: str, agrees: bool) -> xr.Dataset:
    """A case as the paper describes it, or one that contradicts every claim."""
    ell, rng = np.arange(48), np.random.default_rng(3)
    frequency = int(name[3:-3]) if name.startswith("at_") else 25
    snr = np.where(ell < 10, 50.0, np.where(ell < 33, 4.9, 0.5))
    rho = np.where(ell < 13, 0.95, np.where(ell < 33, 0.7, 0.1))
    power = np.where(ell <= 15, 0.99, np.where(ell <= 35, 0.7, 0.2))
    if name.startswith("quarter"):
        snr = snr / 5
    elif name == "three_cycles":
        snr = np.where(ell < 33, 2.5, 1.0) * snr
    elif name.startswith("beam"):
        snr = np.where(ell < 33, 0.6, 1.0) * snr
    elif name.startswith("noise"):
        power = np.where(ell > 20, 0.1, 1.0) * power
    if name.endswith("ignored"):
        snr = np.full(48, 0.9)
    vectors = np.array(healpy.pix2vec(16, np.arange(3072)))
    truth = 100 + 20 * vectors[0]
    mean = truth + rng.normal(0, 2.0 if frequency == 5 else 1.0, 3072)
    pole = SkyCoord(0 * u.deg, 90 * u.deg, frame="icrs").galactic.cartesian.xyz.value
    altitude = np.cos(np.radians(24)) - pole @ vectors
    data = 1e5 * rng.normal(size=(16, 328))
    noise = np.full_like(data, np.sqrt(2) if name == "duty_cycle_50" else 1.0)
    n_data = {"three_cycles": 3, "half_cycle": 0.5}.get(name, 1) * 5232
    rms, products = 0.01 if "0.4" in name else 0.1, list(labels())
    scenario, seen_at = whole_paper()[name].to_yaml(), frequency
    if not agrees:
        # fidelity: everything poor and nothing of it where the paper has it
        rho = np.full(48, 0.8 if name in ("duty_cycle_50", "prior_x10") else 0.1)
        snr = np.full(48, 2.0 if name in ("beam_4MHz", "beam_0.4MHz", "duty_cycle_50") else 0.9)
        power, mean = np.ones(48), -2 * truth - (100 if frequency == 45 else 0)
        altitude = np.ones(3072)
        data, noise = np.tile(data[:1, :100], (16, 1)), np.ones((16, 100))
        data = data / 1e5
        n_data, rms, seen_at = 100, 0.5, 50 - frequency
        products[0] = "01R"
        scenario = scenario.replace("lmax: 47", "lmax: 20").replace("sigma: 0.01", "sigma: 1.0")
    grid = HemisphereGrid.gauss_legendre(48, 96)
    theta, sin = grid.theta[:, None], np.outer(np.sin(grid.theta), np.sin(grid.phi))
    beam = np.cos(theta) ** (0.5 if seen_at < 25 else 3) * (1 + (0.8 if agrees else -0.8) * sin)
    beam = beam * (1 - (0.4 if seen_at > 25 else 0) * np.exp(-((theta / 0.2) ** 2)))
    return xr.Dataset(
        {
            "rho": ("ell", rho), "snr": ("ell", snr), "cl_mean": ("ell", power),
            "cl_truth": ("ell", np.ones(48)), "mean": ("pixel", mean), "truth": ("pixel", truth),
            "mean_modes": ("mode", harmonics.map_to_modes(mean, 8)),
            "truth_modes": ("mode", harmonics.map_to_modes(truth, 8)),
            "highest_altitude": ("pixel", altitude), "data": (("product", "time"), data),
            "noise_std": (("product", "time"), noise),
            "beam": (("pattern", "theta", "phi"), np.stack([beam] * 3)),
        },
        coords={"ell": ell, "theta": grid.theta, "phi": grid.phi, "product": products},
        attrs={"n_data": n_data, "n_modes": 2304, "beam_rms_difference": rms, "scenario": scenario},
    )  # fmt: skip


@pytest.mark.parametrize("agrees", [True, False])
def test_every_claim_can_come_out_both_ways(agrees):
    cases = {name: synthetic(name, agrees) for name in paper.CASES}
    verdicts = {row["paper"]: row["agrees"] for row in claims.claim_table(cases)}
    assert not {s: v for s, v in verdicts.items() if (v == "yes") != agrees}
