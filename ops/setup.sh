# shellcheck shell=bash
# Sourced by demo.sh and test.sh: makes the virtual environment .venv of this checkout from a lock.
# Plain bash 3.2, so that it runs on macOS. Needs no root.
#
#   set_up requirements.lock         what the program needs
#   set_up requirements-test.lock    the same versions, and what its tests need

# Packages are compiled by whoever imports them first, and the program itself in every process otherwise.
unset PYTHONDONTWRITEBYTECODE

say() { printf '%s\n' "$*" >&2; }

die() {
    say "error: $*"
    exit 1
}

# Prints the name of the first Python on the path that is new enough.
find_python() {
    local candidate
    for candidate in "${PYTHON:-python3}" python3.13 python3.12 python3.11; do
        if "$candidate" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then
            command -v "$candidate"
            return
        fi
    done
    return 1
}

# Prints what the environment is made from: it is current while this stays the same.
fingerprint() {
    "$1" - "$2" <<'PYTHON'
import hashlib, pathlib, sys
digest = hashlib.sha256(f"{sys.version} {pathlib.Path.cwd()}".encode())
for name in (sys.argv[1], "pyproject.toml"):
    digest.update(pathlib.Path(name).read_bytes())
print(digest.hexdigest())
PYTHON
}

set_up() {
    local lock="$1" python wanted started=$SECONDS
    python="$(find_python)" ||
        die "sms_jobs needs Python 3.11 or newer, but $("${PYTHON:-python3}" --version 2>/dev/null || echo "no ${PYTHON:-python3}") was found: install one, or set PYTHON to its path"

    wanted="$(fingerprint "$python" "$lock")"
    if [ -x .venv/bin/sms ] && [ "$(cat ".venv/$lock.stamp" 2>/dev/null)" = "$wanted" ]; then
        return
    fi
    "$python" -c 'import venv, ensurepip' 2>/dev/null ||
        die "$python cannot make virtual environments: install its venv module (Debian and Ubuntu: apt-get install python3-venv) and run this again"

    say "setting up .venv from $lock (about a minute, once)"
    rm -f .venv/*.stamp
    if [ "$(.venv/bin/python -c 'import sys; print(sys.version)' 2>/dev/null)" != "$("$python" -c 'import sys; print(sys.version)')" ]; then
        "$python" -m venv --clear .venv >&2
    fi
    local pip=".venv/bin/python -m pip --disable-pip-version-check --quiet"
    # The lock has all that is needed: pip need not look. Python compiles what it imports; compiling all that is
    # installed takes as long as installing it.
    $pip install --no-compile --no-deps --requirement "$lock" >&2 || die "the packages of $lock could not be installed: see pip's message above, mend it and run this again"
    # The build backend comes from the lock too.
    $pip install --no-deps --no-build-isolation --editable . >&2 || die "sms_jobs itself could not be installed: see pip's message above"
    fingerprint "$python" "$lock" >".venv/$lock.stamp"
    if [ "$lock" = requirements-test.lock ]; then
        fingerprint "$python" requirements.lock >.venv/requirements.lock.stamp
    fi
    say "setting up took $((SECONDS - started)) s"
}
