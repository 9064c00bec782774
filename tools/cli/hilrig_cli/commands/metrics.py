"""`hilrig metrics`: Prometheus exporter of the lab."""

import time
from typing import Annotated

import typer

from hilrig_cli.commands.services import LogFormat
from hilrig_cli.options import Config, announcer


def metrics(
    config: Config = None,
    listen: Annotated[
        str, typer.Option(metavar="HOST:PORT", help="Address to listen on; :9464 listens on all addresses.")
    ] = "127.0.0.1:9464",
    log_format: LogFormat = "text",
) -> None:
    """Serve the lab's metrics for Prometheus at http://HOST:PORT/metrics until Ctrl-C.

    One process serves the whole lab. It uses the health reports that the services publish anyway.
    """
    from hilrig_monitoring.lab_watch import LabWatch
    from hilrig_monitoring.metrics_server import MetricsServer
    from hilrig_monitoring.prometheus import exposition
    from hilrig_runtime.config.lab import load_lab
    from hilrig_runtime.listen_address import ListenAddress
    from hilrig_runtime.process.logging_setup import start_logging
    from hilrig_runtime.process.shutdown import stop_on_signals, wait_for
    from hilrig_runtime.timing.realtime import lower_priority

    start_logging("metrics", "1", log_format)
    lab = load_lab(config)
    address = ListenAddress.parse(listen)
    lower_priority()
    stopping = stop_on_signals()
    with LabWatch(lab) as watch:

        def text() -> str:
            with watch.lock:
                return exposition(watch.view, lab.name, time.monotonic())

        with MetricsServer(address, text) as server:
            announcer(log_format)(f"metrics of lab {lab.name}: {address.urls(server.port, 'http', '/metrics')}")
            wait_for(stopping)
