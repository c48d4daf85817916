"""Find geoms by the name of a geom, the name of a body (all its colliding geoms), or a pattern with * and ?."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase

import mujoco

from legged_mw.utils.errors import ModelError, unknown


@dataclass(frozen=True)
class GeomNames:
    """Names of the geoms and bodies in a robot's file, including bodies that are fused later."""

    where: str  # name of the file
    geoms: tuple[str, ...]  # all geoms with a name
    colliding: tuple[str, ...]  # geoms that may collide
    bodies: dict[str, tuple[str, ...]]  # body -> its colliding geoms; without any, those of bodies fixed to it
    lost: Mapping[str, str]  # ``RobotFile.lost``

    def find(self, patterns: Sequence[str], what: str, colliding: bool = False) -> tuple[str, ...]:
        """The geoms that match ``patterns``, each once, in their order; with ``colliding`` only colliding ones.

        A name is first looked up among geoms, then among bodies. ``what``: name of the caller's parameter, for a
        ModelError. A pattern with * or ? does not need to match ``lost`` colliders.
        """
        matches: dict[str, None] = {}
        geoms = self.colliding if colliding else self.geoms
        for pattern in patterns:
            hits = [name for name in geoms if fnmatchcase(name, pattern)]
            bodies = [] if hits else [name for name in self.bodies if fnmatchcase(name, pattern)]
            hits += [geom for body in bodies for geom in self.bodies[body]]
            if not hits:
                for name in [name for name in self.lost if fnmatchcase(name, pattern)]:
                    raise ModelError.of((what, self.lost[name]))
                raise ModelError.of((what, self._no_geom(pattern, geoms, bodies, colliding)))
            matches |= dict.fromkeys(hits)
        return tuple(matches)

    def passed_over(self, patterns: Sequence[str]) -> list[str]:
        """A warning for each ``lost`` collider that matches one of ``patterns``."""
        fitting = [text for name, text in self.lost.items() if any(fnmatchcase(name, pattern) for pattern in patterns)]
        return [f"warning: {text}" for text in dict.fromkeys(fitting)]

    def _no_geom(self, pattern: str, geoms: Sequence[str], bodies: Sequence[str], colliding: bool) -> str:
        """Message for a ``pattern`` that matches no geom. ``bodies``: the bodies that it matches."""
        if bodies:
            have = ", ".join(name for name, own in self.bodies.items() if own) or "none"
            return f"body '{bodies[0]}' of {self.where} has no geom that collides; bodies that have: {have}"
        kind = "colliding geom or body" if colliding else "geom or body"
        text = unknown(kind, pattern, [*geoms, *self.bodies], self.where).partition("there are: ")[0]
        return f"{text}there are: geoms {', '.join(geoms) or 'none'}; bodies {', '.join(self.bodies)}"


def name_geoms(spec: mujoco.MjSpec, where: str, notes: list[str], lost: Mapping[str, str]) -> GeomNames:
    """Give unnamed colliding geoms the name ``<body>_<number>``, and collect all names."""
    taken = {geom.name for geom in spec.geoms}
    for body in spec.bodies:
        for number, geom in enumerate(body.geoms):
            name = f"{body.name or 'body'}_{number}"
            if geom.name or not _collides(geom):
                continue
            while name in taken:
                name += "_"
            geom.name = name
            taken.add(name)
            notes.append(f"geom of '{body.name}' without a name is called '{name}'")
    named = [geom for geom in spec.geoms if geom.name]
    colliding = [geom.name for geom in named if _collides(geom)]
    bodies = {body.name: tuple(_own(body) or _fixed_to(body)) for body in spec.bodies[1:] if body.name}
    return GeomNames(where, tuple(geom.name for geom in named), tuple(colliding), bodies, lost)


def _collides(geom: mujoco.MjsGeom) -> bool:
    return bool(geom.contype or geom.conaffinity)


def _own(body: mujoco.MjsBody) -> list[str]:
    return [geom.name for geom in body.geoms if _collides(geom)]


def _fixed_to(body: mujoco.MjsBody) -> list[str]:
    """Names of the colliding geoms of bodies that are fixed to ``body``."""
    fixed = [child for child in body.bodies if not child.joints]
    return [name for child in fixed for name in (*_own(child), *_fixed_to(child))]
