"""
Starting an episode from a stored state (report, appendix A.1: a challenge may say where it starts).

What a simulation must be given to go on as it did: the episode's seed (it rules what is not part of the simulator's state: the
geometry of tasks that build a new scene per episode, fields like TurnFaucet's target), the simulator's state, what the
controller remembers (without the target pose of ``pd_ee_target_delta_pose`` the arm goes elsewhere), the step counter, what
the gripper feels, which the simulator only knows again after the next step, and which things are asleep.

PhysX puts a thing that hardly moves to sleep: it stays exactly where it is until it is touched. Giving it a pose wakes it, and
a ball that slept on one of its corners rolls over, though nobody touched it. So what slept is put to sleep again.

The same actions then give the same trajectory up to small numbers: measured on PickCube, 25 actions, rewards within 1e-5 and
observations within 1e-4. Three things PhysX does not give away: the solver's warm start, contacts, and how soon a thing that
is awake will sleep. While the arm presses against something fixed, or a thing is about to topple, trajectories part sooner.
"""

from collections.abc import Iterator, Mapping
from typing import Any, TypedDict

import numpy as np
import torch as th


class StartState(TypedDict):
    """
    Plain data, about 2 kB pickled: it can be sent to another process or saved.

    :param env_id: the task that it belongs to
    :param seed: of the episode
    :param elapsed_steps: of the episode
    :param simulation: ManiSkill's state dict with arrays of shape ``(size,)``
    :param controller: nested dict of arrays of what the controller remembers; empty for most
    :param grasps: what the gripper feels, by the name that the task gives it
    :param asleep: names of the things that PhysX let sleep
    """

    env_id: str
    seed: int
    elapsed_steps: int
    simulation: dict[str, Any]
    controller: dict[str, Any]
    grasps: dict[str, bool]
    asleep: tuple[str, ...]


def state_of(env: Any, i: int, env_id: str, seed: int, grasps: dict[str, bool]) -> StartState:
    """
    :param env: the unwrapped ManiSkill environment
    :param i: index of the environment
    :param env_id: its task
    :param seed: of its episode
    :param grasps: what the gripper feels
    """
    simulation = _row(env.get_state_dict(), i)
    controller = simulation.pop("controller", {})
    return StartState(
        env_id=env_id,
        seed=seed,
        elapsed_steps=int(env._elapsed_steps[i]),
        simulation=simulation,
        controller=controller,
        grasps=grasps,
        asleep=tuple(name for name, body in _things(env) if body.is_sleeping),
    )


def check_state(state: Any, env_id: str) -> StartState:
    """
    :return: the state
    :raises ValueError: if it is none, or of another task
    """
    if not isinstance(state, Mapping) or not StartState.__required_keys__ <= state.keys():
        raise ValueError(f"A start state is what get_state() returned, got {type(state).__name__}: {str(state)[:80]}")
    if state["env_id"] != env_id:
        raise ValueError(f"This state is of {state['env_id']}, it cannot start an episode of {env_id}.")
    return state  # type: ignore[return-value]


def restore(env: Any, states: Mapping[int, StartState]) -> None:
    """
    Put environments that have just been reset with the states' seeds into these states.

    :param env: the unwrapped ManiSkill environment
    :param states: by index of the environment, ascending
    """
    rows = th.as_tensor(list(states), device=env.device)
    try:
        env.set_state_dict(_stack([state["simulation"] for state in states.values()], env.device), rows)
    except (KeyError, RuntimeError) as error:
        raise ValueError(
            f"This state does not fit the scene ({error}): the task must be made with the same robot and arguments as the one "
            "that it was taken from."
        ) from error
    # `set_state_dict` restores this mask to "all", and controllers look at it
    mask = th.zeros_like(env.scene._reset_mask)
    mask[rows] = True
    env.scene._reset_mask, everyone = mask, env.scene._reset_mask
    env.agent.controller.reset()
    env.scene._reset_mask = everyone
    remembered = env.agent.get_controller_state()
    if any(state["controller"] for state in states.values()):
        theirs = _stack([state["controller"] for state in states.values()], env.device)
        # controllers take the state of all environments or none
        env.agent.set_controller_state(_merged(remembered, theirs, rows))
    env._elapsed_steps[rows] = th.as_tensor(
        [state["elapsed_steps"] for state in states.values()], dtype=env._elapsed_steps.dtype, device=env.device
    )
    for name, body in _things(env):
        if name in states[0]["asleep"]:
            body.put_to_sleep()


def _things(env: Any) -> Iterator[tuple[str, Any]]:
    """Name and PhysX's body of all things that can sleep; none on a GPU, whose simulation does not say who sleeps."""
    if not env.scene.gpu_sim_enabled:
        for name, actor in env.scene.state_dict_registry.actors.items():
            if actor.px_body_type == "dynamic":
                yield name, actor._bodies[0]


def _row(tree: Any, i: int) -> Any:
    if isinstance(tree, Mapping):
        return {key: _row(value, i) for key, value in tree.items()}
    return np.array(tree[i].cpu().numpy())


def _stack(trees: list[Any], device: th.device) -> Any:
    if isinstance(trees[0], Mapping):
        return {key: _stack([tree[key] for tree in trees], device) for key in trees[0]}
    return th.as_tensor(np.stack(trees), device=device)


def _merged(everyone: Any, some: Any, rows: th.Tensor) -> Any:
    if isinstance(everyone, Mapping):
        return {key: _merged(value, some[key], rows) if key in some else value for key, value in everyone.items()}
    merged = everyone.clone()
    merged[rows] = some.to(merged.dtype)
    return merged
