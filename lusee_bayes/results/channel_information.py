"""What the data of a channel say, in a file: for the channels of a joint posterior."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass

import numpy as np
import xarray as xr
from jaxtyping import Float

from lusee_bayes.experiment.experiment import Experiment
from lusee_bayes.experiment.rounds import Inference
from lusee_bayes.linear.fit import ChiSquare
from lusee_bayes.linear.information import Information
from lusee_bayes.linear.split import Split
from lusee_bayes.results.observed import Observed
from lusee_bayes.results.unknowns import Unknowns

# numbers that a file keeps as attributes
OF_INFORMATION = ("misfit", "log_det", "n_data")
OF_CHANNEL = ("frequency_mhz", "n_missing", "rounds")


@dataclass(frozen=True)
class ChannelInformation:
    """What a channel's data say, with what it takes to make a posterior of it and to judge it.

    Attributes
    ----------
    information : Information
    observed : Observed
    sky : (modes,) array
        The scenario's model sky, in K.
    """

    information: Information
    observed: Observed
    sky: Float[np.ndarray, " modes"]

    @classmethod
    def of(
        cls, experiment: Experiment, information: Information, inference: Inference
    ) -> ChannelInformation:
        """Of an experiment and what was inferred from its data."""
        sky, posterior = np.asarray(experiment.setup.sky.modes), inference.posterior
        chi2 = float(information.chi2(posterior.mean) + posterior.prior_chi2())
        split = Split.of(posterior, chi2, inference.model.n_data)
        unknowns = Unknowns.of(experiment, inference, information.reference)
        observed = Observed.of(experiment, inference, split.instrument, unknowns)
        return cls(information, observed, sky)

    def to_dataset(self) -> xr.Dataset:
        """All of it, for :meth:`from_dataset`."""
        information, observed = self.information, self.observed
        variables = {
            "matrix": (("mode", "mode_2"), np.asarray(information.matrix)),
            "vector": ("mode", np.asarray(information.vector)),
            "reference": ("mode", np.asarray(information.reference)),
            "sky": ("mode", self.sky),
            "prior_std": ("mode", observed.prior_std),
            "highest_altitude": ("pixel", observed.highest_altitude),
        }
        if observed.truth is not None:
            variables["truth"] = ("mode", observed.truth)
        numbers = {name: float(getattr(information, name)) for name in OF_INFORMATION}
        numbers |= {name: getattr(observed, name) for name in OF_CHANNEL}
        numbers |= asdict(observed.instrument)
        found = xr.Dataset(variables, attrs={**numbers, "doubts": json.dumps(observed.doubts)})
        if observed.unknowns is None:
            return found
        own = observed.unknowns.to_dataset()
        return found.merge(own).assign_attrs(own.attrs)

    @classmethod
    def from_dataset(cls, dataset: xr.Dataset) -> ChannelInformation:
        """The inverse of :meth:`to_dataset`."""
        arrays = {str(name): np.asarray(values) for name, values in dataset.data_vars.items()}
        information = Information(
            *(arrays[name] for name in ("matrix", "vector", "reference")),
            *(np.asarray(float(dataset.attrs[name])) for name in OF_INFORMATION),
        )
        observed = Observed(
            float(dataset.attrs["frequency_mhz"]),
            arrays["prior_std"],
            arrays.get("truth"),
            arrays["highest_altitude"],
            int(dataset.attrs["n_missing"]),
            int(dataset.attrs["rounds"]),
            ChiSquare(float(dataset.attrs["chi2"]), float(dataset.attrs["degrees"])),
            tuple(json.loads(dataset.attrs["doubts"])),
            Unknowns.from_dataset(dataset, arrays["reference"]),
        )
        return cls(information, observed, arrays["sky"])
