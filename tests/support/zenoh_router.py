"""zenoh router for tests: the router library in a Python process. Ends with its standard input."""

import argparse
import json
import sys

import zenoh


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--listen", required=True)
    parser.add_argument("--no-multicast-scouting", action="store_true")
    arguments = parser.parse_args()
    config = zenoh.Config()
    config.insert_json5("mode", '"router"')
    config.insert_json5("listen/endpoints", json.dumps([arguments.listen]))
    config.insert_json5("scouting/multicast/enabled", json.dumps(not arguments.no_multicast_scouting))
    with zenoh.open(config):
        print("ready", flush=True)
        sys.stdin.read()


if __name__ == "__main__":
    main()
