#!/bin/sh
# Prepares the volumes of compose.yaml: makes the certificates of the bus once, and gives both folders to the services' user.
#
#     setup.sh LAB.TOML CERTIFICATES RECORDINGS
set -eu
lab=$1 certificates=$2 recordings=$3
[ -e "$certificates/bus/ca.pem" ] || hilrig certs "$certificates" --config "$lab"
[ "$(id -u)" != 0 ] || chown -R 10001:10001 "$certificates" "$recordings"
