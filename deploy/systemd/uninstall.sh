#!/bin/sh
# Remove the service. Configuration and state stay, unless --purge: deploy/systemd/uninstall.sh [--purge]
set -eu
[ "$(id -u)" = 0 ] || { echo "uninstall: must be root" >&2; exit 1; }
systemctl disable --now --quiet trotd 2>/dev/null || true
rm -rf /etc/systemd/system/trotd.service /etc/systemd/system/trotd.service.d /opt/trotd /var/cache/trotd /run/trotd
rm -f /etc/udev/rules.d/60-trotd.rules /etc/systemd/network/60-trotd-can.network
systemctl daemon-reload
if [ "${1:-}" = --purge ]; then
    rm -rf /etc/trotd /var/lib/trotd
    userdel trotd 2>/dev/null || true
    echo "trotd is gone, with its configuration, policies and recordings"
else
    echo "trotd is gone; /etc/trotd and /var/lib/trotd are kept (--purge removes them)"
fi
