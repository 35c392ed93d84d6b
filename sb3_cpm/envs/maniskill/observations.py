"""
What a robot knows of itself (report, section 4.1), and from simulator to host memory in one copy.

Nothing here imports ManiSkill, so all of it is tested without a simulator. N is the number of environments.
"""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import torch as th

GOAL_KEYS = ("goal_pos", "target_link_pos", "bin_pos")
"""Where the tasks of ManiSkill put the goal's position, in the order in which we look."""

STATE_KEYS = ("tcp_pose", *GOAL_KEYS, "target_angle_diff", "target_joint_axis", "is_grasped")
"""What of a task's extra observations a robot may know: itself and its goal. Never a pose of an object that it must find
with its cameras, even if a future version of ManiSkill shows one; therefore a list of what is kept, not of what is dropped."""


def find_goal(extra: Mapping[str, np.ndarray]) -> np.ndarray | None:
    """
    :param extra: the task's extra observations
    :return: the goals' positions in metres, shape ``(N, 3)``, or None where the task shows none
    """
    for key in GOAL_KEYS:
        if key in extra:
            return np.asarray(extra[key], dtype=np.float32).reshape(-1, 3)
    return None


def state_parts(agent: Mapping[str, Any], extra: Mapping[str, Any], privileged: bool) -> dict[str, np.ndarray]:
    """
    What the state vector is made of, in its order: joint positions and velocities, what controllers remember, the task's extra
    observations.

    :param agent: proprioception ("qpos" and "qvel" first, then whatever controllers add, by name)
    :param extra: the task's extra observations
    :param privileged: all of ``extra`` in its own order, instead of :data:`STATE_KEYS` as far as the task has them
    :return: name to shape ``(N, size)``, float32
    """
    own = [key for key in ("qpos", "qvel") if key in agent] + sorted(agent.keys() - {"qpos", "qvel"})
    known = list(extra) if privileged else [key for key in STATE_KEYS if key in extra]
    parts = dict(_flat_parts({key: agent[key] for key in own}, "agent/"))
    parts.update(_flat_parts({key: extra[key] for key in known}, ""))
    return parts


def _flat_parts(tree: Mapping[str, Any], prefix: str) -> Iterator[tuple[str, np.ndarray]]:
    for key, value in tree.items():
        if isinstance(value, Mapping):
            yield from _flat_parts(value, f"{prefix}{key}/")
        else:
            yield prefix + key, np.asarray(value, dtype=np.float32).reshape(len(value), -1)


def join_parts(parts: Mapping[str, np.ndarray], n_envs: int) -> np.ndarray:
    """
    :param parts: see :func:`state_parts`
    :param n_envs: N, for the case that there are no parts
    :return: shape ``(N, state_dim)``, float32
    """
    return np.concatenate([*parts.values(), np.zeros((n_envs, 0), dtype=np.float32)], axis=1)


def layout(parts: Mapping[str, np.ndarray]) -> dict[str, slice]:
    """
    :param parts: see :func:`state_parts`
    :return: where in the vector of :func:`join_parts` each part is
    """
    ends = np.cumsum([part.shape[1] for part in parts.values()]).tolist()
    return {key: slice(end - part.shape[1], end) for (key, part), end in zip(parts.items(), ends, strict=True)}


# ---------------------------------------------------------------------- to the host
def to_host(tree: Mapping[str, Any], rows: th.Tensor | None = None) -> dict[str, Any]:
    """
    Copy a tree of tensors to NumPy arrays. What is on a GPU travels in one block: every separate copy would wait for the
    device once more. The arrays never share memory with the simulator, which reuses its own.

    :param tree: nested dicts of tensors, arrays or numbers, first axis N
    :param rows: only these environments
    :return: the same tree of NumPy arrays
    """
    leaves: dict[tuple[str, ...], th.Tensor] = {}
    _collect(tree, (), leaves, rows)
    result: dict[str, Any] = _skeleton(tree)
    for path, leaf in leaves.items():
        if _on_host(leaf):
            _put(result, path, leaf.numpy().copy())
    remote = {path: leaf for path, leaf in leaves.items() if not _on_host(leaf)}
    if remote:
        # the widest type first, so that every part of the block begins at a multiple of its own item size
        paths = sorted(remote, key=lambda path: -remote[path].element_size())
        block = th.cat([remote[path].contiguous().reshape(-1).view(th.uint8) for path in paths]).cpu().numpy()
        start = 0
        for path in paths:
            leaf = remote[path]
            end = start + leaf.numel() * leaf.element_size()
            _put(result, path, block[start:end].view(_numpy_type(leaf.dtype)).reshape(leaf.shape))
            start = end
    return result


def _on_host(leaf: th.Tensor) -> bool:
    return leaf.device.type == "cpu"


def _put(tree: dict[str, Any], path: tuple[str, ...], value: np.ndarray) -> None:
    for key in path[:-1]:
        tree = tree[key]
    tree[path[-1]] = value


def _collect(tree: Mapping[str, Any], path: tuple[str, ...], leaves: dict[tuple[str, ...], th.Tensor], rows: Any) -> None:
    for key, value in tree.items():
        if isinstance(value, Mapping):
            _collect(value, (*path, key), leaves, rows)
        else:
            tensor = th.as_tensor(value)
            leaves[(*path, key)] = tensor if rows is None else tensor[rows.to(tensor.device)]


def _skeleton(tree: Mapping[str, Any]) -> dict[str, Any]:
    """The same nested dicts, keys in the same order."""
    return {key: _skeleton(value) if isinstance(value, Mapping) else None for key, value in tree.items()}


_NUMPY_TYPES: dict[th.dtype, Any] = {}


def _numpy_type(dtype: th.dtype) -> Any:
    if dtype not in _NUMPY_TYPES:
        _NUMPY_TYPES[dtype] = th.zeros(0, dtype=dtype).numpy().dtype
    return _NUMPY_TYPES[dtype]
