#!/usr/bin/env bash
# Makes an environment of its own for the programs that `sms bench stereo` compares itself with: they are no
# part of this project, and no dependency. Then: SMS_TEST_PEERS=FOLDER sms bench stereo
#
#   bash ops/peers.sh [FOLDER]     the cache of the user when no folder is given
set -euo pipefail

folder="${1:-${XDG_CACHE_HOME:-$HOME/.cache}/sms-jobs/peers}"
python="${PYTHON:-python3}"
"$python" -m venv "$folder"
"$folder/bin/pip" install --quiet --disable-pip-version-check \
    "pyvale==2026.10.2" "riley-raster==2026.10.1" "al-dic-3d==1.1.0" "al-dic==0.7.2"
echo "$folder"
