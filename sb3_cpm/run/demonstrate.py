"""Demonstrations of a task's scripted expert in a file: what ``python -m sb3_cpm demonstrate`` does."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from sb3_cpm.agents import load_agent
from sb3_cpm.agents.tasks import imported_task
from sb3_cpm.arguments import check_each, integer
from sb3_cpm.buffers.demonstrations import write_demonstrations
from sb3_cpm.imitation import record_demonstrations
from sb3_cpm.seeds import check_seed


def demonstrate(
    env: str,
    episodes: int = 200,
    agent: str = "bc_ppo",
    output: str | Path | None = None,
    seed: int = 0,
    n_envs: int = 1,
    hold: bool = False,
    overwrite: bool = False,
    env_kwargs: Mapping[str, Any] | None = None,
    progress_bar: bool = False,
    tell: Callable[[str], None] = lambda news: None,
) -> Path:
    """
    Record what an agent's training will see: its cameras, cloud and state, its controller, its wrappers.

    :param env: a task, as for :func:`~sb3_cpm.run.train`
    :param episodes: with a success; others are left out
    :param agent: the name of a file in ``zoo_configs/``, or the path of one, which says how the task is made
    :param output: the ``.h5`` file, beside which a ``.json`` is written; None: named after task and number, in ``demos/``
    :param seed: of the environments
    :param n_envs: parallel environments, in processes of their own when more than one
    :param hold: go on to the end of each episode, holding what was reached
    :param overwrite: replace a file that is there
    :param env_kwargs: arguments of the environment, on top of the agent's
    :param progress_bar: show one
    :param tell: is given a line at the end
    :return: the file
    :raises ValueError: for unknown tasks and agents, tasks without an expert, and a file that is there
    :raises RuntimeError: if the expert fails too often
    """
    check_each(integer(1), episodes=episodes, n_envs=n_envs)
    env_id = imported_task(env)
    path = Path(output) if output is not None else Path("demos") / f"{env_id.replace('/', '-')}-{episodes}.h5"
    if path.suffix != ".h5":
        raise ValueError(f"output={str(path)!r}: demonstrations are written as ManiSkill's are, so its name ends with .h5.")
    if path.exists() and not overwrite:
        raise ValueError(f"{path} is there already: choose another --output, or replace it with --overwrite.")
    check_seed(seed, n_envs)
    loaded = load_agent(agent, env_id, {"env_kwargs": dict(env_kwargs)} if env_kwargs else None)
    built = loaded.build(seed, n_envs=n_envs, device="cpu", vec_env_type="robust" if n_envs > 1 else "dummy")
    outcomes: list[bool] = []
    try:
        found = record_demonstrations(built.env, episodes, seed, hold, progress_bar, outcomes)
        control_mode = built.env.get_attr("control_mode")[0] if built.env.has_attr("control_mode") else None
    finally:
        built.env.close()
    path.parent.mkdir(parents=True, exist_ok=True)
    write_demonstrations(path, found, env_id, loaded.hyperparameters.get("env_kwargs") or {}, control_mode)
    steps = sum(len(one.rewards) for one in found)
    tell(
        f"{len(found)} demonstrations of {env_id}, {steps} transitions, in {path}. The expert succeeded in {sum(outcomes)} of "
        f"{len(outcomes)} episodes."
    )
    return path
