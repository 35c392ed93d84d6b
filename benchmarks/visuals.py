"""
Light visuals against full ones: triangles, CPU milliseconds per step, how far the pictures differ, and whether the physics are
the same; and a picture of both (docs/light_visuals.png).

    python benchmarks/visuals.py --size 128 --tasks PickCube-v1 StackCube-v1:fetch --picture docs/light_visuals.png

Tasks that download their objects are measured on whatever MS_ASSET_DIR has, for instance on stand-ins
(tests/standin_assets.py).
"""

import argparse
import time
from typing import Any, NamedTuple

import numpy as np
import torch as th

from sb3_cpm.envs import ManiSkillEnv, make_maniskill_env

TASKS = ("PickCube-v1", "StackCube-v1:fetch")
"""Task, and robot if not the task's usual one. These two show both robots and download nothing."""


class Measured(NamedTuple):
    """
    One task with one kind of visuals.

    :param triangles: in the scene
    :param build: CPU seconds for make and first reset
    :param step: CPU milliseconds per step
    :param pictures: of the first and of every fifth step, shape ``(n, cameras, height, width, 3)``
    :param states: of the simulator at all steps, shape ``(n, state)``
    """

    triangles: int
    build: float
    step: float
    pictures: np.ndarray
    states: np.ndarray


def measure(task: str, visuals: str, size: int, n_steps: int) -> Measured:
    env_id, _, robot = task.partition(":")
    start = time.process_time()
    env = make_maniskill_env(env_id, robot_uids=robot or None, visuals=visuals, image_size=size)
    observation, _ = env.reset(seed=1)
    built = time.process_time()
    simulator: Any = env.unwrapped
    pictures, states, seconds = [_pictures(observation)], [simulator.get_state().numpy()], 0.0
    for i, action in enumerate(np.random.default_rng(0).uniform(-1, 1, (n_steps, *env.action_space.shape))):  # type: ignore
        before = time.process_time()
        observation, *_ = env.step(action)
        seconds += time.process_time() - before
        states.append(simulator.get_state().numpy().copy())
        if i % 5 == 4:
            pictures.append(_pictures(observation))
    triangles = count_triangles(env)
    env.close()
    return Measured(triangles, built - start, 1e3 * seconds / n_steps, np.stack(pictures), np.concatenate(states))


def count_triangles(env: ManiSkillEnv) -> int:
    bodies = env.unwrapped.scene.sub_scenes[0].render_system.render_bodies  # type: ignore
    shapes = [shape for body in bodies for shape in body.render_shapes]
    return sum(len(part.triangles) for shape in shapes for part in getattr(shape, "parts", []))


def _pictures(observation: dict[str, np.ndarray]) -> np.ndarray:
    return np.stack([value for value in observation.values() if value.dtype == np.uint8])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", default=list(TASKS))
    parser.add_argument("--size", type=int, default=128)
    parser.add_argument("--steps", type=int, default=50)
    parser.add_argument("--picture")
    options = parser.parse_args()
    th.set_num_threads(1)
    print(
        f"images of {options.size}x{options.size}; CPU time; difference: mean over all values, of 255, and share that is >16"
    )
    print(
        "| task | triangles full | light | make + reset full | light | step full | light | difference | >16 | same physics |"
    )
    print("| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |")
    rows = []
    for task in options.tasks:
        measure(task, "light", options.size, 1)  # so that the light meshes are in the cache
        full, light = (measure(task, visuals, options.size, options.steps) for visuals in ("full", "light"))
        difference = np.abs(full.pictures.astype(float) - light.pictures)
        same = np.array_equal(full.states, light.states)
        differs = f"{difference.mean():.2f} | {(difference > 16).mean():.1%}"
        print(
            f"| {task} | {full.triangles:,} | {light.triangles:,} | {full.build:.1f} s | {light.build:.1f} s "
            f"| {full.step:.1f} ms | {light.step:.1f} ms | {differs} | {same} |",
            flush=True,
        )
        rows.append(np.concatenate([np.concatenate(list(m.pictures[0]), axis=1) for m in (full, light)], axis=0))
    if options.picture:
        from PIL import Image

        gap = np.full((rows[0].shape[0], 8, 3), 255, dtype=np.uint8)
        Image.fromarray(np.concatenate([part for row in rows for part in (row, gap)][:-1], axis=1)).save(
            options.picture, optimize=True
        )


if __name__ == "__main__":
    main()
