"""What the tables of `lab.toml` are made of: a strict base class, and the kinds of numbers that stand in them."""

from ipaddress import IPv4Network, IPv6Network, ip_network
from typing import Annotated, Final

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

from hilrig_schemas.topics import NAME_PATTERN

_NAME: Final = rf"^{NAME_PATTERN}$"
_COLOUR: Final = r"^#[0-9a-fA-F]{6}$"
PATTERN_DESCRIPTIONS: Final = {
    _NAME: "1 to 63 letters, digits, - and _, beginning with a letter or digit",
    _COLOUR: "a colour as #2f6fc4",
}
"""What a text that follows a pattern is called to people."""

# TOML has types of its own: a number in quotes is a mistake.
Flag = Annotated[bool, Field(strict=True)]
Name = Annotated[str, Field(pattern=_NAME)]
Color = Annotated[str, Field(pattern=_COLOUR)]
Port = Annotated[int, Field(strict=True, ge=1, le=65535)]
Positive = Annotated[float, Field(strict=True, gt=0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(strict=True, ge=0, allow_inf_nan=False)]
Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
# pydantic's own of that kind takes as long to import as all of ours.
Network = Annotated[IPv4Network | IPv6Network, BeforeValidator(ip_network)]
Vector2 = tuple[Number, Number]
Vector4 = tuple[Number, Number, Number, Number]


class Section(BaseModel):
    """Base of every table of the file: unknown keys are mistakes, values are fixed once read.

    What stands below a key is its meaning, for `template`.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)
