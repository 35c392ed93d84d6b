"""Adam with what Dreamer adds to it: gradient clipping, decoupled weight decay, and a refusal to step on NaN."""

import copy
import math
from collections.abc import Iterable
from typing import Any

import torch as th
from torch import nn

#: Of every parameter, None where the loss does not depend on it.
Gradients = tuple[th.Tensor | None, ...]


class Optimizer:
    """
    :param name: how errors and logs call it
    :param modules: whose parameters to train; parameters without gradients (slow targets) are left out
    :param learning_rate: of Adam
    :param eps: of Adam
    :param clip: greatest norm of the whole gradient
    :param weight_decay: share of every weight that a step takes away, independent of the learning rate; biases and gains
        of layer norms keep theirs
    """

    def __init__(
        self,
        name: str,
        modules: Iterable[nn.Module],
        learning_rate: float,
        eps: float = 1e-5,
        clip: float = 100.0,
        weight_decay: float = 1e-6,
    ) -> None:
        named = [item for module in modules for item in module.named_parameters() if item[1].requires_grad]
        self.name, self.clip, self.weight_decay = name, clip, weight_decay
        self.parameters = [parameter for _, parameter in named]
        self.decayed: list[th.Tensor] = [parameter for key, parameter in named if parameter.dim() > 1 and "bias" not in key]
        self.adam = th.optim.Adam(self.parameters, lr=learning_rate, eps=eps, fused=True)

    @property
    def learning_rate(self) -> float:
        """Of all parameters."""
        return self.adam.param_groups[0]["lr"]

    @learning_rate.setter
    def learning_rate(self, rate: float) -> None:
        for group in self.adam.param_groups:
            group["lr"] = rate

    def gradients(self, loss: th.Tensor) -> Gradients:
        """
        :param loss: scalar
        :return: of this optimizer's parameters; none is computed for any other
        """
        return th.autograd.grad(loss, self.parameters, allow_unused=True)

    def step(self, loss: th.Tensor, gradients: Gradients | None = None) -> th.Tensor:
        """
        One update, for this optimizer's parameters only: no gradient is left at any other.

        :param loss: scalar
        :param gradients: its :meth:`gradients`, where they are known already
        :return: the gradient's norm before clipping
        :raises RuntimeError: if loss or gradient are not finite; the parameters are then still the good ones
        """
        if not math.isfinite(loss.item()):
            raise RuntimeError(f"The {self.name} loss became {loss.item()}. {ADVICE}")
        gradients = self.gradients(loss) if gradients is None else gradients
        for parameter, gradient in zip(self.parameters, gradients, strict=True):
            parameter.grad = gradient
        used = [gradient for gradient in gradients if gradient is not None]
        norm = nn.utils.get_total_norm(used)
        size = norm.item()
        if not math.isfinite(size):
            self.adam.zero_grad(set_to_none=True)
            raise RuntimeError(f"The gradient of the {self.name} loss ({loss.item():.4g}) became {size}. {ADVICE}")
        if size > self.clip:
            th._foreach_mul_(used, self.clip / (size + 1e-6))
        self.adam.step()
        self.adam.zero_grad(set_to_none=True)
        if self.weight_decay and self.decayed:
            with th.no_grad():
                th._foreach_mul_(self.decayed, 1.0 - self.weight_decay)
        return norm

    def adopt(self, other: "Optimizer") -> None:
        """Take over another one's averages of gradients; the learning rate stays this one's."""
        rate = self.learning_rate
        self.adam.load_state_dict(copy.deepcopy(other.adam.state_dict()))  # torch would share the averages
        self.learning_rate = rate

    def state_dict(self) -> dict[str, Any]:
        return self.adam.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.adam.load_state_dict(state)


ADVICE = (
    "No weight was changed by this update. Look for NaN or very large values in observations and rewards; a lower learning "
    "rate or a smaller `grad_clip` helps where the data are sound."
)
