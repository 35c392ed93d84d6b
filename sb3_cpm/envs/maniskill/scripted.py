"""
A scripted controller that solves PickCube-v1 every time, as a source of demonstrations that needs no motion planner.

::

    python -m sb3_cpm.envs.maniskill.scripted demos/pickcube --episodes 20

writes ``demos/pickcube/*.h5`` and ``.json`` as ManiSkill's own tools do, for
:meth:`CPMBuffer.add_demonstrations <sb3_cpm.buffers.CPMBuffer.add_demonstrations>`.
"""

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from sb3_cpm.envs.maniskill.checks import choose_renderer

#: Metres of motion that an action of 1 asks for (pd_ee_delta_pose and pd_ee_delta_pos)
REACH = 0.1
OPEN, CLOSED = 1.0, -1.0


class PickCubeController:
    """
    Above the cube, down, close, and to the goal; each step is proportional to what is left.

    :param env: PickCube-v1 with an end-effector controller (``pd_ee_delta_pose`` or ``pd_ee_delta_pos``), gymnasium
    """

    def __init__(self, env: Any):
        self.task = env.unwrapped
        self.n_rotations = env.action_space.shape[-1] - 4
        self.reset()

    def reset(self) -> None:
        """A new episode begins."""
        self.above, self.closing = False, 0

    def act(self) -> np.ndarray:
        """:return: the next action, shape ``(7,)`` or ``(4,)``"""
        hand, cube, goal = (
            np.asarray(pose.p.cpu()).reshape(-1, 3)[0]
            for pose in (self.task.agent.tcp.pose, self.task.cube.pose, self.task.goal_site.pose)
        )
        if self.closing >= 2:
            target, gripper = hand + (goal - cube), CLOSED
        elif self.above and np.linalg.norm(hand - cube) < 0.012:
            self.closing += 1
            target, gripper = cube, CLOSED
        else:
            self.above = self.above or bool(np.linalg.norm(hand[:2] - cube[:2]) < 0.01)
            target, gripper = cube + np.array([0, 0, 0 if self.above else 0.08]), OPEN
        move = np.clip((target - hand) / REACH, -1, 1)
        return np.concatenate([move, np.zeros(self.n_rotations), [gripper]]).astype(np.float32)


def record(folder: str | Path, n_episodes: int = 10, seed: int = 0, **env_kwargs: Any) -> Path:
    """
    Record demonstrations of PickCube-v1.

    :param folder: where to write
    :param n_episodes: number of episodes, of which all succeed
    :param seed: seed of the first episode; the others count on from it
    :param env_kwargs: for ``gym.make``, for instance ``robot_uids`` and ``control_mode`` of the training environment
    :return: the ``.h5`` file
    :raises RuntimeError: if pictures are asked for and this machine has no renderer, with the cure
    """
    env_kwargs = {"obs_mode": "state", "control_mode": "pd_ee_delta_pose", "robot_uids": "panda_wristcam", **env_kwargs}
    if "render_backend" not in env_kwargs:  # before SAPIEN is imported: the renderer may be one of our own
        env_kwargs["render_backend"] = choose_renderer("PickCube-v1", env_kwargs["obs_mode"]).backend

    import gymnasium as gym
    import mani_skill.envs  # noqa: F401  # registers the tasks
    from mani_skill.utils.wrappers.record import RecordEpisode

    env = RecordEpisode(
        gym.make("PickCube-v1", sim_backend="physx_cpu", **env_kwargs),
        str(folder),
        trajectory_name="scripted",
        save_video=False,
        record_reward=True,
        source_type="scripted",
    )
    controller = PickCubeController(env)
    for number in range(n_episodes):
        env.reset(seed=seed + number)
        controller.reset()
        for _ in range(50):
            *_, info = env.step(controller.act())
            if bool(np.all(np.asarray(info["success"]))):
                break
        env.flush_trajectory()
    env.close()
    return Path(folder) / "scripted.h5"


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description="Record demonstrations of PickCube-v1 with a scripted controller.")
    parser.add_argument("folder")
    parser.add_argument("--episodes", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--control-mode", default="pd_ee_delta_pose")
    parser.add_argument("--robot", default="panda_wristcam")
    arguments = parser.parse_args()
    record(
        arguments.folder, arguments.episodes, arguments.seed, control_mode=arguments.control_mode, robot_uids=arguments.robot
    )


if __name__ == "__main__":
    main()
