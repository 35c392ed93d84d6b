"""
Our PickCube-v1 beside ManiSkill's own, in one run: steps per second, start-up, overhead, memory, price of point clouds.

::

    OMP_NUM_THREADS=1 python benchmarks/envs.py                     # about 3 minutes
    OMP_NUM_THREADS=1 python benchmarks/envs.py --memory 20000      # and memory over so many steps (5 minutes more)

Both show two cameras of 32 x 32 and a cloud, from the same robot. Every contestant lives in a process of its own and they take
turns, so that what else the machine does disturbs all alike; numbers are medians over the turns. Wall times say how fast it
is, CPU times compare better on a busy machine. Prints markdown tables; exits with 1 if a target is missed.
"""

import argparse
import multiprocessing as mp
import os
import pickle
import resource
import statistics
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

EPISODE = 50
ENV_ID = "PickCube-v1"


# ---------------------------------------------------------------------- contestants, in their own processes
def make_stock() -> Any:
    """ManiSkill as its users make it, with the same robot, cameras and observations; images of 32 x 32."""
    import gymnasium as gym
    import mani_skill.envs  # noqa: F401

    return gym.make(
        ENV_ID,
        num_envs=1,
        obs_mode="rgb+pointcloud",
        robot_uids="panda_wristcam",
        control_mode="pd_ee_delta_pose",
        sensor_configs={"height": 32, "width": 32},
        render_mode=None,
    )


def make_ours() -> Any:
    from sb3_cpm.envs import make_maniskill_env

    return make_maniskill_env(ENV_ID)


def make_two() -> Any:
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.vec_env import SubprocVecEnv

    from sb3_cpm.envs import make_maniskill_env

    return make_vec_env(make_maniskill_env, 2, env_kwargs={"env_id": ENV_ID}, vec_env_cls=SubprocVecEnv)  # type: ignore[arg-type]


CONTESTANTS: dict[str, Callable[[], Any]] = {"stock": make_stock, "ours": make_ours, "two": make_two}


def serve(remote: Connection, name: str) -> None:
    """
    Make an environment, say what that cost, then step on demand.

    :param remote: number of steps in, a dict of measurements out; None ends it
    :param name: of :data:`CONTESTANTS`
    """
    import torch

    torch.set_num_threads(1)
    import mani_skill.envs  # noqa: F401  (not part of what making an environment costs)

    import sb3_cpm.envs  # noqa: F401

    start = time.process_time(), time.perf_counter()
    env = CONTESTANTS[name]()
    env.reset() if name == "two" else env.reset(seed=0)
    remote.send({"cpu": time.process_time() - start[0], "wall": time.perf_counter() - start[1]})
    inside = [0.0]
    if name != "two":
        _time_inside(env.unwrapped, inside)
    actions = np.random.default_rng(0).uniform(-1, 1, (EPISODE, 2, 7)).astype(np.float32)
    done = 0
    while (n_steps := remote.recv()) is not None:
        inside[0] = 0.0
        start = time.process_time(), time.perf_counter()
        for _ in range(n_steps):
            env.step(actions[done % EPISODE] if name == "two" else actions[done % EPISODE, 0])
            done += 1
            if done % EPISODE == 0 and name != "two":
                env.reset()
        remote.send(
            {
                "cpu": (time.process_time() - start[0]) / n_steps,
                "wall": (time.perf_counter() - start[1]) / n_steps,
                "inside": inside[0] / n_steps,
                "rss": _resident(),
            }
        )
    env.close()


def _time_inside(unwrapped: Any, total: list[float]) -> None:
    """Let ManiSkill's own ``step`` and ``reset`` add their CPU seconds to ``total``."""
    for name in ("step", "reset"):
        original = getattr(unwrapped, name)

        def timed(*args: Any, original: Callable = original, **kwargs: Any) -> Any:
            start = time.process_time()
            result = original(*args, **kwargs)
            total[0] += time.process_time() - start
            return result

        setattr(unwrapped, name, timed)


