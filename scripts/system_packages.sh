#!/bin/sh
# System parts that tests and benchmarks use: foreign Modbus clients, a screen without a screen, network namespaces.
# Installs what is missing as root on Debian; elsewhere it says what is missing and goes on: a test that needs a
# missing part says so when it is skipped.
set -eu
packages="gcc libc6-dev pkg-config libmodbus-dev mbpoll iproute2 openssl docker-compose xvfb xauth libvulkan1 mesa-vulkan-drivers chromium"
# What the viewer loads by itself when it opens a window.
packages="$packages libxkbcommon-x11-0 libxcursor1 libxi6"
# Node.js may have come another way than by apt.
command -v npm >/dev/null 2>&1 || packages="$packages nodejs npm"

command -v dpkg-query >/dev/null 2>&1 || { echo "not a Debian system: tests may miss $packages" >&2; exit 0; }
missing=""
for package in $packages; do
    dpkg-query --show --showformat='${db:Status-Status}' "$package" 2>/dev/null | grep -qx installed || missing="$missing $package"
done
[ -z "$missing" ] && exit 0
[ "$(id -u)" = 0 ] || { echo "missing system packages (install them as root):$missing" >&2; exit 0; }
export DEBIAN_FRONTEND=noninteractive
apt-get update --quiet=2 || true
# shellcheck disable=SC2086  # a list of words
apt-get install --yes --quiet=2 --no-install-recommends $missing >/dev/null || echo "could not install:$missing" >&2
