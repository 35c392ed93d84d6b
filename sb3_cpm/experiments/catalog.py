"""
The experiments of the report, and the two that say most in little time, as data.

Contenders name files of ``zoo_configs/``. Quick versions run on ``CPMToy-v0``, which has a camera, a point cloud and a state
like the robot tasks but needs no renderer: they show that everything works and what the figures look like, not what is true.
Short versions run on the robot, for as long as two cores can bear, and on tasks whose files ManiSkill brings along.
"""

from dataclasses import replace
from typing import Any

from sb3_cpm.arguments import nearest
from sb3_cpm.experiments.specification import Contender, Experiment, Plan, Task
from sb3_cpm.presets import CHALLENGES


def challenger(**kwargs: Any) -> dict[str, Any]:
    """Overrides of the arguments of ``ChallengerCallback``."""
    return {"callback": {"sb3_cpm.ChallengerCallback": kwargs}}


PICKCUBE = Task("PickCube-v1", "CPM/PickCube-v1")
VISUAL = tuple(
    Task(name, f"CPM/{name}")
    for name in ("PickCube-v1", "PickSingleEGAD-v1", "PickSingleYCB-v1", "StackCube-v1", "TurnFaucet-v1")
)
TOY, REACH, MOUNTAINCAR, POINTMAZE = (
    Task(name, name) for name in ("CPMToy-v0", "CPMReach-v0", "MountainCarContinuous-v0", "PointMaze_UMaze-v3")
)
#: The player of the experiments with state vectors: half an update per step as in ManiSkill's example, smaller networks.
STATE = {"sac": {"policy_kwargs": {"net_arch": [128, 128]}, "batch_size": 128, "train_freq": 2, "gradient_steps": 1}}
#: Everything smaller, for the quick versions.
SMALL: dict[str, dict[str, Any]] = {
    "sac": {"learning_starts": 200, "batch_size": 64, "buffer_size": 5000, "train_freq": 4, "gradient_steps": 1},
    "ppo": {"n_envs": 2, "n_steps": 250, "batch_size": 50, "n_epochs": 3},
    "dreamer": {"learning_starts": 200, "buffer_size": 5000, "train_freq": 25},
    "plan2explore": {"learning_starts": 200, "buffer_size": 5000, "train_freq": 25},
}


def controller(mode: str) -> Task:
    """PickCube with state vectors and one of the robot's controllers."""
    return Task(f"PickCubeState-v1-{mode}", "CPM/PickCubeState-v1", {"env_kwargs": {"control_mode": mode}})


