"""Run the Python blocks of a Markdown file, in order, in one namespace.

They run in a folder of their own, in which `lusee-bayes map --draws 100` has been run.
"""

import os
import re
import sys
import tempfile
from pathlib import Path

from lusee_bayes.cli.main import main

text = Path(sys.argv[1]).read_text()
namespace: dict[str, object] = {}
blocks = re.findall(r"^```python\n(.*?)^```", text, flags=re.DOTALL | re.MULTILINE)
if not blocks:
    sys.exit(f"{sys.argv[1]} has no Python block to run")
with tempfile.TemporaryDirectory() as folder:
    os.chdir(folder)
    main(["map", "--draws", "100", "--quiet"])
    for number, block in enumerate(blocks, 1):
        exec(compile(block, f"{sys.argv[1]} block {number}", "exec"), namespace)
    os.chdir("/")
print(f"{sys.argv[1]}: {len(blocks)} Python block(s) run")
