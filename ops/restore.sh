#!/usr/bin/env bash
# Makes a home of a backup, and reads every file of it to see that it is what was sealed.
#
#   bash ops/restore.sh BACKUP HOME              the newest snapshot
#   bash ops/restore.sh BACKUP HOME 20260301     the last of those whose name begins like this
#
# HOME must be empty or not be there. It becomes a home without servers; the ones that the environment names are not
# touched. What to do then is said at the end. Exit code 6: files are missing or damaged, and listed.
set -euo pipefail

if [ $# -lt 2 ] || [ $# -gt 3 ]; then
    echo "usage: bash ops/restore.sh BACKUP HOME [SNAPSHOT]" >&2
    exit 2
fi
SMS="${SMS:-$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)/.venv/bin/sms}"
if [ ! -x "$SMS" ]; then
    SMS="$(command -v sms)" || { echo "error: there is no sms on the path: set SMS to it" >&2; exit 2; }
fi
unset SMS_DATABASE_URL SMS_BROKER_URL SMS_ARCHIVE

status=0
"$SMS" db restore "$1" "$2" --snapshot "${3:-}" || status=$?
if [ $status != 0 ] && [ $status != 6 ]; then exit $status; fi
"$SMS" archive verify --home "$2" || status=$?
if [ $status = 0 ]; then
    echo "restored and verified. Next: 'sms up --home $2', which also recovers the jobs that were running;" >&2
    echo "or first 'sms db copy URL --home $2', to go on with PostgreSQL" >&2
fi
exit $status
