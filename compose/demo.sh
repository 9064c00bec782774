#!/bin/sh
# Drives a rig with the example controller; leaves the recording and its report in the folder of recordings.
#
#     demo.sh HOST RECORDINGS [SECONDS]
set -eu
host=$1 recordings=$2 seconds=${3:-20}
folder=$(mktemp -d)
started=$folder/started
touch "$started"
hilrig example pick_and_place.py --out "$folder" >/dev/null
python "$folder/pick_and_place.py" --host "$host" --duration "$seconds" || [ $? = 1 ] # 1: not every part was placed
echo "waiting for the end of the session"
for _ in $(seq 30); do
    run=$(find "$recordings" -name '*.mcap' -newer "$started" | head -n 1)
    [ -z "$run" ] || break
    sleep 1
done
[ -n "$run" ] || { echo "demo.sh: no recording in $recordings 30 s after the end: see the log of the recorder" >&2; exit 3; }
hilrig latency "$run" || [ $? = 1 ] # 1: not fit for a measurement, with the reasons
hilrig report "$run" --out "${run%.mcap}.html"
