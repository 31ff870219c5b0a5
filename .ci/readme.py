"""Run the Python blocks of a Markdown file, in order, in one namespace."""

import re
import sys
from pathlib import Path

text = Path(sys.argv[1]).read_text()
namespace: dict[str, object] = {}
blocks = re.findall(r"^```python\n(.*?)^```", text, flags=re.DOTALL | re.MULTILINE)
if not blocks:
    sys.exit(f"{sys.argv[1]} has no Python block to run")
for number, block in enumerate(blocks, 1):
    exec(compile(block, f"{sys.argv[1]} block {number}", "exec"), namespace)
print(f"{sys.argv[1]}: {len(blocks)} Python block(s) run")
