"""The geoms that a name means: one geom, all colliding geoms of a body, or those that a pattern with * and ? fits."""

# pyright: reportAttributeAccessIssue=false
# (mujoco ships no type stubs)
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase

import mujoco

from legged_mw.utils.errors import ModelError, unknown


@dataclass(frozen=True)
class GeomNames:
    """Geoms and bodies of a robot by the names in its file, also of bodies that are fused later."""

    where: str  # the file
    geoms: tuple[str, ...]  # all that have a name
    colliding: tuple[str, ...]  # those that may touch
    # body -> its own geoms that may touch; of a body without any, those that are fixed to it
    bodies: dict[str, tuple[str, ...]]

    def find(self, patterns: Sequence[str], what: str, colliding: bool = False) -> tuple[str, ...]:
        """The geoms that ``patterns`` mean, each once, in the order of the patterns; with ``colliding`` only those that may touch.

        A geom wins over a body of the same name. ``what`` names the caller's parameter in the text of a ModelError.
        """
        found: dict[str, None] = {}
        geoms = self.colliding if colliding else self.geoms
        for pattern in patterns:
            hits = [name for name in geoms if fnmatchcase(name, pattern)]
            bodies = [] if hits else [name for name in self.bodies if fnmatchcase(name, pattern)]
            hits += [geom for body in bodies for geom in self.bodies[body]]
            if bodies and not hits:
                have = ", ".join(name for name, own in self.bodies.items() if own) or "none"
                why = f"body '{bodies[0]}' of {self.where} has no geom that collides; bodies that have: {have}"
                raise ModelError.of((what, why))
            if not hits:
                kind = "colliding geom or body" if colliding else "geom or body"
                text = unknown(kind, pattern, [*geoms, *self.bodies], self.where).partition("there are: ")[0]
                known = f"geoms {', '.join(geoms) or 'none'}; bodies {', '.join(self.bodies)}"
                raise ModelError.of((what, f"{text}there are: {known}"))
            found |= dict.fromkeys(hits)
        return tuple(found)


def name_geoms(spec: mujoco.MjSpec, where: str, notes: list[str]) -> GeomNames:
    """Call unnamed geoms that may touch ``<body>_<number>``, and list all names."""
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
    bodies = {
        body.name: tuple(_own(body) or _fixed_to(body)) for body in spec.bodies if body.name and body.name != "world"
    }
    return GeomNames(
        where, tuple(geom.name for geom in named), tuple(geom.name for geom in named if _collides(geom)), bodies
    )


def _collides(geom: mujoco.MjsGeom) -> bool:
    return bool(geom.contype or geom.conaffinity)


def _own(body: mujoco.MjsBody) -> list[str]:
    return [geom.name for geom in body.geoms if _collides(geom)]


def _fixed_to(body: mujoco.MjsBody) -> list[str]:
    """Geoms of bodies that do not move against ``body``."""
    fixed = [child for child in body.bodies if not child.joints]
    return [name for child in fixed for name in (*_own(child), *_fixed_to(child))]
