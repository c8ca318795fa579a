# shellcheck shell=bash
# Sourced by test.sh: private PostgreSQL and Redis servers for the tests, in a temporary folder, in memory where that
# has room.
# They listen on the loopback interface alone and never touch servers that run already.
#
#   start_servers    exports SMS_TEST_POSTGRESQL_URL and SMS_TEST_REDIS_URL, and TMPDIR, a folder beside theirs
#   stop_servers     ends what start_servers started and removes the folder
#   keep_folders     moves what failed tests have left in TMPDIR to the disk
#   provide_servers  installs PostgreSQL and Redis
#   provide_peers    installs what projectors and cameras are tried against
#   provide_browser  installs a Chromium for the tests of reports
#   do_without_browser  leaves these tests out where there is none and nobody insists
#
# A URL that is set beforehand is used as it is, and no server is started for it.

SERVERS=""         # the temporary folder
ROOM_KB=8000000    # a run writes 3 GB at most, and its processes need as much
POSTGRESQL_BIN=""  # the folder of initdb and pg_ctl
REDIS_PID=""
AS_POSTGRES=""     # a prefix that leaves root: PostgreSQL refuses to run as root
LISTS_ARE_NEW=""   # set when apt-get has been told of the newest packages

as_root() {
    if [ "$(id -u)" = 0 ]; then "$@"; else sudo "$@"; fi
}

# Installs Debian packages, without starting their system services.
apt_install() {
    local policy=/usr/sbin/policy-rc.d made="" status=0
    if [ ! -e "$policy" ]; then
        made=yes
        printf '#!/bin/sh\nexit 101\n' | as_root tee "$policy" >/dev/null
        as_root chmod 755 "$policy"
    fi
    { { [ -n "$LISTS_ARE_NEW" ] || as_root env DEBIAN_FRONTEND=noninteractive apt-get update -qq; } &&
        as_root env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "$@"; } >&2 || status=1
    LISTS_ARE_NEW=yes
    if [ -n "$made" ]; then as_root rm -f "$policy"; fi
    return $status
}

# Tries to install Debian packages where that is possible; says what to do where it is not.
provide() {
    local what="$1"
    shift
    if command -v apt-get >/dev/null && { [ "$(id -u)" = 0 ] || command -v sudo >/dev/null; }; then
        say "installing $* with apt-get, because the tests need $what"
        apt_install "$@" || die "apt-get could not install $*: install $what and run this again"
    elif command -v brew >/dev/null; then
        die "the tests need $what: brew install postgresql redis, and run this again"
    else
        die "the tests need $what, which is not installed: install it and run this again"
    fi
}

provide_servers() {
    if [ -z "${SMS_TEST_POSTGRESQL_URL:-}" ] && ! find_postgresql; then provide "a PostgreSQL server" postgresql; fi
    if [ -z "${SMS_TEST_REDIS_URL:-}" ] && ! command -v redis-server >/dev/null; then provide "a Redis server" redis-server; fi
}

# Installs an X server in memory, the library of GigE cameras, which brings a simulated one, and what makes network
# namespaces, which stand for several computers. They exist for Linux; elsewhere the tests that need them are skipped. What is missing fails its own tests and no others.
provide_peers() {
    local packages=""
    if [ "$(uname)" != Linux ]; then return; fi
    if ! command -v Xvfb >/dev/null; then packages="xvfb"; fi
    if ! { ldconfig -p || /sbin/ldconfig -p; } 2>/dev/null | grep -q 'libaravis-0\.8\.so\.0'; then
        packages="$packages aravis-tools-cli"
    fi
    if ! command -v ip >/dev/null; then packages="$packages iproute2"; fi
    # shellcheck disable=SC2086  # a list of words
    if [ -n "$packages" ]; then (provide "a display, a camera and network namespaces" $packages) || true; fi
}

# The names are those of sms_jobs/bench/browser.py; SMS_TEST_BROWSER names another, or 'none' to skip its tests.
find_browser() {
    local name
    if [ -n "${SMS_TEST_BROWSER:-}" ]; then return; fi
    for name in chromium-headless-shell chromium chromium-browser google-chrome google-chrome-stable "/Applications/Google Chrome.app/Contents/MacOS/Google Chrome"; do
        if command -v "$name" >/dev/null; then return; fi
    done
    return 1
}

provide_browser() {
    local what="a Chromium (or set SMS_TEST_BROWSER to the path of one, or to none to leave its tests out)"
    if find_browser; then return; fi
    # The shell is the same browser without windows, and a third lighter; not every Debian has it.
    (provide "$what" chromium-headless-shell) || (provide "$what" chromium) || true
}

# Ubuntu has it as a snap alone. Where nobody insists, the tests of reports in a browser are left out.
do_without_browser() {
    if [ "${CI:-}" != true ] && ! find_browser; then
        say "no Chromium: the tests of reports in a browser are skipped"
        export SMS_TEST_BROWSER=none
    fi
}

