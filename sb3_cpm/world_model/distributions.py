"""
The distributions of Dreamer: stochastic latents (Gaussian as in the report, categorical as in DreamerV2) and a truncated
normal for bounded actions that really is one.

They work on plain tensors of parameters ("stats") instead of ``torch.distributions`` objects: whole sequences can then be
stacked, masked and indexed without any bookkeeping.
"""

import math
from typing import Any

import torch as th
import torch.nn.functional as F

from sb3_cpm.world_model.fast.one_hot import OneHot

SQRT_2PI = math.sqrt(2.0 * math.pi)
SQRT_2 = math.sqrt(2.0)


class GaussianLatent:
    """
    Diagonal Gaussian latents, std = 2 * sigmoid(x / 2) + ``min_std``.

    :param size: number of stochastic dimensions (50 in the report)
    """

    min_std = 0.1
    one_hot = None

    def __init__(self, size: int) -> None:
        self.size = size
        self.stats_size = 2 * size

    def mean_std(self, stats: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        mean, raw = stats.chunk(2, dim=-1)
        return mean, 2.0 * th.sigmoid(0.5 * raw) + self.min_std

    def noise(self, *batch: int, like: th.Tensor) -> th.Tensor:
        """Random numbers for samples of shape ``(*batch, size)``; drawn at once for a whole sequence."""
        return th.randn(*batch, self.size, device=like.device, dtype=like.dtype)

    def sample(self, stats: th.Tensor, noise: th.Tensor, out: th.Tensor | None = None) -> th.Tensor:
        """Reparametrised sample, into ``out`` where given (without gradient)."""
        mean, std = self.mean_std(stats)
        return th.addcmul(mean, std, noise, out=out)

    def slopes(self, stats: th.Tensor, noise: th.Tensor) -> th.Tensor:
        """What :meth:`pull_back` needs to know of samples, for any batch dimensions at once."""
        sigmoid = th.sigmoid(0.5 * stats[..., self.size :])
        return noise * sigmoid * (1.0 - sigmoid)

    def pull_back(self, slopes: th.Tensor, gradient: th.Tensor) -> th.Tensor:
        """Gradient of samples to gradient of ``stats``, by hand."""
        return th.cat((gradient, gradient * slopes), dim=-1)

    def mode(self, stats: th.Tensor) -> th.Tensor:
        return stats[..., : self.size]

    def mean(self, stats: th.Tensor) -> th.Tensor:
        return stats[..., : self.size]

    def kl_sides(self, posterior: th.Tensor, prior: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """
        KL(posterior || prior) twice, for KL balancing: its gradient reaches the prior only, and the posterior only.

        :return: nats, summed over the dimensions, each of shape ``(*batch,)``
        """
        return self.kl(posterior.detach(), prior), self.kl(posterior, prior.detach())

    def kl(self, left: th.Tensor, right: th.Tensor) -> th.Tensor:
        """KL(left || right) in nats, summed over the dimensions, shape ``(*batch,)``."""
        (mean, std), (other_mean, other_std) = self.mean_std(left), self.mean_std(right)
        ratio = (std / other_std).square()
        distance = ((mean - other_mean) / other_std).square()
        return 0.5 * (ratio + distance - 1.0 - ratio.log()).sum(-1)


class CategoricalLatent:
    """
    ``groups`` one-hot latents of ``classes`` classes with straight-through gradients (DreamerV2: 32 x 32).

    :param groups: number of categorical variables
    :param classes: classes of each
    """

    def __init__(self, groups: int, classes: int) -> None:
        self.groups, self.classes = groups, classes
        self.size = self.stats_size = groups * classes
        self.one_hot = OneHot(groups, classes)

    def _logits(self, stats: th.Tensor) -> th.Tensor:
        return stats.unflatten(-1, (self.groups, self.classes))

    def noise(self, *batch: int, like: th.Tensor) -> th.Tensor:
        """
        Random numbers for samples of shape ``(*batch, groups, classes)``; drawn at once for a whole sequence.

        :return: on a CPU, one uniform number per variable, thirty times fewer than a race of exponential ones takes, shape
            ``(*batch, groups)``; on a GPU, where numbers cost nothing and a cumulative sum is slow, those of the race, shape
            ``(*batch, groups, classes)``
        """
        if like.device.type == "cpu":
            return th.rand(*batch, self.groups, device=like.device, dtype=like.dtype)
        race = th.empty(*batch, self.groups, self.classes, device=like.device, dtype=like.dtype)
        return race.exponential_().clamp_(min=th.finfo(like.dtype).tiny)

    def sample(self, stats: th.Tensor, noise: th.Tensor) -> th.Tensor:
        """
        One-hot sample with the gradient of the probabilities: from the inverse of the cumulative distribution, or the winner
        of a race in which every class arrives after an exponential time, its rate the class's probability.
        """
        probabilities = F.softmax(self._logits(stats), dim=-1)
        if noise.dim() == probabilities.dim():
            winner = (probabilities.detach() / noise).argmax(-1, keepdim=True)
            return _StraightThrough.apply(probabilities, winner).flatten(-2)
        quantiles = probabilities.detach().cumsum(-1)
        chosen = th.searchsorted(quantiles, noise.unsqueeze(-1), right=True).clamp_(max=self.classes - 1)
        return _StraightThrough.apply(probabilities, chosen).flatten(-2)

    def slopes(self, stats: th.Tensor, noise: th.Tensor) -> th.Tensor:
        """See :meth:`GaussianLatent.slopes`."""
        return F.softmax(self._logits(stats), dim=-1)

    def pull_back(self, slopes: th.Tensor, gradient: th.Tensor) -> th.Tensor:
        """See :meth:`GaussianLatent.pull_back`."""
        weighted = slopes * self._logits(gradient)
        return th.addcmul(weighted, slopes, weighted.sum(-1, keepdim=True), value=-1.0).flatten(-2)

    def mode(self, stats: th.Tensor) -> th.Tensor:
        return F.one_hot(self._logits(stats).argmax(-1), self.classes).to(stats.dtype).flatten(-2)

    def mean(self, stats: th.Tensor) -> th.Tensor:
        return F.softmax(self._logits(stats), dim=-1).flatten(-2)

    def kl_sides(self, posterior: th.Tensor, prior: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """The same as :meth:`GaussianLatent.kl_sides`; both share the logarithms, which are the dear part."""
        log_posterior = F.log_softmax(self._logits(posterior), dim=-1)
        log_prior = F.log_softmax(self._logits(prior), dim=-1)
        probabilities = log_posterior.exp()
        prior_side = probabilities.detach() * (log_posterior.detach() - log_prior)
        posterior_side = probabilities * (log_posterior - log_prior.detach())
        return prior_side.sum((-1, -2)), posterior_side.sum((-1, -2))

    def kl(self, left: th.Tensor, right: th.Tensor) -> th.Tensor:
        log_left = F.log_softmax(self._logits(left), dim=-1)
        log_right = F.log_softmax(self._logits(right), dim=-1)
        return (log_left.exp() * (log_left - log_right)).sum((-1, -2))


class _StraightThrough(th.autograd.Function):
    """Exact ones and zeros forwards, and backwards as if they were the probabilities (Bengio et al. 2013)."""

    @staticmethod
    def forward(ctx: Any, probabilities: th.Tensor, chosen: th.Tensor) -> th.Tensor:
        return th.zeros_like(probabilities).scatter_(-1, chosen, 1.0)

    @staticmethod
    def backward(ctx: Any, gradient: th.Tensor) -> tuple[th.Tensor, None]:
        return gradient, None


Latent = GaussianLatent | CategoricalLatent


class TruncatedNormal:
    """
    Normal distribution restricted to [-1, 1] and renormalised, independent in its last dimension.

    Samples come from the inverse of the cumulative distribution, which makes them differentiable in both parameters.
    Clipping a normal sample instead puts mass on the bounds and cuts the gradient there.

    :param loc: mode, within [-1, 1], shape ``(..., action_dim)``
    :param scale: standard deviation before truncation, shape ``(..., action_dim)``
    """

    min_scale = 0.1
    #: At the very ends float32 has no quantile left: stay where ndtri and its slope are finite.
    quantiles = (1e-6, 1.0 - 1e-6)

    def __init__(self, loc: th.Tensor, scale: th.Tensor) -> None:
        self.loc, self.scale = loc, scale
        self.alpha, self.beta = (-1.0 - loc) / scale, (1.0 - loc) / scale
        self._low = th.special.ndtr(self.alpha)
        self._mass = th.special.ndtr(self.beta) - self._low  # at least ndtr(20) - 1/2, since loc lies inside

    @classmethod
    def of_outputs(cls, outputs: th.Tensor) -> "TruncatedNormal":
        """
        :param outputs: of a network, any numbers: means, then raw standard deviations, shape ``(..., 2 * action_dim)``
        """
        mean, raw = outputs.float().chunk(2, dim=-1)
        return cls(th.tanh(mean), 2.0 * th.sigmoid(0.5 * raw) + cls.min_scale)

    @property
    def mode(self) -> th.Tensor:
        return self.loc

    @property
    def mean(self) -> th.Tensor:
        return self.loc + self.scale * (self._density(self.alpha) - self._density(self.beta)) / self._mass

    def rsample(self) -> th.Tensor:
        """Sample with gradients, within [-1, 1], shape ``(..., action_dim)``."""
        return self.at(th.rand_like(self.loc))[0]

    def at(self, chance: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """
        :param chance: uniform numbers between 0 and 1, shape ``(..., action_dim)``
        :return: the samples that they stand for, within [-1, 1], and these before ``loc`` and ``scale``
        """
        standard = th.special.ndtri((self._low + self._mass * chance).clamp(*self.quantiles))
        return th.addcmul(self.loc, self.scale, standard).clamp(-1.0, 1.0), standard

    def slopes(self, chance: th.Tensor, standard: th.Tensor) -> th.Tensor:
        """
        Slopes of samples with respect to what :meth:`of_outputs` was given, by hand. With the distribution function Phi of the
        normal distribution and its density phi, a sample is loc + scale * z, where Phi(z) lies between Phi(alpha) and
        Phi(beta), at the share ``chance`` of the way.

        :param chance: as given to :meth:`at`
        :param standard: z, as it was returned
        :return: for means and raw standard deviations, side by side, shape ``(..., 2 * action_dim)``
        """
        low, high, here = (th.exp(-0.5 * x.square()) for x in (self.alpha, self.beta, standard))  # phi, up to a factor
        low, high = low * (1.0 - chance), high * chance
        # where the quantile was clamped, z is a constant; where the sample was, all is
        moves = (standard.abs() < _LAST_QUANTILE).to(here.dtype) / here
        free = (th.addcmul(self.loc, self.scale, standard).abs() <= 1.0).to(here.dtype)
        to_loc = free * (1.0 - (low + high) * moves)
        to_scale = free * (standard - (self.alpha * low + self.beta * high) * moves)
        sigmoid = 0.5 * (self.scale - self.min_scale)
        return th.cat((to_loc * (1.0 - self.loc.square()), to_scale * sigmoid * (1.0 - sigmoid)), dim=-1)

    def log_prob(self, value: th.Tensor) -> th.Tensor:
        """Log density of ``value``, summed over the last dimension; -inf outside of [-1, 1]."""
        standard = (value - self.loc) / self.scale
        log_density = -0.5 * standard.square() - (SQRT_2PI * self.scale * self._mass).log()
        return log_density.masked_fill(value.abs() > 1.0, -math.inf).sum(-1)

    def entropy(self) -> th.Tensor:
        """Differential entropy in nats, summed over the last dimension."""
        shift = self.alpha * self._density(self.alpha) - self.beta * self._density(self.beta)
        return ((SQRT_2PI * math.sqrt(math.e) * self.scale * self._mass).log() + shift / (2.0 * self._mass)).sum(-1)

    @staticmethod
    def _density(x: th.Tensor) -> th.Tensor:
        return th.exp(-0.5 * x.square()) / SQRT_2PI


#: Quantile that the last one of :attr:`TruncatedNormal.quantiles` stands for, and a little less.
_LAST_QUANTILE = 4.748


class OutputSampler:
    """
    ``TruncatedNormal.of_outputs(outputs).at(chance)`` without gradient, in a third of the operations.

    :param like: outputs of a network, shape ``(..., 2 * action_dim)``
    """

    def __init__(self, like: th.Tensor) -> None:
        dim = like.shape[-1] // 2
        # of means and raw standard deviations: tanh(x) is 2 * sigmoid(2 * x) - 1
        self._factor = like.new_tensor([2.0] * dim + [0.5] * dim)
        self._offset = like.new_tensor([-1.0] * dim + [TruncatedNormal.min_scale] * dim)
        self._ends = like.new_tensor([[-1.0], [1.0]])

    def sample(self, outputs: th.Tensor, chance: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """
        :param outputs: shape ``(n, 2 * action_dim)``
        :param chance: see :meth:`TruncatedNormal.at`
        """
        parameters = th.add(self._offset, (outputs * self._factor).sigmoid_(), alpha=2.0)
        loc, scale = parameters.chunk(2, dim=-1)
        ends = (self._ends - loc.unsqueeze(-2)).div_(scale.unsqueeze(-2))
        low, high = th.special.erfc(ends.mul_(-1.0 / SQRT_2)).unbind(-2)  # twice the distribution function
        quantile = th.lerp(low, high, chance).mul_(0.5).clamp_(*TruncatedNormal.quantiles)
        standard = th.special.ndtri(quantile)
        return th.addcmul(loc, scale, standard).clamp_(-1.0, 1.0), standard
