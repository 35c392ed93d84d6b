"""
Noise that perseveres: what an exploration behaviour is unsure about, it tries for some steps in a row.

White noise undoes at the next step what it tried at this one; wherever mass or friction is to be overcome, nothing comes of
it. Correlated noise gets somewhere (Eberhard et al. 2023 recommend pink noise for this), and the behaviour still says where
to: every single action has the distribution that the actor gave.
"""

import math

import numpy as np
import torch as th


class CorrelatedNoise:
    """
    Standard normal numbers whose correlation falls to 1/e within ``memory`` steps (an autoregressive process of first order).

    :param memory: steps, 0 for white noise
    :param dim: numbers per environment
    :param device: where they are needed
    """

    def __init__(self, memory: float, dim: int, device: th.device) -> None:
        self.kept = math.exp(-1.0 / memory) if memory > 0.0 else 0.0
        self.dim, self.device = dim, device
        self._last = np.zeros((0, dim), dtype=np.float32)
        self._fresh = np.ones(0, dtype=bool)

    def restart(self, envs: np.ndarray) -> None:
        """
        :param envs: environments in which an episode has begun, indices; what comes next there does not depend on the past
        """
        self._make_room_for(envs)
        self._fresh[envs] = True

    def draw(self, envs: np.ndarray) -> th.Tensor:
        """
        :param envs: indices of the environments that act
        :return: shape ``(len(envs), dim)``
        """
        self._make_room_for(envs)
        kept = np.where(self._fresh[envs], 0.0, self.kept)[:, None]
        news = th.randn(len(envs), self.dim).numpy()  # on the CPU, whatever the device: one seed, one run
        self._last[envs] = kept * self._last[envs] + np.sqrt(1.0 - kept**2) * news
        self._fresh[envs] = False
        return th.as_tensor(self._last[envs], device=self.device)

    def _make_room_for(self, envs: np.ndarray) -> None:
        missing = int(np.max(envs, initial=-1)) + 1 - len(self._last)
        if missing > 0:
            self._last = np.concatenate((self._last, np.zeros((missing, self.dim), dtype=np.float32)))
            self._fresh = np.append(self._fresh, np.ones(missing, dtype=bool))
