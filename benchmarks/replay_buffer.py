"""
CPMBuffer beside SB3's buffers, in one run: time of ``sample`` and ``add``, bytes per transition, price of a challenge.

::

    OMP_NUM_THREADS=1 python benchmarks/replay_buffer.py             # everything, about 3 minutes, below 3 GB
    OMP_NUM_THREADS=1 python benchmarks/replay_buffer.py --sizes 10000 100000 --rounds 20

Times are CPU microseconds, medians over rounds in which the contestants take turns. A contestant that cannot be imported is
left out (``sb3-extra-buffers`` is on PyPI). Prints a markdown table; exits with 1 if a target is missed.
"""

import argparse
import contextlib
import io
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import DictReplayBuffer
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from sb3_cpm.buffers import CPMBuffer
from sb3_cpm.type_aliases import Evaluation

try:
    with contextlib.redirect_stdout(io.StringIO()):  # it prints which compression methods there are
        from sb3_extra_buffers.compressed import CompressedDictReplayBuffer
except ImportError:
    CompressedDictReplayBuffer = None

EPISODE = 50

GOAL_SPACE = spaces.Dict(
    {
        "observation": spaces.Box(-np.inf, np.inf, (25,), np.float32),
        "achieved_goal": spaces.Box(-np.inf, np.inf, (3,), np.float32),
        "desired_goal": spaces.Box(-np.inf, np.inf, (3,), np.float32),
    }
)


def pickcube(n_points: int) -> spaces.Dict:
    return spaces.Dict(
        {
            "base_camera": spaces.Box(0, 255, (32, 32, 3), np.uint8),
            "hand_camera": spaces.Box(0, 255, (32, 32, 3), np.uint8),
            "pointcloud": spaces.Box(-np.inf, np.inf, (n_points, 6), np.float32),
            "state": spaces.Box(-np.inf, np.inf, (29,), np.float32),
        }
    )


PICKCUBE_SPACE = pickcube(306)  # make_maniskill_env's default: 256 points of the scene, 50 of the goal
ACTION_SPACE = spaces.Box(-1, 1, (4,), np.float32)
COMPACT = {"pointcloud": ["float16"] * 3 + [("uint8", 0.0, 1.0)] * 3}
#: CPU milliseconds of one PickCube step with images and cloud (low-poly visuals, software rendering)
STEP_MS = 12.5


class GoalEnv:
    """What hindsight relabelling asks of an environment."""

    def env_method(self, name: str, achieved: np.ndarray, desired: np.ndarray, infos: Any, indices: Any) -> list[np.ndarray]:
        return [-(np.linalg.norm(achieved - desired, axis=-1) > 0.05).astype(np.float32)]


Result = tuple[str, str, str, str, bool | None]  # measure, contestants' values, ratio, target, met


class Playback:
    """Episodes of 50 steps of noise; the next observation of a step is the observation of the following one."""

    def __init__(self, space: spaces.Dict, n_envs: int, seed: int = 0):
        rng = np.random.default_rng(seed)
        self.observations = [
            {key: np.stack([_random(box, rng) for _ in range(n_envs)]) for key, box in space.spaces.items()} for _ in range(20)
        ]
        self.action = rng.uniform(-1, 1, (n_envs, *ACTION_SPACE.shape)).astype(np.float32)
        self.reward = np.zeros(n_envs, np.float32)
        self.done = [np.full(n_envs, step == EPISODE - 1) for step in range(EPISODE)]
        self.infos = [[{"TimeLimit.truncated": step == EPISODE - 1}] * n_envs for step in range(EPISODE)]

    def into(self, buffer: Any, n_steps: int) -> None:
        observations, action, reward = self.observations, self.action, self.reward
        for step in range(n_steps):
            now = step % EPISODE
            buffer.add(observations[step % 20], observations[(step + 1) % 20], action, reward, self.done[now], self.infos[now])


