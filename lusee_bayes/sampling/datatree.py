"""Draws as an ArviZ DataTree, with every group of a sampled model, in netCDF."""

from pathlib import Path
from typing import Any

import arviz_base
import jax
import numpy as np
import xarray as xr
from numpyro.infer import Predictive

from lusee_bayes.core import formats, harmonics
from lusee_bayes.core.layouts import Attribute, Layout, Variable
from lusee_bayes.core.reading import reading
from lusee_bayes.instrument.visibilities import Visibilities
from lusee_bayes.linear.linear_gaussian import LinearGaussian
from lusee_bayes.linear.posterior import Posterior
from lusee_bayes.sampling import hmc, programs
from lusee_bayes.systematics.systematic import SKY

# required contents of a file of samples
STATISTIC = ("chain", "draw")
ARRAYS = {
    "sample_stats.diverging": Variable(STATISTIC, "boolean"),
    "sample_stats.n_steps": Variable(STATISTIC, low=0.0),
    "sample_stats.acceptance_rate": Variable(STATISTIC),
    "sample_stats.energy": Variable(STATISTIC, missing=True),
    "posterior.sky": Variable(("chain", "draw", "mode"), optional=True),
    "observed_data.data": Variable(("datum",)),
}
WORDS = {
    "program": Attribute("text"),
    "frequency_mhz": Attribute(low=0.0, optional=True),
    "identity": Attribute("text", optional=True),
}
GROUPS = Layout("samples of lusee-bayes sample", ARRAYS, WORDS)


def to_datatree(
    chains: hmc.Chains,
    program: programs.Program,
    model: LinearGaussian,
    posterior: Posterior,
    data: Visibilities,
    *,
    seed: int = 0,
    n_predictive: int = 100,
    arguments: dict[str, Any] | None = None,
    truth: dict[str, float | np.ndarray] | None = None,
    attributes: dict[str, object] | None = None,
) -> xr.DataTree:
    """Collect draws and everything that belongs to them.

    The groups are posterior, sample_stats, prior, prior and posterior predictive, data and
    constants. Skies are on dims (chain, draw, mode) with coords ell and m, in K; data on (datum)
    with coords product and time. If the program integrates the sky out, missing skies are drawn.

    Parameters
    ----------
    chains : Chains
        Draws of the program's sites.
    program : Program
        The program.
    model : LinearGaussian
        The model with all systematics in N.
    posterior : Posterior
        Its analytic posterior, stored among the constants.
    data : Visibilities
        The data.
    seed : int
        Seed of the predictive draws.
    n_predictive : int
        Number of draws from the prior and in each predictive group.
    arguments : dict, optional
        The program's arguments without the data, if they differ from those of ``model``.
    truth : dict, optional
        True values of sites, stored among the constants as true_NAME.
    attributes : dict, optional
        Further attributes of the tree.
    """
    arguments = program.arguments(model) if arguments is None else arguments
    keys = jax.random.split(jax.random.fold_in(jax.random.key(seed), 1), 3)
    sites = dict(chains.sites)
    n_chains, n_draws = next(iter(sites.values())).shape[:2]
    step = max(1, n_chains * n_draws // n_predictive)
    thinned = {name: values[:, ::step] for name, values in sites.items()}
    with programs.numpyro_promotion():
        prior = Predictive(program.model, num_samples=n_predictive)(keys[1], **arguments)
        if programs.is_collapsed(program, arguments, data.data):
            given = (program, arguments, data.data)
            if SKY not in sites:
                sites[SKY] = programs.collapsed_draws(*given, sites, keys[0])
            replicated = programs.collapsed_draws(*given, thinned, keys[2], sites[SKY][:, ::step])
        else:
            again = Predictive(program.model, thinned, batch_ndims=2, return_sites=[programs.DATA])
            replicated = again(keys[2], **arguments)[programs.DATA]
    constants = {
        "prior_std": np.sqrt(model.prior.variance()),
        "analytic_mean": posterior.mean,
        "analytic_std": posterior.std(),
    }
    if data.truth is not None:
        constants["truth"] = data.truth
    dims = {programs.DATA: ["datum"], **{name: ["mode"] for name in (SKY, *constants)}}
    if sites.get("gains", np.empty(0)).ndim == 4:
        dims["gains"] = ["antenna", "sample"]
    constants |= {f"true_{name}": value for name, value in (truth or {}).items() if name in sites}
    groups = {
        "posterior": sites,
        "sample_stats": chains.statistics,
        "prior": {name: values[None] for name, values in prior.items() if name in sites},
        "prior_predictive": {programs.DATA: prior[programs.DATA][None]},
        "posterior_predictive": {programs.DATA: replicated},
        "observed_data": {programs.DATA: data.data},
        "constant_data": constants,
    }
    said = formats.header(formats.SAMPLES) | {"program": program.name, **(attributes or {})}
    # more chains than draws is unusual, not wrong
    options = {"dims": dims, "check_conventions": False, "attrs": {"/": said}}
    tree = arviz_base.from_dict(jax.tree.map(np.asarray, groups), **options)
    for statistic in tree["sample_stats"].data_vars.values():
        statistic.attrs["units"] = "1"
    predicted = tree["posterior_predictive"]
    predicted.dataset = predicted.dataset.assign_coords(draw=np.arange(n_draws)[::step])
    return _with_coordinates(tree, model, data)


def _with_coordinates(tree: xr.DataTree, model: LinearGaussian, data: Visibilities) -> xr.DataTree:
    """Add ell and m of every mode, product and time of every sample, and units."""
    ell, m = harmonics.mode_numbers(harmonics.lmax_of(model.prior.size))
    coordinates = {
        "ell": ("mode", ell),
        "m": ("mode", m),
        "product": ("datum", np.asarray(data.labels)[data.layout.product]),
        "time": ("datum", np.asarray(data.observation.times.isot)[data.layout.time]),
    }

    def labelled(dataset: xr.Dataset) -> xr.Dataset:
        chosen = {name: given for name, given in coordinates.items() if given[0] in dataset.dims}
        dataset = dataset.assign_coords(chosen)
        for values in dataset.data_vars.values():
            if {"mode", "datum"} & set(values.dims):
                values.attrs["units"] = "K"
        return dataset

    return tree.map_over_datasets(labelled)


def read_datatree(path: str | Path) -> xr.DataTree:
    """Read a file of samples that ``lusee-bayes sample`` has written.

    Raises
    ------
    InputError
        For any other file.
    """
    formats.read_netcdf(path, formats.SAMPLES, Layout(GROUPS.what))
    with reading(path, GROUPS.what) as file:
        tree = xr.load_datatree(file, engine="h5netcdf")
    arrays = {f"{g}.{name}": tree[g][name] for g in tree.children for name in tree[g]}
    GROUPS.checked(path, arrays, tree.attrs)
    return tree
