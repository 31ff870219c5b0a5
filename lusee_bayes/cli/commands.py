"""The commands: each parses its options, calls a run and prints its results.

A command imports its run only when called, so that ``--help`` and completion respond immediately.
The docstrings are the help text, in the subset that Markdown (terminal) and reST (site) share.
"""

import json
import webbrowser
from contextlib import nullcontext
from itertools import takewhile
from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter

from lusee_bayes.cli import options as option
from lusee_bayes.cli.options import say
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.version import release

app = App(
    name="lusee-bayes",
    version=release,
    suppress_keyboard_interrupt=False,
    # a file name may begin with [
    default_parameter=Parameter(json_list=False, json_dict=False),
    help=(
        "Bayesian maps of the low-frequency sky from LuSEE-Night's visibilities.\n\n"
        "Exit codes: 0 success; 1 a validation failed, workers were lost, or memory or disk ran "
        "out; 2 bad input (one sentence on standard error); 130 interrupted; 143 terminated. For "
        "examples, see lusee-bayes COMMAND --help."
    ),
)
app.register_install_completion_command()


# the scenario that map uses by default
FIRST_MAP = "first_map"


@app.command(name="map", group="Maps")
def map_command(
    scenario: str | None = None,
    *,
    truth: option.Flag = False,
    draws: option.Number | None = None,
    covariance: option.Flag = False,
    information: option.Flag = False,
    add: Path | None = None,
    diagnose: option.Flag = False,
    frequencies: option.Frequencies | None = None,
    joint: option.Flag = False,
    open: option.Flag = False,
    options: option.DataOptions = option.DataOptions(),
    engine: option.EngineOptions = option.EngineOptions(),
) -> None:
    """Compute a posterior map of the sky from simulated or given data.

    Results go to output/NAME, or to the folder given by --output.

    **Examples**

    - ``lusee-bayes map``
    - ``lusee-bayes map fiducial --set frequency_mhz=10 -o output/ten``
    - ``lusee-bayes map fiducial --data data.nc -o output/measured``
    - ``lusee-bayes map fiducial --data waterfall.fits --set beam.file=beam.fits``
    - ``lusee-bayes map first_light.yaml --data session_*.h5 --clock clock.json``
    - ``lusee-bayes map first_light.yaml --data reduced.nc --frequencies 5:50:1``
    - ``lusee-bayes map fiducial --frequencies 5:50:1 --joint --draws 20 -o output/cube``
    - ``lusee-bayes map fiducial --data second_cycle.nc --add output/first_cycle``

    Parameters
    ----------
    scenario
        YAML file, or name of a built-in scenario (default: first_map).
    truth
        Compare the map with the scenario's sky (use if the data were simulated from it).
    draws
        Number of posterior draws to store in posterior.nc (output.draws).
    covariance
        Store the posterior covariance in posterior.nc (output.covariance).
    information
        Store the data's information about the sky in posterior.nc, for a later --add
        (output.information).
    add
        Folder of a run made with --information: add the new data to that run.
    diagnose
        Test every group of data and try the usual mistakes (signs, swapped ports, angles, clocks,
        ...), even if the data fit. If they do not fit, this is done automatically.
    frequencies
        Channels in MHz, as 10,25,30 or first:last:step, mapped independently. To resume an
        interrupted run, repeat the command.
    joint
        Fit one posterior to all channels, using the scenario's spectral prior.
    open
        Open the report in a browser.
    """
    from lusee_bayes.runs.cost import demand_of
    from lusee_bayes.runs.map_run import run_map

    if scenario is None and options.data is not None:
        raise InputError("--data needs the scenario of its instrument: lusee-bayes map SCENARIO")
    scenario = scenario or FIRST_MAP
    kept = {"output__draws": draws, "output__covariance": covariance}
    kept["output__information"] = information
    loaded = options.load(scenario, frequencies_mhz=frequencies, joint=joint, **kept)
    several = bool(loaded.frequencies_mhz)
    if not several and engine != option.EngineOptions():
        raise InputError("--workers and --cluster distribute channels; give --frequencies")
    with engine.open(demand_of(loaded)) if several else nullcontext() as opened:
        given = {"truth": truth, "earlier": add, "thorough": diagnose}
        run = run_map(loaded, options.folder(scenario), engine=opened, **given, **options.running())
    lines = run.result.lines(verbose=options.verbose)
    options.print(*lines, look_at(run.page, open), files=run.files)


