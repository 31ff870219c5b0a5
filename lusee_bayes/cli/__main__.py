"""``python -m lusee_bayes.cli``: the command line."""

import sys

from lusee_bayes.cli.main import main

sys.exit(main())
