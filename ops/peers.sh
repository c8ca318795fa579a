#!/usr/bin/env bash
# Makes an environment of its own for the programs that `sms bench peers` and `sms bench stereo` compare
# themselves with, and those that render for `sms bench witness`: they are no part of this project, and no
# dependency. NumPy, SciPy, Numba and OpenCV have the versions that ours are tested with, so that nobody is faster
# by those. Mitsuba compiles with LLVM's library, which the system has to have (Debian: apt-get install libllvm15).
#
#   bash ops/peers.sh [FOLDER]     the cache of the user when no folder is given
#   SMS_TEST_PEERS=FOLDER sms bench peers stereo witness
set -euo pipefail

folder="${1:-${XDG_CACHE_HOME:-$HOME/.cache}/sms-jobs/peers}"
python="${PYTHON:-python3}"
alike="$(mktemp)"
trap 'rm -f "$alike"' EXIT
grep -oE '^(numpy|scipy|numba|opencv-python-headless)==[^\\]*' "$(dirname "$0")/../requirements.lock" > "$alike"

"$python" -m venv "$folder"
"$folder/bin/pip" install --quiet --disable-pip-version-check --constraint "$alike" \
    "fringes==2.1.0" "pyvale==2026.10.2" "riley-raster==2026.10.1" "mitsuba==3.9.1" \
    "al-dic-3d==1.1.0" "al-dic==0.7.2"
echo "$folder"