def _resident() -> float:
    """Resident memory of this process, MB."""
    try:
        with open("/proc/self/statm") as file:
            return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6
    except OSError:  # no Linux: the most that it ever was
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3


@contextmanager
def contestant(name: str) -> Iterator[tuple[Connection, dict[str, float]]]:
    """:return: the process's end of the pipe, and what its start cost"""
    context = mp.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=serve, args=(theirs, name))
    process.start()
    theirs.close()
    try:
        yield ours, ours.recv()
        ours.send(None)
        process.join(timeout=20)
    finally:
        process.kill()
        process.join()


# ---------------------------------------------------------------------- measures
def measure_starts(rounds: int) -> dict[str, dict[str, float]]:
    results: dict[str, list[dict[str, float]]] = {"stock": [], "ours": []}
    for _ in range(rounds):
        for name, found in results.items():
            with contestant(name) as (_, start):
                found.append(start)
    return {name: _medians(found) for name, found in results.items()}


def measure_steps(rounds: int, n_steps: int) -> dict[str, dict[str, float]]:
    """Stock is given fewer steps per turn, since it takes so long."""
    turns = {"stock": max(n_steps // 10, 5), "ours": n_steps, "two": n_steps}
    results: dict[str, list[dict[str, float]]] = {name: [] for name in turns}
    with contestant("stock") as (stock, _), contestant("ours") as (ours, _), contestant("two") as (two, _):
        for turn in range(rounds + 1):
            for (name, steps), remote in zip(turns.items(), (stock, ours, two), strict=True):
                remote.send(steps)
                measured = remote.recv()
                if turn:  # the first turn warms up
                    results[name].append(measured)
    return {name: _medians(found) for name, found in results.items()}


def measure_memory(n_steps: int) -> list[float]:
    """:return: resident memory (MB) of one process, at the start (after 1000 steps) and 20 times until the end"""
    with contestant("ours") as (remote, _):
        sizes = []
        for steps in [1000] + [max((n_steps - 1000) // 20, 1)] * 20:
            remote.send(steps)
            sizes.append(remote.recv()["rss"])
    return sizes


def measure_clouds(repeats: int) -> list[tuple[str, float, float]]:
    """:return: what is asked for, points before, milliseconds per step"""
    import torch

    torch.set_num_threads(1)
    from sb3_cpm.envs import make_maniskill_env
    from sb3_cpm.envs.maniskill import clouds
    from sb3_cpm.envs.maniskill import observations as obs_tools

    results = []
    for size in (32, 128):
        env = make_maniskill_env(ENV_ID, image_size=size)
        env.reset(seed=0)
        batch = env.batch
        unwrapped: Any = env.unwrapped
        host = obs_tools.to_host(batch._select(unwrapped._last_obs))
        pictures = [clouds.Picture(**host[f"camera {name}"]) for name in batch.cameras]
        points, _ = clouds.scene_points(pictures, batch._labels, 3.0)
        pose = unwrapped.agent.tcp.pose.raw_pose.numpy()
        for settings in (
            clouds.CloudSettings(),
            clouds.CloudSettings(frame="end_effector", labels=True),
            clouds.CloudSettings(n_points=128),
            clouds.CloudSettings(n_points=128, sampling="farthest"),
            clouds.CloudSettings(sampling="farthest"),
        ):
            frame = None if settings.frame == "world" else pose
            goal = obs_tools.find_goal(host["extra"])
            make = partial(clouds.make_clouds, settings, pictures, batch._labels, goal, pose[:, :3], frame, _generator)
            what = f"{size} x {size}, {settings.sampling} {settings.n_points}"
            what += f", {settings.frame} frame and labels" if settings.labels else ""
            results.append((what, float(len(points)), 1e3 * _cpu(make, repeats)))
        if size == 32:
            observation = env.step(np.zeros(7))[0]
            round_trip = _cpu(lambda seen=observation: pickle.loads(pickle.dumps(seen, pickle.HIGHEST_PROTOCOL)), repeats)
            results.append(("(the observation pickled and back)", float(len(points)), 1e3 * round_trip))
        env.close()
    return results


def _generator(i: int) -> np.random.Generator:
    return np.random.default_rng([i, 0])


def _cpu(function: Callable[[], Any], repeats: int) -> float:
    """Median CPU seconds of a call, over turns of ten."""
    found = []
    for _ in range(repeats):
        start = time.process_time()
        for _ in range(10):
            function()
        found.append((time.process_time() - start) / 10)
    return statistics.median(found)


def _medians(found: list[dict[str, float]]) -> dict[str, float]:
    return {key: statistics.median(one[key] for one in found) for key in found[0]}


# ---------------------------------------------------------------------- report
def _at_least(target: float, what: str, mine: float, other: float, ratio: float | None = None) -> bool:
    ratio = mine / other if ratio is None else ratio
    verdict = "met" if ratio >= target else "MISSED"
    print(f"| {what} | {mine:.2f} | {other:.2f} | {ratio:.1f} | {target} | {verdict} |")
    return ratio >= target


def _at_most(target: float, what: str, mine: float, other: float, share: float) -> bool:
    verdict = "met" if share <= target else "MISSED"
    print(f"| {what} | {mine:.2f} | {other:.2f} | {share:.1%} | {target:.0%} | {verdict} |")
    return share <= target


def main() -> int:
    """:return: exit status, 1 if a target is missed"""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=8, help="turns of each contestant")
    parser.add_argument("--steps", type=int, default=100, help="steps per turn (stock ManiSkill: a tenth)")
    parser.add_argument("--starts", type=int, default=2, help="how often an environment is made")
    parser.add_argument("--memory", type=int, default=2500, help="steps over which memory is watched, 20000 for the target")
    options = parser.parse_args()

    steps = measure_steps(options.rounds, options.steps)
    starts = measure_starts(options.starts)
    sizes = measure_memory(options.memory)
    clouds = measure_clouds(20)

    stock, ours, two = (steps[name] for name in ("stock", "ours", "two"))
    start, stock_start = starts["ours"]["cpu"], starts["stock"]["cpu"]
    added, inside = ours["cpu"] - ours["inside"], 1e3 * ours["inside"]
    drift = max(abs(size / sizes[0] - 1) for size in sizes)
    print(f"{ENV_ID}, two cameras of 32 x 32 and a cloud; medians over {options.rounds} turns\n")
    print("| measure | ours | against | ratio | target | |\n| --- | --- | --- | --- | --- | --- |")
    met = [
        _at_least(15, "steps/s, 1 process, against stock (wall)", 1 / ours["wall"], 1 / stock["wall"]),
        _at_least(1.6, "env-steps/s, 2 processes against 1 (wall)", 2 / two["wall"], 1 / ours["wall"]),
        _at_least(5, "make + first reset, against stock (CPU s)", start, stock_start, stock_start / start),
        _at_most(0.15, "wrapper overhead on ManiSkill's own step (CPU ms)", 1e3 * added, inside, 1e3 * added / inside),
        _at_most(0.05, f"memory over {options.memory} steps: most against first (MB)", max(sizes), sizes[0], drift),
    ]
    mine, other = 1e3 * ours["cpu"], 1e3 * stock["cpu"]
    print(f"| a step, against stock (CPU ms) | {mine:.2f} | {other:.2f} | {other / mine:.1f} | | |")
    print(f"| an env-step of 2 processes costs their parent (CPU ms) | {500 * two['cpu']:.2f} | | | | |")

    print("\n| cloud of one step | points seen | CPU ms |\n| --- | --- | --- |")
    for what, points, milliseconds in clouds:
        print(f"| {what} | {points:.0f} | {milliseconds:.2f} |")
    return int(not all(met))


if __name__ == "__main__":
    sys.exit(main())
