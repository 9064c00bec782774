#!/bin/sh
# Installs the system packages of tests and benchmarks: Modbus clients, a virtual display, network namespaces.
# On Debian as root it installs the missing packages; otherwise it reports them and exits with 0, because a test that
# needs a missing package is skipped with a reason.
set -eu
packages="gcc libc6-dev pkg-config libmodbus-dev mbpoll iproute2 openssl docker-compose nftables xvfb xauth libvulkan1 mesa-vulkan-drivers chromium"
# Libraries that the rerun viewer loads when it opens a window.
packages="$packages libxkbcommon-x11-0 libxcursor1 libxi6"
# Node.js may be installed from another source than apt.
command -v npm >/dev/null 2>&1 || packages="$packages nodejs npm"

command -v dpkg-query >/dev/null 2>&1 || { echo "not a Debian system: tests may need $packages" >&2; exit 0; }
missing=""
for package in $packages; do
    dpkg-query --show --showformat='${db:Status-Status}' "$package" 2>/dev/null | grep -qx installed || missing="$missing $package"
done
[ -z "$missing" ] && exit 0
[ "$(id -u)" = 0 ] || { echo "missing system packages (install them as root):$missing" >&2; exit 0; }
export DEBIAN_FRONTEND=noninteractive
apt-get update --quiet=2 || true
# shellcheck disable=SC2086  # a list of words
apt-get install --yes --quiet=2 --no-install-recommends $missing >/dev/null || echo "apt-get could not install:$missing" >&2
