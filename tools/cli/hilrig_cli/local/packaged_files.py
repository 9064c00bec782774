"""Files of the checkout that are installed with the package: the example of the demo, and the exercises."""

import importlib.util
from pathlib import Path

from hilrig_runtime.errors import OperationError


def packaged_file(folder: str, name: str) -> Path:
    """Path of a file or folder in `folder` of this checkout, or as installed with the package, in `hilrig_<folder>`.

    Raises:
        OperationError: the installation does not contain it.
    """
    in_checkout = Path(__file__).parents[4] / folder / name
    if in_checkout.exists():
        return in_checkout
    spec = importlib.util.find_spec(f"hilrig_{folder}")
    for installed in (spec.submodule_search_locations or []) if spec is not None else []:
        if (path := Path(installed) / name).exists():
            return path
    raise OperationError(f"{folder}/{name} is not part of this installation")
