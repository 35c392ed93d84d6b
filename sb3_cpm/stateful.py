"""Callbacks that have a state of their own, which checkpoints keep."""

from abc import ABC, abstractmethod
from pathlib import Path

from stable_baselines3.common.callbacks import BaseCallback


class StatefulCallback(BaseCallback, ABC):
    """A callback that :mod:`sb3_cpm.checkpoint` saves in a file of its own, and gives back its state before ``learn()``."""

    @property
    @abstractmethod
    def has_state(self) -> bool:
        """Whether there is anything to save yet."""

    @abstractmethod
    def save(self, path: str | Path) -> None:
        """
        :param path: file to write
        """

    @abstractmethod
    def load(self, path: str | Path) -> None:
        """
        After ``init_callback()``: go on where another callback with the same arguments was.

        :param path: of :meth:`save`
        :raises ValueError: if it does not fit
        """