def look_at(page: Path, open_it: bool) -> str:
    """The line that names a page, which is also opened in a browser if that was asked for."""
    if open_it:
        webbrowser.open(page.resolve().as_uri())
    return f"look at {page}"


@app.command(name="simulate", group="Data")
def simulate_command(
    scenario: str,
    *,
    frequencies: option.Frequencies | None = None,
    flight: option.Flag = False,
    options: option.ScenarioOptions = option.ScenarioOptions(),
) -> None:
    """Simulate visibilities for a scenario.

    Results go to data.nc, or to the file given by --output: netCDF, or a luseepy waterfall if the
    name ends in .fits. With --flight, sessions go to the folder flight, or to --output.

    **Examples**

    - ``lusee-bayes simulate fiducial --set seed=2 -o data.nc``
    - ``lusee-bayes simulate fiducial --frequencies 10:30:5 -o waterfall.fits``

    Parameters
    ----------
    scenario
        YAML file, or name of a built-in scenario (fiducial, ...).
    frequencies
        Channels of a waterfall in MHz, as 10,25,30 or first:last:step. The noise seed increases by
        one from channel to channel.
    flight
        Write spectrometer sessions as the lander delivers them (flight.simulated).
    """
    from lusee_bayes.runs.data_run import run_simulate, run_simulate_flight

    loaded = options.load(scenario, frequencies_mhz=frequencies)
    if flight:
        files = run_simulate_flight(loaded, options.output or Path("flight"), **options.running())
        options.print(*files.lines())
        return
    path = options.output or Path("data.nc")
    data = run_simulate(loaded, path, **options.running())
    options.print(
        f"{sum(d.layout.size for d in data)} visibilities of {data[0].layout.n_products} products "
        f"at {', '.join(f'{d.frequency_mhz:g}' for d in data)} MHz -> {path}",
    )


@app.command(name="reduce", group="Data")
def reduce_command(
    scenario: str,
    files: Annotated[list[Path], Parameter(required=True)],
    /,
    *,
    frequencies: option.Frequencies | None = None,
    clock: str | None = None,
    options: option.ScenarioOptions = option.ScenarioOptions(),
) -> None:
    """Calibrate, flag and average spectrometer sessions.

    The scenario supplies what the files lack: gain table, bin origin, meaning of the times, clock.
    map --data SESSION... reduces sessions in the same way, for its own frequencies. Bands go to
    reduced.nc, or to the file given by --output; pass that file to map --data.

    **Examples**

    - ``lusee-bayes reduce first_light.yaml session_*.h5 --frequencies 5:50:1 -o reduced.nc``
    - ``lusee-bayes reduce first_light.yaml session.h5 --clock clock.json -o reduced.nc``

    Parameters
    ----------
    scenario
        YAML file, or name of a built-in scenario, with a section flight.
    files
        Sessions written by luseepy, HDF5 or FITS, in any order.
    frequencies
        Band centres in MHz, as 10,25,30 or first:last:step.
    clock
        Clock reference (JSON), for sessions with no absolute time or to correct their UTC
        (flight.clock).
    """
    from lusee_bayes.core.checks import counted
    from lusee_bayes.runs.data_run import reduced_lines, run_reduce

    loaded = options.load(scenario, frequencies_mhz=frequencies, flight__clock=clock)
    path = options.output or Path("reduced.nc")
    reduced = run_reduce(loaded, files, path, **options.running())
    bands = counted(len(reduced.frequencies_mhz), "band")
    options.print(*reduced_lines(reduced), f"{bands} -> {path}")


