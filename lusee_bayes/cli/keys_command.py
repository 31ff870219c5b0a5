"""lusee-bayes keys: the keys of a scenario."""

from __future__ import annotations

from typing import Annotated

from cyclopts import Parameter
from rich.console import Console

from lusee_bayes.cli.options import say


def keys_command(
    key: str = "", *, markdown: Annotated[bool, Parameter(negative="")] = False
) -> None:
    """List the keys of a scenario: meaning, unit, choices, default.

    Parameters
    ----------
    key
        A key, or a section (noise, noise.gain, ...): list only what is in it.
    markdown
        Write a table of Markdown.
    """
    from lusee_bayes.experiment.keys import keys_as_markdown, scenario_keys

    console, keys = Console(soft_wrap=True), scenario_keys(key)
    if markdown:
        say(console, keys_as_markdown(keys).rstrip())
        return
    for found in keys:
        model = f"  (model {found.kind})" if found.kind else ""
        unit = f" [{found.unit}]" if found.unit else ""
        say(console, f"{found.path} = {found.default}{model}")
        say(console, f"    {found.meaning}")
        say(console, f"    {found.choices}{unit}")
