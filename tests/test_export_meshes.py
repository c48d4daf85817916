"""Meshes that MuJoCo builds stay a line of numbers in an exported MJCF, and nothing else changes."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest

from legged_mw.export.scene import shorten

ROOT = Path(__file__).parents[1]
SOURCE = """<mujoco><asset>
  <mesh name="hull" builtin="supersphere" params="12 0.4 0.5" scale="0.2 0.1 0.05"/>
  <mesh name="tip" builtin="cone" params="12 0.5" scale="0.02 0.02 0.04" smoothnormal="true"/>
  <mesh name="plain" vertex="0 0 0 1 0 0 0 1 0 0 0 1" scale="0.1 0.1 0.1"/>
</asset><worldbody><body pos="0 0 1"><freejoint/>
  <geom type="mesh" mesh="hull" quat="0.8 0.6 0 0"/>
  <geom type="mesh" mesh="tip" pos="0.3 0 0" mass="0" contype="0" conaffinity="0"/>
  <geom type="mesh" mesh="plain" pos="-0.3 0 0"/>
</body></worldbody></mujoco>"""


@pytest.fixture(scope="module")
def written() -> str:
    spec = mujoco.MjSpec.from_string(SOURCE)
    spec.compile()
    return spec.to_xml()


def test_built_meshes_get_their_numbers_back(written: str) -> None:
    short = shorten(written, SOURCE)
    assert len(short) < len(written) / 4
    assert 'builtin="supersphere" params="12 0.4 0.5"' in short and 'builtin="cone" params="12 0.5"' in short
    assert short.count("vertex=") == 1, "of the mesh that is not built"
    assert shorten(short, SOURCE) == short
    new, old = mujoco.MjModel.from_xml_string(short), mujoco.MjModel.from_xml_string(SOURCE)
    np.testing.assert_array_equal(new.mesh_vert, old.mesh_vert)
    np.testing.assert_array_equal(new.mesh_face, old.mesh_face)
    np.testing.assert_allclose(new.body_inertia, old.body_inertia, rtol=1e-5)


@pytest.mark.parametrize(
    ("right", "wrong"),
    [
        ('params="12 0.4 0.5"', 'params="12 0.9 0.5"'),  # edited since
        ('params="12 0.4 0.5"', 'params="14 0.4 0.5"'),
        ('builtin="supersphere"', 'builtin="hypersphere"'),
        ("</asset>", ""),
    ],
)
def test_a_source_that_tells_another_model_changes_nothing(right: str, wrong: str, written: str) -> None:
    assert right in SOURCE
    assert shorten(written, SOURCE.replace(right, wrong)) == written


def test_a_source_without_such_meshes_changes_nothing(written: str) -> None:
    for source in (
        "",
        "<mujoco/>",
        '<robot name="a"><link name="b"><visual><geometry><mesh filename="b.stl"/></geometry></visual></link></robot>',
    ):
        assert shorten(written, source) == written


@pytest.mark.parametrize(
    "name", ["go1_flat/scene.xml", "go1_rough/scene.xml", "go1_rough_scan/scene.xml", "go1_rough_scan/terrain.mjz"]
)
def test_shipped_scenes_are_short(name: str) -> None:
    assert (ROOT / "resources" / "policies" / name).stat().st_size < (60_000 if name.endswith("scene.xml") else 12_000)