@app.command(name="average", group="Data")
def average_command(
    data: Path,
    *,
    to: option.Duration,
    scenario: str = "fiducial",
    no_information: option.Flag = False,
    options: option.ScenarioOptions = option.ScenarioOptions(),
) -> None:
    """Average data over longer times and report the information lost.

    Averaged data need less memory and time to map. The loss of information about the map, in bits,
    is forecast as in plan. Averages go to averaged.nc, or to the file given by --output.

    **Examples**

    - ``lusee-bayes average data.nc --to 2h -o averaged.nc``
    - ``lusee-bayes average data.nc --to 30min --scenario gain_1e-2 --set lmax=31``

    Parameters
    ----------
    data
        Visibilities whose samples have windows. From a waterfall, the scenario's frequency is used.
    to
        Averaging time: 30s, 10min, 2h, 1d.
    scenario
        Scenario with the instrument, noise and prior used to compute the loss: YAML file, or name
        of a built-in scenario.
    no_information
        Skip the information loss, which takes the memory and time of two maps.
    """
    from lusee_bayes.runs.data_run import run_average

    path = options.output or Path("averaged.nc")
    loaded, information = options.load(scenario), not no_information
    run = run_average(loaded, data, to, path, information=information, **options.running())
    options.print(*run.lines(), f"{run.averaged.layout.size} visibilities -> {path}")


@app.command(name="sample", group="Maps")
def sample_command(
    scenario: str,
    *,
    model: str | None = None,
    algorithm: option.Algorithm | None = None,
    frequencies: option.Frequencies | None = None,
    options: option.DataOptions = option.DataOptions(),
    chains: option.ChainOptions = option.ChainOptions(),
) -> None:
    """Sample the posterior of a NumPyro program with Hamiltonian Monte Carlo.

    Draws are written during the run; --resume continues an interrupted run. Results go to
    output/NAME-PROGRAM, or to the folder given by --output.

    **Examples**

    - ``lusee-bayes sample fiducial --set lmax=20 --draws 500 -o output/hmc``
    - ``lusee-bayes sample fiducial --model my_model.py --set lmax=12``
    - ``lusee-bayes sample gain_1e-2 --frequencies 10,25,40 --resume -o output/three``

    Parameters
    ----------
    scenario
        YAML file, or name of a built-in scenario (fiducial, ...).
    model
        Program: a Python file with a function model, or the name of a built-in program (sky,
        sky_marginal, gains, instrument, ...). Default: systematics if the scenario samples
        anything, else sky.
    algorithm
        nuts (No-U-Turn Sampler), hmc (trajectories of fixed length) or crank-nicolson (no
        gradients; the default if the sampled parameters were first estimated iteratively).
    frequencies
        Channels in MHz, as 10,25,30 or first:last:step, sampled one after another. Each channel has
        its own folder; cubes combine the maps. --resume keeps finished channels.
    """
    from lusee_bayes.runs.sample_run import default_program, run_sample
    from lusee_bayes.sampling.programs import load_program

    loaded = options.load(scenario, frequencies_mhz=frequencies)
    program = default_program(loaded) if model is None else load_program(model)
    given = chains.running(loaded.seed, algorithm) | options.running()
    run = run_sample(loaded, options.folder(scenario, f"-{program.name}"), program=program, **given)
    several, lines = bool(loaded.frequencies_mhz), []
    for result in run.result:
        lines += [f"{result.experiment.scenario.frequency_mhz:g} MHz"] * several + result.lines()
    page = f"the {run.page.name} of every channel in {run.folder}" if several else run.page
    options.print(*lines, f"look at {page}", files=run.files)


@app.command(name="validate", group="Maps")
def validate_command(
    scenario: str,
    *,
    simulations: option.Count = 500,
    options: option.DataOptions = option.DataOptions(),
    chains: option.ChainOptions = option.ChainOptions(),
    engine: option.EngineOptions = option.EngineOptions(),
) -> int:
    """Check the posterior of a scenario with HMC and simulated data sets.

    The exit code is 1 if a check fails; validation.md lists the thresholds. Results go to
    output/NAME-validation, or to the folder given by --output.

    **Examples**

    - ``lusee-bayes validate gain_1e-2 --set lmax=8 -o output/check``

    Parameters
    ----------
    scenario
        YAML file, or name of a built-in scenario (fiducial, ...).
    simulations
        Number of data sets for simulation-based calibration.
    """
    from lusee_bayes.sampling.least import require_draws, require_simulations

    require_simulations(simulations)
    require_draws(chains.draws)
    loaded = options.load(scenario)
    from lusee_bayes.cli.tables import checks_table
    from lusee_bayes.runs.sample_run import demand_of_calibration, run_validate

    with engine.open(demand_of_calibration(loaded)) as opened:
        given = {"name": Path(scenario).stem, "simulations": simulations, "engine": opened}
        given |= chains.running(loaded.seed) | options.running()
        run = run_validate(loaded, options.folder(scenario, "-validation"), **given)
    verdict = f"{run.result.headline()}; look at {run.page}"
    options.print(checks_table(run.result.checks), verdict, files=run.files)
    return 0 if run.result.passed else 1


