#!/usr/bin/env bash
# Sets everything up in .venv (no root, no server) and runs a whole simulated campaign through a real worker.
# Arguments go to `sms demo`: bash ops/demo.sh --json. Results lie in .demo, or in $SMS_DEMO_DIR, or where
# a given --out says.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
. ops/setup.sh

set_up requirements.lock
exec .venv/bin/sms demo --out "${SMS_DEMO_DIR:-.demo}" "$@"
