#!/bin/sh
# Install trotd as a service, or upgrade it. Run as root from a checkout: deploy/systemd/install.sh [options]
#
#   --extras NAMES   what to install of trotd, default robot; "sim" for a simulated robot
#   --robot NAME     the shipped robot whose TOML becomes /etc/trotd/robot.toml, default stoch3
#   --body NAME      hardware (default), sim, twin or null
#   --pi3hat         run as root, as the pi3hat's library needs
#   --python PATH    the interpreter, default the newest of python3.11 and later
#   --no-start       install only
#
# The version that ran before stays in /opt/trotd/versions. When the new one does not come up in order, it is switched
# back to, and this script exits 1. Whatever is in /etc/trotd and /var/lib/trotd is kept.
set -eu

extras=robot robot=stoch3 body=hardware pi3hat=no start=yes python=
while [ $# -gt 0 ]; do
    case $1 in
        --extras) extras=$2; shift ;;
        --robot) robot=$2; shift ;;
        --body) body=$2; shift ;;
        --python) python=$2; shift ;;
        --pi3hat) pi3hat=yes ;;
        --no-start) start=no ;;
        *) sed -n '2,14s/^# \{0,1\}//p' "$0"; exit 2 ;;
    esac
    shift
done

fail() { echo "install: $*" >&2; exit 1; }

[ "$(id -u)" = 0 ] || fail "must be root"
here=$(cd "$(dirname "$0")" && pwd)
source=$(cd "$here/../.." && pwd)
[ -f "$source/pyproject.toml" ] || fail "$source is no checkout of trotd"
if [ -z "$python" ]; then
    for candidate in python3.13 python3.12 python3.11 python3; do
        if command -v $candidate >/dev/null && $candidate -c 'import sys, venv; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then
            python=$candidate
            break
        fi
    done
fi
[ -n "$python" ] || fail "no Python 3.11 with venv: apt install python3 python3-venv"

# The solvers' wheels are linked against the OpenMP runtime, which a minimal Debian lacks.
if ! ldconfig -p | grep -q 'libgomp\.so\.1'; then
    apt-get install --yes --quiet --no-install-recommends libgomp1 >/dev/null || fail "libgomp.so.1 is missing: apt install libgomp1"
fi

root=/opt/trotd
new=$root/versions/$(date +%Y%m%dT%H%M%S)
old=$(readlink "$root/current" 2>/dev/null || true)

getent group dialout >/dev/null || groupadd --system dialout
getent passwd trotd >/dev/null || useradd --system --home-dir /var/lib/trotd --no-create-home --shell /usr/sbin/nologin trotd

echo "installing trotd[$extras] into $new"
mkdir -p "$new"
abandon() { rm -rf "$new"; }
trap abandon EXIT
$python -m venv "$new"
"$new/bin/pip" install --quiet --disable-pip-version-check --constraint "$source/constraints.txt" "$source[$extras]"
"$new/bin/python" -c 'import runtime.daemon, trotd.cli' || fail "the new version does not even import"
trap - EXIT

install -d -m 0750 -g trotd /etc/trotd
if [ ! -e /etc/trotd/robot.toml ]; then
    install -m 0640 -g trotd "$source/runtime/robots/$robot.toml" /etc/trotd/robot.toml
    grep -q '^\[realtime\]' /etc/trotd/robot.toml || printf '\n[realtime]\npriority = 50\nlock_memory = true\n' >>/etc/trotd/robot.toml
fi
if [ ! -e /etc/trotd/trotd.env ]; then
    sed "s/^TROTD_BODY=.*/TROTD_BODY=$body/" "$here/trotd.env" >/etc/trotd/trotd.env
    chmod 0640 /etc/trotd/trotd.env
fi
install -m 0644 "$here/trotd.service" /etc/systemd/system/trotd.service
[ "$pi3hat" = no ] || install -D -m 0644 "$here/pi3hat.conf" /etc/systemd/system/trotd.service.d/pi3hat.conf
install -D -m 0644 "$here/60-trotd.rules" /etc/udev/rules.d/60-trotd.rules
install -D -m 0644 "$here/60-trotd-can.network" /etc/systemd/network/60-trotd-can.network

switch() { ln -sfn "$1" "$root/current.new" && mv -T "$root/current.new" "$root/current"; }

in_order() {
    # Up, answering, and not in a bad state: 1 is a warning, 2 is bad or nobody there.
    systemctl is-active --quiet trotd || return 1
    code=0
    "$root/current/bin/trotd" health --robot /etc/trotd/robot.toml || code=$?
    [ $code -lt 2 ]
}

wait_in_order() {
    tries=0
    while [ $tries -lt 5 ]; do
        in_order && return 0
        tries=$((tries + 1))
        sleep 2
    done
    return 1
}

switch "$new"
systemctl daemon-reload
udevadm control --reload 2>/dev/null || true
systemctl enable --quiet trotd
if [ $start = no ]; then
    echo "installed, not started: systemctl start trotd"
    exit 0
fi

if systemctl restart trotd && wait_in_order; then
    echo "trotd runs: $new"
    # Keep the version before this one, remove older ones.
    for version in "$root"/versions/*; do
        [ "$version" = "$new" ] || [ "$version" = "$old" ] || rm -rf "$version"
    done
    exit 0
fi

journalctl -u trotd -n 20 --no-pager >&2 || true
if [ -n "$old" ] && [ -d "$old" ]; then
    switch "$old"
    systemctl restart trotd
    rm -rf "$new"
    fail "the new version did not come up in order; back at $old"
fi
systemctl stop trotd || true
fail "trotd did not come up in order; installed at $new, stopped"