@app.command(name="plan", group="Maps")
def plan_command(
    scenario: str,
    *others: str,
    vary: Annotated[tuple[str, ...], option.Repeated] = (),
    options: option.ScenarioOptions = option.ScenarioOptions(),
    engine: option.EngineOptions = option.EngineOptions(),
) -> None:
    """Forecast the information content of observations, without data.

    Reports bits of information, the number of modes with SNR > 1, and ell_cross, the first ell with
    SNR < 1. Table and figure go to output/plan, or to the folder given by --output.

    **Examples**

    - ``lusee-bayes plan fiducial gain_1e-2 -o output/plan``
    - ``lusee-bayes plan fiducial --vary frequency_mhz=10,25,40``

    Parameters
    ----------
    scenario
        YAML file, or name of a built-in scenario (fiducial, ...).
    others
        More scenarios; every variation is applied to each.
    vary
        key.path=value,value,...: a key and the values to try; may be repeated. Default: vary
        turntable, duration, nights, duty cycle and lost antennas.
    """
    from lusee_bayes.cli.tables import forecast_table
    from lusee_bayes.results.forecast import forecast_lines
    from lusee_bayes.runs.cost import demand_of
    from lusee_bayes.runs.plan_run import run_plan, variations_of

    sources, given = [scenario, *others], options.running()
    variations = variations_of(sources, options.set_, vary, given["stages"])
    with engine.open(demand_of(*(v.scenario for v in variations))) as opened:
        run = run_plan(variations, options.output or Path("output/plan"), engine=opened, **given)
    by_source = [[f for f in run.result if f.variation.source == source] for source in sources]
    tables = [forecast_table(forecasts) for forecasts in by_source]
    lines = [line for forecasts in by_source for line in forecast_lines(forecasts)]
    options.print(*tables, *lines, f"look at {run.folder}/figures/plan.png", files=run.files)


@app.command(name="compare", group="Results")
def compare_command(*folders: Path, options: option.Options = option.Options()) -> None:
    """Compare finished map runs: maps, spectra, evidence.

    comparison.html, comparison.csv and the figures go to output/comparison, or to the folder given
    by --output.

    **Examples**

    - ``lusee-bayes compare output/fiducial output/gain_1e-2``

    Parameters
    ----------
    folders
        Two or more result folders of map, each of one frequency.
    """
    from lusee_bayes.cli.tables import comparison_table
    from lusee_bayes.results.finished_runs import evidence_caveat
    from lusee_bayes.runs.compare_run import run_compare

    run = run_compare(folders, options.output or Path("output/comparison"), **options.running())
    lines = filter(None, [evidence_caveat(run.result), f"look at {run.folder}/comparison.html"])
    options.print(comparison_table(run.result), *lines, files=run.files)


@app.command(name="report", group="Results")
def report_command(folder: Path, *, open: option.Flag = False, quiet: option.Quiet = False) -> None:
    """Rebuild report.html from the results in a run folder.

    **Examples**

    - ``lusee-bayes report output/fiducial``

    Parameters
    ----------
    folder
        Results of map, sample or validate.
    open
        Open it in a browser.
    quiet
        Print only errors.
    """
    from lusee_bayes.report.pages import write_report

    say(look_at(write_report(folder), open), quiet=quiet)


