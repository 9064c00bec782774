"""`hilrig metrics`: Prometheus exporter of the lab."""

import time
from typing import Annotated

import typer

from hilrig_cli.options import Config


def metrics(
    config: Config = None,
    listen: Annotated[
        str, typer.Option(metavar="HOST:PORT", help="Address to listen on; :9464 listens on all addresses.")
    ] = "127.0.0.1:9464",
) -> None:
    """Serve the lab's metrics for Prometheus at http://HOST:PORT/metrics until Ctrl-C.

    One process serves the whole lab. It uses the health reports that the services publish anyway.
    """
    from hilrig_monitoring.lab_watch import LabWatch
    from hilrig_monitoring.metrics_server import MetricsServer
    from hilrig_monitoring.prometheus import exposition
    from hilrig_runtime.config.lab import load_lab
    from hilrig_runtime.errors import InputError, OperationError
    from hilrig_runtime.process.shutdown import stop_on_signals, wait_for
    from hilrig_runtime.timing.realtime import lower_priority

    lab = load_lab(config)
    host, colon, port = listen.rpartition(":")
    if not colon or not port.isdigit() or int(port) > 65535:
        raise InputError(f"--listen: expected HOST:PORT, for example 127.0.0.1:9464, got {listen!r}")
    lower_priority()
    stopping = stop_on_signals()
    with LabWatch(lab) as watch:

        def text() -> str:
            with watch.lock:
                return exposition(watch.view, lab.name, time.monotonic())

        try:
            server = MetricsServer((host.strip("[]"), int(port)), text)
        except OSError as error:
            raise OperationError(
                f"can't listen on {listen}: {error.strerror}; choose another address with --listen"
            ) from error
        with server:
            print(f"metrics of lab {lab.name}: http://{host or '0.0.0.0'}:{server.server_port}/metrics", flush=True)
            wait_for(stopping)
