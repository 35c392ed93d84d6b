"""Trained players in ONNX, for robots and programs that have no PyTorch: what they see in, the deterministic action out."""

import contextlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.type_aliases import PyTorchObs
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn

from sb3_cpm.extras import check_installed
from sb3_cpm.files import disk_errors_named, replacing

#: Name of the input where observations are no Dict.
OBSERVATION = "observation"


class OnnxPlayer(nn.Module):
    """
    The way from observations to the action that ``model.predict(observation, deterministic=True)`` gives.

    :param model: trained, with continuous actions
    :param normalize: whose statistics observations go through first; None: the model's, where it has an environment with some
    :raises ValueError: for models that this cannot be done for
    """

    low: th.Tensor
    high: th.Tensor

    def __init__(self, model: BaseAlgorithm, normalize: VecNormalize | None = None) -> None:
        super().__init__()
        space, name = model.observation_space, type(model).__name__
        if not isinstance(model.action_space, spaces.Box):
            raise ValueError(f"ONNX export is for continuous actions (a Box), this {name} has {model.action_space}.")
        if hasattr(model.policy, "lstm_actor") or not hasattr(model.policy, "_predict"):
            raise ValueError(
                f"ONNX export is for policies that see one observation, this {name} has a {type(model.policy).__name__}."
            )
        self.policy = model.policy
        self.is_dict = isinstance(space, spaces.Dict)
        read = getattr(getattr(getattr(model.policy, "actor", model.policy), "features_extractor", None), "player_keys", None)
        boxes = dict(space.spaces) if isinstance(space, spaces.Dict) else {OBSERVATION: space}
        #: What it reads, in the order of its inputs.
        self.boxes = {key: box for key, box in boxes.items() if read is None or key in read}
        normalize = normalize or model.get_vec_normalize_env()
        self.normalized: list[str] = []
        self.clip, self.epsilon = 0.0, 0.0
        if normalize is not None and normalize.norm_obs:
            self._take_statistics(normalize)
        for bound in ("low", "high"):
            value = th.as_tensor(getattr(model.action_space, bound), dtype=th.float32, device=model.device)
            self.register_buffer(bound, value)

    def _take_statistics(self, normalize: VecNormalize) -> None:
        found = normalize.obs_rms if isinstance(normalize.obs_rms, dict) else {OBSERVATION: normalize.obs_rms}
        self.clip, self.epsilon = normalize.clip_obs, normalize.epsilon
        self.normalized = [key for key in self.boxes if key in found]
        for i, key in enumerate(self.normalized):
            statistics: RunningMeanStd = found[key]
            for name in ("mean", "var"):
                value = th.as_tensor(getattr(statistics, name), dtype=th.float32, device=self.policy.device)
                self.register_buffer(f"{name}_{i}", value)

    def forward(self, *observations: th.Tensor) -> th.Tensor:
        """
        :param observations: by the order of :attr:`boxes`, each of shape ``(batch, *shape)``
        :return: actions in the environment's units, shape ``(batch, *action_shape)``
        """
        given = dict(zip(self.boxes, observations, strict=True))
        for i, key in enumerate(self.normalized):
            mean, var = getattr(self, f"mean_{i}"), getattr(self, f"var_{i}")
            given[key] = ((given[key] - mean) / th.sqrt(var + self.epsilon)).clamp(-self.clip, self.clip)
        seen: PyTorchObs = given if self.is_dict else given[OBSERVATION]
        action = self.policy._predict(seen, deterministic=True)
        if self.policy.squash_output:
            return self.low + 0.5 * (action + 1.0) * (self.high - self.low)
        return th.maximum(th.minimum(action, self.high), self.low)


@contextlib.contextmanager
def _unchecked_distributions() -> Iterator[None]:
    """Their checks look at values, which a graph has not."""
    before = th.distributions.Distribution._validate_args
    th.distributions.Distribution.set_default_validate_args(False)
    try:
        yield
    finally:
        th.distributions.Distribution.set_default_validate_args(before)


def export_onnx(model: BaseAlgorithm, path: str | Path, normalize: VecNormalize | None = None) -> dict[str, tuple[int, ...]]:
    """
    Write a player as an ONNX graph whose inputs are named after the observation's keys (``"observation"`` where it is no Dict)
    and whose output is ``"action"``. Statistics of a ``VecNormalize`` are part of the graph.

    :param model: of SB3, sb3-contrib or this package, with continuous actions; observations are as ``model.observation_space``
        has them: images with channels first
    :param path: of the file, ``player.onnx``
    :param normalize: see :class:`OnnxPlayer`
    :return: the inputs, with the shape of one observation
    :raises ValueError: for models that this cannot be done for
    """
    check_installed("ONNX graphs", ("onnx", "onnxscript"), "onnx")
    player = OnnxPlayer(model, normalize)
    model.policy.set_training_mode(False)
    keys = list(player.boxes)
    sample = tuple(th.as_tensor(np.stack([box.sample()] * 2), device=model.device) for box in player.boxes.values())
    batch = th.export.Dim("batch", min=1)
    with disk_errors_named(path), replacing(path) as temporary, th.no_grad(), _unchecked_distributions():
        program = th.onnx.export(
            player.eval(), sample, input_names=keys, output_names=["action"], dynamo=True, verbose=False,
            dynamic_shapes=(tuple({0: batch} for _ in keys),),
        )  # fmt: skip
        assert program is not None
        program.save(str(temporary), external_data=False)
    return {key: tuple(box.shape or ()) for key, box in player.boxes.items()}