@app.command(name="spectrum", group="Results")
def spectrum_command(
    run: Path,
    *,
    region: str = "observed sky",
    signal: Annotated[tuple[str, ...], option.Repeated] = (),
    order: int = 6,
    figure: Path | None = None,
    table: Annotated[tuple[Path, ...], option.Repeated] = (),
) -> None:
    """Print the spectrum of the sky of a finished map of several channels.

    --signal also limits a global signal: a template beside a smooth spectrum, with sky and
    instrument marginalised. --figure draws the spectrum beside published ones and those of given
    tables.

    **Examples**

    - ``lusee-bayes spectrum output/cube``
    - ``lusee-bayes spectrum output/cube --signal trough:17.5:3 --signal excess``
    - ``lusee-bayes spectrum output/cube --figure spectrum.png --table measured.csv``

    Parameters
    ----------
    run
        Result folder of map.
    region
        mean sky, observed sky, ``cap b > 60``, ``cap b < -60``, ``plane |b| < 10``, or a point
        source of the scenario.
    signal
        trough:MHZ:WIDTH (a Gaussian absorption), excess (index -2.6), constant, or a CSV file with
        frequency_mhz and temperature_k; may be repeated.
    order
        Degree of the smooth spectrum, a polynomial of ln T in ln f.
    figure
        PNG file to write.
    table
        CSV file with frequency_mhz, temperature_k and, if known, std_k, to draw in it; may be
        repeated.
    """
    from lusee_bayes.cli.tables import table_of_numbers
    from lusee_bayes.results.finished_runs import FinishedRun
    from lusee_bayes.results.signal_limit import named_template, signal_limit

    if table and figure is None:
        raise InputError("--table draws a spectrum into a figure; give --figure FILE.png, too")
    spectrum = FinishedRun.read(run).sky_spectrum()
    templates = [named_template(one) for one in signal]
    limits = [signal_limit(spectrum, *one, region=region, order=order) for one in templates]
    rows = table_of_numbers(*spectrum.rows(region)), *(limit.sentence() for limit in limits)
    say(f"{region} (share: of the variance that would vanish if it were known; shares overlap)")
    say(*rows)
    if figure is not None:
        from lusee_bayes.core.files import replacing, require_new
        from lusee_bayes.report.figures.drawing import save
        from lusee_bayes.report.figures.maps import spectrum_figure

        require_new(figure, replace=False)
        with replacing(figure) as path:
            save([(path, spectrum_figure(spectrum, table))], 150)
        say(f"spectrum -> {figure}")


@app.command(name="export", group="Results")
def export_command(
    run: Path,
    *,
    release: Path | None = None,
    skyh5: Path | None = None,
    creator: Annotated[tuple[str, ...], option.Repeated] = (),
    doi: str = "",
    license: option.Licence = "CC-BY-4.0",
    quiet: option.Quiet = False,
) -> None:
    """Bundle a finished run for publication, or write its map for pyradiosky.

    --release writes a folder with checksums, DataCite metadata, a licence and read_it.py, which
    reads the map without lusee_bayes; the command lists what is still to be filled in. --skyh5
    writes the posterior mean as a SkyH5 file.

    **Examples**

    - ``lusee-bayes export output/fiducial --release fiducial_release``
    - ``lusee-bayes export output/fiducial --release out --creator "Galilei, Galileo"``
    - ``lusee-bayes export output/fiducial --skyh5 sky.skyh5``

    Parameters
    ----------
    run
        Results of map, sample or validate.
    release
        Folder to write; it must not exist.
    skyh5
        File to write, of a run of map.
    creator
        Creator of the data set: "Family, Given", or the name of a group; may be repeated.
    doi
        DOI of the data set, without https, such as one reserved at the archive.
    license
        Licence of the files (SPDX identifier).
    quiet
        Print only errors.
    """
    from lusee_bayes.runs.export_run import BLANK, METADATA, run_export, write_skyh5

    if (release is None) == (skyh5 is None):
        raise InputError("export needs either --release FOLDER or --skyh5 FILE")
    if release is None:
        lines = [str(file) for file in write_skyh5(run, skyh5).files]
    else:
        written = run_export(run, release, creators=creator, doi=doi, licence=license)
        lines = [f"{len(written.files)} files in {release}"]
        for blank in written.result:
            lines.append(f"{blank}: replace {BLANK} in {release / METADATA}")
    say(*lines, quiet=quiet)


