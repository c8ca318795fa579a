#!/usr/bin/env bash
# Backs up the catalogue, the archive, the rigs and the unarchived frames of a home, while its service runs.
#
#   bash ops/backup.sh HOME DEST
#
# Three steps, in this order, make the parts fit each other:
#   1. the files of rigs, and frames that are not archived yet: DEST/hosts/<host>
#   2. a snapshot of the catalogue, as it stands at one moment: DEST/snapshots/<time>.sqlite, whatever the database
#   3. the files that this snapshot knows: DEST/archive. They were sealed before the catalogue knew them and never
#      change, so copying may take as long as it likes, and what an earlier backup has copied is not copied again.
# The other way round, the catalogue would know files that had been sealed after the archive was copied.
#
# The snapshot gets its name last: one that has its name is whole. DEST must lie on another disk to be of use.
# Copies are verified, and a thirtieth of the earlier ones is read again each time.
# Exit codes: those of sms; 6 when files are missing or damaged, which are named. ops/restore.sh is the way back.
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