def fill(buffer: Any, n_transitions: int, space: spaces.Dict) -> None:
    Playback(space, buffer.n_envs).into(buffer, n_transitions // buffer.n_envs)


def _random(box: spaces.Space, rng: np.random.Generator) -> np.ndarray:
    assert isinstance(box, spaces.Box)
    if box.dtype == np.uint8:
        return rng.integers(0, 256, box.shape, dtype=np.uint8)
    return rng.random(box.shape, dtype=np.float32)


def alternate(contestants: dict[str, Callable[[], Any]], rounds: int, calls: int) -> dict[str, float]:
    """:return: median CPU microseconds per call, the contestants taking turns in every round"""
    times: dict[str, list[float]] = {name: [] for name in contestants}
    for round_ in range(-1, rounds):  # the first one warms up
        for name, call in contestants.items():
            start = time.process_time()
            for _ in range(calls):
                call()
            if round_ >= 0:
                times[name].append((time.process_time() - start) / calls * 1e6)
    return {name: float(np.median(values)) for name, values in times.items()}


def make(kind: str, size: int, space: spaces.Dict, n_envs: int = 1, **kwargs: Any) -> Any:
    common = dict(device="cpu", n_envs=n_envs)
    env: Any = GoalEnv()
    if kind == "Dict":
        return DictReplayBuffer(size, space, ACTION_SPACE, **common)
    if kind == "HER":
        return HerReplayBuffer(size, space, ACTION_SPACE, env=env, **{"n_sampled_goal": 4, **common, **kwargs})
    if kind == "CPM":
        return CPMBuffer(size, space, ACTION_SPACE, env=env, challenge_ratio=0, **{**common, **kwargs})
    if kind == "compact":
        return make("CPM", size, space, n_envs, storage_dtypes=COMPACT)
    if kind == "CPM+HER":
        return CPMBuffer(size, space, ACTION_SPACE, env=env, challenge_ratio=0, n_sampled_goal=4, **common)
    assert kind == "extra"
    with contextlib.redirect_stdout(io.StringIO()):  # it prints its configuration
        return CompressedDictReplayBuffer(
            size, space, ACTION_SPACE, dtypes=dict(elem_type=np.uint8, runs_type=np.uint8), compression_method="gzip", **common
        )


def sampling(sizes: Sequence[int], rounds: int) -> list[Result]:
    results: list[Result] = []
    for size in sizes:
        buffers = {kind: make(kind, size, GOAL_SPACE) for kind in ("Dict", "CPM", "HER", "CPM+HER")}
        buffers["HER, n_sampled_goal=0"] = make("HER", size, GOAL_SPACE, n_sampled_goal=0)
        for buffer in buffers.values():
            fill(buffer, size, GOAL_SPACE)
        times = alternate({kind: lambda b=b: b.sample(256) for kind, b in buffers.items()}, rounds, 20)
        against_her = 0.1 if size >= 1_000_000 else None
        results += [
            _row(f"sample(256), {size:,} transitions, µs", times, "CPM", "Dict", at_most=1.1),
            _row("the same, against HER as it comes (n_sampled_goal=4), µs", times, "CPM", "HER", at_most=against_her),
            _row("n_sampled_goal=0 in both, µs", times, "CPM", "HER, n_sampled_goal=0"),
            _row("n_sampled_goal=4 in both, µs", times, "CPM+HER", "HER"),
        ]
    return results


def sampling_images(rounds: int) -> list[Result]:
    kinds = ["Dict", "CPM", "compact"] + (["extra"] if CompressedDictReplayBuffer else [])
    images = spaces.Dict({"base_camera": PICKCUBE_SPACE["base_camera"], "hand_camera": PICKCUBE_SPACE["hand_camera"]})
    buffers = {kind: make(kind, 5000, PICKCUBE_SPACE) for kind in kinds if kind != "extra"}
    for buffer in buffers.values():
        fill(buffer, 5000, PICKCUBE_SPACE)
    times = alternate({kind: lambda b=b: b.sample(256) for kind, b in buffers.items()}, rounds, 3)
    results = [
        _row("sample(256), PickCube image + cloud + state, µs", times, "CPM", "Dict", at_most=1.1),
        _row("the same, compact cloud, µs", times, "compact", "Dict"),
    ]
    if "extra" in kinds:  # it casts everything to one dtype: images only
        buffers = {kind: make(kind, 2000, images) for kind in ("CPM", "extra")}
        for buffer in buffers.values():
            fill(buffer, 2000, images)
        times = alternate({kind: lambda b=b: b.sample(256) for kind, b in buffers.items()}, max(rounds // 4, 3), 1)
        results.append(_row("sample(256), images only, sb3-extra-buffers gzip, µs", times, "CPM", "extra"))
    return results


def adding(rounds: int) -> list[Result]:
    results = []
    for name, space in (("goal environment", GOAL_SPACE), ("PickCube", PICKCUBE_SPACE)):
        for n_envs in (1, 8):
            kinds = ("HER", "CPM") if space is GOAL_SPACE else ("HER", "CPM", "compact")
            buffers = {kind: make(kind, 4000, space, n_envs) for kind in kinds}
            playback, steps = Playback(space, n_envs), 4 * EPISODE
            for buffer in buffers.values():
                playback.into(buffer, buffer.buffer_size)  # the system has given them their memory then
            calls = {kind: partial(playback.into, b, steps) for kind, b in buffers.items()}
            times = alternate(calls, rounds, 1)
            times = {kind: value / steps for kind, value in times.items()}
            results.append(_row(f"add, {name}, n_envs={n_envs}, µs per step", times, "CPM", "HER", at_most=1.0))
            if "compact" in times:
                results.append(_row("the same, compact cloud, µs per step", times, "compact", "HER"))
    return results


def memory() -> list[Result]:
    size, rows = 2000, []
    # what does not shrink are the images: the fewer points, the less compact clouds save
    for n_points, target in ((306, None), (1200, 0.30)):
        space, n_bytes = pickcube(n_points), {}
        for kind in ("Dict", "CPM", "compact"):
            buffer = make(kind, size, space)
            fill(buffer, size, space)
            n_bytes[kind] = _bytes(buffer) / size
        name = f"PickCube image + cloud ({n_points} points) + state"
        rows.append(_row(f"bytes per transition, {name}", n_bytes, "CPM", "Dict", at_most=0.52))
        rows.append(_row("the same, compact cloud (float16, colours uint8)", n_bytes, "compact", "Dict", at_most=target))
    if CompressedDictReplayBuffer:
        images = spaces.Dict({key: box for key, box in PICKCUBE_SPACE.spaces.items() if box.dtype == np.uint8})
        n_bytes = {}
        for kind in ("CPM", "extra"):
            buffer = make(kind, size, images)
            fill(buffer, size, images)
            n_bytes[kind] = _bytes(buffer) / size
        rows.append(
            _row("bytes per transition, images of noise (the worst case for compression), gzip", n_bytes, "CPM", "extra")
        )
    return rows


def _bytes(buffer: Any) -> int:
    if isinstance(buffer, CPMBuffer):
        return buffer.nbytes
    arrays = [*buffer.observations.values(), *buffer.next_observations.values()]
    arrays += [buffer.actions, buffer.rewards, buffer.dones, buffer.timeouts]
    inside = sum(sys.getsizeof(item) for array in arrays if array.dtype == object for item in array.flat)
    return inside + sum(array.nbytes for array in arrays)


def proposing(rounds: int) -> list[Result]:
    """A 200-step episode, evaluation given, against the environment steps that made it."""
    buffer = CPMBuffer(
        1000, GOAL_SPACE, ACTION_SPACE, device="cpu", filter_kwargs=dict(novelty_tolerance=1e5, relevance_tolerance=1e5)
    )
    buffer.attach_challenger()
    obs = {key: np.zeros((1, *box.shape), np.float32) for key, box in GOAL_SPACE.spaces.items()}  # type: ignore[misc]
    for step in range(200):
        buffer.add(obs, obs, np.zeros((1, 4)), np.ones(1), np.array([step == 199]), [{}])
    (episode,) = buffer.pop_completed()
    rng = np.random.default_rng(0)
    evaluation = Evaluation(rng.random(200), rng.random(200), rng.random((201, 1024), dtype=np.float32))
    times = alternate({"CPM": lambda: buffer.propose(episode, evaluation)}, rounds, 20)
    times["200 steps"] = 200 * STEP_MS * 1000
    return [
        _row(f"proposing a challenge against 200 PickCube steps of {STEP_MS} ms, µs", times, "CPM", "200 steps", at_most=0.01)
    ]


def telling(rounds: int) -> list[Result]:
    """A quarter of each batch from challenges, whose rows say which challenge they are of."""
    size, rng = 10_000, np.random.default_rng(0)
    told = spaces.Dict({**GOAL_SPACE.spaces, "challenge": spaces.Box(-np.inf, np.inf, (26,), np.float32)})
    kwargs = dict(device="cpu", mix="row", filter_kwargs=dict(novelty_tolerance=1e5, relevance_tolerance=1e5))
    buffers = {
        "Dict": make("Dict", size, told),
        "untold": CPMBuffer(size, GOAL_SPACE, ACTION_SPACE, **kwargs),
        "CPM": CPMBuffer(size, told, ACTION_SPACE, challenge_keys=["observation"], **kwargs),
    }
    for kind, buffer in buffers.items():
        if kind != "Dict":
            buffer.attach_challenger()
        fill(buffer, size, told)
        for episode in buffer.pop_completed() if kind != "Dict" else ():
            states = rng.random((EPISODE + 1, 64), dtype=np.float32)
            buffer.propose(episode, Evaluation(rng.random(EPISODE), rng.random(EPISODE), states))
    times = alternate({kind: lambda b=b: b.sample(256) for kind, b in buffers.items()}, rounds, 20)
    n_bytes = {kind: _bytes(buffer) / size for kind, buffer in buffers.items()}
    return [
        _row("sample(256), rows told their challenge, µs", times, "CPM", "Dict", at_most=1.5),
        _row("the same, against rows that are not told, µs", times, "CPM", "untold"),
        _row("bytes per transition, told and not", n_bytes, "CPM", "untold", at_most=1.0),
    ]


def _row(measure: str, values: dict[str, float], ours: str, theirs: str, at_most: float | None = None) -> Result:
    ratio = values[ours] / values[theirs]
    pair = f"{values[ours]:,.0f} | {values[theirs]:,.0f} ({theirs})"
    return (
        measure,
        pair,
        f"{ratio:.3f}",
        "" if at_most is None else f"≤ {at_most:g}",
        None if at_most is None else ratio <= at_most,
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("--sizes", type=int, nargs="+", default=[10_000, 100_000, 1_000_000])
    parser.add_argument("--rounds", type=int, default=30)
    parser.add_argument("--only", nargs="+", choices=["sample", "images", "add", "memory", "propose", "tell"], default=None)
    arguments = parser.parse_args()
    th.set_num_threads(1)
    parts: dict[str, Callable[[], list[Result]]] = {
        "sample": lambda: sampling(arguments.sizes, arguments.rounds),
        "images": lambda: sampling_images(arguments.rounds),
        "add": lambda: adding(arguments.rounds),
        "memory": memory,
        "propose": lambda: proposing(arguments.rounds),
        "tell": lambda: telling(arguments.rounds),
    }
    print("| measure | CPMBuffer | against | ratio | target | met |\n| --- | --- | --- | --- | --- | --- |")
    missed = 0
    for name, part in parts.items():
        if arguments.only is None or name in arguments.only:
            for measure, pair, ratio, target, met in part():
                print(
                    f"| {measure} | {pair} | {ratio} | {target} | {'' if met is None else 'yes' if met else 'NO'} |",
                    flush=True,
                )
                missed += met is False
    return int(missed > 0)


if __name__ == "__main__":
    sys.exit(main())
