"""``python -m lusee_bayes.cli``: the command line."""

from lusee_bayes.cli.main import program

program()
