"""One open file of a session: its messages, what is noted in it besides, and its last words.

Trouble with the disk stays here: the file takes no more from then on, counts what it did not take, and is ended by
whoever is told of its failure.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from typing import Final

from hilrig_recorder.ingest.recording import Recording
from hilrig_recorder.mcap_format.writer import RunWriter
from hilrig_runtime.timing.clock import Clock
from hilrig_schemas import RigConfig

LOSS_NOTES: Final = 1000
"""Places of losses noted in a file; all are counted in its summary."""


class RunFile:
    """Implements `recording.Sink`. `on_failure` is called once, when the disk does not take something."""

    def __init__(
        self, recording: Recording, writer: RunWriter, clock: Clock, on_failure: Callable[[OSError], None]
    ) -> None:
        self.recording = recording
        self.writer = writer
        self.opened_ns = clock.monotonic_ns()
        self.failure: OSError | None = None
        """What the disk said when it did not take something; None: it took everything."""
        self.moved = False
        """Whether somebody moved or deleted it."""
        self.sources: set[tuple[str, int]] = set()
        """Runs of services that contribute, by name and incarnation."""
        self.configurations: set[int] = set()
        """Incarnations of the simulation whose configuration is noted."""
        self._clock = clock
        self._on_failure = on_failure
        self._losses = 0

    def write(self, records: Sequence[bytes]) -> None:
        """See `Sink.write`."""
        if self.failure is not None:
            self.recording.tally.lost_recorder += len(records)
            return
        try:
            self.writer.write(records)
        except OSError as error:
            self.fail(error)

    def fail(self, error: OSError) -> None:
        """Take no more: the disk let it down."""
        if self.failure is None:
            self.failure = error
            self._on_failure(error)

    def note_loss(self, source: str, key: str, transport: int, recorder: int) -> None:
        """Note where messages are missing."""
        if self._losses < LOSS_NOTES:
            self._losses += 1
            values = {
                "source": source,
                "key": key,
                "transport": str(transport),
                "recorder": str(recorder),
                "log_time": str(self._clock.wall_ns()),
            }
            self._note(numbered("hilrig.loss", self._losses), values)

    def note_source(self, source: str, incarnation: int) -> bool:
        """Note that a run of a service contributes; whether that is new."""
        if (source, incarnation) in self.sources:
            return False
        self.sources.add((source, incarnation))
        values = {"source": source, "incarnation": str(incarnation)}
        self._note(numbered("hilrig.source", len(self.sources)), values)
        return True

    def note_config(self, config: RigConfig) -> None:
        """Note what the simulation says of itself, with its files; the same only once."""
        if config.incarnation in self.configurations:
            return
        self.configurations.add(config.incarnation)
        values = {
            "rig": config.rig,
            "incarnation": str(config.incarnation),
            "step_ns": str(config.step_ns),
            "parameters_json": config.parameters_json,
            "software_version": config.software_version,
            "machine": config.machine,
        }
        self._note(numbered("hilrig.config", len(self.configurations)), values)
        lab_toml = config.lab_toml or "# There was no lab.toml: the defaults were in force.\n"
        self._attach("lab.toml", "application/toml", lab_toml)
        self._attach(f"{config.rig}.urdf", "application/xml", config.urdf)

    def ending(self, end: str, reason: str) -> Callable[[], None]:
        """What writes the last words and the index, on whatever thread; nothing is written to this file any more.

        `end` is one word for programs, `reason` a sentence for people. Calling it raises what `RunWriter.finish` does.
        """
        writer, recording = self.writer, self.recording
        # The recording may go on in a next file, with a tally of its own.
        tally, end_wall_ns = recording.tally, recording.end_wall_ns or self._clock.wall_ns()

        def last_words() -> dict[str, dict[str, str]]:
            values = {name: str(value) for name, value in asdict(tally).items()}
            values["lost_recorder"] = str(tally.lost_recorder + writer.given_up)
            return {
                "hilrig.summary": {
                    "ended": end,
                    "reason": reason,
                    "end_wall_ns": str(end_wall_ns),
                    **values,
                    "messages": str(writer.message_count),
                }
            }

        return lambda: writer.finish(last_words)

    def _note(self, name: str, values: Mapping[str, str]) -> None:
        try:
            self.writer.add_metadata(name, values)
        except OSError as error:
            self.fail(error)

    def _attach(self, name: str, media_type: str, text: str) -> None:
        try:
            self.writer.add_attachment(name, media_type, text.encode(), log_time=self._clock.wall_ns())
        except OSError as error:
            self.fail(error)


def numbered(name: str, number: int) -> str:
    """Name of the first, second, … metadata record of a kind: names are unique in a file."""
    return name if number == 1 else f"{name}.{number}"