find_postgresql() {
    local folder
    if command -v initdb >/dev/null && command -v pg_ctl >/dev/null; then
        POSTGRESQL_BIN="$(dirname "$(command -v pg_ctl)")"
        return
    fi
    # The last match is the newest version.
    for folder in /opt/homebrew/opt/postgresql*/bin /usr/local/opt/postgresql*/bin /usr/pgsql-*/bin /usr/lib/postgresql/*/bin; do
        if [ -x "$folder/initdb" ]; then POSTGRESQL_BIN="$folder"; fi
    done
    [ -n "$POSTGRESQL_BIN" ]
}

free_port() {
    .venv/bin/python -c 'import socket; s = socket.socket(); s.bind(("127.0.0.1", 0)); print(s.getsockname()[1])'
}

# Each of many tests has a database of its own, some hundred files to make and to remove. No test cuts the power of
# this server, so that none of them has to be forced to a disk.
start_postgresql() {
    local port account=nobody data="$SERVERS/postgresql"
    find_postgresql || die "PostgreSQL's initdb was not found: look at what its installation said"
    mkdir "$data"
    if [ "$(id -u)" = 0 ]; then
        if id postgres >/dev/null 2>&1; then account=postgres; fi
        chown "$account" "$data"
        AS_POSTGRES="runuser -u $account --"
    fi
    port="$(free_port)"
    (
        cd "$data" # an account other than root may not be allowed to stay in the checkout
        $AS_POSTGRES "$POSTGRESQL_BIN/initdb" --pgdata="$data/data" --username=sms --auth=trust --encoding=UTF8 --no-locale >"$SERVERS/initdb.log" 2>&1 &&
            $AS_POSTGRES "$POSTGRESQL_BIN/pg_ctl" start --silent --wait --pgdata="$data/data" --log="$data/server.log" \
                --options="-c listen_addresses=127.0.0.1 -c port=$port -c unix_socket_directories=$data -c max_connections=100 -c fsync=off -c full_page_writes=off" >&2
    ) || { cat "$SERVERS/initdb.log" "$data/server.log" >&2 2>/dev/null || true; die "the tests' PostgreSQL server did not start: see its messages above"; }
    export SMS_TEST_POSTGRESQL_URL="postgresql+psycopg://sms@127.0.0.1:$port/postgres"
}

start_redis() {
    local port tries=0
    port="$(free_port)"
    mkdir "$SERVERS/redis"
    redis-server --port "$port" --bind 127.0.0.1 --dir "$SERVERS/redis" --save '' --appendonly yes --maxmemory-policy noeviction >"$SERVERS/redis/server.log" 2>&1 &
    REDIS_PID=$!
    until redis-cli -p "$port" ping >/dev/null 2>&1; do
        tries=$((tries + 1))
        if [ $tries -gt 100 ] || ! kill -0 "$REDIS_PID" 2>/dev/null; then
            cat "$SERVERS/redis/server.log" >&2
            die "the tests' Redis server did not start: see its messages above"
        fi
        sleep 0.1
    done
    export SMS_TEST_REDIS_URL="redis://127.0.0.1:$port/0"
}

# Prints how many kB of a file in memory there is room for; 0 where there are no such files.
room_in_memory() {
    { df -Pk /dev/shm 2>/dev/null | awk 'NR == 2 {print $4}'; awk '/^MemAvailable/ {print $2}' /proc/meminfo 2>/dev/null; } |
        sort -n | awk 'NR == 1 {least = $1} END {print NR == 2 ? least : 0}'
}

start_servers() {
    local place=/tmp
    if [ "$(room_in_memory)" -gt "$ROOM_KB" ]; then place=/dev/shm; fi
    SERVERS="$(mktemp -d $place/sms-test.XXXXXX)" # a short path: that of a unix socket is limited to about 100 characters
    mkdir "$SERVERS/tmp"
    chmod 755 "$SERVERS" "$SERVERS/tmp"
    export TMPDIR="$SERVERS/tmp"
    if [ -z "${SMS_TEST_POSTGRESQL_URL:-}" ]; then start_postgresql; fi
    if [ -z "${SMS_TEST_REDIS_URL:-}" ]; then start_redis; fi
}

keep_folders() {
    local kept
    if ! ls "$TMPDIR"/pytest-of-* >/dev/null 2>&1; then return; fi
    kept="$(mktemp -d /tmp/sms-test-failed.XXXXXX)"
    mv "$TMPDIR"/pytest-of-* "$kept" 2>/dev/null || true
    say "the folders of failed tests are in $kept"
}

stop_servers() {
    if [ -n "$REDIS_PID" ]; then
        kill "$REDIS_PID" 2>/dev/null || true
        wait "$REDIS_PID" 2>/dev/null || true
    fi
    if [ -n "$SERVERS" ] && [ -e "$SERVERS/postgresql/data/postmaster.pid" ]; then
        (cd / && $AS_POSTGRES "$POSTGRESQL_BIN/pg_ctl" stop --silent --wait --mode=immediate --pgdata="$SERVERS/postgresql/data") >&2 || true
    fi
    if [ -n "$SERVERS" ]; then rm -rf "$SERVERS"; fi
}
