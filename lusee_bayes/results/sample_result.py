"""A sampled scenario: draws that survive a kill, and what they say of the sky."""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import jax
import numpy as np
import pandas as pd
import xarray as xr
from numpyro.infer.hmc import HMCState

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.progress import Stages, peak_memory_gb
from lusee_bayes.core.reading import naming, reading
from lusee_bayes.core.version import versions
from lusee_bayes.experiment.experiment import Experiment
from lusee_bayes.experiment.inference import infer
from lusee_bayes.experiment.pieces import program_pieces
from lusee_bayes.experiment.rounds import Inference
from lusee_bayes.experiment.simulate import true_values
from lusee_bayes.instrument.visibilities import Visibilities
from lusee_bayes.results.convergence import warnings_of
from lusee_bayes.sampling.chains import Chains
from lusee_bayes.sampling.checkpoints import Checkpoints
from lusee_bayes.sampling.datatree import read_datatree, to_datatree
from lusee_bayes.sampling.distributions import TimesStudentT
from lusee_bayes.sampling.hmc import Sampler, sample
from lusee_bayes.sampling.mode import laplace_approximation
from lusee_bayes.sampling.program_checks import require_sampleable
from lusee_bayes.sampling.program_sites import predicts
from lusee_bayes.sampling.programs import Program
from lusee_bayes.sampling.straight_log_normal import coordinates_of
from lusee_bayes.sampling.uncertainty import (
    INTERVAL,
    pixel_interval_of_draws,
    pixel_mean_of_draws,
    pixel_std_of_draws,
    sky_quantities,
    summary,
)
from lusee_bayes.sampling.whitening import Whitening
from lusee_bayes.sky.landmarks import LANDMARKS
from lusee_bayes.systematics import SCALES, Systematic
from lusee_bayes.systematics.base import SKY
from lusee_bayes.systematics.chart import Chart

SAMPLES, CHAINS = "samples.nc", "chains"

# where the mode of a collapsed program is looked for
STARTS = 4


@dataclass(frozen=True)
class SampleResult:
    """Draws of a program given an experiment's data, with the analytic posterior beside them.

    Attributes
    ----------
    experiment : Experiment
    inference : Inference
        The linear model with every systematic in N, and its posterior.
    tree : xarray.DataTree
        The draws, as ArviZ has them.
    seconds : dict
        By stage.
    gradients_per_second : float or None
        Of all chains together while drawing; None if too little was drawn in this session to tell.
    """

    experiment: Experiment
    inference: Inference
    tree: xr.DataTree
    seconds: dict[str, float]
    gradients_per_second: float | None

    @property
    def skies(self) -> np.ndarray:
        """Draws of the sky, (chains, draws, modes), in K."""
        return self.tree["posterior"][SKY].values

    def quantities(self) -> dict[str, np.ndarray]:
        """Draws (chains, draws) of the other sites, landmarks, powers and lowest modes."""
        lmax = self.experiment.scenario.lmax
        others = {
            name: values.values
            for name, values in self.tree["posterior"].data_vars.items()
            if name != SKY and values.ndim == 2
        }
        ells = sorted({min(ell, lmax) for ell in (0, 1, 2, 5, 10, 20, 30, 40)})
        modes = [(ell, m) for ell in range(min(lmax, 2) + 1) for m in range(-ell, ell + 1)]
        return others | sky_quantities(self.skies, pixels=LANDMARKS, ells=ells, modes=modes)

    @cached_property
    def _summary(self) -> pd.DataFrame:
        return summary(self.quantities())

    def summary_table(self) -> pd.DataFrame:
        """ArviZ's summary of :meth:`quantities`."""
        return self._summary

    @cached_property
    def maps(self) -> dict[str, np.ndarray]:
        """Mean, standard deviation and the ends of the 90 % interval of every pixel, in K."""
        nside = self.experiment.scenario.map_nside
        lower, upper = pixel_interval_of_draws(self.skies, nside, INTERVAL)
        return {
            "mean": pixel_mean_of_draws(self.skies, nside),
            "std": pixel_std_of_draws(self.skies, nside),
            "lower": lower,
            "upper": upper,
        }

    def headline(self) -> str:
        """The few figures that matter, in one line."""
        table, figures = self.summary_table(), self.figures()
        parts = [
            f"{figures['chains']} x {figures['draws']} draws of {figures['program']}",
            f"R-hat at most {table['r_hat'].max():.4f}",
            f"bulk ESS at least {table['ess_bulk'].min():.0f}",
            f"{figures['divergences']} divergences",
        ]
        if self.gradients_per_second is not None:
            parts.append(f"{self.gradients_per_second:.0f} gradients/s")
        return ", ".join(parts)

    def lines(self) -> list[str]:
        """What a terminal shows."""
        table = self.summary_table().rename_axis("quantity").reset_index()
        reasons = warnings_of({name: table[name].to_numpy() for name in table}, self.figures())
        return [self.headline(), *reasons, *self.experiment.doubts]

    def figures(self) -> dict[str, object]:
        """What sampling.json tells: sizes, speeds, times, memory, versions."""
        stats = self.tree["sample_stats"]
        chains, draws = self.skies.shape[:2]
        return {
            "program": self.tree.attrs["program"],
            "chains": chains,
            "draws": draws,
            "divergences": int(stats["diverging"].sum()),
            "mean_acceptance": float(stats["acceptance_rate"].mean()),
            "doubts": list(self.experiment.doubts),
            "step_size": [float(x) for x in stats["step_size"].values[:, -1]],
            "mean_steps": float(stats["n_steps"].mean()),
            "gradients_per_second": self.gradients_per_second,
            "seconds": {name: round(s, 3) for name, s in self.seconds.items()},
            "peak_memory_gb": round(peak_memory_gb(), 3),
            "versions": versions(),
        }


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
