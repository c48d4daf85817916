"""Handle missing or unreadable meshes and textures: drop those of visuals, raise an error for those of the physics."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import mujoco
import numpy as np

from legged_mw.robot.triangles import thinned
from legged_mw.sim.robot_file import compile_copy
from legged_mw.utils.errors import ModelError

READABLE = (".stl", ".obj", ".msh", ".dae")  # mesh formats of MuJoCo's reader, and ours
FACES_OF_LOOKS, _FACES_OF_COLLIDERS = 5_000, 100_000  # larger meshes are thinned [ours: a link on a screen]
INSTEAD = 'give the geom a primitive shape, or let it not collide (contype="0" conaffinity="0")'


def why_unreadable(path: Path) -> str:
    """The reason why a mesh file cannot be read, judged by its name and existence; "" if there is none."""
    if path.suffix.lower() not in READABLE:
        return f"no {path.suffix or 'file without an ending'} is read, only {', '.join(READABLE)}"
    return "" if path.is_file() else "no such file"


def compile_readable(spec: mujoco.MjSpec, where: str, notes: list[str], lost: dict[str, str]) -> mujoco.MjModel:
    """Compile ``spec`` after removing geoms with unreadable files. ``lost``: see ``RobotFile``.

    Raises ModelError for an unreadable mesh that gives a body its mass, ValueError for any other fault.
    """
    try:
        return compile_copy(spec)
    except ValueError:  # check files only now, because an attached model has other paths
        broken = {
            mesh.name: why_unreadable(path_of(spec, mesh)) or _read_error(spec, mesh)
            for mesh in spec.meshes
            if mesh.file
        }
        if not any(broken.values()) and not _missing_pictures(spec) and not _missing_skins(spec):
            raise
    for name in [name for name, reason in broken.items() if reason]:
        broken[name] = _mend(spec, name, broken[name])
    _drop(spec, broken, where, notes, lost)
    _drop_pictures(spec, notes)
    return compile_copy(spec)


def _drop(spec: mujoco.MjSpec, reasons: Mapping[str, str], where: str, notes: list[str], lost: dict[str, str]) -> None:
    """Remove meshes and their geoms. ``reasons``: name of the mesh -> reason; empty: keep it."""
    left_out: dict[str, list[str]] = {}
    for mesh in [mesh for mesh in spec.meshes if reasons.get(mesh.name)]:
        reason, collides = reasons[mesh.name], False
        for geom in [geom for geom in spec.geoms if geom.meshname == mesh.name]:
            if _gives_mass(geom):
                raise ModelError(f"{where}: {_whats_wrong(spec, geom, 'takes its mass from', mesh, reason)}")
            if geom.contype or geom.conaffinity:
                collides = True
                text = f"{where}: {_whats_wrong(spec, geom, 'collides as', mesh, reason)}"
                lost |= dict.fromkeys((name for name in (geom.name, geom.parent.name) if name), text)
                notes.append(f"collider of '{geom.parent.name}' left out ({reason}): {mesh.file}")
            spec.delete(geom)
        if not collides:
            left_out.setdefault(reason, []).append(mesh.file)
        spec.delete(mesh)
    for reason, files in left_out.items():
        notes.append(f"looks left out ({reason}): {', '.join(dict.fromkeys(files))}")


def _mend(spec: mujoco.MjSpec, name: str, reason: str) -> str:
    """Read and thin a mesh that MuJoCo cannot read, such as a .dae or a large .stl. "", or why that failed."""
    mesh, path = spec.mesh(name), path_of(spec, spec.mesh(name))
    if why_unreadable(path):
        return reason
    geoms = [geom for geom in spec.geoms if geom.meshname == name]
    looks = not any(matters(geom) for geom in geoms)
    try:
        points, faces = thinned(path.resolve(), FACES_OF_LOOKS if looks else _FACES_OF_COLLIDERS)
    except (ValueError, OSError) as error:
        return f"{reason}; {error}"
    mesh.file, mesh.uservert, mesh.userface = "", points.ravel(), faces.ravel()
    if looks:  # an open surface has no volume
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    return _read_error(spec, mesh)


def path_of(spec: mujoco.MjSpec, item: mujoco.MjsMesh | mujoco.MjsTexture | mujoco.MjsSkin, file: str = "") -> Path:
    """The path of a mesh, skin or texture, or of ``file`` in the same folder."""
    folder, name = spec.texturedir if isinstance(item, mujoco.MjsTexture) else spec.meshdir, Path(file or item.file)
    return Path(spec.modelfiledir) / folder / (name.name if spec.strippath else name)


def _read_error(spec: mujoco.MjSpec, mesh: mujoco.MjsMesh) -> str:
    """MuJoCo's error for the mesh alone; "" if it compiles."""
    alone = mujoco.MjSpec()
    file = str(path_of(spec, mesh).resolve()) if mesh.file else ""
    copy = alone.add_mesh(name="mesh", file=file, scale=mesh.scale, inertia=mesh.inertia)
    copy.uservert, copy.userface = mesh.uservert, mesh.userface
    alone.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="mesh", contype=0, conaffinity=0, density=0.0)
    try:
        alone.compile()
    except ValueError as error:
        return " ".join(str(error).split())
    return ""


def matters(geom: mujoco.MjsGeom) -> bool:
    """Whether a geom affects the physics: it collides, or gives its body mass."""
    return bool(geom.contype or geom.conaffinity) or _gives_mass(geom)


def _gives_mass(geom: mujoco.MjsGeom) -> bool:
    return not geom.parent.explicitinertial and geom.mass != 0.0 and (geom.density > 0.0 or not np.isnan(geom.mass))


def _whats_wrong(spec: mujoco.MjSpec, geom: mujoco.MjsGeom, role: str, mesh: mujoco.MjsMesh, reason: str) -> str:
    name = f"geom '{geom.name}'" if geom.name else "a geom"
    return (
        f"{name} of body '{geom.parent.name}' {role} the mesh '{mesh.name}', and its file {mesh.file} cannot be read ({reason}; "
        f"looked for at {path_of(spec, mesh)}); put the file there as one of {', '.join(READABLE)}, or {INSTEAD}"
    )


def _missing_pictures(spec: mujoco.MjSpec) -> dict[str, list[str]]:
    """Texture -> its missing files."""
    files = {
        t.name: [file for file in (t.file, *t.cubefiles) if file and not path_of(spec, t, file).is_file()]
        for t in spec.textures
    }
    return {name: missing for name, missing in files.items() if missing}


def _missing_skins(spec: mujoco.MjSpec) -> list[mujoco.MjsSkin]:
    return [skin for skin in spec.skins if skin.file and not path_of(spec, skin).is_file()]


def _drop_pictures(spec: mujoco.MjSpec, notes: list[str]) -> None:
    """Remove skins and textures with missing files. The materials keep their colours."""
    missing = _missing_pictures(spec)
    dropped = [file for files in missing.values() for file in files] + [skin.file for skin in _missing_skins(spec)]
    for skin in _missing_skins(spec):
        spec.delete(skin)
    for material in spec.materials:
        if any(name in missing for name in material.textures):
            material.textures = ["" if name in missing else name for name in material.textures]
    for texture in [texture for texture in spec.textures if texture.name in missing]:
        spec.delete(texture)
    if dropped:
        notes.append(f"looks left out (no such file): {', '.join(dict.fromkeys(dropped))}")
