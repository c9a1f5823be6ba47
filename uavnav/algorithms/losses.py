"""TorchRL's losses as a population in one graph needs them. Only this file overrides private parts of TorchRL.

A test of each algorithm that uses one holds it to the equations, so a TorchRL that changes these parts is noticed.
"""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torch.distributions import Categorical
from torchrl.modules import ProbabilisticActor
from torchrl.objectives import ClipPPOLoss, DiscreteSACLoss


class TraceableClipPPOLoss(ClipPPOLoss):  # type: ignore[misc]
    """TorchRL's own asks whether the entropy is finite, which no graph can be made of, and always clips."""

    @property
    def _clip_bounds(self) -> tuple[Tensor, Tensor]:
        return (-self.clip_epsilon.clamp(max=1)).log1p(), self.clip_epsilon.log1p()

    def _get_entropy(self, dist: Categorical, adv_shape: torch.Size) -> Tensor:
        entropy: Tensor = dist.entropy()[..., None]  # type: ignore[no-untyped-call]
        return entropy


class PopulationSACLoss(DiscreteSACLoss):  # type: ignore[misc]
    """TorchRL's own, with a temperature for each of n_agents, and twins behind the axis of agents; one loss a row.

    TorchRL's one temperature would tie the agents together; it draws the second Q network from the global random state,
    and keeps Q's parameters for the policy's loss as they were at the first call, which a graph would freeze.

    twins: observation [A, N, ...] -> action_value [2, A, N, actions].
    """

    def __init__(
        self, actor: ProbabilisticActor, twins: TensorDictModule, n_agents: int, target_entropy: float
    ) -> None:
        super().__init__(
            actor,
            twins,
            action_space="categorical",
            num_qvalue_nets=None,  # they are two already
            loss_function="l2",
            target_entropy=target_entropy,
            reduction="none",
            scalar_output_mode="exclude",
        )
        self._has_update_associated["qvalue_network"] = True  # the targets follow in the learner
        device = next(twins.parameters()).device
        self.log_alpha = nn.Parameter(torch.zeros(n_agents, 1, device=device))

    def _make_vmap(self) -> None:
        """Q of both networks by parameters that are given, in place of vmap over their copies."""
        module = self.qvalue_network

        def values(batch: TensorDictBase, parameters: TensorDictBase) -> TensorDictBase:
            with parameters.to_module(module, preserve_module_state=False):  # else wrapped anew, which a graph freezes
                found = module.module(batch["observation"])
            return TensorDict({"action_value": found}, found.shape[:-1])

        self._vmap_qnetworkN0 = values

    @property
    def _alpha(self) -> Tensor:
        """[A, 1, 1]."""
        return self.log_alpha.detach().exp()[..., None]

    @property
    def _cached_detached_qvalue_params(self) -> TensorDictBase:
        """Those of this step."""
        return self.qvalue_network_params.detach()
