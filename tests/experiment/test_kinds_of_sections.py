"""Beams, skies and priors told apart by ``model``: scenarios of old, and errors that help."""

import numpy as np
import pytest
from fits_files import write_images

from lusee_bayes.core.reading import as_yaml, parse_yaml
from lusee_bayes.experiment.instrument_sections import (
    MonopoleBeamSection,
    ResponseSection,
    ScalarBeamSection,
    section_of_file,
)
from lusee_bayes.experiment.scenario import load_scenario
from lusee_bayes.experiment.sky_sections import (
    FileSkySection,
    GalaxySection,
    IsotropicPriorSection,
    LocalScalesPriorSection,
)

# all keys, as a resolved scenario was written before sections came in kinds
OLD = """
frequency_mhz: 25.0
frequencies_mhz: []
joint: false
lmax: 47
nside: null
observation: {lon_deg: 182.258, lat_deg: -23.814, start: '2027-01-15T00:00:00', step_s: 7200.0,
  runs: [{cycles: 1.0, turntable_deg: 0.0, night_only: false}], fixed_axis: false}
beam: {model: monopole, length_m: 3.0, zenith_angle_deg: 75.0, height_m: 2.0,
  surface_permittivity: 3.7, deep_permittivity: 6.1, loss_tangent: 0.01, turntable_offset_deg: 0.0,
  file: null, taper: true, quadrature: exact, receiver: jfet, moon_temperature_k: 0.0,
  antenna_temperature_k: 0.0, rotations_deg: [0.0, 90.0, 180.0, 270.0]}
sky: {model: galaxy, seed: 1, sources: false, file: null, dataset: null, file_frequency_mhz: null,
  spectral_index: -2.5}
prior: {spectrum: sky, scale: 1.0, log_amplitude_std: null, tilt_std: null, band_edges: [],
  log_band_std: 1.0}
noise: {radiometer: {form: paper, bandwidth_hz: 1000000.0, duty_cycle: 1.0, factor: 1.0,
  log_factor_std: null, temperature: model}, gain: null, beam: null}
sources: {list: [], treatment: marginalised}
spectral: {model: components, components: [power_law, curvature, turnover], index: -2.5,
  reference_mhz: 20.0, turnover_mhz: 5.0, length: 1.0, residual: null}
seed: 1
"""


def old_scenario(path, **changes):
    """The scenario of the old text with some sections' entries changed."""
    tree = parse_yaml(OLD, "the file")
    for section, entries in changes.items():
        tree[section] |= entries
    path.write_text(as_yaml(tree))
    return load_scenario(path)


@pytest.fixture
def response(tmp_path):
    """A file that is known as a four-port response by its images."""
    return str(write_images(tmp_path / "ports.fits", {"h_theta_real": np.zeros((1, 1))}, {}))


@pytest.fixture
def scalar(tmp_path):
    """A FITS file that is none."""
    return str(write_images(tmp_path / "arm.fits", {"Etheta_real": np.zeros((1, 1))}, {}))


# --- scenarios that were written before -----------------------------------------------------------


def test_the_old_fiducial_scenario_is_the_fiducial_scenario(tmp_path):
    found = old_scenario(tmp_path / "old.yaml")
    # it says of which visibilities the noise level is that, which has since been left open
    assert found == load_scenario("fiducial", ["noise.radiometer.temperature=model"])
    assert found.prior == IsotropicPriorSection(spectrum="sky")
    # written again, it has no key of another kind
    tree = parse_yaml(found.to_yaml(), "the file")
    assert set(tree["beam"]) == set(MonopoleBeamSection.model_fields)
    assert set(tree["sky"]) == set(GalaxySection.model_fields)
    assert tree["prior"]["spectrum"] == "sky"


def test_what_an_old_scenario_says_of_the_embedded_antennas_is_kept(tmp_path):
    beam = {"length_m": 2.5, "loss_tangent": 0.02, "turntable_offset_deg": 3.0}
    found = old_scenario(tmp_path / "old.yaml", beam=beam, prior={"scale": 2.0, "tilt_std": 0.5})
    assert found.beam == MonopoleBeamSection(**beam)
    assert found.prior == IsotropicPriorSection(scale=2.0, tilt_std=0.5)


