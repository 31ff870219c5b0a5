"""Sampling of a program given an experiment's data: draws survive a kill."""

from __future__ import annotations

import json
import time
from pathlib import Path

import jax
import xarray as xr
from numpyro.infer.hmc import HMCState

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.progress import Stages
from lusee_bayes.core.reading import naming, reading
from lusee_bayes.core.version import versions
from lusee_bayes.experiment.experiment import Experiment, infer, program_pieces
from lusee_bayes.experiment.model import true_values
from lusee_bayes.experiment.rounds import Inference
from lusee_bayes.instrument.visibilities import Visibilities
from lusee_bayes.results.sample_result import CHAINS, SAMPLES, SampleResult
from lusee_bayes.sampling.datatree import read_datatree, to_datatree
from lusee_bayes.sampling.distributions import TimesStudentT
from lusee_bayes.sampling.hmc import Chains, Checkpoints, Sampler, Whitening, sample
from lusee_bayes.sampling.log_normal import coordinates_of
from lusee_bayes.sampling.mode import laplace_approximation
from lusee_bayes.sampling.program_checks import require_sampleable
from lusee_bayes.sampling.programs import Program, predicts
from lusee_bayes.systematics.gain_drifts import SCALES
from lusee_bayes.systematics.systematic import SKY, Chart, Systematic

# where the mode of a collapsed program is looked for
STARTS = 4


def sample_result(
    experiment: Experiment,
    program: Program,
    sampler: Sampler,
    folder: Path,
    *,
    resume: bool = False,
    stages: Stages | None = None,
) -> SampleResult:
    """Sample ``program`` given an experiment's data; draws are kept in ``folder``/chains.

    Parameters
    ----------
    experiment : Experiment
    program : Program
    sampler : Sampler
    folder : Path
        Of the run; unfinished chains are kept in it.
    resume : bool
        Go on with an unfinished run of the same settings, or take over a finished one.
    stages : Stages, optional
        Told what is being done.

    Raises
    ------
    InputError
        If ``folder`` holds an unfinished run and ``resume`` is not given, if the unfinished run has
        other settings, or if the program does not end with draws of the sky.
    """
    stages = stages or Stages()
    scenario, data = experiment.scenario, experiment.data
    with stages("posterior"):
        inference = infer(experiment)
        jax.block_until_ready(inference.posterior.white_mean)
    identity = {
        "scenario": scenario.to_yaml(),
        "data": data.digest(),
        "program": program.name,
        "program text": program.digest,
        **{f"sampler's {name}": value for name, value in sampler.identity().items()},
        "versions": versions(with_commit=False),
    }
    if resume and (finished := _finished(folder, identity, sampler)) is not None:
        return SampleResult(experiment, inference, finished, stages.seconds, None)
    arguments = program.arguments(inference.model, program_pieces(experiment))
    n_modes = inference.posterior.mean.shape[0]
    latent = require_sampleable(program, arguments, data.data, n_modes)
    with stages("coordinates"):
        whitening = coordinates(program, arguments, data, inference, latent)
    checkpoints = Checkpoints(folder / CHAINS, identity, resume=resume)
    times = []
    with stages.progress("sampling", sampler.warmup + sampler.draws) as update:

        def report(iteration: int, state: HMCState) -> None:
            times.append((time.perf_counter(), iteration))
            update(iteration, _state_in_words(iteration, state, sampler))

        with naming(f"the program '{program.path or program.name}'"):
            chains = sample(
                program.model,
                {**arguments, "data": data.data},
                sampler,
                whitening,
                checkpoints,
                report,
            )
    with stages("data tree"):
        tree = to_datatree(
            chains,
            program,
            inference.model,
            inference.posterior,
            data,
            seed=sampler.seed,
            arguments=arguments,
            truth=true_values(experiment.setup),
            attributes={
                "coordinates": "learned in warmup" if whitening is None else "white",
                "identity": json.dumps(identity),
                "frequency_mhz": scenario.frequency_mhz,
                "frame": "galactic",
                "scenario": scenario.to_yaml(),
            },
        )
    speed = _speed(times, chains, sampler.warmup)
    return SampleResult(experiment, inference, tree, stages.seconds, speed)


def coordinates(
    program: Program,
    arguments: dict,
    data: Visibilities,
    inference: Inference,
    latent: list[str],
) -> Whitening | None:
    """White coordinates for a program: those of the analytic posterior where it samples the sky
    alone, and data are Gaussian about it; the straight ones of a log-normal sky; else those about
    its mode. None if no mode is found: warmup then learns scales."""
    if latent == [SKY] and not predicts(program.model, arguments, TimesStudentT):
        return Whitening.of(inference.posterior)
    positive = arguments.get("log_normal")
    if positive is not None and set(latent) == set(positive.sites):
        return coordinates_of(positive, inference.model.inform(data.data)[0])
    start = {SKY: inference.posterior.mean} if SKY in latent else {}
    arguments = {**arguments, "data": data.data}
    starts = 1 if SKY in latent else STARTS
    chart = _chart(arguments, latent)
    found = laplace_approximation(program.model, arguments, start, SCALES, starts, chart)
    return found.whitening if bool(found.converged) else None


def _chart(arguments: dict, latent: list[str]) -> Chart | None:
    """The curved coordinates that a systematic among a program's arguments knows."""
    gaussian = arguments.get("gaussian")
    for piece in arguments.values():
        for systematic in piece if isinstance(piece, tuple) else (piece,):
            if gaussian is not None and isinstance(systematic, Systematic):
                chart = systematic.chart(gaussian)
                if chart is not None and set(chart.names) <= set(latent):
                    return chart
    return None


def _finished(folder: Path, identity: dict, sampler: Sampler) -> xr.DataTree | None:
    """The samples that an earlier run of the same settings has left, if there are enough."""
    if (folder / CHAINS).exists() or not (folder / SAMPLES).exists():
        return None
    tree = read_datatree(folder / SAMPLES)
    with reading(folder / SAMPLES, "samples"):
        same = json.loads(tree.attrs["identity"]) == json.loads(json.dumps(identity))
    if not same or tree["posterior"].sizes["draw"] != sampler.draws:
        raise InputError(
            f"'{folder}' holds a finished run with other settings; leave out --resume to replace "
            "it, or give another folder"
        )
    return tree


def _state_in_words(iteration: int, state: HMCState, sampler: Sampler) -> str:
    phase = "warmup" if iteration <= sampler.warmup else "draws"
    steps, size = float(state.num_steps.mean()), float(state.adapt_state.step_size.mean())
    return (
        f"{phase}, {steps:.0f} steps of {size:.3f}, acceptance {state.mean_accept_prob.mean():.2f}"
    )


def _speed(times: list[tuple[float, int]], chains: Chains, warmup: int) -> float | None:
    """Gradients per second between the first and the last file of draws of this session."""
    drawn = [(at, done - warmup) for at, done in times if done > warmup]
    if len(drawn) < 2:
        return None
    (start, first), (end, last) = drawn[0], drawn[-1]
    return float(chains.statistics["n_steps"][:, first:last].sum() / (end - start))
