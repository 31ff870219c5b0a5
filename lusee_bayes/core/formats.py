"""Names of the package's own file formats: every file says which one it is, in ``format``."""

VISIBILITIES = "lusee_bayes visibilities 1"
POSTERIOR = "lusee_bayes posterior 1"
POSTERIOR_CUBE = "lusee_bayes posterior cube 1"
COMPACT_POSTERIOR = "lusee_bayes compact posterior 1"
SAMPLES = "lusee_bayes samples 1"
DIAGNOSTICS = "lusee_bayes diagnostics 1"
PAPER_CASE = "lusee_bayes paper case 1"
