#!/bin/bash
# The robot's own processor: a Debian 12 root for arm64 under user-mode emulation installs trotd[robot] as a Pi would,
# and the tests of the core and of the codecs pass in it.
#
# make test-arm64. Needs root, debootstrap and qemu-user-static with binfmt; says so and skips where one is missing.
#   TROTD_ARM64_ROOT   where the root is kept between runs, default /var/tmp/trotd-arm64
#   TROTD_TEST_BIND    folders that pip inside needs to see, space separated; PIP_* variables are handed in
#   TROTD_ARM64_TESTS  which test files, space separated, instead of the list below
set -euo pipefail

skip() { echo "test-arm64: skipped: $*"; exit 0; }
fail() { echo "test-arm64: FAILED: $*" >&2; exit 1; }
say() { echo "test-arm64: $(date +%H:%M:%S) $*"; }

# Arithmetic and wire formats: what must come out the same on another processor. Compiling is slow under emulation, so
# the estimator, the controller and whole walks are left to machines that run them natively; quick ones come first.
tests=(test_moteus test_mit test_xbus test_ring test_durable test_messages test_config test_recorder
    test_kinematics test_contact test_gait test_trajectory test_torque test_policy test_observation test_grf)
[ -z "${TROTD_ARM64_TESTS:-}" ] || read -ra tests <<<"$TROTD_ARM64_TESTS"

[ "$(id -u)" = 0 ] || skip "not root"
for program in debootstrap chroot unshare; do
    command -v $program >/dev/null || skip "no $program"
done
here=$(cd "$(dirname "$0")/.." && pwd)
root=${TROTD_ARM64_ROOT:-/var/tmp/trotd-arm64}
if [ "$(uname -m)" != aarch64 ]; then
    command -v qemu-aarch64-static >/dev/null || skip "no qemu-aarch64-static (apt install qemu-user-static)"
    [ -e /proc/sys/fs/binfmt_misc/register ] || mount -t binfmt_misc binfmt_misc /proc/sys/fs/binfmt_misc 2>/dev/null \
        || skip "this kernel has no binfmt_misc"
    [ -e /proc/sys/fs/binfmt_misc/qemu-aarch64 ] || update-binfmts --enable qemu-aarch64 2>/dev/null \
        || skip "qemu-aarch64 is not registered with binfmt_misc"
fi
if [ ! -e "$root/trotd-made" ]; then
    say "making a Debian 12 root for arm64 in $root (once)"
    rm -rf "$root"
    debootstrap --arch=arm64 --variant=minbase --include=python3,python3-venv,libgomp1,ca-certificates bookworm "$root" \
        >/var/tmp/trotd-arm64.log 2>&1 || skip "debootstrap cannot make it: $(tail -1 /var/tmp/trotd-arm64.log)"
    touch "$root/trotd-made"
fi

pip=()
while IFS= read -r line; do pip+=("$line"); done < <(env | grep '^PIP_' || true)
inside() {
    # Mounts live and die with the command.
    unshare --mount --fork --pid --kill-child bash -c '
        root=$1 binds=$2; shift 2
        mount -t proc proc "$root/proc"; mount -t tmpfs tmpfs "$root/tmp"; mount --rbind /dev "$root/dev"
        for folder in $binds; do mkdir -p "$root$folder"; mount --rbind "$folder" "$root$folder"; done
        cp /etc/resolv.conf "$root/etc/resolv.conf" 2>/dev/null || true
        exec chroot "$root" "$@"' - "$root" "${TROTD_TEST_BIND:-}" \
        env -i PATH=/usr/sbin:/usr/bin:/sbin:/bin HOME=/root LANG=C.UTF-8 OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 \
        NUMBA_NUM_THREADS=1 "${pip[@]}" "$@"
}

[ "$(inside uname -m)" = aarch64 ] || skip "the root's programs do not run here"
rm -rf "$root/src"
mkdir -p "$root/src"
git -C "$here" archive HEAD | tar -x -C "$root/src"
say "$(inside python3 -c 'import platform; print(platform.machine(), "Python", platform.python_version())')"
inside test -x /venv/bin/python || inside python3 -m venv /venv
inside /venv/bin/pip install --quiet --disable-pip-version-check --constraint /src/constraints.txt \
    '/src[robot]' pytest pytest-timeout hypothesis moteus || fail "trotd[robot] does not install"
say "trotd[robot] is installed: $(inside /venv/bin/pip list --format=freeze 2>/dev/null | grep -ciE '^(numba|llvmlite|daqp|eclipse-zenoh|uvloop|proxsuite|imufusion|moteus-pi3hat|msgspec)==') of its compiled parts"
inside /venv/bin/trotd --help >/dev/null || fail "trotd does not start"
say "tests: ${tests[*]}"
inside /bin/sh -c 'cd /src && exec /venv/bin/python -m pytest -q -p no:cacheprovider -o timeout=1800 "$@"' - \
    $(printf "tests/%s.py " "${tests[@]}") || fail "the tests"
say "passed"
