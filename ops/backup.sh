#!/usr/bin/env bash
# Backs up the catalogue and the archive of a home, while its service runs.
#
#   bash ops/backup.sh HOME DEST
#
# Two steps, in this order, make the two fit each other:
#   1. a snapshot of the catalogue, as it stands at one moment: DEST/snapshots/<time>.sqlite, whatever the database
#   2. the files that this snapshot knows: DEST/archive. They were sealed before the catalogue knew them and never
#      change, so copying may take as long as it likes, and what an earlier backup has copied is not copied again.
# The other way round, the catalogue would know files that had been sealed after the archive was copied.
#
# The snapshot gets its name last: one that has its name is whole. DEST must lie on another disk to be of use.
# Exit codes: those of sms; 6 when files of the archive are missing. ops/restore.sh is the way back.
set -euo pipefail

if [ $# != 2 ]; then
    echo "usage: bash ops/backup.sh HOME DEST" >&2
    exit 2
fi
SMS="${SMS:-$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)/.venv/bin/sms}"
if [ ! -x "$SMS" ]; then
    SMS="$(command -v sms)" || { echo "error: there is no sms on the path: set SMS to it" >&2; exit 2; }
fi

exec "$SMS" db backup "$2" --home "$1"
