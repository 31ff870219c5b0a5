"""Tables of parameters, each in a file beside its tests."""

from pathlib import Path

from lusee_bayes.core.reading import read_yaml


def tables(test: str) -> dict:
    """The tables in the YAML file that has the name of a test's file."""
    return read_yaml(Path(test).with_suffix(".yaml"), "tables of parameters")
