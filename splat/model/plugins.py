"""What packages of other people add: objects that an installed package names in its entry points.

landscape.methods    NAME = "package.module:Settings", a subclass of `MethodSettings` for `landscape train --method NAME`
landscape.files      SUFFIX = "package.module:read", from the bytes of a file NAME.SUFFIX to a `SplatFile`

They are code of packages that the user has installed; a scene or a checkpoint cannot name any.
"""

from importlib.metadata import entry_points
from typing import Any

from landscape.errors import InputError


def added(group: str, taken: tuple[str, ...] = ()) -> dict[str, Any]:
    """The objects of an entry point group by name.  taken: names that are this program's own.

    InputError that names the package where one cannot be imported or its name is taken.

    >>> added("landscape.nothing")
    {}
    """
    found: dict[str, Any] = {}
    for entry in entry_points(group=group):
        package = entry.dist.name if entry.dist else entry.value
        if entry.name in (*taken, *found):
            raise InputError(
                f"expected another name than {entry.name!r} in {group} of {package}, which is taken; rename it"
            )
        try:
            found[entry.name] = entry.load()
        except Exception as error:
            raise InputError(
                f"expected to import {entry.value} of the package {package}, got {type(error).__name__}: {error}; mend or "
                "uninstall it"
            ) from error
    return found
