#!/usr/bin/env bash
# The parts that differ between ArviZ 0.8 (Python 3.11) and 1.x (3.12 and newer), on another
# interpreter, if this machine has one.
set -euo pipefail
cd "$(dirname "$0")/.."
here=$(.venv/bin/python -c 'import sys; print("%d.%d" % sys.version_info[:2])')
for version in 3.13 3.12 3.11; do
  [ "$version" = "$here" ] && continue
  for python in "python$version" "$HOME"/.pyenv/versions/"$version".*/bin/python; do
    "$python" -c 'import venv' >/dev/null 2>&1 || continue
    folder=.venv-$version
    [ -x "$folder/bin/python" ] || "$python" -m venv "$folder"
    "$folder/bin/python" -m pip install --quiet --editable '.[dev]'
    exec "$folder/bin/python" -m pytest -n 2 --dist loadfile tests/sampling/test_sites.py \
      tests/sampling/test_programs.py tests/sampling/test_datatree.py \
      tests/sampling/test_uncertainty.py tests/sampling/test_validation.py \
      tests/runs/test_sample_run.py
  done
done
echo "no other Python here: ArviZ was checked with Python $here only"