def test_an_old_scenario_with_a_scalar_beam(tmp_path, scalar):
    beam = {
        "file": scalar,
        "taper": False,
        "quadrature": "luseepy",
        "moon_temperature_k": 250.0,
        "rotations_deg": [0.0, 90.0],
        "turntable_offset_deg": 7.0,
    }
    found = old_scenario(tmp_path / "old.yaml", beam=beam)
    assert found.beam == ScalarBeamSection(**beam)
    assert found.beam.n_ports == 2
    (tmp_path / "again.yaml").write_text(found.to_yaml())
    assert load_scenario(tmp_path / "again.yaml") == found


def test_an_old_scenario_with_a_response(tmp_path, response):
    beam = {"file": response, "receiver": "open", "antenna_temperature_k": 300.0}
    found = old_scenario(tmp_path / "old.yaml", beam=beam)
    assert found.beam == ResponseSection(**beam)
    assert found.beam.n_ports == 4


def test_an_old_scenario_with_a_sky_from_a_file(tmp_path):
    """``sources`` were said there, too, without effect; sources beside the map may be."""
    sky = {"file": "x.hdf5", "dataset": "map", "file_frequency_mhz": 10.0, "sources": True}
    beside = {"list": [{"name": "Cas A"}]}
    found = old_scenario(tmp_path / "old.yaml", sky=sky, sources=beside)
    assert found.sky == FileSkySection(file="x.hdf5", dataset="map", file_frequency_mhz=10.0)
    assert not found.sky.sources
    assert [source.name for source in found.sources.list] == ["Cas A"]


@pytest.mark.parametrize(
    ("text", "kind"),
    [
        ("sky: {file: x.fits}", FileSkySection),
        ("sky: {model: galaxy, file: x.fits}", FileSkySection),
        ("sky: {model: galaxy, file: null}", GalaxySection),
        ("sky: {seed: 3}", GalaxySection),
    ],
)
def test_the_sky_of_a_short_file(tmp_path, text, kind):
    path = tmp_path / "short.yaml"
    path.write_text(text)
    assert type(load_scenario(path).sky) is kind


def test_a_prior_takes_the_place_of_another(tmp_path):
    """``--set`` leaves the keys of the kind that was there, which the other kind drops."""
    found = load_scenario("fiducial", ["prior.model=local_scales", "prior.sources=false"])
    assert found.prior == LocalScalesPriorSection(sources=False)
    (tmp_path / "again.yaml").write_text(found.to_yaml())
    assert load_scenario(tmp_path / "again.yaml") == found
    plain = load_scenario("fiducial", ["prior.model=local_scales"])
    (tmp_path / "plain.yaml").write_text(plain.to_yaml())
    back = load_scenario(tmp_path / "plain.yaml", ["prior.model=isotropic"])
    assert back == load_scenario("fiducial", ["prior.spectrum=learned"])
    (tmp_path / "short.yaml").write_text("prior: {tilt_std: 0.5}")
    assert load_scenario(tmp_path / "short.yaml").prior == IsotropicPriorSection(tilt_std=0.5)


def test_the_file_tells_which_beams_they_are(tmp_path, response, scalar):
    path = tmp_path / "short.yaml"
    for file, kind in [(response, ResponseSection), (scalar, ScalarBeamSection)]:
        path.write_text(f"beam: {{file: {file}}}\n")
        assert load_scenario(path).beam == kind(file=file)
        assert load_scenario("fiducial", [f"beam.file={file}"]).beam == kind(file=file)


# --- the section of another file ------------------------------------------------------------------


def test_the_section_of_another_file_is_put_up_alike(response, scalar):
    arm = ScalarBeamSection(
        file="own.fits",
        taper=False,
        rotations_deg=(0.0, 120.0),
        turntable_offset_deg=7.0,
        quadrature="luseepy",
        moon_temperature_k=250.0,
    )
    assert section_of_file(scalar, arm) == arm.model_copy(update={"file": scalar})
    shared = {"turntable_offset_deg": 7.0, "quadrature": "luseepy", "moon_temperature_k": 250.0}
    assert section_of_file(response, arm) == ResponseSection(file=response, **shared)
    ports = ResponseSection(file="own.fits", receiver="open", **shared)
    assert section_of_file(scalar, ports) == ScalarBeamSection(file=scalar, **shared)
    embedded = MonopoleBeamSection(turntable_offset_deg=7.0, length_m=2.0)
    assert section_of_file(scalar, embedded) == ScalarBeamSection(
        file=scalar, turntable_offset_deg=7.0
    )
