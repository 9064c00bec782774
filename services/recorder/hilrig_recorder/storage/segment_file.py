"""An open segment file of a session: writes messages, metadata and attachments, and prepares its final metadata.

A write error is handled here: the file accepts no more messages, counts the lost ones, and reports the failure to its
owner, which finishes the file.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from typing import Final

from hilrig_recorder.ingest.recording import Recording
from hilrig_recorder.mcap_format.ending import Ending
from hilrig_recorder.mcap_format.writer import RecordingWriter
from hilrig_runtime.timing.clock import Clock
from hilrig_schemas import RigConfig

MAX_LOSS_RECORDS: Final = 1000
"""Maximum number of metadata records of losses in a file; the summary counts all losses."""
_ABSOLUTE_PATH: Final = re.compile(
    r"""(?<![^\s"'=,;:(\[{])
    (?:~[\w.-]*[/\\]+|(?:[A-Za-z]:[/\\]+|(?<!:)[/\\]+|(?<=:)(?:/{3,}|/(?!/)|\\+))(?=[^\s/\\"']))
    [^"'\n\r,;)\]}]*""",
    re.VERBOSE,
)
"""An absolute path in a text: after a space, quote, bracket or prefix such as `trace:`, up to the end of the string."""
_HOMES: Final = ("home", "Users")


class SegmentFile:
    """An open file of a recording.

    Args:
        recording: the recording.
        writer: the writer of the file.
        clock: the clock.
        on_failure: called once, at the first write error.
    """

    def __init__(
        self, recording: Recording, writer: RecordingWriter, clock: Clock, on_failure: Callable[[OSError], None]
    ) -> None:
        self.recording = recording
        self.writer = writer
        self.opened_ns = clock.monotonic_ns()
        self.failure: OSError | None = None
        """The first write error; None: all writes succeeded."""
        self.is_replaced = False
        """Whether the file was moved or deleted while it was open."""
        self.sources: set[tuple[str, int]] = set()
        """(source, incarnation) of the services that contribute."""
        self.configurations: set[int] = set()
        """Incarnations of the simulation whose configuration is in the file."""
        self._clock = clock
        self._on_failure = on_failure
        self._losses = 0

    def write(self, records: Sequence[bytes]) -> None:
        """Write encoded messages; after a write error, count them as lost."""
        if self.failure is not None:
            self.recording.counters.lost_recorder += len(records)
            return
        try:
            self.writer.write(records)
        except OSError as error:
            self.fail(error)

    def fail(self, error: OSError) -> None:
        """Accept no more messages, because of a write error."""
        if self.failure is None:
            self.failure = error
            self._on_failure(error)

    def record_loss(self, source: str, key: str, transport: int, recorder: int) -> None:
        """Add a metadata record about lost messages."""
        if self._losses < MAX_LOSS_RECORDS:
            self._losses += 1
            values = {
                "source": source,
                "key": key,
                "transport": str(transport),
                "recorder": str(recorder),
                "log_time": str(self._clock.wall_ns()),
            }
            self._add_metadata(numbered("hilrig.loss", self._losses), values)

    def record_source(self, source: str, incarnation: int) -> bool:
        """Add a metadata record about a contributing service; False: it is already in the file."""
        if (source, incarnation) in self.sources:
            return False
        self.sources.add((source, incarnation))
        values = {"source": source, "incarnation": str(incarnation)}
        self._add_metadata(numbered("hilrig.source", len(self.sources)), values)
        return True

    def record_config(self, config: RigConfig) -> None:
        """Add the configuration of a simulation and its files, unless it is already in the file."""
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
        self._add_metadata(numbered("hilrig.config", len(self.configurations)), values, is_repeated=True)
        lab_toml = without_folders(config.lab_toml) or "# There was no lab.toml: the defaults were used.\n"
        self._attach("lab.toml", "application/toml", lab_toml)
        self._attach(f"{config.rig}.urdf", "application/xml", config.urdf)

    def finisher(self, end: Ending, reason: str) -> Callable[[], None]:
        """A function that writes the final metadata and the index; any thread may call it.

        Nothing else may be written to this file any more. The function raises the errors of `RecordingWriter.finish`.

        Args:
            end: cause of the end.
            reason: a sentence that explains the end.
        """
        writer, recording = self.writer, self.recording
        # The recording may continue in a new segment with new counters.
        counters, end_wall_ns = recording.counters, recording.end_wall_ns or self._clock.wall_ns()

        def final_metadata() -> dict[str, dict[str, str]]:
            values = {name: str(value) for name, value in asdict(counters).items()}
            values["lost_recorder"] = str(counters.lost_recorder + writer.dropped_count)
            return {
                "hilrig.summary": {
                    "ended": end,
                    "reason": reason,
                    "end_wall_ns": str(end_wall_ns),
                    **values,
                    "messages": str(writer.message_count),
                }
            }

        return lambda: writer.finish(final_metadata)

    def _add_metadata(self, name: str, values: Mapping[str, str], *, is_repeated: bool = False) -> None:
        try:
            self.writer.add_metadata(name, values, is_repeated=is_repeated)
        except OSError as error:
            self.fail(error)

    def _attach(self, name: str, media_type: str, text: str) -> None:
        try:
            self.writer.add_attachment(name, media_type, text.encode(), log_time=self._clock.wall_ns())
        except OSError as error:
            self.fail(error)


def without_folders(lab_toml: str) -> str:
    """The text of a lab file with file names instead of absolute paths, which can reveal a user's name."""
    return _ABSOLUTE_PATH.sub(lambda found: _last_name(found[0]), lab_toml)


def _last_name(path: str) -> str:
    """The name of a file or folder; `home` for the folder of a user."""
    first, *names = [name for name in re.split(r"[/\\]+", path) if name]
    is_home = not names if first.startswith("~") else len(names) == 1 and first in _HOMES
    return "home" if is_home else (names[-1] if names else first)


def numbered(name: str, number: int) -> str:
    """Name of the first, second, … metadata record of a kind; names are unique in a file."""
    return name if number == 1 else f"{name}.{number}"
