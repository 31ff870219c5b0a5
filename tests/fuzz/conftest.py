"""Inputs that nobody has thought of: a few in each run, many in the long one."""

from hypothesis import HealthCheck, Phase, settings

settings.register_profile(
    "here",
    database=None,
    deadline=None,
    derandomize=True,
    # an example of two changes needs no smaller one, and finding it takes minutes
    phases=[Phase.explicit, Phase.generate],
    suppress_health_check=list(HealthCheck),
)
settings.load_profile("here")
