"""Files of robots that the package robot_descriptions knows by name."""

from __future__ import annotations

import pkgutil
from typing import Any, NamedTuple

from torchdq.base.optional import imported
from torchdq.errors import ArgumentError, DescriptionError, UnknownNameError

ASKED_BY = ("robot_descriptions", "Robot.from_name", "'torchdq[names]'")
MUJOCO = "_mj_description"  # end of names of MJCF files


class NamedFile(NamedTuple):
    """File of a robot."""

    format: str  # "urdf", "xacro" or "mjcf"
    path: str
    arguments: dict[str, str]  # for a xacro file
    packages: dict[str, str]  # folders of packages that a xacro file names


def file_of(name: Any) -> NamedFile:
    """File of the robot with a name, which is fetched from its repository once."""
    package = imported(ASKED_BY[0], *ASKED_BY)
    known = sorted(x.name for x in pkgutil.iter_modules(package.__path__) if x.name.endswith("_description"))
    if not isinstance(name, str):
        raise ArgumentError(f"name must be a string, as in 'panda_description', found {name!r}")
    if name not in known or name.startswith("_"):
        raise UnknownNameError("robot description", name, [x for x in known if not x.startswith("_")])
    try:
        module = imported(f"{ASKED_BY[0]}.{name}", *ASKED_BY)
    except Exception as error:  # git's, the network's
        raise DescriptionError(f"robot_descriptions cannot fetch {name!r}: {error}") from error
    paths = {"urdf": "URDF_PATH", "xacro": "XACRO_PATH", "mjcf": "MJCF_PATH"}
    formats = [x for x in paths if hasattr(module, paths[x])]
    if not formats:
        raise DescriptionError(f"{name!r} of robot_descriptions must have a URDF, xacro or MJCF file, found none")
    chosen = "mjcf" if name.endswith(MUJOCO) and "mjcf" in formats else formats[0]
    arguments, packages = (getattr(module, f"XACRO_{x}", {}) for x in ("ARGS", "PACKAGE_PATHS"))
    return NamedFile(chosen, getattr(module, paths[chosen]), dict(arguments), dict(packages))
