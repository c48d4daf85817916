"""Frames and inertias of links, for the tests that hold robots against published figures."""

from __future__ import annotations

import mujoco
import numpy as np


def rotation(quat: np.ndarray | tuple) -> np.ndarray:
    """(3, 3) of a quaternion w x y z, of any length."""
    q, matrix = np.array(quat, float), np.zeros(9)
    mujoco.mju_quat2Mat(matrix, q / np.linalg.norm(q))
    return matrix.reshape(3, 3)


def tensor(quat: np.ndarray | tuple, moments: np.ndarray | tuple) -> np.ndarray:
    """Inertia (3, 3) at the com, in the axes of the body."""
    r = rotation(quat)
    return r @ np.diag(moments) @ r.T


def compiled_tensor(model: mujoco.MjModel, body: str) -> np.ndarray:
    """The same of a body in a compiled model."""
    return tensor(model.body(body).iquat, model.body(body).inertia)
