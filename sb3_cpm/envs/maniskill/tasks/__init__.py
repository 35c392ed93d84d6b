"""
Tasks of the report (section 5) that ManiSkill 3 lacks, after the definitions of ManiSkill 2 (version 0.5.3):

* ``LiftCube-v1`` (:mod:`sb3_cpm.envs.maniskill.tasks.lift_cube`), of the original PPO tutorial
* ``PickSingleEGAD-v1`` (:mod:`sb3_cpm.envs.maniskill.tasks.pick_single_egad`)
* ``TurnFaucetDense-v1`` (:mod:`sb3_cpm.envs.maniskill.tasks.turn_faucet`): TurnFaucet-v1 with the dense reward that it lost

They are ordinary ManiSkill tasks, batched, and ``gym.make`` finds them once :func:`register_report_tasks` was called, which
:func:`sb3_cpm.envs.make_maniskill_env` does.
"""

REPORT_TASKS = (
    "PickCube-v1",
    "StackCube-v1",
    "PickSingleYCB-v1",
    "PickSingleEGAD-v1",
    "TurnFaucet-v1",
    "OpenCabinetDrawer-v1",
    "OpenCabinetDoor-v1",
    "LiftCube-v1",
)
"""The tasks that the report shows (its OpenCabinet is the one with doors; drawers are the easier of the two)."""

DENSE = {"TurnFaucet-v1": "TurnFaucetDense-v1"}
"""Tasks that have their dense rewards under another name."""


def register_report_tasks() -> None:
    """
    Make the tasks known to ManiSkill and gymnasium. Can be repeated.

    :raises ImportError: if ManiSkill is not installed
    """
    # importing registers, like ManiSkill's own tasks; each module once in a process
    from sb3_cpm.envs.maniskill.tasks import lift_cube, pick_single_egad, turn_faucet  # noqa: F401


def knows_task(name: str) -> bool:
    """:return: whether there is a task of that name, of ManiSkill's or ours"""
    import mani_skill.envs  # noqa: F401  # registers them
    from mani_skill.utils.registration import REGISTERED_ENVS

    register_report_tasks()
    return name in REGISTERED_ENVS


def registered_name(env_id: str, reward_mode: str) -> str:
    """
    :param env_id: the task that is asked for
    :param reward_mode: the kind of reward that is asked for
    :return: name of the task that has this reward, ``env_id`` itself for nearly all
    """
    return DENSE.get(env_id, env_id) if "dense" in reward_mode else env_id
