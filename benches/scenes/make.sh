#!/bin/bash
# make.sh SET...  (rigid joints breathing rolling): renders the set beside this script and caches its baselines.
set -euo pipefail
cd "$(dirname "$0")"
if [ ! -x v/bin/python ]; then
    # needs python3-venv, ffmpeg and LLVM >= 15 (Debian: apt-get install libllvm19)
    python3 -m venv v
    v/bin/pip install mitsuba==3.9.1 drjit==1.5.0 numpy opencv-python-headless scipy
fi
. ./env.sh
for name in "$@"; do
    rm -rf "${name:?}"
    nice -n 10 v/bin/python make.py "$name" 2>&1 | tee "$name.log"
    nice -n 10 v/bin/python evaluate.py "$name"
done