SAC = Contender("SAC", "sac")
HER = Contender("SAC+HER", "sac_her")
CPM = Contender("CPM-SAC", "cpm_sac")
CPM_HER = Contender("CPM-SAC+HER", "cpm_sac", {"replay_buffer_kwargs": {"n_sampled_goal": 4}})
HIGH = Contender("CPM high exploration", "cpm_sac_high_exploration")
SIMPLE = Contender("CPM simple", "cpm_sac")
SAC_CLOUD = Contender("SAC point cloud", "sac")
REPORT = Contender("CPM report", "cpm_sac_report")
TUNED = Contender("CPM tuned", "cpm_sac_tuned")
#: What rl_zoo3 has found for SAC on MountainCarContinuous-v0, with state-dependent exploration and observations as they come.
ZOO_SDE = Contender(
    "SAC of rl_zoo3, gSDE",
    "sac",
    {
        "env_wrapper": "sb3_cpm.zoo.wrappers.TerminationIsSuccess",
        "policy_kwargs": {"log_std_init": -3.67, "net_arch": [64, 64]},
        "use_sde": True,
        "learning_rate": 3e-4,
        "buffer_size": 50_000,
        "learning_starts": 0,
        "batch_size": 512,
        "ent_coef": 0.1,
        "gamma": 0.9999,
        "tau": 0.01,
        "train_freq": 32,
        "gradient_steps": 32,
    },
)
PINK = Contender("SAC, pink noise", "sac", {"policy": "sb3_cpm.zoo.pink_noise.PinkNoisePolicy"})
PRINTED = Contender(
    "CPM-SAC, printed F and R",
    "cpm_sac",
    {
        "replay_buffer_kwargs": {
            "reward_origin": "zero",
            "filter_kwargs": {"self_balancing": "always"},
            "reward_kwargs": {"keep_mean": False, "zero_reward_size": None},
        }
    },
)
#: Updates as large and as seldom as they were before they became cheap, with white noise.
FORMER = Contender(
    "CPM-SAC, seldom large updates",
    "cpm_sac",
    challenger(
        train_freq=25,
        decay_kwargs={"start": 0.9, "floor": 0.05},
        challenger_kwargs={
            "sequence_length": 32,
            "horizon": 15,
            "imagination_starts": 64,
            "exploration_entropy_scale": 1e-4,
            "noise_memory": 0.0,
        },
    ),
)
CPM_RND = Contender("CPM-SAC, RND", "cpm_sac", challenger(uncertainty_class="rnd"))
DREAMER = Contender("Dreamer", "dreamer")
PLAN2EXPLORE = Contender("Plan2Explore", "plan2explore")
PPO_RGBD = Contender("PPO RGBD", "ppo_rgbd")
PPO_CLOUD = Contender("PPO point cloud", "ppo_pointcloud")
#: The report's five, and the control experiment that it lacks.
PICKCUBE_AGENTS = (HIGH, SIMPLE, DREAMER, PPO_CLOUD, PPO_RGBD, SAC_CLOUD)
LOG = Contender("CPM log", "cpm_sac", challenger(uncertainty_kwargs={"metric": "log"}))
DECAYS = tuple(
    # the default is not named: these runs are those of CPM-SAC
    Contender(f"CPM {name}", "cpm_sac", {} if name == "linear" else challenger(decay=name))
    for name in ("constant", "linear", "exponential", "inverse_time", "cosine", "logistic")
)
NO_CHALLENGES = Contender("CPM without challenges", "cpm_sac", {"replay_buffer_kwargs": {"challenge_ratio": 0.0}})
WEAK = Contender("CPM, weak challenges", "cpm_sac", {"replay_buffer_kwargs": CHALLENGES["tuned"]})
CONDITIONED = Contender("CPM, told its challenge", "cpm_sac", {"vec_env_wrapper": "sb3_cpm.ChallengeVecEnv"})
#: What of the method helps or hurts where the report's constants do badly.
PARTS = (
    SAC,
    CPM,
    CONDITIONED,
    Contender("CPM, 200 challenges", "cpm_sac", {"replay_buffer_kwargs": {"max_challenges": 200, "mix": "row"}}),
    NO_CHALLENGES,
    WEAK,
    Contender(
        "CPM, task rewards",
        "cpm_sac",
        {"replay_buffer_kwargs": {"reward_kwargs": {"exploration_ratio": 1e-3, "scale": 1.0}}},
    ),
    Contender("CPM without exploration", "cpm_sac", challenger(decay="constant", decay_kwargs={"start": 0.0, "floor": 0.0})),
)
#: RLPD, what was left out of it or put beside it, and its control: the same player and budget without demonstrations.
RLPD = (
    Contender("RLPD + BC", "rlpd"),
    Contender("RLPD + BC + challenger", "cpm_rlpd"),
    Contender(
        "RLPD + BC, from a clone",
        "rlpd",
        {
            "callback": [
                {
                    "sb3_cpm.imitation.CloneCallback": {
                        **{"n_episodes": 200, "log_std": -2.5},
                        **{"n_updates": 5000, "learning_rate": 3e-3},
                    }
                },
                {"sb3_cpm.imitation.BCLossCallback": {"weight": 5.0}},
            ],
            "learning_rate": 1e-4,
        },
    ),
    Contender(
        "RLPD",
        "rlpd",
        {"callback": [{"sb3_cpm.imitation.DemonstrationsCallback": {"demonstrations": "expert", "n_episodes": 200}}]},
    ),
    Contender(
        "SAC, layer normalisation",
        "sac_layernorm",
        {
            "env_kwargs": {"reward_mode": "sparse", "ignore_terminations": False},
            "policy_kwargs": {"net_arch": [128, 128]},
            **{"batch_size": 128, "gamma": 0.95, "tau": 0.005, "train_freq": 1, "gradient_steps": 2},
        },
    ),
)
BC_PPO = Contender("BC + PPO", "bc_ppo")


