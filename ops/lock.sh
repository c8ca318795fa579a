#!/usr/bin/env bash
# Resolves pyproject.toml anew and writes requirements.lock and requirements-test.lock: exact versions with
# hashes, for every platform, free of the address of any index. Run it after a change of dependencies.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

tools="$(mktemp -d "${TMPDIR:-/tmp}/sms-lock.XXXXXX")"
trap 'rm -rf "$tools"' EXIT
python3 -m venv "$tools/venv"
"$tools/venv/bin/python" -m pip install --quiet --disable-pip-version-check uv

resolve() {
    "$tools/venv/bin/uv" pip compile --quiet --upgrade --universal --python-version 3.11 --generate-hashes \
        --no-header --no-annotate --no-emit-index-url --no-emit-find-links pyproject.toml "$@"
}

# A grown installation and a rig with a projector are set up by the same commands as any other.
resolve --extra build --extra postgresql --extra projector --output-file requirements.lock
# The constraint keeps the two files on the same versions, so that tests run what users run.
resolve --extra build --extra postgresql --extra projector --extra test --constraint requirements.lock --output-file requirements-test.lock
