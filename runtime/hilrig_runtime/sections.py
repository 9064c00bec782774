"""What the tables of `lab.toml` are made of: a strict base class, and the kinds of numbers that stand in them."""

from ipaddress import IPv4Network, IPv6Network, ip_network
from typing import Annotated

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

from hilrig_schemas.topics import NAME_PATTERN

Name = Annotated[str, Field(pattern=rf"^{NAME_PATTERN}$")]
Port = Annotated[int, Field(ge=1, le=65535)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Number = Annotated[float, Field(allow_inf_nan=False)]
# pydantic's own of that kind takes as long to import as all of ours.
Network = Annotated[IPv4Network | IPv6Network, BeforeValidator(ip_network)]
Vector2 = tuple[Number, Number]
Vector4 = tuple[Number, Number, Number, Number]


class Section(BaseModel):
    """Base of every table of the file: unknown keys are mistakes, values are fixed once read.

    What stands below a key is its meaning, for `template`.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)