def _gail(**kwargs: Any) -> dict[str, Any]:
    """Overrides of the arguments of ``GAILCallback``."""
    return {"callback": {"sb3_cpm.imitation.GAILCallback": kwargs}}


#: Of the ablation of Shen et al. (2022) what a task of vectors can tell, beside a clone of the same demonstrations.
GAIL = (
    Contender(
        "Clone",
        "bc_ppo",
        {
            "callback": [
                {
                    "sb3_cpm.imitation.CloneCallback": {
                        **{"n_episodes": 20, "hold": True, "critic_warmup": 4},
                        **{"n_updates": 3000, "batch_size": 64},
                    }
                }
            ]
        },
    ),
    Contender("GAIL", "gail_sac"),
    Contender("GAIL, self-imitation", "gail_sac", _gail(self_imitation=True)),
    Contender("GAIL, self-imitation, one ring", "gail_sac", _gail(self_imitation=True, balance=False)),
)
DAPG = Contender("BC + DAPG", "dapg")
MODES = ("pd_ee_delta_pose", "pd_ee_delta_pos", "pd_joint_delta_pos", "pd_ee_target_delta_pose")
CONTROLLERS = tuple(controller(mode) for mode in MODES)

_FULL = Plan((PICKCUBE,), 200_000, 20_000, 20, 5, cost="5 to 10 hours per run on a core, less with a GPU")
#: A seventh of it, for those who have no days.
_SHORT = Plan((PICKCUBE,), 30_000, 5_000, 10, 3, cost="10 to 40 CPU minutes per run, by agent and processor")
_QUICK = Plan((TOY,), 1500, 500, 5, 2, SMALL, cost="2 to 6 minutes on 2 cores")
_PPO_QUICK = Plan((TOY,), 3000, 1000, 5, 2, SMALL, cost="2 minutes on 2 cores")


def _of_five_agents(
    name: str, figure: str, title: str, claim: str, contenders: tuple[Contender, ...], drawing: str
) -> Experiment:
    """A figure that draws the runs of ``five-agents`` in a way of its own."""
    return Experiment(name, figure, title, claim, contenders, drawing, _FULL, _QUICK, source="five-agents", short=_SHORT)


