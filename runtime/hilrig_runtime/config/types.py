"""Base class and value types of the tables in `lab.toml`."""

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from ipaddress import IPv4Network, IPv6Network, ip_network
from typing import Annotated, Final

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

from hilrig_schemas.topics import NAME_PATTERN

_NAME: Final = rf"^{NAME_PATTERN}$"
MAX_NUMBER: Final = 1e10
"""Largest number of a setting without a limit of its own: the square of a larger one can exceed the range of floats."""
_COLOR: Final = r"^#[0-9a-fA-F]{6}$"
PATTERN_DESCRIPTIONS: Final = {
    _NAME: "1 to 63 letters, digits, - and _, beginning with a letter or digit",
    _COLOR: "a color such as #2f6fc4",
}
"""Human-readable description of each regular expression."""

# Strict: TOML has types of its own, so a number in quotes is an error.
Flag = Annotated[bool, Field(strict=True)]
Name = Annotated[str, Field(pattern=_NAME)]
Color = Annotated[str, Field(pattern=_COLOR)]
Port = Annotated[int, Field(strict=True, ge=1, le=65535)]
Positive = Annotated[float, Field(strict=True, gt=0, le=MAX_NUMBER, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(strict=True, ge=0, le=MAX_NUMBER, allow_inf_nan=False)]
Number = Annotated[float, Field(strict=True, ge=-MAX_NUMBER, le=MAX_NUMBER, allow_inf_nan=False)]
# pydantic's own network type takes as long to import as all of this package.
Network = Annotated[IPv4Network | IPv6Network, BeforeValidator(ip_network)]
Vector2 = tuple[Number, Number]
Vector4 = tuple[Number, Number, Number, Number]


def check_distinct(kind: str, names: Iterable[str]) -> None:
    """Check that no name occurs twice.

    Raises:
        ValueError: one does.
    """
    for name, times in Counter(names).items():
        if times > 1:
            raise ValueError(f"duplicate {kind} {name!r}")


@dataclass(frozen=True)
class TableForm:
    """Marks a list of tables that may also be written as one table of this type."""

    section: type["Section"]


class Section(BaseModel):
    """Base of every table of the file: unknown keys are errors, values are immutable.

    The docstring below a key is its description in the template.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)
