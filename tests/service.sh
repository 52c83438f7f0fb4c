#!/bin/bash
# The installer and the unit for real: a Debian 12 root is booted with systemd-nspawn, trotd is installed with the
# simulated body, driven over zenoh from outside, killed, upgraded with a broken version, and uninstalled.
#
# make test-service. Needs root, systemd-nspawn and debootstrap; says so and skips where one is missing.
#   TROTD_TEST_ROOT   where the root is kept between runs, default /var/tmp/trotd-root
#   TROTD_TEST_BIND   folders that pip inside needs to see, space separated; PIP_* variables are handed in
set -euo pipefail

skip() { echo "test-service: skipped: $*"; exit 0; }
fail() { echo "test-service: FAILED: $*" >&2; inside journalctl -u trotd -n 30 --no-pager >&2 || true; exit 1; }
say() { echo "test-service: $*"; }

[ "$(id -u)" = 0 ] || skip "not root"
for program in systemd-nspawn debootstrap nsenter; do
    command -v $program >/dev/null || skip "no $program"
done

here=$(cd "$(dirname "$0")/.." && pwd)
root=${TROTD_TEST_ROOT:-/var/tmp/trotd-root}
if [ ! -e "$root/etc/debian_version" ]; then
    say "making a Debian 12 root in $root (once)"
    debootstrap --variant=minbase --include=systemd,systemd-sysv,udev,dbus,python3,python3-venv,procps,iproute2 \
        bookworm "$root" >/dev/null || skip "debootstrap cannot reach its mirror"
fi

rm -rf "$root/src" "$root/broken"
mkdir -p "$root/src"
git -C "$here" archive HEAD | tar -x -C "$root/src"
cp -a "$root/src" "$root/broken"
# A version that imports and starts, but never ticks.
sed -i 's/^    daemon = Daemon(job)$/    raise SystemExit("a broken version")/' "$root/broken/runtime/daemon.py"
! cmp -s "$root/src/runtime/daemon.py" "$root/broken/runtime/daemon.py" || fail "the broken version is not broken"

binds=()
for folder in ${TROTD_TEST_BIND:-}; do binds+=("--bind-ro=$folder"); done
systemd-nspawn --quiet --register=no --keep-unit --directory="$root" "${binds[@]}" --resolv-conf=copy-host --boot \
    </dev/null >/var/tmp/trotd-boot.log 2>&1 &
machine=$!
leader=
inside() { nsenter --target "$leader" --mount --uts --ipc --pid env -i PATH=/usr/sbin:/usr/bin:/sbin:/bin HOME=/root LANG=C.UTF-8 "${pip[@]}" "$@"; }
pip=()
while IFS= read -r line; do pip+=("$line"); done < <(env | grep '^PIP_' || true)
trap 'kill -TERM $machine 2>/dev/null || true; sleep 1; [ -z "$leader" ] || kill -KILL "$leader" 2>/dev/null || true; wait $machine 2>/dev/null || true' EXIT
for _ in $(seq 60); do
    leader=$(pgrep -P $machine -x systemd || true)
    [ -n "$leader" ] && inside systemctl is-system-running 2>/dev/null | grep -qE 'running|degraded' && break
    sleep 0.5
done
[ -n "$leader" ] || skip "systemd-nspawn cannot boot here: $(tail -1 /var/tmp/trotd-boot.log)"
say "booted"

inside /src/deploy/systemd/uninstall.sh --purge >/dev/null 2>&1 || true
inside /src/deploy/systemd/install.sh --extras sim --body sim || fail "install"
good=$(inside readlink /opt/trotd/current)
user=$(inside systemctl show -p User --value trotd)
[ "$user" = trotd ] || fail "runs as $user"
say "installed; runs as $user; $(inside systemd-analyze security trotd --no-pager | tail -1 | cut -d: -f2)"

"$here/.venv/bin/python" "$here/tests/service_drive.py" walk || fail "it does not walk"
main=$(inside systemctl show -p MainPID --value trotd)
say "walks; kill -9 $main"
began=$(date +%s%N)
inside kill -9 "$main"
"$here/.venv/bin/python" "$here/tests/service_drive.py" damped || fail "not back in damp"
back=$((($(date +%s%N) - began) / 1000000))
say "back in DAMP and reachable after $back ms"
[ $back -le 3000 ] || say "slower than the 3000 ms that are wanted"
"$here/.venv/bin/python" "$here/tests/service_drive.py" recovered || fail "what the killed run left is not whole"

if inside /broken/deploy/systemd/install.sh --extras sim; then fail "a broken version was accepted"; fi
[ "$(inside readlink /opt/trotd/current)" = "$good" ] || fail "not back at the version before"
"$here/.venv/bin/python" "$here/tests/service_drive.py" damped || fail "the version before does not serve"
say "a broken version was left again"

inside /src/deploy/systemd/uninstall.sh || fail "uninstall"
if inside test -e /opt/trotd || ! inside test -d /var/lib/trotd; then fail "uninstall left the wrong things"; fi
say "passed"
