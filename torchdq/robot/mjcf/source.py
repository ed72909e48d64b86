"""Models that MuJoCo's own compiler makes of MJCF files: angles, default classes, frames and includes are its business.

Meshes and pictures are opened only where a body's mass comes from them, so a file alone is usually enough.
"""

from __future__ import annotations

import math
import re
import reprlib
from collections.abc import Callable
from os import PathLike, fsdecode
from pathlib import Path
from typing import Any, NamedTuple

from torchdq.base.optional import imported
from torchdq.base.sources import located, xml
from torchdq.errors import DescriptionError, MissingFileError, MissingLibraryError
from torchdq.robot.xml_text import root_name

OLDEST = 4  # version of MuJoCo
MOST_BYTES = 50_000_000
# elements that no tree of bodies needs, some of which refer to geoms that are left out
UNUSED = ("sensors", "pairs", "tuples", "keys", "skins", "cameras", "lights")
_INCLUDE = re.compile(r"""<include\s[^>]*?file\s*=\s*["']([^"']+)["']""")
UNNAMED = "MuJoCo Model"  # name that MuJoCo gives a model without one


class MjcfText(NamedTuple):
    """XML text with the place that the files it names lie around."""

    text: str
    folder: Path = Path()
    path: Path | None = None  # file that holds the text as it is


class Mesh(NamedTuple):
    """Mesh of a geom, in whose place there is a sphere unless a mass comes from it."""

    name: str
    file: str  # "": it has none
    scale: tuple[float, ...]


class MjcfModel(NamedTuple):
    """Model as MuJoCo compiled it."""

    mujoco: Any  # the module
    model: Any  # mujoco.MjModel
    name: str
    degrees: bool  # whether angles of the file are in degrees
    weighed: bool  # whether masses come from geoms even where the file states them
    collides: bool  # whether geoms of the file take part in contacts
    meshes: dict[int, Mesh]  # meshes of geoms, by number
    balls: list[str]  # names of ball joints that three hinges stand for
    source: MjcfText


def compiled(source: Any) -> MjcfModel:
    """Model of a file or of XML text; raises `DescriptionError` with MuJoCo's message if it has a fault."""
    mujoco = imported("mujoco", "mujoco", "Robot.from_mjcf", "'torchdq[mujoco]'")
    if int(mujoco.__version__.partition(".")[0]) < OLDEST:
        raise MissingLibraryError(
            f"Robot.from_mjcf needs mujoco {OLDEST} or newer, found {mujoco.__version__}; pip install --upgrade mujoco"
        )
    text = source if isinstance(source, MjcfText) else _text(source)
    spec = _attempt(lambda: _parsed(mujoco, text))
    balls = hinged(mujoco, spec)
    name, collides = spec.modelname, any(x.contype or x.conaffinity for x in spec.geoms) or bool(spec.pairs)
    needed, drawn = _without_meshes(mujoco, spec)
    try:
        model = spec.compile()
    except (ValueError, mujoco.FatalError):  # whatever was left out was wanted
        spec = _attempt(lambda: _parsed(mujoco, text))
        balls, drawn = hinged(mujoco, spec), _meshes(spec)
        model = _attempt(spec.compile, needed)
    meshes = {geom.id: mesh for geom, mesh in drawn}
    degrees, weighed = bool(spec.compiler.degree), _from_geoms(mujoco, spec)
    return MjcfModel(
        mujoco, model, "robot" if name in ("", UNNAMED) else name, degrees, weighed, collides, meshes, balls, text
    )


def hinged(mujoco: Any, spec: Any) -> list[str]:
    """Names of the ball joints of a specification, in which three hinges about x, y and z take their places."""
    names = []
    for ball in [joint for joint in spec.joints if joint.type == mujoco.mjtJoint.mjJNT_BALL]:
        body, name = ball.parent, ball.name or f"{ball.parent.name}_ball"
        if ball is not body.joints[-1] and ball.name != body.joints[-1].name:
            raise DescriptionError(
                f"a ball joint must be the last of its body, found {name!r} before {body.joints[-1].name!r}; put a "
                "body between them"
            )
        for letter, axis in zip("xyz", ((1, 0, 0), (0, 1, 0), (0, 0, 1)), strict=True):
            hinge = body.add_joint(name=f"{name}_{letter}", type=mujoco.mjtJoint.mjJNT_HINGE, axis=axis)
            for number in ("pos", "damping", "frictionloss", "armature", "stiffness"):
                setattr(hinge, number, getattr(ball, number))
            hinge.limited = mujoco.mjtLimited.mjLIMITED_FALSE
        spec.delete(ball)
        names.append(name)
    return names