_ALL = (
    Experiment(
        "pickcube-state",
        "",
        "PickCube-v1 from state vectors",
        "not in the report: the same method where it is fast",
        (SAC, CPM, TUNED, HER),
        "curves",
        Plan(CONTROLLERS[:2], 100_000, 10_000, 20, 3, STATE, cost="12 to 38 CPU minutes per run, by processor"),
        Plan(CONTROLLERS[:1], 2000, 1000, 5, 1, STATE, cost="2 minutes on 2 cores"),
    ),
    Experiment(
        "imitation",
        "",
        "PickCube-v1 from state vectors: learning from 200 scripted episodes",
        "not in the report: its prior winners cloned or used PPO; the evaluation at step 0 is the clone's",
        (BC_PPO, DAPG),
        "curves",
        Plan(CONTROLLERS[:1], 40_000, 10_000, 50, 5, cost="5 CPU minutes per run"),
        Plan((TOY,), 2000, 1000, 5, 1, SMALL, cost="1 minute on 2 cores"),
    ),
    Experiment(
        "imitation-clouds",
        "",
        "PickCube-v1 from point clouds: a clone of 200 scripted episodes",
        "not in the report; the evaluation at step 0 is the clone's, and hardly anything is learnt after it",
        (BC_PPO,),
        "curves",
        Plan((PICKCUBE,), 2000, 2000, 50, 5, cost="8 CPU minutes per run"),
        Plan((TOY,), 2000, 1000, 5, 1, SMALL, cost="1 minute on 2 cores"),
    ),
    Experiment(
        "rlpd",
        "",
        "PickCube-v1 from state vectors, sparse reward: RLPD from 200 scripted episodes",
        "not in the report; with and without a behaviour cloning loss, a challenger, and demonstrations",
        RLPD,
        "curves",
        Plan(CONTROLLERS[:1], 10_000, 2500, 50, 5, cost="7 to 10 CPU minutes per run"),
        Plan(CONTROLLERS[:1], 400, 200, 2, 1, cost="2 minutes on 2 cores"),
    ),
    Experiment(
        "gail",
        "",
        "CPMReach-v0, three objects of unequal difficulty: 20 scripted episodes and no reward",
        "not in the report; the clone is its evaluation at step 0, PPO with the reward goes on from there",
        GAIL,
        "curves",
        Plan((REACH,), 10_000, 2500, 50, 5, cost="2 CPU minutes per run"),
        Plan((REACH,), 1000, 500, 5, 1, cost="2 minutes on 2 cores"),
    ),
    Experiment(
        "pickcube-parts",
        "",
        "PickCube-v1 from state vectors: parts of the method",
        "not in the report: for choosing constants, on seeds and evaluation episodes that no other experiment uses",
        PARTS,
        "curves",
        Plan(CONTROLLERS[:1], 40_000, 10_000, 10, 2, STATE, "10 to 24 CPU minutes per run, by processor", 100, 2_000_000),
        Plan(CONTROLLERS[:1], 2000, 1000, 5, 1, STATE, "5 minutes on 2 cores", 100, 2_000_000),
    ),
    Experiment(
        "mountaincar",
        "",
        "MountainCarContinuous-v0: a reward that has to be found",
        "not in the report: hard exploration in minutes",
        (SAC, CPM, TUNED, PLAN2EXPLORE, ZOO_SDE),
        "curves",
        Plan(
            (MOUNTAINCAR,),
            10_000,
            2_000,
            5,
            10,
            cost="1 (SAC) to 4 CPU minutes per run, by processor",
        ),
        Plan((MOUNTAINCAR,), 4_000, 1_000, 3, 2, cost="2 minutes on 2 cores"),
    ),
    Experiment(
        "exploration",
        "",
        "MountainCarContinuous-v0: how soon the reward is found",
        "not in the report: explorers beside each other on seeds that nothing was chosen on",
        (SAC, CPM, PRINTED, FORMER, CPM_RND, PLAN2EXPLORE, ZOO_SDE, PINK),
        "curves",
        Plan((MOUNTAINCAR,), 10_000, 2_000, 5, 10, {}, "1 (SAC) to 3 CPU minutes per run, by processor", 10),
        Plan((MOUNTAINCAR,), 2_000, 1_000, 3, 1, {}, "1 minute on 2 cores", 10),
    ),
    Experiment(
        "mountaincar-parts",
        "",
        "MountainCarContinuous-v0: parts of the method",
        "not in the report: for choosing constants, on seeds and evaluation episodes that no other experiment uses",
        (CPM, NO_CHALLENGES, WEAK),
        "curves",
        Plan((MOUNTAINCAR,), 10_000, 2_000, 5, 3, {}, "2 to 4 CPU minutes per run, by processor", 100, 2_000_000),
        Plan((MOUNTAINCAR,), 2_000, 1_000, 3, 1, {}, "1 minute on 2 cores", 100, 2_000_000),
    ),
    Experiment(
        "pointmaze",
        "",
        "PointMaze_UMaze-v3 with sparse rewards",
        "not in the report: a sparse goal task where hindsight applies",
        (SAC, CPM, HER, CPM_HER, PLAN2EXPLORE),
        "curves",
        Plan((POINTMAZE,), 50_000, 5_000, 10, 10, cost="5 to 10 CPU minutes per run"),
        Plan((POINTMAZE,), 4_000, 2_000, 3, 1, cost="1 minute on 2 cores"),
    ),
    Experiment(
        "baselines",
        "3",
        "PPO on RGBD after ManiSkill's tutorial, five tasks",
        "PPO succeeds seldom on PickCube and never on the other tasks",
        (PPO_RGBD,),
        "curves",
        Plan(VISUAL, 200_000, 20_000, 20, 5, cost="3 to 4 CPU hours per run"),
        _PPO_QUICK,
        short=replace(_SHORT, tasks=tuple(task for task in VISUAL if task.name in ("PickCube-v1", "StackCube-v1"))),
    ),
    Experiment(
        "five-agents",
        "4",
        "The report's five agents on PickCube-v1, and SAC: evaluation",
        "both handicapped CPM agents succeed sometimes and early; PPO on point clouds has the best return and never succeeds",
        PICKCUBE_AGENTS,
        "curves",
        _FULL,
        _QUICK,
        short=_SHORT,
    ),
    _of_five_agents(
        "five-agents-training",
        "5",
        "The report's five agents on PickCube-v1, and SAC: training episodes",
        "exploration is high, so that training succeeds seldom; PPO on point clouds does best there",
        PICKCUBE_AGENTS,
        "training",
    ),
    _of_five_agents(
        "challenge-quality",
        "6",
        "Rewards r, uncertainty u and the coefficient c of the score",
        "c follows the fluctuating magnitudes and so keeps r and u in balance",
        (HIGH, SIMPLE),
        "quality",
    ),
    _of_five_agents(
        "challenge-filters",
        "7",
        "Tolerances of the challenge filter",
        "all three tolerances adjust to what was accepted and rejected",
        (HIGH, SIMPLE),
        "filters",
    ),
    _of_five_agents(
        "artificial-rewards",
        "8",
        "Exploration and the coefficients of the artificial reward",
        "peaks of the exploration reward are followed by the coefficients of the other terms",
        (HIGH, SIMPLE),
        "rewards",
    ),
    Experiment(
        "plan2explore",
        "9",
        "Ensemble loss and the scale k before the exponential function; exp against log",
        "k adapts to the ensemble's spread, and stays low where the loss suddenly rises",
        (SIMPLE, LOG, PLAN2EXPLORE),
        "plan2explore",
        _FULL,
        _QUICK,
        short=_SHORT,
    ),
    _of_five_agents(
        "world-model",
        "10",
        "Losses of the world model, and its errors",
        "image loss near 5.7, pixel error below 0.1; high exploration keeps the model from understanding rewards",
        (HIGH, SIMPLE, DREAMER),
        "world_model",
    ),
    _of_five_agents(
        "player",
        "11",
        "The player's losses and Q values on D and on I",
        "both are in the same range on both buffers",
        (HIGH, SIMPLE),
        "player",
    ),
    Experiment(
        "report-configuration",
        "",
        "PickCube-v1 with all constants of the report, beside the small challenger and SAC",
        "not in the report, whose own two CPM agents are handicapped: its world model, and its few updates of the player",
        (REPORT, SIMPLE, SAC_CLOUD),
        "curves",
        replace(_FULL, cost="5 to 13 hours per run on a core, less with a GPU"),
        Plan((TOY,), 750, 250, 5, 1, {"sac": {"learning_starts": 200, "batch_size": 64}}, cost="5 minutes on 2 cores"),
        short=replace(_SHORT, cost="20 to 120 CPU minutes per run, by agent and processor"),
    ),
    Experiment(
        "controllers",
        "B.3",
        "The robot's controllers, PickCube-v1 from state vectors",
        "the controllers are not similarly good; success came with the switch from pd_joint_delta_pos to pd_ee_delta_pose",
        (SAC,),
        "curves",
        Plan(CONTROLLERS, 100_000, 10_000, 20, 3, STATE, cost="12 to 28 CPU minutes per run, by processor"),
        Plan(CONTROLLERS[:2], 2000, 1000, 5, 1, STATE, cost="1 minute on 2 cores"),
    ),
    Experiment(
        "decays",
        "B.4",
        "Decay models of the exploration probability",
        "the report's appendix B.4 is empty",
        DECAYS,
        "decays",
        Plan((MOUNTAINCAR,), 10_000, 2_000, 5, 5, cost="2 to 4 CPU minutes per run, by processor"),
        Plan((TOY,), 1500, 500, 5, 1, SMALL, cost="3 minutes on 2 cores"),
    ),
)

EXPERIMENTS: dict[str, Experiment] = {experiment.name: experiment for experiment in _ALL}
"""By name."""


def find_experiment(name: str) -> Experiment:
    """
    :param name: of an experiment, or the number of a figure: ``"4"``, ``"figure4"``, ``"B.3"``
    :raises ValueError: if there is none, with the nearest
    """
    wanted = str(name).strip().lower().removeprefix("figure").removeprefix("fig").strip(" .-_")
    for experiment in EXPERIMENTS.values():
        if str(name) == experiment.name or (experiment.figure and wanted == experiment.figure.lower()):
            return experiment
    figures = [experiment.figure for experiment in EXPERIMENTS.values() if experiment.figure]
    raise ValueError(
        f"There is no experiment or figure {name!r}.{nearest(str(name), [*EXPERIMENTS, *figures])} Names: "
        f"{', '.join(EXPERIMENTS)}; figures: {', '.join(figures)}."
    )
