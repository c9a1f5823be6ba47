"""Distributional DQN, C51 of Bellemare, Dabney and Munos (2017): DQN that learns the distribution of the
return.

    Z(s, a) = z_i with probability p_i(s, a),   z_1, ..., z_n evenly spaced from v_min to v_max
    m_i = sum_j [1 - |[R + gamma z_j] - z_i| / dz]_0^1 p_j(s', a*; theta-)        eq. (7)
    L(theta) = -E[sum_i m_i log p_i(s, a; theta)]

[x] is x within v_min and v_max, and a* has the largest expected return sum_i z_i p_i(s', .). Buffer,
exploration and learning are DQN's.
Letters: A agents, one per seed; B the rest of a batch.
"""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictParams
from torch import Tensor, nn
from torchrl.objectives import LossModule

from uavnav.acting import by_atom, dueling, values_of
from uavnav.algorithms.dqn import DQNConfig, QConfig
from uavnav.errors import ConfigError
from uavnav.settings import AtLeast0, Share, Whole, key
from uavnav.tasks.rewards import bounds_of_returns
from uavnav.training.loop import train

__all__ = ["PRESETS", "C51Config", "C51Loss", "train"]


class C51Config(QConfig):
    """Distributional DQN, which the paper does not have; the defaults are its authors' and CleanRL's."""

    algorithm: ClassVar[str] = "c51"
    PRESETS: ClassVar[dict[str, dict[str, Any]]] = {
        "paper": {},
        "vectorised": {"n_envs": 64},
        "fast": DQNConfig.PRESETS["fast"],
        "rainbow-lite": {"n_envs": 64, "double": True, "dueling": True, "n_steps": 5},
    }

    lr: AtLeast0 = key(2.5e-4)
    adam_eps: AtLeast0 = key(0.01 / 32)
    epsilon_end: Share = key(0.01)
    n_atoms: Whole = key(51, "of the distribution of an action's return", "atoms", ge=2)
    v_min: float | None = key(None, "the least atom; by default the least return within the reward's bounds")
    v_max: float | None = key(
        None, "the greatest atom; by default the greatest return within the reward's bounds"
    )

    def check(self) -> None:
        super().check()
        low, high = self.support
        step = (high - low) / (self.n_atoms - 1)
        ends = torch.tensor([[low, low + step], [high - step, high]])  # as the network has them
        if not ((ends[:, 0] < ends[:, 1]).all() and (ends[1, 1] - ends[0, 0]).isfinite()):
            raise ConfigError(
                f"v_min={low:g}, v_max={high:g}; give a v_min below v_max, both finite and with room for "
                f"{self.n_atoms} atoms in single precision"
            )

    def make_loss(self, network: nn.Module) -> C51Loss:
        return C51Loss(network, self)

    def check_machine(self) -> None:
        super().check_machine()
        named = f"n_atoms={self.n_atoms}, batch_size={self.batch_size}: the projection of a target"
        self.check_memory(named, 4 * self.batch_size * self.n_atoms**2, "fewer atoms or a smaller batch_size")

    @property
    def support(self) -> tuple[float, float]:
        """The least and the greatest atom.

        Raises:
            ConfigError: the reward declares no bounds of returns, and they are not given.
        """
        bounds = bounds_of_returns(self.reward, self.world, self.gamma) or (None, None)
        least = bounds[0] if self.v_min is None else self.v_min
        most = bounds[1] if self.v_max is None else self.v_max
        if least is None or most is None:
            raise ConfigError(
                f"reward={self.reward}, gamma={self.gamma:g}: it declares no bounds of returns; give v_min "
                "and v_max"
            )
        return least, most

    @property
    def head(self) -> str:
        least, most = self.support
        return f"{'dueling-' if self.dueling else ''}distribution {least} {most} {self.n_atoms}"

    @property
    def n_outputs(self) -> int:
        """How many outputs the network has: a logit an action and atom; with `dueling` the state's too."""
        return super().n_outputs * self.n_atoms


PRESETS = {name: C51Config(preset=name) for name in C51Config.PRESETS}


def project(probabilities: Tensor, places: Tensor, atoms: Tensor) -> Tensor:
    """Move probabilities to evenly spaced atoms, each shared by its two neighbours. Eq. (7).

    probabilities and the places where they are [B, n], atoms [n] -> [B, n].
    """
    inside = places.clamp(atoms[0], atoms[-1])
    distance = (inside[..., None, :] - atoms[:, None]).abs() / (atoms[1] - atoms[0])
    return ((1 - distance).clamp(min=0) * probabilities[..., None, :]).sum(-1)


class C51Loss(LossModule):  # type: ignore[misc]
    """The cross-entropy of the projected target and the prediction, one loss a row: batches [A, B] of
    `Replay.read`.

    TorchRL's own DistributionalDQNLoss takes one batch dimension, branches on values and is always double.
    """

    value_network: TensorDictModule
    value_network_params: TensorDictParams
    target_value_network_params: TensorDictParams

    def __init__(self, network: nn.Module, config: C51Config) -> None:
        super().__init__()
        module = TensorDictModule(network, in_keys=["observation"], out_keys=["outputs"])
        self.convert_to_functional(module, "value_network", create_target_params=True)
        self.register_buffer("atoms", torch.linspace(*config.support, config.n_atoms, device=config.device))
        self.config = config

    def forward(self, batch: TensorDictBase) -> TensorDict:
        """Transitions [A, B] -> `loss` [A, B]."""
        predicted = self._of_taken(batch).log_softmax(-1)
        with torch.no_grad():
            following = batch["next"]
            outputs = self._outputs(following, self.target_value_network_params)
            judge = self._outputs(following, self.value_network_params) if self.config.double else outputs
            best = values_of(self.config.head, judge).argmax(-1)
            discount = self.config.discount ** batch.get("steps_to_next_obs", 1) * ~following["terminated"]
            places = following["reward"] + discount * self.atoms
            of_best = _chosen(self._logits(outputs), best[..., None]).squeeze(-2)
            target = project(of_best.softmax(-1), places, self.atoms)
        return TensorDict({"loss": -(target * predicted).sum(-1)})

    def _outputs(self, rows: TensorDictBase, parameters: TensorDictParams) -> Tensor:
        """Of the network with these weights: observations [A, B] -> [A, B, outputs]."""
        with parameters.to_module(self.value_network, preserve_module_state=False):
            outputs: Tensor = self.value_network.module(rows["observation"])
        return outputs

    def _of_taken(self, batch: TensorDictBase) -> Tensor:
        """The logits of the actions taken, [A, B, n].

        The last layer uses only the weights of these actions, so an update costs one wide product, not three.
        """
        with self.value_network_params.to_module(self.value_network, preserve_module_state=False):
            *_, last = network = self.value_network.module
            features: Tensor = network[:-1](batch["observation"])
            weight, bias = (
                _chosen(self._logits(part), batch["action"][:, None]) for part in (last.weight, last.bias)
            )
        return (features[..., None] * weight.transpose(1, 2)).sum(-2) + bias[:, 0]

    def _logits(self, outputs: Tensor) -> Tensor:
        """Of each action and atom: [..., outputs] -> [..., actions, n]; linear, so of weights too."""
        outputs = dueling(outputs, len(self.atoms)) if self.config.dueling else outputs
        return by_atom(outputs, len(self.atoms))


def _chosen(values: Tensor, actions: Tensor) -> Tensor:
    """Those of some actions: [..., actions, n], [..., B] -> [..., B, n]."""
    index = actions[..., None].expand(*values.shape[:-2], -1, values.shape[-1])
    return values.gather(-2, index)