def _attempt(step: Callable[[], Any], needed: list[str] | None = None) -> Any:
    try:
        return step()
    except Exception as error:  # MuJoCo raises ValueError, FatalError and, for some paths, others
        hint = ""
        if needed:
            names = ", ".join(needed)
            hint = f"; the masses of {names} come from meshes: keep these files where it names them, or add <inertial>"
        raise DescriptionError(f"MuJoCo cannot compile the robot description: {str(error).strip()}{hint}") from error


def _text(source: Any) -> MjcfText:
    text = xml("robot description", source, MOST_BYTES, DescriptionError, MissingFileError)
    if root_name(text) not in ("mujoco", "robot"):
        expected = "an MJCF file, whose root element is <mujoco>"
        raise DescriptionError(f"the robot description must be {expected}, found {reprlib.repr(text)}")
    if "\0" in text:
        raise DescriptionError("the robot description is not XML text: it holds a zero byte")
    if source is text or not isinstance(source, str | PathLike):
        return MjcfText(text)
    path = Path(located(fsdecode(source), MissingFileError))
    return MjcfText(text, path.parent, path)


def _parsed(mujoco: Any, source: MjcfText) -> Any:
    """Specification that MuJoCo reads from a text; other files are opened when it is compiled."""
    if source.path is not None:
        return mujoco.MjSpec.from_file(str(source.path))
    text = source.text.lstrip("\ufeff \t\r\n")
    spec = mujoco.MjSpec.from_string(text, include=_includes(text, source.folder, {}))
    spec.modelfiledir = str(source.folder.absolute())
    return spec


def _includes(text: str, folder: Path, found: dict[str, bytes]) -> dict[str, bytes]:
    """Files that a text includes, and those that they include, by the last part of their paths, as MuJoCo has them."""
    for name in _INCLUDE.findall(text):
        path = folder / name
        if not path.is_file() or path.stat().st_size > MOST_BYTES:
            continue
        data = path.read_bytes()
        if found.setdefault(path.name, data) != data:
            raise DescriptionError(f"files that a text includes must have different names, found two of {path.name!r}")
        if found[path.name] is data:
            for around in (folder, path.parent):
                _includes(data.decode("utf-8", "replace"), around, found)
    return found


def _from_geoms(mujoco: Any, spec: Any) -> bool:
    return spec.compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE


def _meshes(spec: Any) -> list[tuple[Any, Mesh]]:
    """Geoms of a specification that have meshes or height fields, and these."""
    files = {
        x.name or Path(x.file).stem: (x.file and str(Path(spec.meshdir) / x.file), tuple(map(float, x.scale)))
        for x in spec.meshes
    }
    names = [(geom, geom.meshname or geom.hfieldname) for geom in spec.geoms]
    return [(geom, Mesh(name, *files.get(name, ("", ())))) for geom, name in names if name]


def _without_meshes(mujoco: Any, spec: Any) -> tuple[list[str], list[tuple[Any, Mesh]]]:
    """Names of bodies whose mass comes from meshes; geoms and their meshes, most of which are spheres now."""
    always = _from_geoms(mujoco, spec)
    first, last = spec.compiler.inertiagrouprange
    for kind in UNUSED:
        for element in list(getattr(spec, kind)):
            spec.delete(element)
    needed, drawn, kinds = [], _meshes(spec), mujoco.mjtGeom
    for body in spec.bodies:
        weighed = body.name != "world" and (always or not body.explicitinertial)
        for geom in list(body.geoms):
            if not (geom.meshname or geom.hfieldname):
                continue
            massless = geom.mass == 0 or (math.isnan(geom.mass) and geom.density == 0)
            if weighed and first <= geom.group <= last and not massless:
                needed.append(body.name or "a body without name")
            else:
                # a sphere without mass has its place, with the frames and default classes of the file resolved
                geom.type, geom.size, geom.mass = kinds.mjGEOM_SPHERE, (1e-3, 0.0, 0.0), 0.0
                geom.meshname = geom.hfieldname = ""
    kept = {geom.meshname for geom in spec.geoms} | {flex.name for flex in spec.flexes}
    for mesh in list(spec.meshes):
        if mesh.name not in kept:
            spec.delete(mesh)
    for element in (*spec.geoms, *spec.sites, *spec.tendons):
        element.material = ""
    for kind in ("hfields", "materials", "textures"):
        for element in list(getattr(spec, kind)):
            spec.delete(element)
    return list(dict.fromkeys(needed)), drawn
