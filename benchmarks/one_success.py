"""
Does the player learn from a goal that was found once? On PointMaze_Medium-v3, from the same start to the farthest corner.

::

    OMP_NUM_THREADS=1 python benchmarks/one_success.py --policy MultiInputPolicy --gamma 0.98 0.995 --copies 1 20

25 episodes of pink noise (two of which meet the goal) and one that a controller drives there are put into a buffer, and SAC
learns from it for 7,500 updates without acting. Then, along the driven episode: the critics' smaller value of what was done
there, so many steps before the goal, beside gamma to the power of the steps, which it should be; the cosine between the
policy's actions and those that led to the goal; and whether the policy gets there. ``--copies`` puts the driven episode in
several times.
About a minute per row.
"""

import argparse
from collections import deque
from collections.abc import Callable

import gymnasium as gym
import gymnasium_robotics
import numpy as np
import torch as th
from gymnasium import spaces
from pink import PinkActionNoise
from stable_baselines3 import SAC
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_cpm.agents.algorithms import NAMES
from sb3_cpm.buffers import CPMBuffer

START, LIMIT, N_UPDATES, BATCH = (1, 1), 600, 7500, 128
BEFORE_GOAL = (1, 10, 30, 100, 400)
Policy = Callable[[np.ndarray], np.ndarray]
Transition = tuple[np.ndarray, np.ndarray, np.ndarray, float, bool, bool]  # state, next, action, reward, ended, cut off


class Maze(gym.Wrapper):
    """The maze with position and velocity as observation, one start and one goal."""

    def __init__(self) -> None:
        gym.register_envs(gymnasium_robotics)
        super().__init__(gym.make("PointMaze_Medium-v3", continuing_task=False, max_episode_steps=LIMIT))
        self.observation_space = spaces.Dict({"observation": spaces.Box(-np.inf, np.inf, (4,), np.float32)})
        self.path = self._longest_path()

    def _longest_path(self) -> list[tuple[int, int]]:
        """Cells from the start to the one farthest from it."""
        grid, before, queue = self.unwrapped.maze.maze_map, {START: START}, deque([START])
        while queue:
            cell = queue.popleft()
            for step in ((1, 0), (-1, 0), (0, 1), (0, -1)):
                there = (cell[0] + step[0], cell[1] + step[1])
                if grid[there[0]][there[1]] != 1 and there not in before:
                    before[there] = cell
                    queue.append(there)
        path = [list(before)[-1]]  # the last one that a search by breadth meets
        while path[-1] != START:
            path.append(before[path[-1]])
        return path[::-1]

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        ends = {"reset_cell": np.array(self.path[0]), "goal_cell": np.array(self.path[-1])}
        observation, info = self.env.reset(seed=seed, options=ends)
        return {"observation": observation["observation"].astype(np.float32)}, info

    def step(self, action: np.ndarray):
        observation, reward, *rest = self.env.step(action)
        return {"observation": observation["observation"].astype(np.float32)}, float(reward), *rest

    def driver(self) -> Policy:
        """:return: who goes from cell to cell along the path"""
        ahead = deque(self.unwrapped.maze.cell_rowcol_to_xy(np.array(cell)) for cell in self.path[1:])

        def act(state: np.ndarray) -> np.ndarray:
            if len(ahead) > 1 and np.linalg.norm(state[:2] - ahead[0]) < 0.25:
                ahead.popleft()
            return np.clip(4 * (ahead[0] - state[:2]) - state[2:], -1, 1).astype(np.float32)

        return act

    def play(self, policy: Policy, seed: int) -> list[Transition]:
        """:return: an episode"""
        state, transitions = self.reset(seed=seed)[0]["observation"], []
        while not transitions or not (transitions[-1][4] or transitions[-1][5]):
            action = policy(state)
            observation, reward, ended, cut_off, _ = self.step(action)
            transitions.append((state, observation["observation"], action, reward, ended, cut_off))
            state = observation["observation"]
        return transitions


def learn(policy: str, gamma: float, episodes: list[list[Transition]]) -> SAC:
    """:return: SAC after its updates"""
    model = SAC(
        NAMES.get(policy, policy), DummyVecEnv([Maze]), replay_buffer_class=CPMBuffer, buffer_size=40_000, batch_size=BATCH,
        replay_buffer_kwargs={"challenge_ratio": 0}, learning_rate=1e-3, gamma=gamma, tau=0.01, ent_coef="auto_0.1",
        policy_kwargs={"net_arch": [128, 128]}, seed=0, device="cpu",
    )  # fmt: skip
    for transition in (transition for episode in episodes for transition in episode):
        state, after, action, reward, ended, cut_off = transition
        told = [{"TimeLimit.truncated": cut_off and not ended}]
        done = np.array([ended or cut_off])
        model.replay_buffer.add({"observation": state[None]}, {"observation": after[None]}, action[None], reward, done, told)
    model.set_logger(configure(None, []))
    model._setup_learn(1)
    model.train(N_UPDATES, BATCH)
    return model


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--policy", nargs="+", default=["MultiInputPolicy"])
    parser.add_argument("--gamma", nargs="+", type=float, default=[0.98, 0.995])
    parser.add_argument("--copies", nargs="+", type=int, default=[1, 20])
    args = parser.parse_args()
    maze = Maze()
    driven, noisy = maze.play(maze.driver(), 0), []
    for seed in range(1, 26):
        noise = PinkActionNoise(1.0, LIMIT, 2, np.random.default_rng(seed))
        noisy.append(maze.play(lambda state, noise=noise: np.clip(noise(), -1, 1).astype(np.float32), seed))
    met = sum(episode[-1][4] for episode in noisy)
    print(
        f"{sum(map(len, noisy)):,} steps of noise, {met} of {len(noisy)} episodes meet the goal; driven there in {len(driven)}"
    )
    before = [steps for steps in BEFORE_GOAL if steps <= len(driven)]
    print(f"| policy | gamma | copies | Q (and should be) {', '.join(map(str, before))} steps before | cosine | gets there |")
    print("| --- | --- | --- | --- | --- | --- |")
    states, actions = (np.stack([transition[index] for transition in driven]) for index in (0, 2))
    for policy in args.policy:
        for gamma in args.gamma:
            for copies in args.copies:
                model = learn(policy, gamma, noisy + [driven] * copies)
                with th.no_grad():
                    rated = model.critic({"observation": th.as_tensor(states)}, th.as_tensor(actions))
                values = th.cat(rated, dim=1).min(dim=1).values.tolist()
                chosen = model.predict({"observation": states}, deterministic=True)[0]
                norms = np.linalg.norm(chosen, axis=1) * np.linalg.norm(actions, axis=1)
                cosine = float(((chosen * actions).sum(axis=1) / (norms + 1e-6)).mean())
                last = maze.play(lambda state, m=model: m.predict({"observation": state}, deterministic=True)[0], 0)[-1]
                row = ", ".join(f"{values[-steps]:.2f} ({gamma ** (steps - 1):.2f})" for steps in before)
                print(f"| {policy} | {gamma} | {copies} | {row} | {cosine:.2f} | {'yes' if last[4] else 'no'} |", flush=True)


if __name__ == "__main__":
    main()
