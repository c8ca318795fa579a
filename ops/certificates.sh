#!/usr/bin/env bash
# Makes the certificate with which PostgreSQL and Redis are reached by TLS, signed by an authority of your own.
#
#   bash ops/certificates.sh FOLDER NAME...      names and addresses by which other hosts reach the servers
#
# Writes server.key and server.crt, for 825 days, and the authority, authority.key and authority.crt, where there is none
# yet. Run it again for a new certificate. Give authority.crt to every host, and the keys to nobody.
set -euo pipefail

die() {
    printf 'error: %s\n' "$*" >&2
    exit 1
}

if [ $# -lt 2 ]; then
    printf 'usage: bash ops/certificates.sh FOLDER NAME...\n' >&2
    exit 2
fi
folder="$1"
shift
command -v openssl >/dev/null || die "openssl is not installed"

# The servers in the containers of compose.yaml have the group 999; PostgreSQL takes no key that others may read.
SERVERS=999

names=""
for name in "$@"; do
    case "$name" in
        *[!0-9A-Za-z.:-]*) die "'$name' is no name or address of a host" ;;
        *:*) names="$names,IP:$name" ;;
        *[!0-9.]*) names="$names,DNS:$name" ;;
        *) names="$names,IP:$name" ;;
    esac
done

umask 077
mkdir -p "$folder"
settings="$(mktemp "${TMPDIR:-/tmp}/sms-certificates.XXXXXX")"
trap 'rm -f "$settings"' EXIT
cat >"$settings" <<SETTINGS
[req]
distinguished_name = name
prompt = no
[name]
CN = sms servers
[authority]
basicConstraints = critical, CA:TRUE
keyUsage = critical, keyCertSign, cRLSign
subjectKeyIdentifier = hash
[server]
basicConstraints = critical, CA:FALSE
keyUsage = critical, digitalSignature
extendedKeyUsage = serverAuth
subjectKeyIdentifier = hash
authorityKeyIdentifier = keyid
subjectAltName = ${names#,}
SETTINGS

# Keys are elliptic: small, quick, and known to every library since a decade.
make_key() { openssl ecparam -name prime256v1 -genkey -noout -out "$1"; }

cd "$folder"
if [ ! -e authority.key ]; then
    make_key authority.key
    openssl req -x509 -new -config "$settings" -extensions authority -subj "/CN=sms authority" -days 3650 \
        -key authority.key -out authority.crt
fi
make_key server.key
openssl req -new -config "$settings" -key server.key -out server.csr
openssl x509 -req -in server.csr -CA authority.crt -CAkey authority.key -CAcreateserial -days 825 -sha256 \
    -extfile "$settings" -extensions server -out server.crt 2>/dev/null
rm -f server.csr
chmod 444 authority.crt server.crt
if [ "$(id -u)" = 0 ]; then
    chown "0:$SERVERS" server.key
    chmod 640 server.key
else
    printf 'now as root: chown 0:%s %s/server.key && chmod 640 %s/server.key\n' "$SERVERS" "$folder" "$folder" >&2
fi
