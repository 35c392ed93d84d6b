"""
Sizes and constants of the challenger as plain data (report, section 4.1 and B.1; docs/method.md),
and of what is made of its challenges (4.3 and B.6).

``"report"`` has the report's sizes where it names them, and DreamerV2's for continuous control elsewhere. It also reads
vectors, such as the robot's state, and has a continue head; the report has neither. ``"report_images"`` is the report's own
world model: images only, and two heads, for images and reward. Both leave out the actor-critic for the task, which the report
trains beside that for exploration (``train_task_behavior=True``), and by which C never acts. The number of ensemble heads is
not in the report; 10 is ours. ``"default"`` is small enough for two CPU cores: an update takes about 0.03 CPU seconds for
vectors and 0.06 for two 32x32 cameras. ``"report"`` takes 4 to 6 on one core, nearly all of it for ten large heads that rate
800 x 15 imagined steps: without a GPU add ``imagination_starts=256``, which needs a third of that. A preset of your own is a
dict with the entries that
differ from ``"default"``; every entry can also be given to :class:`~sb3_cpm.challenger.Challenger` as a keyword argument.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from sb3_cpm.arguments import AT_LEAST_0, SHARE, Rule, check, choice, integer, nearest, number

REPORT: dict[str, Any] = {
    # what train() is fed with
    "batch_size": 16,  # sequences per update
    "sequence_length": 50,  # rows per sequence
    # encoder and decoder
    "cnn_depth": 32,  # channels of the first convolution
    "cnn_layers": 4,  # convolutions, each halves the image; 32x32 becomes 2x2 and an embedding of 32 * cnn_depth
    "read_vectors": True,  # whether vectors are read beside images, where `keys` does not say what is read
    "vector_layers": 2,  # hidden layers of the MLPs that encode and decode vectors
    "vector_units": 400,  # size of each of them
    "symlog_vectors": True,  # squash vectors with symlog: robust to whatever range the environment uses
    # latent state
    "latent": "gaussian",  # "gaussian" (report) or "categorical" (DreamerV2)
    "stoch_size": 50,  # stochastic dimensions; number of variables if categorical (32 in DreamerV2)
    "stoch_classes": 32,  # classes of each variable, categorical only
    "deter_size": 200,  # deterministic dimensions, units of the GRU
    "hidden_size": 200,  # size of the layers around the GRU
    # heads
    "head_layers": 2,  # hidden layers of reward and continue head
    "head_units": 400,  # size of each of them
    "symlog_rewards": False,  # learn symlog(reward), for rewards far from [-1, 1]
    "reward_gradient": True,  # let the reward shape the latents
    "continue_head": True,  # learn where episodes terminate
    # losses
    "kl_balance": 0.8,  # share of the prior's side of the KL
    "kl_scale": 1.0,  # factor of the KL
    "free_nats": 1.0,  # KL (batch mean, nats) that costs nothing
    "reward_scale": 1.0,  # factor of the reward loss
    "continue_scale": 1.0,  # factor of the continue loss
    # optimisation
    "model_lr": 3e-4,  # learning rate of the world model
    "actor_lr": 8e-5,  # learning rate of the actors
    "critic_lr": 8e-5,  # learning rate of the critics
    "uncertainty_lr": 3e-4,  # learning rate of the ensemble
    "adam_eps": 1e-5,  # epsilon of Adam
    "grad_clip": 100.0,  # greatest gradient norm
    "weight_decay": 1e-6,  # share of each weight taken away per update
    # behaviour in imagination
    "horizon": 15,  # imagined steps
    "imagination_starts": None,  # how many states of a batch imagination starts from, None for all
    "gamma": 0.99,  # discount
    "lambda_": 0.95,  # of the lambda-returns
    "actor_gradient": "dynamics",  # how actors learn: "dynamics", "reinforce" or "both"
    "reinforce_share": 0.9,  # share of REINFORCE in "both"
    "actor_input_gradient": True,  # whether returns also reach the actor through the latents that later actions depend on
    "entropy_scale": 1e-4,  # reward for the entropy of the task's actor
    "exploration_entropy_scale": 1e-4,  # the same for the exploration actor
    "noise_memory": 0.0,  # steps that the noise of exploring actions reaches back; 0 is white noise
    "actor_layers": 4,  # hidden layers
    "actor_units": 400,  # size of each of them
    "critic_layers": 3,  # hidden layers
    "critic_units": 400,  # size of each of them
    "slow_target": True,  # bootstrap from a slow copy of the critic
    "slow_target_every": 100,  # updates between two copies
    "train_task_behavior": False,  # actor-critic for the task, which the challenger beside a player does not need
    "train_exploration_behavior": True,  # novelty measure and exploration actor-critic, which a plain Dreamer does not need
    # speed, see sb3_cpm.world_model.acceleration
    "amp": False,  # train in bfloat16 mixed precision; pays on GPUs with large images
    "compile": False,  # on GPUs CUDA graphs of whole updates, 5 times faster; on CPUs torch.compile, which hardly pays
    # constructor arguments of uncertainty classes, by name; `uncertainty_kwargs` come on top
    "uncertainty": {
        "plan2explore": {"heads": 10, "layers": 4, "units": 400, "target": "feat", "metric": "exp"},
        "rnd": {"layers": 3, "units": 400, "output_dim": 64},
        "prediction_error": {"layers": 2, "units": 400},
        "observation_ensemble": {"heads": 10, "layers": 2, "units": 400},
    },
}

DEFAULT: dict[str, Any] = {
    **REPORT,
    "batch_size": 8,
    "sequence_length": 16,
    "cnn_depth": 8,
    "vector_units": 128,
    "stoch_size": 30,
    "deter_size": 128,
    "hidden_size": 128,
    "head_units": 128,
    "symlog_rewards": True,
    "model_lr": 1e-3,
    "actor_lr": 3e-4,
    "critic_lr": 3e-4,
    "horizon": 8,
    "imagination_starts": 16,
    "exploration_entropy_scale": 1.0,
    "noise_memory": 10.0,
    "actor_layers": 2,
    "actor_units": 128,
    "critic_layers": 2,
    "critic_units": 128,
    "uncertainty": {
        "plan2explore": {"heads": 5, "layers": 2, "units": 128, "target": "feat", "metric": "exp"},
        "rnd": {"layers": 3, "units": 128, "output_dim": 64},
        "prediction_error": {"layers": 2, "units": 128},
        "observation_ensemble": {"heads": 5, "layers": 2, "units": 128},
    },
}

#: The report's own world model, of images alone and without a continue head [B.1].
REPORT_IMAGES: dict[str, Any] = {**REPORT, "read_vectors": False, "continue_head": False}

#: The same networks for an agent that learns from its imagination alone, as Dreamer does: larger updates.
DREAMER: dict[str, Any] = {
    **DEFAULT,
    "sequence_length": 32,
    "horizon": 15,
    "imagination_starts": 64,
}

PRESETS: dict[str, dict[str, Any]] = {"default": DEFAULT, "dreamer": DREAMER, "report": REPORT, "report_images": REPORT_IMAGES}

#: Arguments of :class:`~sb3_cpm.buffers.CPMBuffer`: how challenges are used. "report" has its constants, which are the
#: buffer's defaults, too. "tuned" makes less of challenges: on a dense reward those of the report slow the player down
#: (docs/experiments.md says on which seeds that was found).
CHALLENGES: dict[str, dict[str, Any]] = {
    "report": {
        "challenge_ratio": 0.25,  # share of I in what the player trains on
        "mix": "batch",  # a whole batch from I now and then
        "max_challenges": 10,  # size of I
        "reward_kwargs": {"exploration_ratio": 1 / 1.5, "scale": 0.5},  # uncertainty is worth two thirds of the task reward
    },
    "tuned": {
        "challenge_ratio": 0.1,
        "mix": "row",  # a tenth of every batch: none consists of ten trajectories alone
        "max_challenges": 100,
        "reward_kwargs": {"exploration_ratio": 0.1, "scale": 0.86},  # mean(r') = 0.86 * (1 + 0.1 * 1.6) * mean(r) = mean(r)
    },
}


_RULES: dict[str, Rule] = {
    **{key: choice(True, False) for key, value in REPORT.items() if isinstance(value, bool)},
    **{key: integer(1) for key in REPORT if key.endswith(("_size", "_units", "_classes", "_every"))},
    **{key: integer(0) for key in REPORT if key.endswith("_layers")},  # an MLP may consist of its output layer
    **{key: integer(1) for key in ("cnn_depth", "cnn_layers", "horizon")},
    **{key: AT_LEAST_0 for key in REPORT if key.endswith(("_lr", "_scale"))},
    "noise_memory": AT_LEAST_0,
    "sequence_length": integer(2),  # a transition has two rows
    "imagination_starts": Rule(f"None or {integer(1).words}", lambda value: value is None or integer(1).holds(value)),
    "latent": choice("gaussian", "categorical"),
    "actor_gradient": choice("dynamics", "reinforce", "both"),
    **{key: SHARE for key in ("gamma", "lambda_", "kl_balance", "reinforce_share", "weight_decay")},
    "free_nats": AT_LEAST_0,
    **{key: number("a number above 0", lambda value: value > 0.0) for key in ("adam_eps", "grad_clip")},
    "uncertainty": Rule(
        "a dict of dicts of arguments, by the name of the uncertainty class",
        lambda value: isinstance(value, dict) and all(isinstance(one, dict) for one in value.values()),
    ),
}


def make_preset(preset: str | Mapping[str, Any] = "default", base: str = "default", **overrides: Any) -> dict[str, Any]:
    """
    A complete preset.

    :param preset: name of a preset, or the entries that differ from ``base``
    :param base: name of the preset that entries are filled up from
    :param overrides: further entries, they win. Each replaces a whole entry, `uncertainty` too: give single arguments as
        `uncertainty_kwargs`
    :return: plain Python numbers: NumPy's scalars would make a saved file unreadable
    :raises ValueError: for unknown names (with the nearest valid one), and values that cannot work, saying what they must be
    """
    if isinstance(preset, str):
        if preset not in PRESETS and preset in CHALLENGES:
            raise ValueError(
                f"{preset!r} is no preset of the challenger, it says what becomes of challenges: give it to the buffer, "
                f"replay_buffer_kwargs=sb3_cpm.presets.CHALLENGES[{preset!r}] (in zoo_configs/ it is cpm_sac_{preset}.yml). "
                f"Valid: {sorted(PRESETS)}."
            )
        if preset not in PRESETS:
            raise ValueError(f"Unknown preset {preset!r}.{nearest(preset, PRESETS, cutoff=0.0)} Valid: {sorted(PRESETS)}.")
        result = dict(PRESETS[preset])
    elif isinstance(preset, Mapping):
        result, overrides = dict(PRESETS[base]), {**preset, **overrides}
    else:
        raise ValueError(f"`preset` must be a name ({sorted(PRESETS)}) or a dict of entries, got {preset!r}.")
    for key in overrides:
        if key not in result:
            raise ValueError(f"Unknown preset entry {key!r}.{nearest(key, result, cutoff=0.0)} Valid: {sorted(result)}.")
    result = plain({**result, **overrides})
    for key, rule in _RULES.items():
        check(f"Preset entry {key!r}", result[key], rule)
    return result


def plain(value: Any) -> Any:
    """
    :param value: a number, or dicts, lists and tuples of them
    :return: the same with Python's numbers in place of NumPy's scalars; everything else stays what it is
    """
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, Mapping):
        return {key: plain(one) for key, one in value.items()}
    if type(value) in (list, tuple):
        return type(value)(plain(one) for one in value)
    return value
