#!/usr/bin/env bash
# Sets everything up and passes the tests, against private PostgreSQL and Redis servers and a headless Chromium.
#
#   bash ops/test.sh                      every check: formatting, lint, types, layers, then every test
#   bash ops/test.sh tests/unit -k strain only pytest, with these arguments (servers are there all the same)
#
# With CI=true a missing server fails the tests that need it instead of skipping them.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
. ops/setup.sh
. ops/servers.sh

failed="" auditing=""

# Runs a check and goes on after a failure, so that one run tells everything that is wrong.
step() {
    local name="$1" started=$SECONDS status=0
    shift
    say "== $name"
    "$@" || status=$?
    if [ $status = 0 ]; then
        say "== $name: passed, $((SECONDS - started)) s"
    else
        say "== $name: failed with exit code $status, $((SECONDS - started)) s"
        failed="$failed, $name"
    fi
}

# Compiles the kernels of some groups of benchmarks, which are all that take long to compile.
compile_kernels() {
    .venv/bin/python -c 'import sys; from sms_jobs.bench.groups import group_named as g; [g(n).warm_up() for n in sys.argv[1:]]' "$@"
}

# A bare Debian has a Python that cannot make virtual environments.
if python="$(find_python)" && ! "$python" -c 'import venv, ensurepip' 2>/dev/null; then
    provide "the venv module of $python" python3-venv
fi

trap stop_servers EXIT
trap 'exit 130' INT
trap 'exit 143' TERM HUP

(provide_servers && provide_peers && provide_browser) & # while Python's packages are installed and the checks run
installing=$!
set_up requirements-test.lock
if [ $# = 0 ]; then
    # Asks a server and so waits most of its time: while all the rest runs.
    .venv/bin/python ops/audit.py requirements-test.lock & auditing=$!
    # While the checks run; left to the tests, several would compile the same at once. Ranging is half of it.
    compile_kernels fdr & ranging=$!
    compile_kernels phase dic displacement strain calibration & others=$!
    # Each process of pytest collects all tests, at the same time: what is compiled for that, is compiled once.
    .venv/bin/python -m pytest --collect-only -qq >/dev/null 2>&1 & collecting=$!
    step "ruff check" .venv/bin/ruff check .
    step "ruff format" .venv/bin/ruff format --check .
    step "mypy" .venv/bin/mypy
    step "layers" .venv/bin/lint-imports
fi
wait $installing || die "what the tests need was not installed: see above"
do_without_browser
start_servers
say "== servers: $SMS_TEST_POSTGRESQL_URL and $SMS_TEST_REDIS_URL"
export CI="${CI:-true}"
# As in a worker's processes: libraries that spread small matrices over every core spend more on waiting for each
# other than on what they compute, since other tests run on the same cores.
export OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 MKL_NUM_THREADS=1 OPENCV_FOR_THREADS_NUM=1
if [ $# = 0 ]; then
    step "kernels" wait $ranging $others
    wait $collecting || true # what is wrong is told by the tests
    # Two processes more than cores, since tests of the service wait a good part of their time. A file's tests stay
    # in one, since they share what is costly to make. In the order of the folders, so that those of the whole
    # service, which take longest, are not left for the end.
    set -- -n "$(($(getconf _NPROCESSORS_ONLN) + 2))" --dist loadfile --no-loadscope-reorder --durations=25
    # A test that waits for ever is named after half an hour, with what it waits for, and ends the run: a new process
    # would wait as long again. The slowest takes 4 to 8 min.
    set -- "$@" -o faulthandler_timeout=1800 -o faulthandler_exit_on_timeout=true --max-worker-restart=0
    # What other packages bring for tests of their own is not loaded by each process: it takes two seconds.
    for plugin in anyio platformdirs schemathesis zarr; do
        set -- "$@" -p "no:$plugin"
    done
fi
step "pytest" .venv/bin/python -m pytest "$@"
case "$failed" in *pytest*) keep_folders ;; esac
if [ -n "$auditing" ]; then
    step "audit of dependencies" wait "$auditing"
fi
if [ -n "$failed" ]; then
    die "these checks failed: ${failed#, } (after $SECONDS s)"
fi
say "== all passed in $SECONDS s"
