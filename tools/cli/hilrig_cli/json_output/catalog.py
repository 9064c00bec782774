"""The catalog of JSON outputs: the models of each command, and their JSON Schemas."""

from dataclasses import dataclass
from typing import Any, Final, Literal

from pydantic.json_schema import GenerateJsonSchema

from hilrig_cli.json_output import classroom, lab, recordings, study
from hilrig_cli.json_output.model import JsonOutput

DIALECT: Final = "https://json-schema.org/draft/2020-12/schema"

Form = Literal["object", "array", "object or array", "lines"]


class _OutputSchema(GenerateJsonSchema):
    """Generator for outputs: every field is present, also one with a default; its title would repeat its name."""

    def field_is_required(self, field: Any, total: bool) -> bool:  # noqa: ARG002
        """Return True."""
        return True

    def field_title_should_be_set(self, schema: Any) -> bool:  # noqa: ARG002
        """Return False: no field gets a title."""
        return False


@dataclass(frozen=True, slots=True)
class Output:
    """The JSON output of a command."""

    models: tuple[type[JsonOutput], ...]
    """An object has one of them."""
    form: Form = "object"
    """`object or array`: an object if one rig is named, otherwise an array; `lines`: an object in each line."""


OUTPUTS: Final[dict[str, Output]] = {
    "assign check": Output((classroom.AssignCheckOutput,)),
    "certs": Output((lab.CertsOutput, lab.RevokeOutput)),
    "check": Output((lab.CheckOutput,)),
    "claim": Output((lab.ClaimOutput,)),
    "compare": Output((recordings.CompareOutput,)),
    "demo": Output((recordings.DemoOutput,)),
    "doctor": Output((lab.DoctorOutput,)),
    "events": Output((lab.EventsOutput,), "lines"),
    "grade": Output((classroom.GradeOutput,)),
    "ik": Output((lab.IkOutput,)),
    "impair": Output((lab.ImpairOutput,), "object or array"),
    "jitter": Output((study.JitterOutput,)),
    "latency": Output((recordings.LatencyOutput, recordings.LatencyRunsOutput)),
    "lease": Output((lab.LeaseOutput,), "object or array"),
    "record start": Output((lab.RecordOutput,), "object or array"),
    "record stop": Output((lab.RecordOutput,), "object or array"),
    "recover": Output((recordings.RecoverOutput,), "array"),
    "registers": Output((lab.RegistersOutput,), "array"),
    "report": Output((recordings.ReportOutput,)),
    "rig codes": Output((lab.RigCodesOutput,)),
    "rig list": Output((lab.RigListOutput,), "array"),
    "runs": Output((recordings.RunsOutput,)),
    "study": Output((study.StudyOutput, study.StudyFromOutput)),
    "top": Output((lab.TopOutput,)),
    "verify": Output((recordings.VerifyOutput, recordings.VerifyRunsOutput)),
}
"""By the names of the command."""


def schema_name(model: type[JsonOutput]) -> str:
    """Return the name and version of a model's schema, as "hilrig.top/1"."""
    return str(model.model_fields["schema_id"].default)


def file_name(model: type[JsonOutput]) -> str:
    """Return the name of the file of a model's schema in docs/json/."""
    return f"{schema_name(model).replace('/', '-')}.schema.json"


def json_schema(model: type[JsonOutput]) -> dict[str, Any]:
    """Return the JSON Schema of an output."""
    schema = model.model_json_schema(mode="serialization", schema_generator=_OutputSchema)
    return {"$schema": DIALECT, "$id": schema_name(model)} | schema


def models() -> list[type[JsonOutput]]:
    """Return every model once, in the order of the commands."""
    return list(dict.fromkeys(model for output in OUTPUTS.values() for model in output.models))