@app.command(name="info", group="Data")
def info_command(files: Annotated[list[Path], Parameter(required=True)], /) -> int:
    """Describe the contents of files or run folders.

    Reads visibilities, sessions, posteriors, samples, skies and beams.

    **Examples**

    - ``lusee-bayes info output/fiducial``
    - ``lusee-bayes info output/fiducial/posterior.nc``
    - ``lusee-bayes info beam.fits``
    - ``lusee-bayes info session_*.h5``

    Parameters
    ----------
    files
        One or more files or folders. Unreadable ones are named; the others are still described.
    """
    from lusee_bayes.report.describe import describe

    refused = 0
    for number, file in enumerate(files):
        try:
            text = describe(file)
        except InputError as error:
            say(f"lusee-bayes: {error}", stderr=True)
            refused += 1
        else:
            # one block per file
            say(f"\n{text}" if number else text)
    return 2 if refused else 0


@app.command(name="keys", group="Scenarios")
def keys_command(
    key: str = "", *, markdown: option.Flag = False, schema: option.Flag = False
) -> None:
    """List every setting of a scenario, with its meaning, unit, choices and default.

    **Examples**

    - ``lusee-bayes keys``
    - ``lusee-bayes keys noise.gain``

    Parameters
    ----------
    key
        List only this key or section (noise, noise.gain, ...).
    markdown
        Print a Markdown table.
    schema
        Print the JSON schema of a scenario, with which editors complete and check YAML.
    """
    from lusee_bayes.experiment.keys import keys_as_markdown, scenario_keys
    from lusee_bayes.experiment.scenario import Scenario

    if schema:
        print(json.dumps(Scenario.model_json_schema(), indent=1))
        return
    keys = scenario_keys(key)
    say(*([keys_as_markdown(keys).rstrip()] if markdown else map(str, keys)))


@app.command(name="scenarios", group="Scenarios")
def scenarios_command() -> None:
    """List the built-in scenarios.

    **Examples**

    - ``lusee-bayes scenarios``
    """
    from lusee_bayes.experiment.scenario import scenario_names, scenario_text

    for name in scenario_names():
        comment = takewhile(lambda line: line.startswith("#"), scenario_text(name).splitlines())
        say(f"{name}: {' '.join(line.lstrip('# ') for line in comment)}")


@app.command(name="init", group="Scenarios")
def init_command(file: Path, *, like: str = FIRST_MAP, force: option.Flag = False) -> None:
    """Write a commented scenario to edit.

    **Examples**

    - ``lusee-bayes init mine.yaml``
    - ``lusee-bayes init mine.yaml --like fiducial``

    Parameters
    ----------
    file
        YAML file to write.
    like
        Built-in scenario to start from.
    force
        Overwrite an existing file.
    """
    from lusee_bayes.core.files import replacing, require_new
    from lusee_bayes.experiment.scenario import scenario_text

    text = f"{scenario_text(like)}# lusee-bayes keys lists every setting\n"
    require_new(file, replace=force)
    with replacing(file) as path:
        path.write_text(text, encoding="utf-8")
    say(f"{file}; map it: lusee-bayes map {file}")


@app.command(name="paper", group="Results")
def paper_command(
    *,
    sky: Annotated[tuple[Path, ...], option.Many] = (),
    options: option.Options = option.Options(),
    engine: option.EngineOptions = option.EngineOptions(),
) -> None:
    """Reproduce the figures of the reference paper and check its claims.

    Finished cases with the same scenario and version are reused, so an interrupted run resumes
    where it stopped. Cases, figures and tables go to output/paper, or to the folder given by
    --output.

    **Examples**

    - ``lusee-bayes paper``
    - ``lusee-bayes paper -o output/ulsa --sky exp1.0MHz_sky.hdf5 exp10.0MHz_sky.hdf5``

    Parameters
    ----------
    sky
        ULSA HDF5 files with the frequency in their names, such as exp10.0MHz_sky.hdf5; each case
        scales the file nearest in log frequency. Default: the embedded sky.
    """
    from lusee_bayes.paper.cases import paper_scenarios
    from lusee_bayes.runs.cost import demand_of
    from lusee_bayes.runs.paper_run import run_paper

    folder = options.output or Path("output/paper")
    with engine.open(demand_of(*paper_scenarios(skies=sky).values())) as opened:
        run = run_paper(folder, skies=sky, engine=opened, **options.running())
    verdict = (run.folder / "claims.md").read_text(encoding="utf-8").splitlines()[0]
    files = [path for path in run.files if path.suffix != ".nc"]
    options.print(verdict, f"look at {run.folder}/claims.md", files=files)
