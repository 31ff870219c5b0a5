"""Whatever is typed: an answer, or one sentence and exit code 2, with nothing left behind."""

import os
import re

import pytest
from changes import SCALE
from commands import refused
from hypothesis import given, settings
from hypothesis import strategies as st

from lusee_bayes.cli.main import main
from lusee_bayes.core.errors import InputError

FEW, MANY = 30, 3_000 * SCALE
SMALL = ("--set", "lmax=2", "--set", "observation.runs.0.cycles=0.02", "-q")


@pytest.fixture
def here(tmp_path, monkeypatch):
    """An empty folder to work in."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("a file")
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "program.py").write_text("def model(data=None):\n    pass\n")
    return tmp_path


LONG, NUL, OTHER = "n" * 300, "a\0b", "x\udcff.nc"
IS_PIPE, JOINT = "neither a file nor a folder", "--joint --frequencies 20,25"
# commands about the scenario fiducial are given SMALL, too
WRONG = [
    # where results go
    ("map fiducial -o /", "root of all files"),
    ("map fiducial -o /proc/nope", "nothing can be written|No such"),
    ("map fiducial -o file/x", "file' is a file; give a folder for the results"),
    ("map fiducial -o file", "'file' is a file"),
    ("simulate fiducial --flight --set flight={} -o file", "is a file"),
    ("map fiducial -o pipe", IS_PIPE),
    (f"map fiducial -o {LONG}", "too long"),
    (f"map fiducial -o {NUL}", "NUL"),
    ("simulate fiducial -o /dev/full", IS_PIPE),
    ("simulate fiducial -o .", "is a folder"),
    # options
    ("mapp fiducial", "mapp"),
    ("map fiducial --draw 3", "--draw"),
    ("map fiducial --draws many", "many"),
    ("sample fiducial --chains 0", "--chains: expected .*got 0"),
    ("sample fiducial --warmup 3", "at least 20, got 3"),
    ("sample fiducial --algorithm hcm", "hcm.*nuts"),
    ("validate fiducial --simulations 50", "simulations"),
    ("map fiducial --frequencies=1:50:1e-9", "channels; at most 4096"),
    ("map fiducial --frequencies 20,10", "expected growing MHz"),
    ("map fiducial --joint", "joint needs frequencies_mhz"),
    ("map fiducial --workers 2", "give --frequencies"),
    ("map fiducial --cluster tcp://127.0.0.1:1", "give --frequencies"),
    ("map fiducial --frequencies 20,25 --add x", "no posterior of"),
    ("map fiducial --add x", "no posterior of lusee-bayes map --information at"),
    (f"map fiducial {JOINT}", "need at least as many channels, got 2"),
    ("compare-priors fiducial --priors isotropic,local", "'local'; did you mean 'local_scales'?"),
    ("compare-priors fiducial --priors isotropic", "a comparison needs two or more"),
    ("compare-priors fiducial --priors isotropic,isotropic", "two or more different ones"),
    ("compare-priors fiducial --priors isotropic,isotropic-sky --data file", "scenario's sky"),
    ("compare-priors fiducial --set frequencies_mhz=[10,20]", "is for a single frequency"),
    ("compare-priors fiducial --set prior.tilt_std=0.1", "something is to be sampled"),
    ("compare", "two"),
    ("plan", "scenario"),
    ("plan nonsense", "no scenario 'nonsense'"),
    ("plan fiducial fiducial", "'fiducial' is given twice; give each once"),
    ("plan fiducial --vary lmax", "--vary takes key.path=value,value"),
    ("plan fiducial --vary lmax=]", "--vary lmax=] is not valid YAML"),
    ("plan fiducial --vary lmx=3,4", "unknown key 'lmx'; did you mean 'lmax'"),
    ("plan fiducial --vary lmax=3,0", "greater than or equal to 1"),
    ("plan fiducial --set sky.file=/gone/a.fits", "fiducial, as given: no sky map at"),
    ("plan fiducial --set observation.start=soon", "fiducial, as given: start 'soon'"),
    # scenarios
    ("map", "scenario"),
    ("map nonsense", "no scenario 'nonsense'"),
    ("map three_cycle", "did you mean 'three_cycles'"),
    ("map three_cycle.yaml", "no scenario file at 'three_cycle.yaml'; check the path"),
    ("map three/cycles", "no scenario file at 'three/cycles'; check the path"),
    (f"map {NUL}", "no scenario"),
    ("map pipe", IS_PIPE),
    ("map .", "is a folder"),
    ("map fiducial --set lmax=" + "9" * 5000, "is not valid YAML"),
    ("map fiducial --set lmax=383", "of memory.*lmax=.*would fit"),
    ("map fiducial --set observation.runs.0.cycles=1000000", "about .* of memory .*would fit"),
    ("map fiducial --set observation.runs.0.cycles=0.0001", "holds no sample"),
    ("map fiducial --set observation.start=soon", "'soon' is not a date"),
    ("map fiducial --set observation.start=2051-01-01", "outside the ephemeris"),
    ("map fiducial --set sky.file=gone.fits", "no sky map at 'gone.fits'"),
    ("simulate fiducial --flight --set flight.gain_table=nowhere.nc", "nowhere.nc"),
    # what is to be sampled
    *(
        (f"map fiducial --set sky.sources=false --set {sampled}", "marginalise; .* sample$")
        for sampled in (
            'sources={"list":[{"name":"Jupiter"}],"treatment":"sampled"}',
            "noise.gain.treatment=sampled",
            'noise.beam={"shift_mhz":4,"treatment":"sampled"}',
            "noise.radiometer.log_factor_std=0.5",
            "prior.tilt_std=0.5",
            "prior.log_amplitude_std=0.5",
            "prior.band_edges=[2,4]",
        )
    ),
    # data, programs, results
    ("map fiducial --data pipe", IS_PIPE),
    ("map fiducial --data .", "is a folder"),
    ("map fiducial --data file", "file"),
    ("map fiducial --data gone.nc", "no data at 'gone.nc'; make some"),
    (f"map fiducial --data {OTHER}", r"no data at 'x\\udcff.nc'"),
    ("sample fiducial --model fil", "no program 'fil'.*prior_amplitude"),
    ("sample fiducial --model gone.py", "no program at 'gone.py'"),
    ("sample fiducial --model program.py", "no observed site"),
    ("info pipe", IS_PIPE),
    ("info file", "file"),
    ("info gone.fits", "no file at 'gone.fits'"),
    ("info [red]x[/red].nc", r"no file at '\[red\]x\[/red\].nc'"),
    (f"info {OTHER}", r"no file at 'x\\udcff.nc'"),
    ("report file", "is no folder"),
    ("report .", "holds neither"),
]


@pytest.mark.parametrize(("line", "message"), WRONG, ids=lambda text: ascii(text)[:50])
def test_wrong_input_is_a_sentence(line, message, here, capsys):
    words = line.split(" ")
    if words[1:2] == ["fiducial"]:
        words[2:2] = SMALL
    before = sorted(p.name for p in here.rglob("*"))
    said = refused(capsys, *words)
    assert re.search(message, said) and "Section" not in said, said
    assert sorted(p.name for p in here.rglob("*")) == before


def test_results_of_another_run_stay(here, capsys, small_map):
    """Another frequency into the same folder: refused, unless it is asked for."""
    before = {p: p.read_bytes() for p in small_map.folder.rglob("*") if p.is_file()}
    other = ("--set", "frequency_mhz=15", "-o", small_map.folder)
    said = refused(capsys, "map", "fiducial", *SMALL, *other)
    assert "frequency_mhz is 25.0 there and 15.0 here" in said and "--force" in said
    assert before == {p: p.read_bytes() for p in small_map.folder.rglob("*") if p.is_file()}


WORDS = ["fiducial", "map", "-o", "--set", "--draws", "--data", "--frequencies", "-q", "--model"]
WORDS += ["lmax=2", "file", "pipe", ".", "/", "", "-1", "1e9", "--", "--help", "-o=", "10:20:5"]


@pytest.mark.parametrize("n", [FEW, pytest.param(MANY, marks=pytest.mark.long)])
def test_any_words(n, here, capsys, monkeypatch):
    """The runs themselves are left out: what comes before them is tried."""

    def stop(*_, **__):
        raise InputError("stopped before the run")

    for name in ("compare", "map", "paper", "plan", "sample", "validate"):
        monkeypatch.setattr(f"lusee_bayes.runs.{name}_run.run_{name}", stop)
    monkeypatch.setattr("lusee_bayes.runs.data_run.run_simulate", stop)
    before = sorted(p.name for p in here.rglob("*"))
    commands = ["map", "sample", "simulate", "validate", "plan", "compare", "report", "info"]

    @settings(max_examples=n)
    @given(
        st.sampled_from(commands),
        st.lists(st.one_of(st.sampled_from(WORDS), st.text(max_size=5)), max_size=7),
    )
    def check(command, words):
        code = main([command, *words])
        said = capsys.readouterr()
        assert code in (0, 2), (code, said)
        if code == 2:
            # info names every bad file
            told, most = said.err.splitlines(), len(words) if command == "info" else 1
            assert 0 < len(told) <= max(most, 1), said.err
            assert all(line.startswith("lusee-bayes: ") for line in told), said.err

    check()
    assert sorted(p.name for p in here.rglob("*")) == before
