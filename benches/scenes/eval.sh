#!/bin/bash
# eval.sh SET OUTPUT.mp4 MASK.mkv [options of evaluate.py]
here="$(dirname "$(readlink -f "$0")")"
. "$here/env.sh"
exec nice -n 5 "$here/v/bin/python" "$here/evaluate.py" "$@"
