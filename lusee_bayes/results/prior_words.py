"""Where a map's prior comes from, in words and numbers."""

from __future__ import annotations

from lusee_bayes.experiment.experiment import Experiment
from lusee_bayes.experiment.scenario import Scenario


def prior_sentence(experiment: Experiment) -> str:
    """The prior's model, where its C_ell comes from and, if it was learned, its parameters.

    Parameters
    ----------
    experiment : Experiment
    """
    section, learned = experiment.scenario.prior, experiment.learned
    rows = [] if learned is None else learned.as_rows()
    found = ", ".join(f"{r['name']} {r['value']:.2f} +- {r['std']:.2f}" for r in rows)
    return f"Prior {section.model}, C_ell {section.origin}{': ' if found else ''}{found}."


def prior_summary(experiment: Experiment) -> dict[str, object]:
    """What summary.json says of the prior.

    Parameters
    ----------
    experiment : Experiment
    """
    learned = experiment.learned
    return {
        "prior": prior_sentence(experiment),
        "prior_parameters": [] if learned is None else learned.as_rows(),
        # the parameters integrated out, too
        "log_evidence_learned": None if learned is None else learned.log_evidence,
    }


def joint_prior_sentence(scenario: Scenario) -> str:
    """Which prior the skies of a joint posterior have.

    Parameters
    ----------
    scenario : Scenario
        Of joint channels.
    """
    section, kept = scenario.spectral, f"prior.model={scenario.prior.model} is not used"
    if section.model == "positive":
        return (
            f"Prior spectral.model=positive: the embedded template times the exponential of "
            f"{', '.join(section.fields)}, their C_ell learned from these data; {kept}."
        )
    return f"Prior spectral.model={section.model}, C_ell of the scenario's own skies; {kept}."
